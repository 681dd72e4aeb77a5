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

// Sum over a block whose size is a multiple of 32, in every thread; all take part.
__device__ __forceinline__ float block_sum(float x) {
  __shared__ float partial[32];
  x = warp_sum(x);
  __syncthreads();
  if (!(threadIdx.x & 31)) partial[threadIdx.x >> 5] = x;
  __syncthreads();
  float sum = 0.f;
  for (int w = 0; w < (int)blockDim.x >> 5; w++) sum += partial[w];
  return sum;
}
