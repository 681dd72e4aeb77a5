// The farther surface beside each pixel, its plane gone on from pixel to pixel.
#include "common.cuh"

// One round: each pixel without a plane takes that of the first of its eight neighbours that got
// one in the round before (in the first, has a depth of its own), if the plane lies behind the
// pixel's own surface, below `near_share` of its inverse depth, and not behind all that was found.
// planes (3, h, w): inverse depth and its slopes per pixel; found (3, h, w) and age (h, w) are zero
// before the first round, and age is the round in which a pixel got its plane.
extern "C" __global__ void farther_planes(
    const float* planes, const float* farthest, float near_share, int round, int h, int w,
    float* found, int* age) {
  const int x = blockIdx.x * blockDim.x + threadIdx.x, y = blockIdx.y * blockDim.y + threadIdx.y;
  if (x >= w || y >= h) return;
  const int pixels = h * w, p = y * w + x;
  if (age[p]) return;
  const float most = near_share * planes[p];
  const float* source = round == 1 ? planes : found;
  for (int step = 0; step < 9; step++) {
    const int dy = step / 3 - 1, dx = step % 3 - 1, v = y + dy, u = x + dx, q = v * w + u;
    if (step == 4 || v < 0 || u < 0 || v >= h || u >= w) continue;
    if (round > 1 ? age[q] != round - 1 : planes[q] <= 0.f) continue;
    const float slope_x = source[pixels + q], slope_y = source[2 * pixels + q];
    const float here = source[q] - dx * slope_x - dy * slope_y;
    if (here < *farthest || here >= most) continue;
    found[p] = here;
    found[pixels + p] = slope_x;
    found[2 * pixels + p] = slope_y;
    age[p] = round;
    return;
  }
}
