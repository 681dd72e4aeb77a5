// The line through the grey values of one view and those of another, see light.py.
#include "common.cuh"

// One block. Of a round, the weights at the line of the round before, then the line through what
// they leave. usable (n) is 0 or 1; light gets gain and offset.
extern "C" __global__ void __launch_bounds__(1024) fit_light(
    const float* __restrict__ grey, const float* __restrict__ other,
    const bool* __restrict__ usable, int n, int rounds, float scale, float plain, float fewest,
    float largest_gain, float* __restrict__ light) {
  float gain = 1.f, mean_x = 0.f, mean_y = 0.f, wide = 0.f, left = 0.f;
  for (int round = 0; round <= rounds; round++) {
    // Of pixels at a distance from the line, which none has in the first round.
    const float across = wide > 0.f ? 1.f / (wide * wide * (1.f + gain * gain)) : 0.f;
    const float x0 = mean_x, y0 = mean_y, slope = gain;
    float w = 0.f, x = 0.f, y = 0.f;
    for (int i = threadIdx.x; i < n; i += blockDim.x) {
      if (!usable[i]) continue;
      const float r = other[i] - y0 - slope * (grey[i] - x0), weight = 1.f / (1.f + r * r * across);
      w += weight;
      x += weight * grey[i];
      y += weight * other[i];
    }
    left = block_sum(w);
    if (round == rounds) break;  // only what is left counts after the last
    const float total = fmaxf(left, 1e-12f);
    mean_x = block_sum(x) / total;
    mean_y = block_sum(y) / total;
    float xx = 0.f, yy = 0.f, xy = 0.f;
    for (int i = threadIdx.x; i < n; i += blockDim.x) {
      if (!usable[i]) continue;
      const float r = other[i] - y0 - slope * (grey[i] - x0), weight = 1.f / (1.f + r * r * across);
      const float dx = grey[i] - mean_x, dy = other[i] - mean_y;
      xx += weight * dx * dx;
      yy += weight * dy * dy;
      xy += weight * dx * dy;
    }
    xx = block_sum(xx) / total + plain * plain;
    yy = block_sum(yy) / total + plain * plain;
    xy = block_sum(xy) / total + plain * plain;
    const float apart = yy - xx;
    gain = (apart + sqrtf(apart * apart + 4.f * xy * xy)) / (2.f * fmaxf(xy, 1e-9f));
    gain = fminf(fmaxf(gain, 1.f / largest_gain), largest_gain);
    wide = scale * fmaxf(1.f, 4.f * (1.f - round / (0.5f * rounds)));
  }
  if (threadIdx.x) return;
  light[0] = left > fewest ? gain : 1.f;
  light[1] = left > fewest ? mean_y - gain * mean_x : 0.f;
}
