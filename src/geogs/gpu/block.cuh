// Sums and medians over a block whose size is a multiple of 32; all of its threads take part.
#pragma once
#include "common.cuh"

// Sums over the lanes of 32 values per lane: lane l returns the sum of value l. Every step halves
// the number of values that a lane still holds, so that 31 exchanges do instead of 160.
__device__ __forceinline__ float lane_sums(float* v) {
  int lane = threadIdx.x & 31;
#pragma unroll
  for (int half = 16; half; half >>= 1) {
    bool upper = lane & half;
#pragma unroll
    for (int n = 0; n < 16; n++) {
      if (n >= half) continue;
      float keep = upper ? v[n + half] : v[n], give = upper ? v[n] : v[n + half];
      v[n] = keep + __shfl_xor_sync(ALL_LANES, give, half);
    }
  }
  return v[0];
}

// Sums over the block of 32 values per thread, into shared memory; destroys the values.
__device__ __forceinline__ void block_sums(float* v, double* sums) {
  __shared__ float partial[32][33];
  float mine = lane_sums(v);
  partial[threadIdx.x >> 5][threadIdx.x & 31] = mine;
  __syncthreads();
  if (threadIdx.x < 32) {
    double sum = 0.0;
    for (int w = 0; w < (int)blockDim.x >> 5; w++) sum += partial[w][threadIdx.x];
    sums[threadIdx.x] = sum;
  }
  __syncthreads();
}

// A value left out of a median; above every key of a number.
#define LEFT_OUT 0xffffffffu

// Key of a value that is not negative; keys are ordered as the values. NaN is above all numbers.
__device__ __forceinline__ u32 median_key(float x) { return __float_as_uint(x) & 0x7fffffffu; }

// Lower median of the keys that are not LEFT_OUT, NaN where there are none, in every thread. The
// bits of the result are found one by one, from the highest.
__device__ float block_median(const u32* keys, int count) {
  __shared__ int below[32], used;
  __syncthreads();
  if (threadIdx.x < 32) below[threadIdx.x] = 0;
  if (threadIdx.x == 0) used = 0;
  __syncthreads();
  int mine = 0;
  for (int i = threadIdx.x; i < count; i += blockDim.x) mine += keys[i] != LEFT_OUT;
  for (int s = 16; s; s >>= 1) mine += __shfl_xor_sync(ALL_LANES, mine, s);
  if (!(threadIdx.x & 31)) atomicAdd(&used, mine);
  __syncthreads();
  int total = used;
  if (total == 0) return __int_as_float(0x7fc00000);
  int rank = (total - 1) / 2;
  u32 key = 0;
  for (int bit = 30; bit >= 0; bit--) {
    u32 candidate = key | (1u << bit);
    mine = 0;
    for (int i = threadIdx.x; i < count; i += blockDim.x) mine += keys[i] < candidate;
    for (int s = 16; s; s >>= 1) mine += __shfl_xor_sync(ALL_LANES, mine, s);
    if (!(threadIdx.x & 31)) atomicAdd(&below[bit], mine);
    __syncthreads();
    if (below[bit] <= rank) key = candidate;
  }
  return __uint_as_float(key);
}
