// The damped camera system of a few poses, solved by Cholesky's method in one block.
#include "common.cuh"

#define MAX_POSES 16
#define ROW(i) ((i) * ((i) + 1) / 2)  // start of a row of a packed lower triangle

// L of a 6 x 6 diagonal block in place, by one thread; false if it is not positive definite.
__device__ bool factor_block(double* L, int k) {
  bool good = true;
  for (int c = 0; c < 6; c++) {
    double* row = L + ROW(k + c) + k;
    double d = row[c];
    for (int m = 0; m < c; m++) d -= row[m] * row[m];
    good &= d > 0.0 && isfinite(d);
    double s = rsqrt(d);
    row[c] = d * s;
    for (int r = c + 1; r < 6; r++) {
      double* below = L + ROW(k + r) + k;
      double x = below[c];
      for (int m = 0; m < c; m++) x -= below[m] * row[m];
      below[c] = x * s;
    }
  }
  return good;
}

// Steps of all frames; zero for the fixed, NaN where the system has no solution. One block.
extern "C" __global__ void __launch_bounds__(256) solve_camera_system(
    const double* H, const double* g, const int* slot, int poses, int frames, double damping,
    double* xi) {
  // The right-hand side is the last row, so that the factorisation substitutes forward as well.
  __shared__ double L[ROW(6 * MAX_POSES) + 6 * MAX_POSES];
  __shared__ int good;
  int n = 6 * poses;
  if (threadIdx.x == 0) good = 1;
  for (int k = threadIdx.x; k < n * n; k += blockDim.x) {
    int r = k / n, c = k % n;
    if (c <= r) L[ROW(r) + c] = r == c ? H[k] + damping * fabs(H[k]) + 1e-2 : H[k];
  }
  for (int k = threadIdx.x; k < n; k += blockDim.x) L[ROW(n) + k] = g[k];
  __syncthreads();
  for (int k = 0; k < n; k += 6) {
    if (threadIdx.x == 0 && !factor_block(L, k)) good = 0;
    __syncthreads();
    for (int r = k + 6 + threadIdx.x; r <= n; r += blockDim.x) {
      double* row = L + ROW(r) + k;
      for (int c = 0; c < 6; c++) {
        const double* factor = L + ROW(k + c) + k;
        double x = row[c];
        for (int m = 0; m < c; m++) x -= row[m] * factor[m];
        row[c] = x / factor[c];
      }
    }
    __syncthreads();
    int rest = n - k - 6;
    for (int m = threadIdx.x; m < (rest + 1) * rest; m += blockDim.x) {
      int r = k + 6 + m / rest, c = k + 6 + m % rest;
      if (c > r) continue;
      const double *a = L + ROW(r) + k, *b = L + ROW(c) + k;
      double x = L[ROW(r) + c];
      for (int q = 0; q < 6; q++) x -= a[q] * b[q];
      L[ROW(r) + c] = x;
    }
    __syncthreads();
  }
  double* y = L + ROW(n);
  for (int k = n - 6; k >= 0; k -= 6) {
    if (threadIdx.x == 0)
      for (int c = 5; c >= 0; c--) {
        double x = y[k + c];
        for (int m = c + 1; m < 6; m++) x -= L[ROW(k + m) + k + c] * y[k + m];
        y[k + c] = x / L[ROW(k + c) + k + c];
      }
    __syncthreads();
    for (int c = threadIdx.x; c < k; c += blockDim.x)
      for (int m = 0; m < 6; m++) y[c] -= L[ROW(k + m) + c] * y[k + m];
    __syncthreads();
  }
  for (int k = threadIdx.x; k < 6 * frames; k += blockDim.x) {
    int s = slot[k / 6];
    double step = s < 0 ? 0.0 : y[6 * s + k % 6];
    xi[k] = good || s < 0 ? step : (double)__int_as_float(0x7fc00000);
  }
}
