// L_ncc (paper Eq. zncc) over square windows, see tests/oracles/photometric_reference.py.
#pragma once
#include "windows.cuh"

template <int HALF_SIDE>
struct Correlation {
  static const int HALF = HALF_SIDE;
  __device__ static __forceinline__ float weight(int) { return 1.f; }
  __device__ static __forceinline__ float seen_share(u32 bits) { return (float)__popc(bits); }
  // Correlation does not see a constant; near 0 the squares lose fewer digits.
  __device__ static __forceinline__ PixelPair prepared(PixelPair p) {
    return {p.a - 0.5f, p.b - 0.5f, p.seen};
  }
  // Windows that leave the image do not.
  __device__ static __forceinline__ bool counts(int y, int x, int height, int width, bool) {
    return y >= HALF && y < height - HALF && x >= HALF && x < width - HALF;
  }
  __device__ static __forceinline__ float compare(const Moments& m, float texture, const PhotoSettings& c, WindowGradient& g) {
    const float share = 1.f / (float)((2 * HALF + 1) * (2 * HALF + 1));
    const float mean_a = share * m.a, mean_b = share * m.b;
    const float raw_a = fmaxf(share * m.aa - mean_a * mean_a, 0.f);
    const float raw_b = fmaxf(share * m.bb - mean_b * mean_b, 0.f);
    const float variance_b = raw_b + c.variance_floor;
    const float inverse = rsqrtf((raw_a + c.variance_floor) * variance_b);
    const float ncc = (share * m.ab - mean_a * mean_b) * inverse;
    // The shares of seen pixels are multiples of ``share``; the margin absorbs rounding.
    if (!(raw_a > c.min_variance && 1.f - ncc < c.reject && share * m.seen > c.min_coverage - 1e-4f)) return 0.f;
    const float w = c.ncc * share_of(texture, c.texture);
    const float cross = -w * share * inverse, own = raw_b > 0.f ? w * share * ncc / variance_b : 0.f;
    g = {-cross * mean_a - own * mean_b, cross, own};
    return w * (1.f - ncc);
  }
};

extern "C" __global__ void __launch_bounds__(128) correlate_3(
    const int* batch, const int* targets, const long long* maps, const float* deviations,
    const float* settings, const float* warped, float* pull, float* gradient, float* loss, int height, int width,
    int partners, int rows, int flags) {
  compare_windows<Correlation<1>>(batch, targets, maps, deviations, settings, warped, pull, gradient, loss,
                                   height, width, partners, rows, flags);
}
extern "C" __global__ void __launch_bounds__(128, 6) correlate_5(
    const int* batch, const int* targets, const long long* maps, const float* deviations,
    const float* settings, const float* warped, float* pull, float* gradient, float* loss, int height, int width,
    int partners, int rows, int flags) {
  compare_windows<Correlation<2>>(batch, targets, maps, deviations, settings, warped, pull, gradient, loss,
                                   height, width, partners, rows, flags);
}
extern "C" __global__ void __launch_bounds__(128, 5) correlate_7(
    const int* batch, const int* targets, const long long* maps, const float* deviations,
    const float* settings, const float* warped, float* pull, float* gradient, float* loss, int height, int width,
    int partners, int rows, int flags) {
  compare_windows<Correlation<3>>(batch, targets, maps, deviations, settings, warped, pull, gradient, loss,
                                   height, width, partners, rows, flags);
}
extern "C" __global__ void __launch_bounds__(128) correlate_9(
    const int* batch, const int* targets, const long long* maps, const float* deviations,
    const float* settings, const float* warped, float* pull, float* gradient, float* loss, int height, int width,
    int partners, int rows, int flags) {
  compare_windows<Correlation<4>>(batch, targets, maps, deviations, settings, warped, pull, gradient, loss,
                                   height, width, partners, rows, flags);
}
extern "C" __global__ void __launch_bounds__(128) correlate_11(
    const int* batch, const int* targets, const long long* maps, const float* deviations,
    const float* settings, const float* warped, float* pull, float* gradient, float* loss, int height, int width,
    int partners, int rows, int flags) {
  compare_windows<Correlation<5>>(batch, targets, maps, deviations, settings, warped, pull, gradient, loss,
                                   height, width, partners, rows, flags);
}
extern "C" __global__ void __launch_bounds__(128) correlate_13(
    const int* batch, const int* targets, const long long* maps, const float* deviations,
    const float* settings, const float* warped, float* pull, float* gradient, float* loss, int height, int width,
    int partners, int rows, int flags) {
  compare_windows<Correlation<6>>(batch, targets, maps, deviations, settings, warped, pull, gradient, loss,
                                   height, width, partners, rows, flags);
}
extern "C" __global__ void __launch_bounds__(128) correlate_15(
    const int* batch, const int* targets, const long long* maps, const float* deviations,
    const float* settings, const float* warped, float* pull, float* gradient, float* loss, int height, int width,
    int partners, int rows, int flags) {
  compare_windows<Correlation<7>>(batch, targets, maps, deviations, settings, warped, pull, gradient, loss,
                                   height, width, partners, rows, flags);
}
