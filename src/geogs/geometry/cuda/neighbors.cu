// The k nearest of m points, by looking at all of them.
#include "common.cuh"

#define TILE 1024
#define QUERIES_PER_BLOCK 8
#define FARTHEST 3.0e38f

// One warp per query, k at most 32: lane i holds the i-th nearest point so far. Blocks of
// 32 QUERIES_PER_BLOCK threads share the points that they read. Of points at the same distance the
// one with the lower index comes first.
extern "C" __global__ void nearest_neighbors(const float* __restrict__ queries,
                                             const float* __restrict__ points, int n, int m, int k,
                                             long long* __restrict__ indices) {
  __shared__ float tile[3][TILE];
  const int lane = threadIdx.x & 31;
  const int query = blockIdx.x * QUERIES_PER_BLOCK + (threadIdx.x >> 5);
  const bool active = query < n;
  float x = 0.f, y = 0.f, z = 0.f;
  if (active) {
    x = queries[3 * query];
    y = queries[3 * query + 1];
    z = queries[3 * query + 2];
  }
  float distance = FARTHEST, bound = FARTHEST;
  int index = 0;
  for (int first = 0; first < m; first += TILE) {
    const int count = min(TILE, m - first);
    const float* source = points + 3 * (long long)first;
    __syncthreads();
    for (int i = threadIdx.x; i < 3 * count; i += blockDim.x) tile[i % 3][i / 3] = source[i];
    __syncthreads();
    if (!active) continue;
    for (int start = 0; start < count; start += 32) {
      const int j = start + lane;
      float mine = FARTHEST;
      if (j < count) {
        // Differences, not the expanded square: those of nearly equal coordinates are exact.
        const float dx = tile[0][j] - x, dy = tile[1][j] - y, dz = tile[2][j] - z;
        mine = dx * dx + dy * dy + dz * dz;
      }
      u32 nearer = __ballot_sync(ALL_LANES, mine < bound);
      while (nearer) {
        const int from = __ffs(nearer) - 1;
        nearer &= nearer - 1;
        const float candidate = __shfl_sync(ALL_LANES, mine, from);
        if (!(candidate < bound)) continue;  // the same in all lanes
        const int place = __popc(__ballot_sync(ALL_LANES, distance <= candidate));
        const float before = __shfl_up_sync(ALL_LANES, distance, 1);
        const int index_before = __shfl_up_sync(ALL_LANES, index, 1);
        if (lane > place) {
          distance = before;
          index = index_before;
        } else if (lane == place) {
          distance = candidate;
          index = first + start + from;
        }
        bound = __shfl_sync(ALL_LANES, distance, k - 1);
      }
    }
  }
  if (active && lane < k) indices[(long long)query * k + lane] = index;
}
