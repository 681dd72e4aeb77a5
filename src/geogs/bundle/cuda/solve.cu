// Solves the damped camera system, (N + 1) x N row by row: the lower triangle, then the right-hand
// side as one more row, so that the factorisation substitutes forward as well.
#include "cholesky.cuh"

#define MAX_POSES 16
#define PANEL 48      // columns factored at a time, a multiple of 6
#define PITCH 49
#define TILE 32

// A few poses, in one block.
extern "C" __global__ void __launch_bounds__(256) solve_few_poses(
    const double* system, const int* slot, int poses, int frames, double* xi) {
  __shared__ double L[(6 * MAX_POSES + 1) * (6 * MAX_POSES + 2) / 2];
  __shared__ int good;
  int n = 6 * poses;
  auto row = [](int i) { return L + i * (i + 1) / 2; };
  if (threadIdx.x == 0) good = 1;
  for (int k = threadIdx.x; k < (n + 1) * n; k += blockDim.x)
    if (k % n <= k / n) row(k / n)[k % n] = system[k];
  __syncthreads();
  factor_rows(row, n, n + 1, &good);
  double* y = row(n);
  for (int k = n - 6; k >= 0; k -= 6) {
    if (threadIdx.x == 0)
      for (int c = 5; c >= 0; c--) {
        double x = y[k + c];
        for (int m = c + 1; m < 6; m++) x -= row(k + m)[k + c] * y[k + m];
        y[k + c] = x / row(k + c)[k + c];
      }
    __syncthreads();
    for (int c = threadIdx.x; c < k; c += blockDim.x)
      for (int m = 0; m < 6; m++) y[c] -= row(k + m)[c] * y[k + m];
    __syncthreads();
  }
  store_steps(y, slot, frames, good, xi);
}

// Inverse of the factor of the panel's diagonal block at column k, into `inverses` (PANEL x PANEL,
// row by row, panel after panel); the first panel sets `good`, a bad one clears it. One block.
extern "C" __global__ void __launch_bounds__(256) factor_panel(
    const double* system, int n, int k, double* inverses, int* good) {
  __shared__ double L[PANEL * PITCH], inverse[PANEL * PITCH];
  __shared__ int fine;
  int size = min(PANEL, n - k);
  auto row = [](int i) { return L + i * PITCH; };
  if (threadIdx.x == 0) fine = 1;
  for (int m = threadIdx.x; m < size * size; m += blockDim.x)
    row(m / size)[m % size] = system[(size_t)(k + m / size) * n + k + m % size];
  __syncthreads();
  factor_rows(row, size, size, &fine);
  for (int c = threadIdx.x; c < size; c += blockDim.x)
    for (int r = c; r < size; r++) {
      double x = r == c ? 1.0 : 0.0;
      for (int m = c; m < r; m++) x -= row(r)[m] * inverse[m * PITCH + c];
      inverse[r * PITCH + c] = x / row(r)[r];
    }
  __syncthreads();
  double* out = inverses + (size_t)(k / PANEL) * PANEL * PANEL;
  for (int m = threadIdx.x; m < size * size; m += blockDim.x) {
    int r = m / size, c = m % size;
    out[r * PANEL + c] = c <= r ? inverse[r * PITCH + c] : 0.0;
  }
  if (threadIdx.x == 0) {
    if (k == 0) *good = fine;
    else if (!fine) *good = 0;
  }
}

// Rows below the panel times L^-T. Blocks of TILE rows.
extern "C" __global__ void __launch_bounds__(256) substitute_panel(
    double* system, int n, int k, const double* inverses) {
  __shared__ double rows[TILE * PITCH];
  int size = min(PANEL, n - k), top = k + size + blockIdx.x * TILE, count = min(TILE, n + 1 - top);
  const double* inverse = inverses + (size_t)(k / PANEL) * PANEL * PANEL;
  for (int m = threadIdx.x; m < count * size; m += blockDim.x)
    rows[m / size * PITCH + m % size] = system[(size_t)(top + m / size) * n + k + m % size];
  __syncthreads();
  for (int m = threadIdx.x; m < count * size; m += blockDim.x) {
    const double *a = rows + m / size * PITCH, *b = inverse + m % size * PANEL;
    double x = 0.0;
    for (int q = 0; q <= m % size; q++) x += a[q] * b[q];
    system[(size_t)(top + m / size) * n + k + m % size] = x;
  }
}

// Takes the panel's products off the rest of the lower triangle. Tiles of columns x and rows y.
extern "C" __global__ void __launch_bounds__(256) update_rest(double* system, int n, int k) {
  __shared__ double a[TILE * PITCH], b[TILE * PITCH];
  int size = min(PANEL, n - k), start = k + size;
  int left = start + blockIdx.x * TILE, top = start + blockIdx.y * TILE;
  if (left > top + TILE - 1) return;
  for (int m = threadIdx.x; m < TILE * size; m += blockDim.x) {
    int r = m / size, c = m % size;
    a[r * PITCH + c] = top + r <= n ? system[(size_t)(top + r) * n + k + c] : 0.0;
    b[r * PITCH + c] = left + r < n ? system[(size_t)(left + r) * n + k + c] : 0.0;
  }
  __syncthreads();
  for (int m = threadIdx.x; m < TILE * TILE; m += blockDim.x) {
    int r = m / TILE, c = m % TILE;
    if (top + r > n || left + c >= n || left + c > top + r) continue;
    double x = 0.0;
    for (int q = 0; q < size; q++) x += a[r * PITCH + q] * b[c * PITCH + q];
    system[(size_t)(top + r) * n + left + c] -= x;
  }
}

// Substitutes backward from the last row, which is overwritten. One block.
extern "C" __global__ void __launch_bounds__(1024) substitute_back(
    double* system, int n, const double* inverses, const int* good, const int* slot, int frames,
    double* xi) {
  __shared__ double x[PANEL];
  double* y = system + (size_t)n * n;
  for (int k = (n - 1) / PANEL * PANEL; k >= 0; k -= PANEL) {
    int size = min(PANEL, n - k);
    const double* inverse = inverses + (size_t)(k / PANEL) * PANEL * PANEL;
    for (int c = threadIdx.x; c < size; c += blockDim.x) {
      double s = 0.0;
      for (int m = c; m < size; m++) s += inverse[m * PANEL + c] * y[k + m];
      x[c] = s;
    }
    __syncthreads();
    for (int c = threadIdx.x; c < k + size; c += blockDim.x) {
      if (c >= k) {
        y[c] = x[c - k];
        continue;
      }
      double s = y[c];
      for (int m = 0; m < size; m++) s -= system[(size_t)(k + m) * n + c] * x[m];
      y[c] = s;
    }
    __syncthreads();
  }
  store_steps(y, slot, frames, *good, xi);
}
