// Whether two images agree where a pose, or a flow, puts what the first shows.
#include "block.cuh"
#include "lens.cuh"

#define SIDE 9        // pixels along the edge of a window
#define INNER 7       // means of 3 x 3 pixels along it
#define WINDOWS 8     // windows of a block, a warp each
#define FROM_MIDDLE 4 // pixels from a window's middle to its border

__device__ __forceinline__ float bilinear(const float* image, int width, int height, float x, float y) {
  int u = min((int)x, max(width - 2, 0)), v = min((int)y, max(height - 2, 0));
  float a = x - u, b = y - v;
  const float* p = image + (size_t)v * width + u;
  float top = p[0] + a * (p[1] - p[0]), bottom = p[width] + a * (p[width + 1] - p[width]);
  return top + b * (bottom - top);
}

// Keys of the correlations of `count` windows, around every step-th cell: LEFT_OUT where a window
// has no texture, is not all in the second image, or its cell has no information. Cells lie at
// `pixels` of the second image, or where the motion T (4 x 4) and the cells' inverse depth put them.
extern "C" __global__ void correlate_windows(
    const float* first, const float* second, int width, int height, const float* rays,
    int grid_width, int stride, int step, int count, const double* T, const float* inverse_depth,
    const float* information, const float2* pixels, float fx, float fy, float cx, float cy, float k1,
    float k2, float p1, float p2, float k3, float k4, float k5, float k6, float fisheye,
    float least_variance, unsigned* keys) {
  __shared__ float here[WINDOWS][SIDE * SIDE], there[WINDOWS][SIDE * SIDE];
  int lane = threadIdx.x, warp = threadIdx.y, n = blockIdx.x * WINDOWS + warp;
  bool counts = n < count;
  int cell = counts ? n * step : 0;
  Camera camera = {fx, fy, cx, cy, LENS};
  Bend bend = bend_of(camera, rays[3 * cell], rays[3 * cell + 1]);
  float area = bend.xx * bend.yy - bend.xy * bend.yx;
  float R[9], middle[3];
  if (T) {
    for (int r = 0; r < 3; r++) {
      middle[r] = inverse_depth[cell] * (float)T[4 * r + 3];
      for (int c = 0; c < 3; c++) {
        R[3 * r + c] = (float)T[4 * r + c];
        middle[r] += R[3 * r + c] * rays[3 * cell + c];
      }
    }
    counts = counts && information[cell] > 0.f;
  }
  int left = cell % grid_width * stride, top = cell / grid_width * stride;
  for (int k = lane; k < SIDE * SIDE; k += 32) {
    int i = k % SIDE, j = k / SIDE;
    // A window may end a pixel outside of the first image, whose border is repeated there.
    here[warp][k] = first[(size_t)min(top + j, height - 1) * width + min(left + i, width - 1)];
    float dx = i - FROM_MIDDLE, dy = j - FROM_MIDDLE, x, y;
    if (T) {
      // The ray moves by what the lens shows as (dx, dy).
      float u = (bend.yy * dx - bend.xy * dy) / area, v = (bend.xx * dy - bend.yx * dx) / area;
      float z = middle[2] + R[6] * u + R[7] * v;
      float2 at = lens_pixel(camera, (middle[0] + R[0] * u + R[1] * v) / z,
                             (middle[1] + R[3] * u + R[4] * v) / z);
      x = at.x;
      y = at.y;
      counts = counts && z > 1e-6f;
    } else {
      x = pixels[cell].x + dx;
      y = pixels[cell].y + dy;
    }
    bool inside = x >= 0.f && x <= width - 1 && y >= 0.f && y <= height - 1;
    counts = counts && inside;
    there[warp][k] = inside ? bilinear(second, width, height, x, y) : 0.f;
  }
  __syncwarp();
  float a[2] = {0.f, 0.f}, b[2] = {0.f, 0.f};
  for (int m = 0; m < 2; m++) {
    int k = lane + 32 * m;
    if (k >= INNER * INNER) continue;
    int at = k / INNER * SIDE + k % INNER;
    for (int j = 0; j < 3; j++)
      for (int i = 0; i < 3; i++) {
        a[m] += here[warp][at + j * SIDE + i] / 9.f;
        b[m] += there[warp][at + j * SIDE + i] / 9.f;
      }
  }
  float mean_a = warp_sum(a[0] + a[1]) / (INNER * INNER), mean_b = warp_sum(b[0] + b[1]) / (INNER * INNER);
  float aa = 0.f, bb = 0.f, ab = 0.f;
  for (int m = 0; m < 2; m++) {
    if (lane + 32 * m >= INNER * INNER) continue;
    float p = a[m] - mean_a, q = b[m] - mean_b;
    aa += p * p;
    bb += q * q;
    ab += p * q;
  }
  aa = warp_sum(aa) / (INNER * INNER);
  bb = warp_sum(bb) / (INNER * INNER);
  ab = warp_sum(ab) / (INNER * INNER);
  counts = __all_sync(ALL_LANES, counts) && aa > least_variance;
  // Two more, so that keys are of numbers that are not negative.
  if (lane == 0 && n < count)
    keys[n] = counts ? median_key(2.f + ab / fmaxf(sqrtf(aa * bb), 1e-6f)) : LEFT_OUT;
}

// Lower median of the correlations that count, 0 without any, and how many there are. One block.
extern "C" __global__ void median_correlation(const unsigned* keys, int count, double* evidence) {
  float counted = 0.f;
  for (int n = threadIdx.x; n < count; n += blockDim.x) counted += keys[n] != LEFT_OUT;
  counted = block_sum(counted);
  float median = block_median(keys, count);
  if (threadIdx.x == 0) {
    evidence[0] = counted > 0.f ? median - 2.f : 0.f;
    evidence[1] = counted;
  }
}

// Share of the cells that are matched, and the lower median of their motion in pixels, 0 without
// any. `keys` has room for all cells. One block.
extern "C" __global__ void matched_motion(
    const float2* pixels, const float2* weight, const float2* grid_pixels, int cells, unsigned* keys,
    double* judgement) {
  float used = 0.f;
  for (int p = threadIdx.x; p < cells; p += blockDim.x) {
    float x = pixels[p].x - grid_pixels[p].x, y = pixels[p].y - grid_pixels[p].y;
    bool counts = weight[p].x > 0.f;
    used += counts;
    keys[p] = counts ? median_key(sqrtf(x * x + y * y)) : LEFT_OUT;
  }
  used = block_sum(used);
  float median = block_median(keys, cells);
  if (threadIdx.x == 0) {
    judgement[0] = used / cells;
    judgement[1] = used > 0.f ? median : 0.f;
  }
}
