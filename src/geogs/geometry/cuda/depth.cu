// Depth averaged over the tangent planes of the pixels around; maps are (h, w).
#include "common.cuh"

// One round. Of each pixel the inverse depth, 0 where there is none, and that times what its plane
// tilts per pixel to the right and down. What the pixels within `radius` say of a pixel counts
// (1 - (e / reach)^2)^2, e its relative distance from `inverse` there.
extern "C" __global__ void average_planes(const float* __restrict__ inverse,
                                          const float* __restrict__ right,
                                          const float* __restrict__ down, int h, int w, int radius,
                                          float reach, float* __restrict__ averaged) {
  const int x = blockIdx.x * blockDim.x + threadIdx.x, y = blockIdx.y * blockDim.y + threadIdx.y;
  if (x >= w || y >= h) return;
  const float own = inverse[y * w + x];
  float top = 0.f, total = 0.f;
  if (own > 0.f) {
    const float before = 1.f / fmaxf(own, 1e-9f);
    for (int v = max(y - radius, 0); v <= min(y + radius, h - 1); v++)
      for (int u = max(x - radius, 0); u <= min(x + radius, w - 1); u++) {
        const int q = v * w + u;
        const float said = inverse[q] + (y - v) * down[q] + (x - u) * right[q];
        const float e = (said * before - 1.f) / reach;
        const float inner = fmaxf(1.f - e * e, 0.f);
        top += inner * inner * said;
        total += inner * inner;
      }
  }
  averaged[y * w + x] = top / fmaxf(total, 1e-9f);
}
