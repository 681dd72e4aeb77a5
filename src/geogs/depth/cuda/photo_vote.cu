// What the images say of two depths of each pixel: costs of single pixels, and their means by colour.
#include "common.cuh"
#include "sampling.cuh"

#define MAX_NEIGHBOURS 16

// Grey value of each of n neighbours where it sees a pixel at one of two depths, less the pixel's
// own; NaN where it sees it not. T (n, 12): pose of the reference in the neighbour's frame, row by
// row; lens: fx, fy, cx, cy.
extern "C" __global__ void grey_differences(
    const float* reference, const float* images, const float* T, const float* lens,
    const float* depths, int n, int h, int w, float* differences) {
  const int x = blockIdx.x * blockDim.x + threadIdx.x, y = blockIdx.y * blockDim.y + threadIdx.y;
  if (x >= w || y >= h) return;
  const int pixels = h * w, p = y * w + x, which = blockIdx.z / n, k = blockIdx.z % n;
  const float depth = depths[which * pixels + p];
  const float px = depth * (x - lens[2]) / lens[0], py = depth * (y - lens[3]) / lens[1];
  const float* t = T + 12 * k;
  const float z = t[8] * px + t[9] * py + t[10] * depth + t[11], inverse = 1.f / fmaxf(z, 1e-9f);
  const float u = lens[0] * (t[0] * px + t[1] * py + t[2] * depth + t[3]) * inverse + lens[2];
  const float v = lens[1] * (t[4] * px + t[5] * py + t[6] * depth + t[7]) * inverse + lens[3];
  const bool inside = depth > 0.f && z > 0.f && u >= 0.f && v >= 0.f && u <= w - 1 && v <= h - 1;
  float found = nanf("");
  if (inside) found = bilinear_repeated(images + k * pixels, w, h, u, v) - reference[p];
  differences[(which * n + k) * pixels + p] = found;
}

// Mean of the lower half, rounded up, of what a pixel costs by those neighbours that see it; 1 if
// none does. `light` and `most` (n): what is taken off a difference, and what counts as 1.
extern "C" __global__ void pixel_costs(
    const float* differences, const float* light, const float* most, int n, int pixels,
    float* costs) {
  const int p = blockIdx.x * blockDim.x + threadIdx.x, which = blockIdx.y;
  if (p >= pixels) return;
  float sorted[MAX_NEIGHBOURS];
  int count = 0;
  for (int k = 0; k < n; k++) {
    const float difference = differences[(which * n + k) * pixels + p];
    if (isnan(difference)) continue;
    const float cost = fminf(fabsf(difference - light[k]) / most[k], 1.f);
    int place = count++;
    while (place > 0 && sorted[place - 1] > cost) {
      sorted[place] = sorted[place - 1];
      place--;
    }
    sorted[place] = cost;
  }
  const int half = (count + 1) / 2;
  float total = 0.f;
  for (int k = 0; k < half; k++) total += sorted[k];
  costs[which * pixels + p] = count ? total / half : 1.f;
}

// Means of two costs (2, h, w) over the pixels within `radius`, by their likeness in the colours
// (3, h, w): a mean difference d weighs exp(fall d). The border repeats.
extern "C" __global__ void average_costs(
    const float* costs, const float* colours, int radius, float fall, int h, int w, float* means) {
  const int x = blockIdx.x * blockDim.x + threadIdx.x, y = blockIdx.y * blockDim.y + threadIdx.y;
  if (x >= w || y >= h) return;
  const int pixels = h * w, p = y * w + x;
  const float r = colours[p], g = colours[pixels + p], b = colours[2 * pixels + p];
  float first = 0.f, second = 0.f, weights = 0.f;
  for (int dy = -radius; dy <= radius; dy++) {
    const int row = min(max(y + dy, 0), h - 1) * w;
    for (int dx = -radius; dx <= radius; dx++) {
      const int q = row + min(max(x + dx, 0), w - 1);
      const float apart = fabsf(colours[q] - r) + fabsf(colours[pixels + q] - g) +
                          fabsf(colours[2 * pixels + q] - b);
      const float weight = __expf(fall / 3.f * apart);
      first += weight * costs[q];
      second += weight * costs[pixels + q];
      weights += weight;
    }
  }
  means[p] = first / weights;
  means[pixels + p] = second / weights;
}
