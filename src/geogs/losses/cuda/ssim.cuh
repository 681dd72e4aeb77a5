// L_ssim (paper Eq. ssim) over Gaussian windows, see tests/oracles/photometric_reference.py.
#pragma once
#include "windows.cuh"

struct Structure {
  static const int HALF = 5;
  // exp(-d^2 / (2 1.5^2)) over the sum of all eleven.
  __device__ static __forceinline__ float weight(int k) {
    const int d = k < HALF ? HALF - k : k - HALF;
    return d == 0 ? 0.266011724f : d == 1 ? 0.213005337f : d == 2 ? 0.109360690f : d == 3 ? 0.0360007721f
         : d == 4 ? 0.00759875815f : 0.00102838012f;
  }
  __device__ static __forceinline__ float seen_share(u32 bits) {
    float sum = 0.f;
#pragma unroll
    for (int k = 0; k < 2 * HALF + 1; k++) sum += (bits >> k) & 1u ? weight(k) : 0.f;
    return sum;
  }
  __device__ static __forceinline__ PixelPair prepared(PixelPair p) {
    return p.seen ? p : PixelPair{0.f, 0.f, false};
  }
  __device__ static __forceinline__ bool counts(int y, int x, int height, int width, bool seen) {
    return seen && y >= 0 && y < height && x >= 0 && x < width;
  }
  __device__ static __forceinline__ float compare(const Moments& m, float, const PhotoSettings& c, WindowGradient& g) {
    const float share = fmaxf(m.seen, 1e-6f), inverse = 1.f / share, c1 = 0.01f * 0.01f, c2 = 0.03f * 0.03f;
    if (!(share >= c.min_coverage)) return 0.f;
    const float mean_a = m.a * inverse, mean_b = m.b * inverse;
    const float variances = (m.aa + m.bb) * inverse - mean_a * mean_a - mean_b * mean_b;
    const float covariance = m.ab * inverse - mean_a * mean_b;
    const float brightness = mean_a * mean_a + mean_b * mean_b + c1, spread = variances + c2;
    const float luminance = (2.f * mean_a * mean_b + c1) / brightness;
    const float structure = (2.f * covariance + c2) / spread;
    // Minus d(luminance * structure), divided by the share as the means are.
    const float w = c.ssim * inverse;
    g.to_a = -2.f * w * luminance / spread;
    g.to_b = 2.f * w * luminance * structure / spread;
    g.constant = -2.f * w * structure * (mean_a - mean_b * luminance) / brightness -
                 g.to_a * mean_a - g.to_b * mean_b;
    return c.ssim * (1.f - luminance * structure);
  }
};

extern "C" __global__ void __launch_bounds__(128) compare_structure(
    const int* batch, const int* targets, const long long* maps, const float* deviations,
    const float* settings, const float* warped, float* pull, float* gradient, float* loss, int height, int width,
    int partners, int rows, int flags) {
  compare_windows<Structure>(batch, targets, maps, deviations, settings, warped, pull, gradient, loss,
                             height, width, partners, rows, flags);
}
