// What the kernels know of the keyframes: maps by slot, and the settings of the losses.
#pragma once
#include "common.cuh"

#define HUGE_VALUE 1e30f

// Columns of the pointer table; the order of ``ViewTable``.
enum ViewField { EDGE, IMAGE_GRADIENT, PRIOR_DEPTH, CONFIDENCE, PRIOR_NORMAL, GREY, TEXTURE, RENDERED_DEPTH, VIEW_FIELDS };

__device__ __forceinline__ float* view_map(const long long* maps, int slot, ViewField field) {
  return (float*)maps[(size_t)slot * VIEW_FIELDS + field];
}

// Weights are divided by the number of pixels, the distortion's also by the length unit.
struct SingleViewSettings {
  float fx, fy, cx, cy;
  float depth, normal, consistency, distortion, opacity, smoothness, silhouette;
  float min_alpha, relative, normal_epsilon, eta, rewards_edges;
};

// Weights are divided by the number of pixels and scaled by the share of a pair. As they come,
// ``huber`` is in deviations of the reference's noise.
struct PhotoSettings {
  float fx, fy, cx, cy;
  float min_depth_ratio, occlusion;
  float l1, huber, cut;
  float ncc, reject, min_variance, texture, min_coverage, variance_floor;
  float ssim;
};

__device__ __forceinline__ float sign(float x) { return (float)((x > 0.f) - (x < 0.f)); }
__device__ __forceinline__ float finite_or_zero(float x) { return fabsf(x) < HUGE_VALUE ? x : 0.f; }

// The depth where it is visible and no mask excludes it (which makes the prior depth negative), else
// 0; NaN compares false.
__device__ __forceinline__ float shown(float depth, float alpha, float prior, float min_alpha) {
  return depth > 0.f && depth < HUGE_VALUE && alpha > min_alpha && prior >= 0.f ? depth : 0.f;
}

// Adds the sum of ``x`` over the block to ``*total``. All threads of the block take part.
__device__ __forceinline__ void add_block_sum(float x, float* total) {
  __shared__ float part[32];
  const int t = threadIdx.x + blockDim.x * threadIdx.y, warps = (blockDim.x * blockDim.y) >> 5;
  x = warp_sum(x);
  if ((t & 31) == 0) part[t >> 5] = x;
  __syncthreads();
  if (t == 0) {
    for (int i = 1; i < warps; i++) x += part[i];
    if (x != 0.f) atomicAdd(total, x);
  }
}
