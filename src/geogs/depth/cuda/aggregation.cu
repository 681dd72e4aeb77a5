// Plane sweep: semi-global aggregation of matching costs, and the winner.
#include "common.cuh"
#include "volume.cuh"

__device__ __forceinline__ float warp_least(float x) {
  for (int s = 16; s; s >>= 1) x = fminf(x, __shfl_xor_sync(ALL_LANES, x, s));
  return x;
}

struct Path { int x, y, dx, dy, length; };

// Steps that stay in [0, size) from `start` on, the first included.
__device__ __forceinline__ int steps_within(int start, int step, int size) {
  return step == 0 ? 1 << 30 : (step > 0 ? size - start : start + 1);
}

// Path number `index` of a direction; its length is 0 where there is none.
__device__ __forceinline__ Path find_path(int direction, int index, int h, int w) {
  // Steps (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1).
  const int dx = direction < 2 ? 1 - 2 * direction
               : direction < 4 ? 0 : (direction == 4 || direction == 6 ? 1 : -1);
  const int dy = direction < 2 ? 0
               : direction < 4 ? 5 - 2 * direction : (direction == 4 || direction == 7 ? 1 : -1);
  const int first_x = dx > 0 ? 0 : w - 1, first_y = dy > 0 ? 0 : h - 1;
  Path p = {0, 0, dx, dy, 0};
  int count = dy == 0 ? h : (dx == 0 ? w : w + h - 1);
  if (index >= count) return p;
  if (dy == 0) {
    p.x = first_x;
    p.y = index;
  } else if (index < w) {
    p.x = index;
    p.y = first_y;
  } else {
    p.x = first_x;
    p.y = first_y + dy * (index - w + 1);
  }
  p.length = min(steps_within(p.x, dx, w), steps_within(p.y, dy, h));
  return p;
}

template <int PER>
__device__ void follow_path(
    const float* volume, const float* guide, Path path, int w, float small, float large,
    float edge, float* out) {
  const int lane = threadIdx.x, slots = 32 * PER;
  int pixel = path.y * w + path.x;
  const int step = path.dy * w + path.dx;
  float previous[PER], cost[PER];
  float grey = guide[pixel];
#pragma unroll
  for (int i = 0; i < PER; i++) cost[i] = volume[(long long)pixel * slots + 32 * i + lane];
#pragma unroll
  for (int i = 0; i < PER; i++) {
    previous[i] = cost[i];
    out[(long long)pixel * slots + 32 * i + lane] = cost[i];
  }
  // Costs are loaded one pixel ahead, so that memory is not waited for.
  float ahead_grey = 0.f, ahead[PER];
  if (path.length > 1) {
    ahead_grey = guide[pixel + step];
#pragma unroll
    for (int i = 0; i < PER; i++)
      ahead[i] = volume[(long long)(pixel + step) * slots + 32 * i + lane];
  }
  for (int n = 1; n < path.length; n++) {
    pixel += step;
    const float jump = fmaxf(1.5f * small, large / (1.f + edge * fabsf(ahead_grey - grey)));
    grey = ahead_grey;
#pragma unroll
    for (int i = 0; i < PER; i++) cost[i] = ahead[i];
    if (n + 1 < path.length) {
      ahead_grey = guide[pixel + step];
#pragma unroll
      for (int i = 0; i < PER; i++)
        ahead[i] = volume[(long long)(pixel + step) * slots + 32 * i + lane];
    }
    float low = previous[0];
#pragma unroll
    for (int i = 1; i < PER; i++) low = fminf(low, previous[i]);
    low = warp_least(low);
    float below = __shfl_up_sync(ALL_LANES, previous[PER - 1], 1);
    const float above = __shfl_down_sync(ALL_LANES, previous[0], 1);
    if (lane == 0) below = FAR;
    const float top = low + jump;
#pragma unroll
    for (int i = 0; i < PER; i++) {
      const float next = i + 1 < PER ? previous[i + 1 < PER ? i + 1 : i] : (lane < 31 ? above : FAR);
      const float own = previous[i], near = fminf(below, next) + small;
      previous[i] = cost[i] + fminf(fminf(own, top), near) - low;
      below = own;
      out[(long long)pixel * slots + 32 * i + lane] = previous[i];
    }
  }
}

// Path costs of Hirschmueller's Eq. 13 (without the constant) in eight directions:
// paths[direction, pixel, slot]. A jump of more than one plane costs
// max(1.5 small, large / (1 + edge |dI|)) with the grey `guide`. One warp per path; grid.y = 8.
extern "C" __global__ void follow_paths(
    const float* volume, const float* guide, int per, int h, int w, float small, float large,
    float edge, float* paths) {
  const Path path = find_path(blockIdx.y, blockIdx.x * blockDim.y + threadIdx.y, h, w);
  if (path.length == 0) return;
  float* out = paths + (long long)blockIdx.y * h * w * 32 * per;
  switch (per) {
    case 1: follow_path<1>(volume, guide, path, w, small, large, edge, out); break;
    case 3: follow_path<3>(volume, guide, path, w, small, large, edge, out); break;
    case 4: follow_path<4>(volume, guide, path, w, small, large, edge, out); break;
    case 5: follow_path<5>(volume, guide, path, w, small, large, edge, out); break;
    default: follow_path<8>(volume, guide, path, w, small, large, edge, out);
  }
}

// A warp's value at plane k, in every lane.
template <int PER>
__device__ __forceinline__ float at_plane(const float (&t)[PER], int k) {
  float value = t[0];
#pragma unroll
  for (int i = 1; i < PER; i++)
    if (i == k % PER) value = t[i];
  return __shfl_sync(ALL_LANES, value, k / PER);
}

template <int PER>
__device__ void pick_pixel(
    const float* paths, const float* volume, long long pixel, long long pixels, int planes,
    float first, float spacing, float* inverse_depth, float* cost, float* margin) {
  const int lane = threadIdx.x, slots = 32 * PER;
  float t[PER];
#pragma unroll
  for (int i = 0; i < PER; i++) {
    t[i] = 0.f;
#pragma unroll
    for (int d = 0; d < 8; d++) t[i] += paths[(d * pixels + pixel) * slots + 32 * i + lane];
  }
  float low = t[0];
  int best = lane * PER;
#pragma unroll
  for (int i = 1; i < PER; i++)
    if (t[i] < low) {
      low = t[i];
      best = lane * PER + i;
    }
  for (int s = 16; s; s >>= 1) {
    const float other = __shfl_xor_sync(ALL_LANES, low, s);
    const int plane = __shfl_xor_sync(ALL_LANES, best, s);
    if (other < low || (other == low && plane < best)) {
      low = other;
      best = plane;
    }
  }
  float second = FAR;
#pragma unroll
  for (int i = 0; i < PER; i++)
    if (abs(lane * PER + i - best) > 2) second = fminf(second, t[i]);
  second = warp_least(second);
  const float before = at_plane(t, max(best - 1, 0)), after = at_plane(t, min(best + 1, slots - 1));
  if (lane != 0) return;
  float shift = 0.f;
  const float curvature = before + after - 2.f * low;
  if (best > 0 && best < planes - 1 && curvature > 1e-6f)
    shift = (before - after) / (2.f * curvature);
  inverse_depth[pixel] = first + (best + shift) * spacing;
  cost[pixel] = volume[pixel * slots + (best % PER) * 32 + best / PER];
  margin[pixel] = second - low;
}

// Winner of the summed path costs: inverse depth at its parabola's vertex, matching cost, and the
// smallest summed cost more than two planes away less the winner's. One warp per pixel.
extern "C" __global__ void pick_planes(
    const float* paths, const float* volume, int per, int pixels, int planes, float first,
    float spacing, float* inverse_depth, float* cost, float* margin) {
  const int pixel = blockIdx.x * blockDim.y + threadIdx.y;
  if (pixel >= pixels) return;
#define PICK(PER) \
  pick_pixel<PER>(paths, volume, pixel, pixels, planes, first, spacing, inverse_depth, cost, margin)
  switch (per) {
    case 1: PICK(1); break;
    case 3: PICK(3); break;
    case 4: PICK(4); break;
    case 5: PICK(5); break;
    default: PICK(8);
  }
#undef PICK
}
