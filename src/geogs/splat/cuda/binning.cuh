// The disks of each tile, nearest first: counts to offsets, entries, a sort per tile.
#pragma once
#include "project.cuh"

#define SHARED_KEYS 2048

// One block of 1024. Exclusive sums of ``counts``, which are cleared; ``status``: the largest number
// of entries seen, and whether it ever exceeded what the lists hold. ``entries``, unless null, is
// memory of the host and receives the number of entries.
extern "C" __global__ void __launch_bounds__(1024) scan_tiles(int tiles, int room, int* counts,
                                                              int* offsets, int* cursor,
                                                              int* status, int* entries) {
  __shared__ int warp_sums[32];
  const int t = threadIdx.x, lane = t & 31, warp = t >> 5, each = (tiles + 1023) / 1024;
  const int first = min(t * each, tiles), last = min(first + each, tiles);
  int sum = 0;
  for (int k = first; k < last; k++) sum += counts[k];
  int x = sum;
  for (int s = 1; s < 32; s <<= 1) {
    const int y = __shfl_up_sync(ALL_LANES, x, s);
    if (lane >= s) x += y;
  }
  if (lane == 31) warp_sums[warp] = x;
  __syncthreads();
  if (warp == 0) {
    const int own = warp_sums[lane];
    int y = own;
    for (int s = 1; s < 32; s <<= 1) {
      const int z = __shfl_up_sync(ALL_LANES, y, s);
      if (lane >= s) y += z;
    }
    warp_sums[lane] = y - own;
  }
  __syncthreads();
  int at = x - sum + warp_sums[warp];
  for (int k = first; k < last; k++) {
    offsets[k] = cursor[k] = at;
    at += counts[k];
    counts[k] = 0;
  }
  if (t == 1023) {
    offsets[tiles] = at;
    status[0] = max(status[0], at);
    if (at > room) status[1] = 1;
    if (entries) *entries = at;
  }
}

// Grid: disks / 256, views. A key orders by inverse depth, nearest first, then by index; its lower
// half is the disk.
extern "C" __global__ void __launch_bounds__(256) list_disks(
    int capacity, const int* count, const float4* records, const float4* outlines, int width,
    int height, int room, int* cursor, unsigned long long* keys) {
  const int i = blockIdx.x * blockDim.x + threadIdx.x, b = blockIdx.y;
  const size_t at = (size_t)b * capacity + i;
  float4 p = make_float4(0.f, 0.f, 0.f, 0.f), q = p;
  float mx = 0.f, my = 0.f, wc = 0.f;
  if (i < disk_count(count, capacity)) {
    q = outlines[2 * at + 1];
    if (has_box(q)) {
      p = outlines[2 * at];
      const float4 r = records[4 * at];
      mx = r.x;
      my = r.y;
      wc = records[4 * at + 2].x;
    }
  }
  const int columns = (width + TILE - 1) / TILE, rows = (height + TILE - 1) / TILE;
  int* own = cursor + (size_t)b * columns * rows;
  const u64 key = ((u64)~__float_as_uint(wc) << 32) | (u32)i;
  visit_tiles(has_box(q), p, q, mx, my, key, [&](int x, int y, u64 k) {
    const int slot = atomicAdd(own + y * columns + x, 1);
    if (slot < room) keys[slot] = k;
  });
}

__device__ __forceinline__ void order_keys(u64* keys, int a, int b, int n) {
  if (b >= n) return;
  const u64 x = keys[a], y = keys[b];
  if (x > y) { keys[a] = y; keys[b] = x; }
}

// Ascending bitonic network for any n, as if padded with infinity.
__device__ __forceinline__ void sort_keys(u64* keys, int n, int t) {
  int size = 1;
  while (size < n) size <<= 1;
  for (int s = 2; s <= size; s <<= 1) {
    for (int i = t; i < size / 2; i += TILE_THREADS) {
      const int r = i & (s / 2 - 1), start = (i - r) * 2;
      order_keys(keys, start + r, start + s - 1 - r, n);
    }
    __syncthreads();
    for (int j = s >> 2; j > 0; j >>= 1) {
      for (int i = t; i < size / 2; i += TILE_THREADS) {
        const int a = 2 * i - (i & (j - 1));
        order_keys(keys, a, a + j, n);
      }
      __syncthreads();
    }
  }
}

// One block per tile of all views.
extern "C" __global__ void __launch_bounds__(TILE_THREADS) sort_tiles(
    int room, const int* offsets, unsigned long long* keys, int* lists) {
  __shared__ u64 near[SHARED_KEYS];
  const int t = threadIdx.x, first = min(offsets[blockIdx.x], room);
  const int n = min(offsets[blockIdx.x + 1], room) - first;
  u64* own = keys + first;
  if (n <= SHARED_KEYS) {
    for (int k = t; k < n; k += TILE_THREADS) near[k] = own[k];
    __syncthreads();
    own = near;
  }
  sort_keys(own, n, t);
  for (int k = t; k < n; k += TILE_THREADS) lists[first + k] = (int)(u32)own[k];
}
