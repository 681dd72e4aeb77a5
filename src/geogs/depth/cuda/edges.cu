// The test at depth edges: which of the surfaces around a pixel it belongs to, by colour and cost.
#include "common.cuh"

struct EdgeSettings {
  float contrast, apart, width, trust, moved;
};

// Maps (h, w) of inverse depth, its slopes per pixel, confidence; colours (3, h, w).
struct PlaneMaps {
  const float *rho, *slope_x, *slope_y, *sure, *colours;
  int h, w;
};

// A plane of a pixel around, extended to the one that asks: its inverse depth there, and its say.
struct Voice {
  float rho, weight;
};

__device__ __forceinline__ Voice voice_of(
    const PlaneMaps& m, int p, int q, int dx, int dy, float contrast) {
  const int pixels = m.h * m.w;
  const float d0 = m.colours[q] - m.colours[p], d1 = m.colours[pixels + q] - m.colours[pixels + p];
  const float d2 = m.colours[2 * pixels + q] - m.colours[2 * pixels + p];
  const float like = 1.f + contrast * (d0 * d0 + d1 * d1 + d2 * d2);
  return {m.rho[q] - m.slope_x[q] * dx - m.slope_y[q] * dy, m.sure[q] / (like * like)};
}

// Matching cost at an inverse depth, interpolated between planes; at the ends the last one's.
__device__ __forceinline__ float cost_at(
    const float* costs, int per, int planes, float first, float spacing, float rho) {
  const float place = fminf(fmaxf((rho - first) / spacing, 0.f), (float)(planes - 1));
  const int k = max(min((int)place, planes - 2), 0), n = min(k + 1, planes - 1);
  const float a = costs[k % per * 32 + k / per], b = costs[n % per * 32 + n / per];
  return a + (place - k) * (b - a);
}

// Each pixel takes the plane of the best mode of those apart from its own surface, farther (below)
// or nearer (above), if the log ratio of weights and what it costs less speak for it. `costs` are
// (pixels, 32 per) in the slots of volume.cuh.
extern "C" __global__ void resolve_edges(
    const float* rho, const float* slope_x, const float* slope_y, const float* sure,
    const float* colours, const float* costs, const float* settings, int per, int planes,
    float first, float spacing, int reach, int rounds, int h, int w, float* new_rho, float* new_x,
    float* new_y, float* new_sure) {
  const int x = blockIdx.x * blockDim.x + threadIdx.x, y = blockIdx.y * blockDim.y + threadIdx.y;
  if (x >= w || y >= h) return;
  const EdgeSettings s = *(const EdgeSettings*)settings;
  const PlaneMaps m = {rho, slope_x, slope_y, sure, colours, h, w};
  const int p = y * w + x, left = max(-reach, -x), right = min(reach, w - 1 - x);
  const int top = max(-reach, -y), low = min(reach, h - 1 - y);
  const float own = rho[p], far = own * (1.f - s.apart), near = own * (1.f + s.apart);
  const float little = 0.1f, enough = 0.3f;
  float same = 0.f, weights[2] = {0.f, 0.f}, sums[2] = {0.f, 0.f};
  for (int dy = top; dy <= low; dy++)
    for (int dx = left; dx <= right; dx++) {
      const Voice v = voice_of(m, p, p + dy * w + dx, dx, dy, s.contrast);
      if (v.rho > far && v.rho < near) {
        same += v.weight;
      } else if (v.rho > 0.f) {
        const int side = v.rho > far;
        weights[side] += v.weight;
        sums[side] += v.weight * v.rho;
      }
    }
  const float* cost = costs + (long long)p * 32 * per;
  const float here = cost_at(cost, per, planes, first, spacing, own);
  float best = 0.f, taken[4] = {own, slope_x[p], slope_y[p], sure[p]};
  for (int side = 0; side < 2; side++) {
    if (weights[side] < enough) continue;
    // Even with all of that weight and no cost.
    if (__logf((weights[side] + little) / (same + little)) + s.trust * here < best) continue;
    float mode[4] = {sums[side] / weights[side], 0.f, 0.f, 0.f}, weight = 0.f;
    for (int round = 0; round < rounds; round++) {
      const float centre = mode[0], inverse = 1.f / (s.width * centre);
      float sum[4] = {0.f, 0.f, 0.f, 0.f};
      weight = 0.f;
      for (int dy = top; dy <= low; dy++)
        for (int dx = left; dx <= right; dx++) {
          const int q = p + dy * w + dx;
          const Voice v = voice_of(m, p, q, dx, dy, s.contrast);
          if (side ? v.rho < near : v.rho > far || v.rho <= 0.f) continue;
          const float away = (v.rho - centre) * inverse, say = v.weight / (1.f + away * away);
          weight += say;
          sum[0] += say * v.rho;
          sum[1] += say * slope_x[q];
          sum[2] += say * slope_y[q];
          sum[3] += say * sure[q];
        }
      for (int k = 0; k < 4; k++) mode[k] = sum[k] / fmaxf(weight, 1e-12f);
    }
    if (weight < enough) continue;
    const float gain = here - cost_at(cost, per, planes, first, spacing, mode[0]);
    const float score = __logf((weight + little) / (same + little)) + s.trust * gain;
    if (score <= best) continue;
    best = score;
    for (int k = 0; k < 3; k++) taken[k] = mode[k];
    taken[3] = s.moved * mode[3];
  }
  new_rho[p] = taken[0];
  new_x[p] = taken[1];
  new_y[p] = taken[2];
  new_sure[p] = taken[3];
}
