// Compositing: one block per tile of 16 x 16 pixels, one warp per 8 x 4 of them.
#pragma once
#include "project.cuh"

// A batch of disks in shared memory: the records, then the outlines.
struct Batch {
  float4 part[6][TILE_THREADS];
};

__device__ __forceinline__ void stage(Batch& batch, int t, const float4* records,
                                      const float4* outlines, size_t at) {
  for (int k = 0; k < 4; k++) batch.part[k][t] = records[4 * at + k];
  for (int k = 0; k < 2; k++) batch.part[4 + k][t] = outlines[2 * at + k];
}

__device__ __forceinline__ bool reaches_part(const Batch& batch, int j, float left, float top) {
  const float4 r = batch.part[0][j];
  return reaches(batch.part[4][j], batch.part[5][j], r.x, r.y, left, left + PART_WIDTH - 1, top,
                 top + PART_HEIGHT - 1);
}

// What a pixel sees of a disk.
struct Hit {
  float dx, dy, u, v, z, rho, gauss, alpha;
  bool on_plane, is_free;  // is_free: the depth follows the plane rather than a bound
};

__device__ __forceinline__ Hit hit_of(float4 r0, float4 r1, float4 r2, float4 r3, float x, float y,
                                      float inverse_near) {
  Hit h;
  h.dx = x - r0.x;
  h.dy = y - r0.y;
  const float w = r1.z * h.dx + r1.w * h.dy + r2.x;
  const float bounded = fminf(fmaxf(w, r2.x * MIN_HIT_RATIO), inverse_near);
  const float z = 1.f / bounded;
  h.u = z * (r0.z * h.dx + r0.w * h.dy);
  h.v = z * (r1.x * h.dx + r1.y * h.dy);
  const float rho3 = h.u * h.u + h.v * h.v, rho2 = h.dx * h.dx + h.dy * h.dy;
  h.on_plane = bounded == w && rho3 <= rho2;
  const float kept = fminf(fmaxf(z, r3.y), r3.z);
  h.is_free = h.on_plane || (kept == z && bounded == w);
  h.z = h.on_plane ? z : kept;
  h.rho = h.on_plane ? rho3 : rho2;
  h.gauss = __expf(-h.rho);
  h.alpha = r2.y * h.gauss;
  return h;
}

struct Pixel {
  int x, y, left, top;  // own, and the first of the warp's part
  bool inside;
};

__device__ __forceinline__ Pixel pixel_of(int tile, int width, int height) {
  const int t = threadIdx.x, lane = t & 31, warp = t >> 5, columns = (width + TILE - 1) / TILE;
  Pixel p;
  p.left = tile % columns * TILE + (warp & 1) * PART_WIDTH;
  p.top = tile / columns * TILE + (warp >> 1) * PART_HEIGHT;
  p.x = p.left + (lane & 7);
  p.y = p.top + (lane >> 3);
  p.inside = p.x < width && p.y < height;
  return p;
}

// Depth from which a tile's sums are measured, to keep their digits: the middle disk's.
__device__ __forceinline__ float reference_depth(const float4* records, const int* lists, int first,
                                                 int last, size_t view) {
  return first < last ? 1.f / records[4 * (view + lists[(first + last) / 2]) + 2].x : 0.f;
}

// Grid: tiles of one view, views. Maps are (views, h, w), normals (views, 3, h, w). ``saved``
// (views, 2, h, w): transmittance and depth moment; ``ranks`` (views, h, w): entries up to the last
// one blended. ``visible`` (disks) is only ever set.
extern "C" __global__ void __launch_bounds__(TILE_THREADS) blend_tiles(
    int capacity, const float4* records, const float4* outlines, const int* offsets,
    const int* lists, int room, float inverse_near, int width, int height, float* depth,
    float* normal, float* alpha, float* distortion, float* median_depth, float* saved, int* ranks,
    unsigned char* visible) {
  __shared__ Batch batch;
  __shared__ int ids[TILE_THREADS];
  const int t = threadIdx.x, lane = t & 31, b = blockIdx.y, tile = b * gridDim.x + blockIdx.x;
  const Pixel p = pixel_of(blockIdx.x, width, height);
  const size_t view = (size_t)b * capacity;
  const int first = min(offsets[tile], room), last = min(offsets[tile + 1], room), n = last - first;
  const float z_reference = reference_depth(records, lists, first, last, view);
  const float x = p.x, y = p.y;
  float light = 1.f, moment = 0.f, nx = 0.f, ny = 0.f, nz = 0.f, spread = 0.f, median = 0.f;
  int rank = 0;
  bool done = !p.inside;
  for (int base = 0; base < n; base += TILE_THREADS) {
    if (__syncthreads_and(done)) break;
    const int count = min(TILE_THREADS, n - base);
    if (t < count) {
      ids[t] = lists[first + base + t];
      stage(batch, t, records, outlines, view + ids[t]);
    }
    __syncthreads();
    for (int c = 0; c < count && !__all_sync(ALL_LANES, done); c += 32) {
      u32 left = __ballot_sync(
          ALL_LANES, c + lane < count && reaches_part(batch, c + lane, p.left, p.top));
      while (left) {
        const int j = c + __ffs((int)left) - 1;
        left &= left - 1;
        const float4 r2 = batch.part[2][j], r3 = batch.part[3][j];
        const Hit h = hit_of(batch.part[0][j], batch.part[1][j], r2, r3, x, y, inverse_near);
        const float a = fminf(h.alpha, MAX_ALPHA), weight = light * a, rest = light - weight;
        const bool hits = !done && a >= MIN_ALPHA;
        done |= hits && rest < MIN_TRANSMITTANCE;
        const bool blended = hits && !done;
        if (blended) {
          const float zc = h.z - z_reference;
          spread += weight * fabsf(zc * (1.f - light) - moment);
          moment += weight * zc;
          nx += weight * r2.z;
          ny += weight * r2.w;
          nz += weight * r3.x;
          if (light > 0.5f) median = h.z;
          light = rest;
          rank = base + j + 1;
        }
        if (__any_sync(ALL_LANES, blended) && lane == 0) visible[ids[j]] = 1;
      }
    }
  }
  if (!p.inside) return;
  const size_t area = (size_t)width * height, at = (size_t)p.y * width + p.x, o = b * area + at;
  const float total = 1.f - light;
  depth[o] = rank ? z_reference + moment / total : 0.f;
  alpha[o] = total;
  distortion[o] = 2.f * spread;
  median_depth[o] = median;
  float* own = normal + 3 * b * area + at;
  own[0] = nx;
  own[area] = ny;
  own[2 * area] = nz;
  if (saved) {
    saved[2 * b * area + at] = light;
    saved[(2 * b + 1) * area + at] = moment;
    ranks[o] = rank;
  }
}
