// 1 / median of the visible depths of each view, which makes the smoothness term unitless.
#pragma once
#include "view_maps.cuh"

// One block per view. The bits of positive floats order like the floats, so the median is found by
// its digits: four histograms of 8 bits, from the highest. The lower median, as torch's.
// depth, alpha (B, pixels) -> inverse_median (B), 0 without any visible depth.
extern "C" __global__ void __launch_bounds__(1024) inverse_median(
    const int* batch, const long long* maps, const float* depth, const float* alpha, float* inverse_median, int pixels,
    float min_alpha) {
  __shared__ u32 histogram[256];
  __shared__ u32 prefix, rank;
  const int b = blockIdx.x, t = threadIdx.x;
  if (batch[b] < 0) return;
  const float* prior = view_map(maps, batch[b], PRIOR_DEPTH);
  depth += (size_t)b * pixels;
  alpha += (size_t)b * pixels;
  u32 found = 0, below = 0;
  for (int shift = 24; shift >= 0; shift -= 8) {
    if (t < 256) histogram[t] = 0;
    __syncthreads();
    for (int i = t; i < pixels; i += blockDim.x) {
      const u32 bits = __float_as_uint(shown(depth[i], alpha[i], prior[i], min_alpha));
      const bool same = shift == 24 || (bits >> (shift + 8)) == found;
      if (bits != 0 && same) atomicAdd(&histogram[(bits >> shift) & 255], 1u);
    }
    __syncthreads();
    if (t == 0) {
      u32 count = 0;
      for (int i = 0; i < 256; i++) count += histogram[i];
      u32 wanted = shift == 24 ? (count ? (count - 1) / 2 : 0) : below, digit = 0;
      while (digit < 255 && wanted >= histogram[digit]) wanted -= histogram[digit++];
      prefix = count ? (found << 8) | digit : 0;
      rank = wanted;
    }
    __syncthreads();
    found = prefix;
    below = rank;
  }
  if (t == 0) inverse_median[b] = found ? 1.f / __uint_as_float(found) : 0.f;
}
