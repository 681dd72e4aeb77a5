// Dense inverse search (Kroeger et al. 2016): small patches of the first image are found in the
// second, each for itself, and their motions are averaged to a dense flow.
#include "flow.cuh"

#define PATCH 8         // edge of a patch, pixels; also the lanes that share one
#define PATCH_STRIDE 4  // between patches, pixels
#define DAMPING 1.f     // added to the Hessian's diagonal, grey levels^2: without texture, stay

__device__ __forceinline__ int patches_along(int size) {
  return (max(size - PATCH, 0) + PATCH_STRIDE - 1) / PATCH_STRIDE + 1;
}
// First pixel of a patch; the last one ends at the border.
__device__ __forceinline__ int patch_origin(int index, int size) {
  return min(index * PATCH_STRIDE, size - PATCH);
}

__device__ __forceinline__ float patch_sum(float x) {
  for (int s = PATCH / 2; s; s >>= 1) x += __shfl_xor_sync(ALL_LANES, x, s);
  return x;
}

// One column of a patch of the first image with its gradient.
struct Column {
  float value[PATCH], gx[PATCH], gy[PATCH];
};

__device__ __forceinline__ Column load_column(const float* image, Level size, int x, int y) {
  Column c;
  int left = max(x - 1, 0), right = min(x + 1, size.width - 1);
  float above = image[max(y - 1, 0) * size.width + x];
#pragma unroll
  for (int j = 0; j < PATCH; j++) {
    const float* row = image + (y + j) * size.width;
    c.value[j] = row[x];
    c.gx[j] = 0.5f * (row[right] - row[left]);
    c.gy[j] = -0.5f * above;
    above = row[x];
    if (j) c.gy[j - 1] += 0.5f * row[x];
  }
  c.gy[PATCH - 1] += 0.5f * image[min(y + PATCH, size.height - 1) * size.width + x];
  return c;
}

// Mean-free squared difference of the patch moved by (u, v), and its gradient sums.
struct Fit {
  float cost, bx, by;
};

__device__ __forceinline__ Fit evaluate(const Column& c, const float* target, Level size, int x, int y, float u, float v, float sum_gx, float sum_gy) {
  Linear h = linear_at(x + u, size.width);
  float s = 0.f, ss = 0.f, bx = 0.f, by = 0.f;
  float fy = floorf(v), share = v - fy;
  int top = y + (int)fy;
  const float* row = target + clampi(top, 0, size.height - 1) * size.width;
  float above = row[h.i] + h.share * (row[h.next] - row[h.i]);
#pragma unroll
  for (int j = 0; j < PATCH; j++) {
    row = target + clampi(top + j + 1, 0, size.height - 1) * size.width;
    float below = row[h.i] + h.share * (row[h.next] - row[h.i]);
    float r = above + share * (below - above) - c.value[j];
    above = below;
    s += r;
    ss += r * r;
    bx += c.gx[j] * r;
    by += c.gy[j] * r;
  }
  const float each = 1.f / (PATCH * PATCH);
  s = patch_sum(s);
  return {patch_sum(ss) - s * s * each, patch_sum(bx) - sum_gx * s * each, patch_sum(by) - sum_gy * s * each};
}

// Motion of each patch by inverse-compositional Gauss-Newton steps (eq. 2-4 of the paper); the best
// of all steps is kept. The start is the coarser level's flow or, where there are results of an
// earlier pass, the best of the patch's own and those of its neighbours `reach` patches away.
// Eight lanes a patch.
extern "C" __global__ void __launch_bounds__(256) flow_search(const long long* images, const float* warped, const float2* coarse, const float2* earlier, float2* patches, int stride, int width, int height, int level, int reach, int iterations) {
  Level size = pyramid_level(width, height, level);
  int across = patches_along(size.width), count = across * patches_along(size.height);
  int index = (blockIdx.x * blockDim.x + threadIdx.x) / PATCH, lane = threadIdx.x % PATCH, d = blockIdx.y;
  int patch = min(index, count - 1);
  int x0 = patch_origin(patch % across, size.width), y = patch_origin(patch / across, size.height);
  const float* image = source_image(images, d) + size.offset;
  const float* target = warped + (long long)d * stride + size.offset;

  int x = x0 + lane;
  Column c = load_column(image, size, x, y);
  float sx = 0.f, sy = 0.f, xx = 0.f, xy = 0.f, yy = 0.f;
#pragma unroll
  for (int j = 0; j < PATCH; j++) {
    sx += c.gx[j];
    sy += c.gy[j];
    xx += c.gx[j] * c.gx[j];
    xy += c.gx[j] * c.gy[j];
    yy += c.gy[j] * c.gy[j];
  }
  const float each = 1.f / (PATCH * PATCH);
  sx = patch_sum(sx);
  sy = patch_sum(sy);
  xx = patch_sum(xx) - sx * sx * each + DAMPING;
  xy = patch_sum(xy) - sx * sy * each;
  yy = patch_sum(yy) - sy * sy * each + DAMPING;
  float inverse = 1.f / (xx * yy - xy * xy);

  float2 start = make_float2(0.f, 0.f);
  if (coarse) {
    int w = (size.width + 1) / 2, h = (size.height + 1) / 2;
    // The centre of the patch in pixels of the coarser level.
    start = sample(coarse + (long long)d * w * h, w, h, 0.5f * (x0 + 0.5f * (PATCH - 1)) - 0.25f, 0.5f * (y + 0.5f * (PATCH - 1)) - 0.25f);
    start = make_float2(2.f * start.x, 2.f * start.y);
  }
  if (earlier) {
    int i = patch % across, j = patch / across, down = count / across;
    float least = 3.4e38f;
    for (int k = 0; k < 5; k++) {
      int column = clampi(i + (k == 1 ? -reach : k == 2 ? reach : 0), 0, across - 1);
      int row = clampi(j + (k == 3 ? -reach : k == 4 ? reach : 0), 0, down - 1);
      float2 f = earlier[(long long)d * count + row * across + column];
      float cost = evaluate(c, target, size, x, y, f.x, f.y, sx, sy).cost;
      if (cost < least) {
        least = cost;
        start = f;
      }
    }
  }
  float u = start.x, v = start.y, least = 3.4e38f;
  float2 best = start;
  for (int k = 0; k <= iterations; k++) {
    Fit fit = evaluate(c, target, size, x, y, u, v, sx, sy);
    bool near = fabsf(u - start.x) < PATCH && fabsf(v - start.y) < PATCH;
    if (fit.cost < least && near) {
      least = fit.cost;
      best = make_float2(u, v);
    }
    u -= inverse * (yy * fit.bx - xy * fit.by);
    v -= inverse * (xx * fit.by - xy * fit.bx);
    // A patch that flies off must not overflow an index.
    u = clampf(u, start.x - 2 * PATCH, start.x + 2 * PATCH);
    v = clampf(v, start.y - 2 * PATCH, start.y + 2 * PATCH);
  }
  if (lane == 0 && index < count) patches[(long long)d * count + index] = best;
}

// Dense flow: the mean of the motions of the patches over a pixel, weighted by how well each
// explains that pixel (eq. 6 of the paper).
extern "C" __global__ void flow_densify(const long long* images, const float* warped, const float2* patches, float2* flow, int stride, int width, int height, int level) {
  Level size = pyramid_level(width, height, level);
  int x = blockIdx.x * blockDim.x + threadIdx.x, y = blockIdx.y * blockDim.y + threadIdx.y, d = blockIdx.z;
  if (x >= size.width || y >= size.height) return;
  int across = patches_along(size.width), down = patches_along(size.height);
  const float2* motion = patches + (long long)d * across * down;
  const float* target = warped + (long long)d * stride + size.offset;
  float value = source_image(images, d)[size.offset + y * size.width + x];
  int last_x = x >= size.width - PATCH ? across - 1 : min(x / PATCH_STRIDE, across - 1);
  int last_y = y >= size.height - PATCH ? down - 1 : min(y / PATCH_STRIDE, down - 1);
  int first_x = max(x - PATCH + PATCH_STRIDE, 0) / PATCH_STRIDE, first_y = max(y - PATCH + PATCH_STRIDE, 0) / PATCH_STRIDE;
  float total = 0.f, sum_x = 0.f, sum_y = 0.f;
  for (int j = first_y; j <= last_y; j++)
    for (int i = first_x; i <= last_x; i++) {
      float2 f = motion[j * across + i];
      float r = sample(target, size.width, size.height, x + f.x, y + f.y) - value;
      float w = 1.f / fmaxf(fabsf(r), 1.f);
      total += w;
      sum_x += w * f.x;
      sum_y += w * f.y;
    }
  flow[((long long)d * size.height + y) * size.width + x] = make_float2(sum_x / total, sum_y / total);
}
