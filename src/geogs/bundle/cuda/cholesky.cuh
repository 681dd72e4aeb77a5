// Cholesky's method by blocks of 6 columns on rows in shared memory; all threads of a block take
// part. `row(i)` is the start of row i of the lower triangle.
#pragma once
#include "common.cuh"

// L of the 6 x 6 diagonal block at k in place, by one thread; false if not positive definite.
template <class Row> __device__ bool factor_diagonal(Row row, int k) {
  bool good = true;
  for (int c = 0; c < 6; c++) {
    double* at = row(k + c) + k;
    double d = at[c];
    for (int m = 0; m < c; m++) d -= at[m] * at[m];
    good &= d > 0.0 && isfinite(d);
    double s = rsqrt(d);
    at[c] = d * s;
    for (int r = c + 1; r < 6; r++) {
      double* below = row(k + r) + k;
      double x = below[c];
      for (int m = 0; m < c; m++) x -= below[m] * at[m];
      below[c] = x * s;
    }
  }
  return good;
}

// L of the first n rows in place, n a multiple of 6; rows n to rows - 1 become x L^-T. Clears
// `good` (shared) if the matrix is not positive definite.
template <class Row> __device__ void factor_rows(Row row, int n, int rows, int* good) {
  for (int k = 0; k < n; k += 6) {
    if (threadIdx.x == 0 && !factor_diagonal(row, k)) *good = 0;
    __syncthreads();
    for (int r = k + 6 + threadIdx.x; r < rows; r += blockDim.x) {
      double* at = row(r) + k;
      for (int c = 0; c < 6; c++) {
        const double* factor = row(k + c) + k;
        double x = at[c];
        for (int m = 0; m < c; m++) x -= at[m] * factor[m];
        at[c] = x / factor[c];
      }
    }
    __syncthreads();
    int rest = n - k - 6;
    for (int m = threadIdx.x; m < (rows - k - 6) * rest; m += blockDim.x) {
      int r = k + 6 + m / rest, c = k + 6 + m % rest;
      if (c > r) continue;
      const double *a = row(r) + k, *b = row(c) + k;
      double x = row(r)[c];
      for (int q = 0; q < 6; q++) x -= a[q] * b[q];
      row(r)[c] = x;
    }
    __syncthreads();
  }
}

// Steps of all frames from the solution; zero for the fixed, NaN where there is none.
__device__ __forceinline__ void store_steps(
    const double* y, const int* slot, int frames, bool good, double* xi) {
  for (int k = threadIdx.x; k < 6 * frames; k += blockDim.x) {
    int s = slot[k / 6];
    double step = s < 0 ? 0.0 : y[6 * s + k % 6];
    xi[k] = good || s < 0 ? step : (double)__int_as_float(0x7fc00000);
  }
}
