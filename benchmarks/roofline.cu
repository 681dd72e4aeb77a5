// Independent multiply-adds, to measure how many a GPU does in a second.
#include "common.cuh"

#define CHAINS 8

template <class Real>
__device__ __forceinline__ void multiply_add(int rounds, Real factor, Real* out) {
  Real x[CHAINS];
  for (int k = 0; k < CHAINS; k++) x[k] = (Real)(threadIdx.x + k);
  #pragma unroll 16
  for (int r = 0; r < rounds; r++) {
    #pragma unroll
    for (int k = 0; k < CHAINS; k++) x[k] = x[k] * factor + factor;
  }
  Real sum = 0;
  for (int k = 0; k < CHAINS; k++) sum += x[k];
  out[blockIdx.x * blockDim.x + threadIdx.x] = sum;
}

// ``out`` has one number per thread, so that nothing can be left out.
extern "C" __global__ void multiply_add_single(int rounds, float factor, float* out) {
  multiply_add(rounds, factor, out);
}

extern "C" __global__ void multiply_add_double(int rounds, double factor, double* out) {
  multiply_add(rounds, factor, out);
}
