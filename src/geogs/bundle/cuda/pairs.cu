// Directed pairs of keyframes: where cells fall, how far that is, how far it has moved. Poses T are
// 4 x 4 of the frames; source and target are rows. One block per pair.
#include "projection.cuh"

__device__ __forceinline__ Motion pair_motion(const double* T, int source, int target) {
  __shared__ Motion motion;
  if (threadIdx.x == 0) {
    double relative[12];
    relative_motion(T + 16 * target, T + 16 * source, relative);
    for (int k = 0; k < 12; k++) motion.m[k] = (float)relative[k];
  }
  __syncthreads();
  return motion;
}

extern "C" __global__ void __launch_bounds__(256) project_pairs(
    const double* T, const float* inverse_depth, const int* source, const int* target,
    const float* rays, int cells, float fx, float fy, float cx, float cy, float k1, float k2,
    float p1, float p2, float k3, float k4, float k5, float k6, float fisheye, float2* pixels) {
  int i = source[blockIdx.x];
  Motion motion = pair_motion(T, i, target[blockIdx.x]);
  Camera camera = {fx, fy, cx, cy, LENS};
  for (int p = threadIdx.x; p < cells; p += blockDim.x)
    pixels[(size_t)blockIdx.x * cells + p] = pixel_of(camera, project_cell(motion, rays, p, inverse_depth[(size_t)i * cells + p]));
}

// Median distance of the matched cells from where they fell before; NaN where none is matched.
extern "C" __global__ void __launch_bounds__(256) moved_pairs(
    const double* T, const float* inverse_depth, const int* source, const int* target,
    const float* rays, int cells, float fx, float fy, float cx, float cy, float k1, float k2,
    float p1, float p2, float k3, float k4, float k5, float k6, float fisheye, const float2* before,
    const float2* weight, float* median) {
  SHARED_MEMORY(u32, keys);
  int i = source[blockIdx.x];
  Motion motion = pair_motion(T, i, target[blockIdx.x]);
  Camera camera = {fx, fy, cx, cy, LENS};
  for (int p = threadIdx.x; p < cells; p += blockDim.x) {
    size_t at = (size_t)blockIdx.x * cells + p;
    float2 now = pixel_of(camera, project_cell(motion, rays, p, inverse_depth[(size_t)i * cells + p]));
    float x = now.x - before[at].x, y = now.y - before[at].y, moved = sqrtf(x * x + y * y);
    keys[p] = weight[at].x > 0.f && !isnan(moved) ? median_key(moved) : LEFT_OUT;
  }
  float result = block_median(keys, cells);
  if (threadIdx.x == 0) median[blockIdx.x] = result;
}

// DROID-SLAM's distance of a pair over every step-th cell; infinite at little overlap.
extern "C" __global__ void __launch_bounds__(128) pair_distances(
    const double* T, const float* inverse_depth, const int* source, const int* target,
    const float* rays, const float2* grid_pixels, int width, int height, int step, float fx,
    float fy, float cx, float cy, float k1, float k2, float p1, float p2, float k3, float k4,
    float k5, float k6, float fisheye, float right, float bottom, float rotation_weight,
    float* distance) {
  int i = source[blockIdx.x];
  Motion motion = pair_motion(T, i, target[blockIdx.x]), shift = motion;
  for (int k = 0; k < 12; k++)
    if (k % 4 != 3) shift.m[k] = k % 5 == 0 ? 1.f : 0.f;
  Camera camera = {fx, fy, cx, cy, LENS};
  int columns = (width + step - 1) / step, count = columns * ((height + step - 1) / step);
  float flow[2] = {0.f, 0.f}, valid[2] = {0.f, 0.f}, inside = 0.f;
  for (int n = threadIdx.x; n < count; n += blockDim.x) {
    int p = n / columns * step * width + n % columns * step;
    float d = inverse_depth[(size_t)i * width * height + p];
    for (int k = 0; k < 2; k++) {
      Projected at = project_cell(k ? shift : motion, rays, p, d);
      if (!is_shown(camera, at)) continue;
      float2 q = pixel_of(camera, at);
      float x = q.x - grid_pixels[p].x, y = q.y - grid_pixels[p].y;
      flow[k] += sqrtf(x * x + y * y);
      valid[k] += 1.f;
      if (k == 0 && q.x >= 1.f && q.x <= right && q.y >= 1.f && q.y <= bottom) inside += 1.f;
    }
  }
  float share = rotation_weight, rest = 1.f - rotation_weight;
  float total = block_sum(share * flow[0] + rest * flow[1]);
  float seen = share * block_sum(valid[0]) + rest * block_sum(valid[1]);
  inside = block_sum(inside) / count;
  if (threadIdx.x == 0)
    distance[blockIdx.x] = seen > 0.75f * count && inside > 0.2f ? total / fmaxf(seen, 1e-6f) : __int_as_float(0x7f800000);
}
