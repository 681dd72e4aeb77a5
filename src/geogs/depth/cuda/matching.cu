// Plane sweep: matching costs and their average over pixels of like colour.
#include "common.cuh"
#include "sampling.cuh"
#include "volume.cuh"

#define OUTSIDE 1.2f
#define TILE_W 32
#define TILE_H 8
#define SLOT_GROUP 8
#define MAX_KEPT 8

// The sample of a neighbour where pixel (x, y) of a plane projects; the lowest bit says whether it
// lies outside, which costs less than an array of its own.
__device__ __forceinline__ float warped_sample(
    const float* image, const float4* hom, float rho, int x, int y, int w, int h) {
  const float4 r0 = hom[0], r1 = hom[1], r2 = hom[2];
  float q0 = r0.x * x + (r0.y * y + r0.z + rho * r0.w);
  float q1 = r1.x * x + (r1.y * y + r1.z + rho * r1.w);
  float q2 = r2.x * x + (r2.y * y + r2.z + rho * r2.w);
  ImagePoint p = project_into(q0, q1, q2, w, h);
  int column = (int)p.u, row = (int)p.v;
  float value = bilinear(image, w, column, row, p.u - column, p.v - row);
  return __int_as_float((__float_as_int(value) & ~1) | (p.inside ? 0 : 1));
}

__device__ __forceinline__ bool is_outside(float sample) { return __float_as_int(sample) & 1; }

__device__ __forceinline__ void insert_cost(float (&best)[MAX_KEPT], int keep, float cost) {
#pragma unroll
  for (int k = 0; k < MAX_KEPT; k++)
    if (k < keep) {
      float low = fminf(best[k], cost);
      cost = fmaxf(best[k], cost);
      best[k] = low;
    }
}

// A window of the reference: mean, and 1 / sqrt(variance + floor). Its pixels are kept where their
// number is known when this is compiled.
template <int RADIUS>
struct Window {
  float mean, scale;
  float pixels[(2 * RADIUS + 1) * (2 * RADIUS + 1)];
};

template <int RADIUS>
__device__ __forceinline__ Window<RADIUS> reference_window(
    const float* tile, int row, int side, float norm, float floor) {
  Window<RADIUS> window;
  float sum = 0.f, square = 0.f;
  for (int i = 0; i < side; i++)
    for (int j = 0; j < side; j++) {
      float a = tile[i * row + j];
      sum += a;
      square += a * a;
    }
  window.mean = sum * norm;
  window.scale = rsqrtf(fmaxf(square * norm - window.mean * window.mean, 0.f) + floor);
  if (RADIUS) {
#pragma unroll
    for (int k = 0; k < (2 * RADIUS + 1) * (2 * RADIUS + 1); k++)
      window.pixels[k] = tile[k / (2 * RADIUS + 1) * row + k % (2 * RADIUS + 1)];
  }
  return window;
}

// 1 - NCC of two windows; `reference` and `warped` are their corners in shared memory.
template <int RADIUS>
__device__ __forceinline__ float window_cost(
    const float* reference, const float* warped, int row, int given_radius,
    const Window<RADIUS>& own, float norm, float floor) {
  const int side = 2 * (RADIUS ? RADIUS : given_radius) + 1;
  float b1 = 0.f, bb = 0.f, ab = 0.f;
#pragma unroll
  for (int i = 0; i < side; i++)
#pragma unroll
    for (int j = 0; j < side; j++) {
      float a = RADIUS ? own.pixels[RADIUS ? i * side + j : 0] : reference[i * row + j];
      float b = warped[i * row + j];
      b1 += b;
      bb += b * b;
      ab += a * b;
    }
  float m = b1 * norm, spread = fmaxf(bb * norm - m * m, 0.f) + floor;
  float ncc = (ab * norm - own.mean * m) * own.scale * rsqrtf(spread);
  return fminf(1.f - ncc, OUTSIDE);
}

template <int RADIUS>
__device__ void match_tile(
    const float* grey, const float* images, const float* homographies, const float* slot_rho,
    int slots, int neighbours, int h, int w, int given_radius, int keep, float floor,
    float* volume, float* shared) {
  const int radius = RADIUS ? RADIUS : given_radius, side = 2 * radius + 1;
  const int row = TILE_W + 2 * radius, size = row * (TILE_H + 2 * radius);
  const int x0 = blockIdx.x * TILE_W - radius, y0 = blockIdx.y * TILE_H - radius;
  const int t = threadIdx.x, px = t % TILE_W, py = t / TILE_W;
  const int x = x0 + radius + px, y = y0 + radius + py;
  const bool matches = py < TILE_H, writes = matches && x < w && y < h;
  const float norm = 1.f / (side * side);
  float4* homs = (float4*)shared;
  float *reference = shared + 12 * neighbours, *warped = reference + size;
  for (int j = t; j < 3 * neighbours; j += blockDim.x) {
    const float *a = homographies + j / 3 * 12 + j % 3 * 3, b = homographies[j / 3 * 12 + 9 + j % 3];
    homs[j] = make_float4(a[0], a[1], a[2], b);
  }
  for (int s = t; s < size; s += blockDim.x) {
    int u = min(max(x0 + s % row, 0), w - 1), v = min(max(y0 + s / row, 0), h - 1);
    reference[s] = grey[v * w + u];
  }
  __syncthreads();
  const int corner = py * row + px, centre = corner + radius * (row + 1);
  Window<RADIUS> own;
  if (matches) own = reference_window<RADIUS>(reference + corner, row, side, norm, floor);
  // A thread's first sample of a tile, which is its only one unless the windows are large.
  const int u0 = min(max(x0 + t % row, 0), w - 1), v0 = min(max(y0 + t / row, 0), h - 1);
  int turn = 0;
  for (int g = 0; g < SLOT_GROUP; g++) {
    const int slot = blockIdx.z * SLOT_GROUP + g;
    const float rho = slot_rho[slot];
    float best[MAX_KEPT];
#pragma unroll
    for (int k = 0; k < MAX_KEPT; k++) best[k] = FAR;
    int seen = 0;
    // Two buffers in turn: one barrier between writing and reading is enough.
    for (int j = 0; j < neighbours && rho >= 0.f; j++, turn ^= 1) {
      float* tile = warped + turn * size;
      const float* image = images + j * h * w;
      if (t < size) tile[t] = warped_sample(image, homs + 3 * j, rho, u0, v0, w, h);
      for (int s = t + blockDim.x; s < size; s += blockDim.x) {
        int u = min(max(x0 + s % row, 0), w - 1), v = min(max(y0 + s / row, 0), h - 1);
        tile[s] = warped_sample(image, homs + 3 * j, rho, u, v, w, h);
      }
      __syncthreads();
      if (matches) {
        float cost = window_cost<RADIUS>(
            reference + corner, tile + corner, row, radius, own, norm, floor);
        const bool outside = is_outside(tile[centre]);
        insert_cost(best, keep, fmaxf(cost, outside ? OUTSIDE : 0.f));
        seen += !outside;
      }
    }
    if (!writes) continue;
    const int used = max((seen + 1) / 2, min(2, neighbours));
    const float share = 1.f / used;
    float mean = 0.f;
#pragma unroll
    for (int k = 0; k < MAX_KEPT; k++) mean += k < used ? best[k] * share : 0.f;
    volume[((long long)y * w + x) * slots + slot] = rho >= 0.f ? mean : FAR;
  }
}

// volume[pixel, slot] = mean of the smaller half of 1 - NCC over the neighbours at the slot's plane:
// half of those into whose images the pixel falls, at least two; `keep` is the most that can be.
// grey (h, w) and images (n, h, w) are centred about zero; homographies (n, 12): a (3 x 3), b (3);
// pixel p at inverse depth rho appears at a p + rho b. Grid: tiles of 32 x 8 pixels, slots / 8.
extern "C" __global__ void match_planes(
    const float* grey, const float* images, const float* homographies, const float* slot_rho,
    int slots, int neighbours, int h, int w, int radius, int keep, float floor, float* volume) {
  SHARED_MEMORY(float, shared);
  if (radius == 1)
    match_tile<1>(grey, images, homographies, slot_rho, slots, neighbours, h, w, radius, keep,
                  floor, volume, shared);
  else
    match_tile<0>(grey, images, homographies, slot_rho, slots, neighbours, h, w, radius, keep,
                  floor, volume, shared);
}

template <int PER>
__device__ void average_pixel(
    const float* volume, const float* weights, const float* slot_rho, float total, int x, int y,
    int h, int w, int radius, float prior, float pull, float tolerance, float* out) {
  const int lane = threadIdx.x, side = 2 * radius + 1, slots = 32 * PER;
  float mean[PER];
#pragma unroll
  for (int i = 0; i < PER; i++) mean[i] = 0.f;
  for (int dy = max(-radius, -y); dy <= min(radius, h - 1 - y); dy++)
    for (int dx = max(-radius, -x); dx <= min(radius, w - 1 - x); dx++) {
      const float weight = weights[(dy + radius) * side + dx + radius];
      const float* cost = volume + ((long long)(y + dy) * w + x + dx) * slots + lane;
#pragma unroll
      for (int i = 0; i < PER; i++) mean[i] += weight * cost[32 * i];
    }
  const float norm = 1.f / total, inverse = 1.f / prior;
#pragma unroll
  for (int i = 0; i < PER; i++) {
    const float rho = slot_rho[32 * i + lane];
    float cost = mean[i] * norm;
    if (pull > 0.f) cost += pull * fminf(fabsf(rho * inverse - 1.f) / tolerance, 1.f);
    out[((long long)y * w + x) * slots + 32 * i + lane] = rho >= 0.f ? cost : FAR;
  }
}

// Mean cost over (2 radius + 1)^2 pixels, weighted by 1 / (1 + contrast |dI|^2)^2 over the colours
// (3, h, w), plus the pull to the prior: weight min(|rho / prior - 1| / tolerance, 1).
// One warp per pixel; block (32, 8, 4), shared: blockDim warps x (2 radius + 1)^2 floats.
extern "C" __global__ void __launch_bounds__(1024) average_support(
    const float* volume, const float* colours, const float* slot_rho, const float* prior,
    const float* prior_weight, int per, int h, int w, int radius, float contrast, float strength,
    float tolerance, float* out) {
  SHARED_MEMORY(float, shared);
  const int lane = threadIdx.x, side = 2 * radius + 1, pixels = h * w;
  const int x = blockIdx.x * blockDim.y + threadIdx.y, y = blockIdx.y * blockDim.z + threadIdx.z;
  if (x >= w || y >= h) return;
  float* weights = shared + (threadIdx.z * blockDim.y + threadIdx.y) * side * side;
  const int p = y * w + x;
  float total = 0.f;
  for (int q = lane; q < side * side; q += 32) {
    const int u = x + q % side - radius, v = y + q / side - radius;
    float weight = 0.f;
    if (u >= 0 && v >= 0 && u < w && v < h) {
      float like = 0.f;
      for (int c = 0; c < 3; c++) {
        float difference = colours[c * pixels + p] - colours[c * pixels + v * w + u];
        like += difference * difference;
      }
      like = 1.f + contrast * like;
      weight = 1.f / (like * like);
    }
    weights[q] = weight;
    total += weight;
  }
  total = warp_sum(total);
  __syncwarp();
  const float near = prior[p], pull = strength * prior_weight[p];
#define AVERAGE(PER) \
  average_pixel<PER>(volume, weights, slot_rho, total, x, y, h, w, radius, near, pull, tolerance, out)
  switch (per) {
    case 1: AVERAGE(1); break;
    case 3: AVERAGE(3); break;
    case 4: AVERAGE(4); break;
    case 5: AVERAGE(5); break;
    default: AVERAGE(8);
  }
#undef AVERAGE
}
