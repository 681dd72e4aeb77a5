// L_ds (paper Eq. depth_smoothness): forward differences of depth against those of the image.
#pragma once
#include "view_maps.cuh"

struct Smoothness {
  float loss;
  float across, down;  // d/dD of the right and of the lower neighbour
};

// At a pixel of depth ``d`` with its right and lower neighbours; ``scale`` is 1 / median depth.
__device__ __forceinline__ Smoothness depth_smoothness(
    float d, float right, float below, float contrast, float scale, const SingleViewSettings& c) {
  if (!(d > 0.f && right > 0.f && below > 0.f)) return {0.f, 0.f, 0.f};
  const float across = right - d, down = below - d, step = scale * (fabsf(across) + fabsf(down));
  const float keep = __expf(-c.eta * contrast);
  const float reward = c.rewards_edges * contrast * __expf(-c.eta * step);
  const float slope = c.smoothness * scale * (keep - c.eta * reward);
  return {c.smoothness * (step * keep + reward), slope * sign(across), slope * sign(down)};
}
