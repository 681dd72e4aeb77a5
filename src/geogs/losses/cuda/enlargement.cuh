// The bilinear enlargement of depth maps to the photometric size, and its adjoint.
#pragma once
#include "view_maps.cuh"

// The two source pixels of a pixel along one axis, and the share of the far one.
struct Source { int near_, far_; float share; };

// A source pixel with less share is not looked at, so that its missing depth does not matter.
#define LEAST_SHARE 1e-3f

// Where a pixel of the enlarged image lies in the source; pixel centres at integers. ``ratio`` is
// the source's size over the enlarged one.
__device__ __forceinline__ float source_position(int i, int size, float ratio) {
  return fminf(fmaxf(fmaf((float)i + 0.5f, ratio, -0.5f), 0.f), (float)(size - 1));
}

__device__ __forceinline__ Source source_pixels(int i, int size, float ratio) {
  const float at = source_position(i, size, ratio);
  const int left = (int)at;
  const float share = at - (float)left;
  const int right = share > LEAST_SHARE ? left + 1 : left;
  return {share < 1.f - LEAST_SHARE ? left : right, right, share};
}

// Depth between its source pixels, 0 where one of them is unknown (0).
__device__ __forceinline__ float enlarged_depth(const float* depth, int width, Source row, Source column) {
  const float* upper = depth + (size_t)row.near_ * width;
  const float* lower = depth + (size_t)row.far_ * width;
  const float p = upper[column.near_], q = upper[column.far_], r = lower[column.near_], s = lower[column.far_];
  if (!(p > 0.f && q > 0.f && r > 0.f && s > 0.f)) return 0.f;
  const float a = p + (q - p) * column.share, b = r + (s - r) * column.share;
  return a + (b - a) * row.share;
}

// The enlarged pixels along one axis that look at source pixel ``i``: first and last.
struct Span { int first, last; };
__device__ __forceinline__ Span reading_pixels(int i, int big_size, float inverse_ratio) {
  const float low = ((float)i - 0.5f) * inverse_ratio - 0.5f, high = ((float)i + 1.5f) * inverse_ratio - 0.5f;
  return {max((int)ceilf(low - 1e-3f), 0), min((int)floorf(high + 1e-3f), big_size - 1)};
}

// The share that source pixel ``i`` has in the enlarged pixel ``reader``.
__device__ __forceinline__ float share_in(int i, int reader, int size, float ratio) {
  const float share = 1.f - fabsf(source_position(reader, size, ratio) - (float)i);
  return share > LEAST_SHARE ? (share < 1.f - LEAST_SHARE ? share : 1.f) : 0.f;
}

// Adds d loss / d enlarged depth of every pair (B, P, H, W) to d loss / d depth (B, h, w).
extern "C" __global__ void __launch_bounds__(256) gather_depth_gradient(
    const int* targets, const float* pull, float* d_depth, int height, int width, int big_height,
    int big_width, int partners) {
  const int x = blockIdx.x * 32 + threadIdx.x, y = blockIdx.y * 8 + threadIdx.y, b = blockIdx.z;
  if (x >= width || y >= height) return;
  const float ratio_x = (float)width / big_width, ratio_y = (float)height / big_height;
  const Span rows = reading_pixels(y, big_height, (float)big_height / height);
  const Span columns = reading_pixels(x, big_width, (float)big_width / width);
  const size_t plane = (size_t)big_height * big_width;
  float sum = 0.f;
  for (int p = 0; p < partners; p++) {
    const int pair = b * partners + p;
    if (targets[pair] < 0) continue;
    for (int v = rows.first; v <= rows.last; v++) {
      const float* line = pull + pair * plane + (size_t)v * big_width;
      float along = 0.f;
      for (int u = columns.first; u <= columns.last; u++)
        along += share_in(x, u, width, ratio_x) * line[u];
      sum += share_in(y, v, height, ratio_y) * along;
    }
  }
  if (sum != 0.f) d_depth[((size_t)b * height + y) * width + x] += sum;
}
