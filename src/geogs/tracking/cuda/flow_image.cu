// Images as the flow operator keeps them, and the second image of a pair brought to the first:
// warped by the start flow and matched in local brightness. Each is a pyramid of grey levels.
#include "flow.cuh"

#define TILE 32
#define MEAN_LEVEL 3
#define DARK 4.f  // grey levels added to both means, so that a ratio of darks stays tame

// Write a tile of level 0 (32 x 32 pixels in shared memory, block 32 x 8) and its share of all
// coarser levels.
__device__ void write_levels(float (*tile)[TILE + 1], float* out, int width, int height, int levels) {
  int thread = threadIdx.y * TILE + threadIdx.x;
  Level size = {width, height, 0};
  for (int level = 0; level < levels; level++) {
    int side = TILE >> level;
    __syncthreads();
    for (int k = thread; k < side * side; k += TILE * 8) {
      int i = k % side, j = k / side, x = blockIdx.x * side + i, y = blockIdx.y * side + j;
      if (x < size.width && y < size.height) out[size.offset + y * size.width + x] = tile[j][i];
    }
    if (level + 1 == levels) return;
    // At most one pixel of the next level per thread.
    int half = side / 2, i = thread % half, j = thread / half;
    bool mine = j < half;
    float mean = 0.f;
    if (mine)
      mean = 0.25f * (tile[2 * j][2 * i] + tile[2 * j][2 * i + 1] + tile[2 * j + 1][2 * i] + tile[2 * j + 1][2 * i + 1]);
    __syncthreads();
    if (mine) tile[j][i] = mean;
    size.offset += size.width * size.height;
    size.width = (size.width + 1) >> 1;
    size.height = (size.height + 1) >> 1;
  }
}

// Grey pyramid of an RGB image; clears the count of textured cells.
extern "C" __global__ void flow_grey(const unsigned char* rgb, float* out, int* textured, int width, int height, int levels) {
  __shared__ float tile[TILE][TILE + 1];
  if (blockIdx.x + blockIdx.y + threadIdx.x + threadIdx.y == 0) *textured = 0;
  int x = min((int)(blockIdx.x * TILE + threadIdx.x), width - 1);
  for (int j = threadIdx.y; j < TILE; j += 8) {
    int y = min((int)(blockIdx.y * TILE) + j, height - 1);
    const unsigned char* p = rgb + 3 * (y * width + x);
    tile[j][threadIdx.x] = 0.299f * p[0] + 0.587f * p[1] + 0.114f * p[2];
  }
  write_levels(tile, out, width, height, levels);
}

// Mean brightness around a pixel of MEAN_LEVEL: Gaussian of 1/16 of the long edge; one warp.
__device__ float local_mean(const float* pyramid, int width, int height, int x, int y) {
  Level size = pyramid_level(width, height, MEAN_LEVEL);
  const float* image = pyramid + size.offset;
  float sigma = max(size.width, size.height) / 16.f;
  int radius = (int)(2.5f * sigma) + 1, side = 2 * radius + 1;
  float scale = -0.5f / (sigma * sigma), sum = 0.f, total = 0.f;
  for (int k = threadIdx.x; k < side * side; k += 32) {
    int i = k % side - radius, j = k / side - radius;
    int u = x + i, v = y + j;
    if (u < 0 || v < 0 || u >= size.width || v >= size.height) continue;
    float w = __expf(scale * (i * i + j * j));
    sum += w * image[v * size.width + u];
    total += w;
  }
  return warp_sum(sum) / warp_sum(total);
}

// The number of cells of the grid whose structure tensor over 9 x 9 pixels has a smaller eigenvalue
// (grey levels^2 / pixel^2) above `least`, and the local means. A warp each.
extern "C" __global__ void flow_structure(float* image, int* textured, int width, int height, int grid_width, int grid_height, int mean_offset, float least) {
  int index = blockIdx.x * blockDim.y + threadIdx.y, lane = threadIdx.x;
  int cells = grid_width * grid_height;
  Level coarse = pyramid_level(width, height, MEAN_LEVEL);
  if (index >= cells) {
    int k = index - cells;
    if (k >= coarse.width * coarse.height) return;
    float mean = local_mean(image, width, height, k % coarse.width, k / coarse.width);
    if (lane == 0) image[mean_offset + k] = mean;
    return;
  }
  int x = GRID_OFFSET + GRID_STRIDE * (index % grid_width), y = GRID_OFFSET + GRID_STRIDE * (index / grid_width);
  float xx = 0.f, yy = 0.f, xy = 0.f;
  for (int k = lane; k < 81; k += 32) {
    int u = mirrored(x + k % 9 - 4, width), v = mirrored(y + k / 9 - 4, height);
    float2 g = gradient_at(image, width, height, u, v);
    xx += g.x * g.x;
    yy += g.y * g.y;
    xy += g.x * g.y;
  }
  xx = warp_sum(xx) / 81.f;
  yy = warp_sum(yy) / 81.f;
  xy = warp_sum(xy) / 81.f;
  if (lane) return;
  float half = 0.5f * (xx - yy), mean = 0.5f * (xx + yy), radius = sqrtf(half * half + xy * xy);
  if (mean - radius > least) atomicAdd(textured, 1);
}

// Pyramid of the second image warped to the first by the start flow.
extern "C" __global__ void flow_warp(const long long* images, const float2* forward, const float2* backward, float* warped, int pairs, int stride, int width, int height, int grid_width, int grid_height, int levels) {
  __shared__ float tile[TILE][TILE + 1];
  int d = blockIdx.z;
  const float* target = target_image(images, d, pairs);
  const float2* start = start_of(forward, backward, d, pairs, grid_width * grid_height);
  int x = min((int)(blockIdx.x * TILE + threadIdx.x), width - 1);
  for (int j = threadIdx.y; j < TILE; j += 8) {
    int y = min((int)(blockIdx.y * TILE) + j, height - 1);
    float2 f = start_flow(start, grid_width, grid_height, x, y);
    tile[j][threadIdx.x] = start ? sample_cubic(target, width, height, x + f.x, y + f.y) : target[y * width + x];
  }
  write_levels(tile, warped + (long long)d * stride, width, height, levels);
}

// Factor that gives the warped image the local brightness of the first; a warp per mean.
extern "C" __global__ void flow_gain(const long long* images, const float* warped, float* gain, int stride, int width, int height, int mean_offset) {
  int k = blockIdx.x * blockDim.y + threadIdx.y, d = blockIdx.y;
  Level coarse = pyramid_level(width, height, MEAN_LEVEL);
  int count = coarse.width * coarse.height;
  if (k >= count) return;
  float mean = local_mean(warped + (long long)d * stride, width, height, k % coarse.width, k / coarse.width);
  float ratio = (source_image(images, d)[mean_offset + k] + DARK) / (mean + DARK);
  if (threadIdx.x == 0) gain[d * count + k] = clampf(ratio, 0.2f, 5.f);
}

// Apply the gain to all levels of the warped images. Light and exposure drop out.
extern "C" __global__ void flow_brighten(float* warped, const float* gain, int stride, int width, int height, int levels) {
  int at = blockIdx.x * blockDim.x + threadIdx.x, d = blockIdx.y;
  Level coarse = pyramid_level(width, height, MEAN_LEVEL), size = {width, height, 0};
  int level = 0;
  while (level < levels && at >= size.offset + size.width * size.height) {
    size.offset += size.width * size.height;
    size.width = (size.width + 1) >> 1;
    size.height = (size.height + 1) >> 1;
    level++;
  }
  if (level == levels) return;
  int x = (at - size.offset) % size.width, y = (at - size.offset) / size.width;
  float scale = (float)(1 << level) / (1 << MEAN_LEVEL);
  float g = sample(gain + d * coarse.width * coarse.height, coarse.width, coarse.height,
                   (x + 0.5f) * scale - 0.5f, (y + 0.5f) * scale - 0.5f);
  float* value = warped + (long long)d * stride + at;
  *value = clampf((*value + DARK) * g - DARK, 0.f, 255.f);
}
