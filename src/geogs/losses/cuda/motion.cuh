// d loss / d relative motion of the pairs, from d loss / d warped image.
#pragma once
#include "warp.cuh"

#define MOTION_ROWS 64

// ``gradient`` (pairs, H, W) is d loss / d warped, ``d_motion`` (pairs, 12) is added to: the 3x4
// matrix from the reference's to the target's frame. The geometry is made again as in warp_pairs.
extern "C" __global__ void __launch_bounds__(256) motion_gradient(
    const int* targets, const float* motions, const long long* maps, const float* settings,
    const float* depth, const float* warped, const float* gradient, double* d_motion, int height,
    int width, int big_height, int big_width, int partners) {
  __shared__ float part[8][12];
  const int pair = blockIdx.z, b = pair / partners, target = targets[pair];
  if (target < 0) return;
  const PhotoSettings c = *(const PhotoSettings*)settings;
  const PixelMotion motion = *(const PixelMotion*)(motions + 12 * pair);
  const float* image = view_map(maps, target, GREY);
  const int x = blockIdx.x * 32 + threadIdx.x, end = min((int)(blockIdx.y + 1) * MOTION_ROWS, big_height);
  depth += (size_t)b * height * width;
  const Source column = source_pixels(x, width, (float)width / big_width);
  const float ratio = (float)height / big_height, rx = ((float)x - c.cx) / c.fx;
  float sums[12];
  for (int k = 0; k < 12; k++) sums[k] = 0.f;
  for (int y = blockIdx.y * MOTION_ROWS + threadIdx.y; y < end && x < big_width; y += 8) {
    const size_t at = ((size_t)pair * big_height + y) * big_width + x;
    const float g = gradient[at];
    if (g == 0.f || !is_seen(warped[at])) continue;
    const float ry = ((float)y - c.cy) / c.fy;
    const float d = enlarged_depth(depth, width, source_pixels(y, height, ratio), column);
    const Landing p = land(motion, (float)x, (float)y, d, big_height, big_width, c);
    if (!(p.z > 0.f)) continue;
    const Sample s = sample_image(image, big_height, big_width, p.u, p.v);
    const float gx = g * c.fx * s.dx / p.z, gy = g * c.fy * s.dy / p.z;
    const float rows[3] = {gx, gy, -gx * (p.u - c.cx) / c.fx - gy * (p.v - c.cy) / c.fy};
#pragma unroll
    for (int k = 0; k < 3; k++) {
      sums[4 * k] += rows[k] * d * rx;
      sums[4 * k + 1] += rows[k] * d * ry;
      sums[4 * k + 2] += rows[k] * d;
      sums[4 * k + 3] += rows[k];
    }
  }
  const int t = threadIdx.y * 32 + threadIdx.x;
#pragma unroll
  for (int k = 0; k < 12; k++) {
    const float sum = warp_sum(sums[k]);
    if (threadIdx.x == 0) part[threadIdx.y][k] = sum;
  }
  __syncthreads();
  if (t >= 12) return;
  double sum = 0.0;
  for (int w = 0; w < 8; w++) sum += (double)part[w][t];
  if (sum != 0.0) atomicAdd(d_motion + 12 * pair + t, sum);
}
