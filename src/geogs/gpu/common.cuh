// What all kernels share. Compiled by NVRTC, and by g++ against the tests' emulator.
#pragma once

#ifdef __CUDACC__
#define SHARED_MEMORY(type, name) extern __shared__ __align__(16) unsigned char name##_bytes[]; type* name = (type*)name##_bytes
#endif

typedef unsigned int u32;
typedef unsigned long long u64;

#define ALL_LANES 0xffffffffu

// Sum over the lanes of a warp, in every lane.
template <class T>
__device__ __forceinline__ T warp_sum(T x) {
  for (int s = 16; s; s >>= 1) x += __shfl_xor_sync(ALL_LANES, x, s);
  return x;
}

// Largest value of a warp, in every lane.
__device__ __forceinline__ int warp_max(int x) {
  for (int s = 16; s; s >>= 1) x = max(x, __shfl_xor_sync(ALL_LANES, x, s));
  return x;
}
