// Completion of the tracker's grid: reweighted least squares by a banded Cholesky factorisation in
// double precision, one block per keyframe.
//
// Unknowns are numbered along the shorter side of the grid first, so that the band is two of its
// lengths wide, and padded to a multiple of PANEL. The factorisation moves a window of band + PANEL
// rows over the matrix in shared memory: row i lies at i modulo the window, and when a panel of
// columns is done its place is taken by the next rows.
#include "common.cuh"

#define PANEL 8
#define WARPS PANEL
#define MAX_HELD 6  // window <= 32 * MAX_HELD
#define ROUNDS 4

struct Grid {
  int minors, majors, minor_stride, major_stride;  // of cells: index = major * minors + minor
  int cells, padded;
};

// What belongs to each unknown, in global memory, `padded` numbers each. `rows` are six such arrays:
// the normal matrix's diagonal, its bands 1, 2, minors and 2 minors below, and the right side.
struct Unknowns {
  double *rows, *smoothness, *data, *scale, *weight, *solution;
};

__device__ __forceinline__ int cell_of(const Grid& g, int i) {
  return i / g.minors * g.major_stride + i % g.minors * g.minor_stride;
}

__device__ __forceinline__ bool is_known(float inverse_depth, float information) {
  return isfinite(inverse_depth) && inverse_depth > 1e-6f && isfinite(information) &&
         information > 0.f;
}

// Normal matrix of second and first differences along one line of cells, `step` unknowns apart:
// cell number `at` of `length` at unknown i. Adds to the diagonal, writes the two off-diagonals.
__device__ __forceinline__ void line_bands(
    const float* smooth, const Grid& g, int i, int at, int length, int step, double bend,
    double stretch, double& diagonal, double& next, double& second) {
  double w[5] = {0., 0., 0., 0., 0.};  // of the cells at - 2 ... at + 2
  for (int k = -2; k <= 2; k++)
    if (at + k >= 0 && at + k < length) w[k + 2] = smooth[cell_of(g, i + k * step)];
  auto bent = [&](int k) {
    const double b = bend * w[k + 2];
    return at + k >= 1 && at + k < length - 1 ? b * b : 0.;
  };
  auto stretched = [&](int k) {
    const double s = stretch * fmin(w[k + 2], w[k + 3]);
    return at + k >= 0 && at + k + 1 < length ? s * s : 0.;
  };
  diagonal += bent(-1) + 4. * bent(0) + bent(1) + stretched(-1) + stretched(0);
  next = at + 1 < length ? -2. * bent(0) - 2. * bent(1) - stretched(0) : 0.;
  second = at + 2 < length ? bent(1) : 0.;
}

__device__ void prepare_unknowns(
    const float* grids, const Grid& g, double typical, double bend, double stretch,
    double sigma_scale, const Unknowns& u) {
  const float *inverse_depth = grids, *information = grids + g.cells, *smooth = grids + 2 * g.cells;
  for (int i = threadIdx.x; i < g.padded; i += blockDim.x) {
    double diagonal = 0., next[2] = {0., 0.}, second[2] = {0., 0.}, data = 0., scale = 1.;
    if (i < g.cells) {
      line_bands(smooth, g, i, i % g.minors, g.minors, 1, bend, stretch, diagonal, next[0], second[0]);
      line_bands(smooth, g, i, i / g.minors, g.majors, g.minors, bend, stretch, diagonal, next[1],
                 second[1]);
      const int c = cell_of(g, i);
      const bool known = is_known(inverse_depth[c], information[c]);
      data = known ? inverse_depth[c] : typical;
      scale = sigma_scale / sqrt((known ? information[c] : 0.) + 1e-9) + 0.002 * data;
      diagonal += 1e-6 / (typical * typical);
    }
    u.smoothness[i] = diagonal;
    u.rows[g.padded + i] = next[0];
    u.rows[2 * g.padded + i] = second[0];
    u.rows[3 * g.padded + i] = next[1];
    u.rows[4 * g.padded + i] = second[1];
    u.data[i] = data;
    u.scale[i] = scale;
    u.solution[i] = data;
  }
}

// Cauchy weights about the last solution, and with them the diagonal and the right side.
__device__ void weigh_data(const Grid& g, const Unknowns& u) {
  for (int i = threadIdx.x; i < g.padded; i += blockDim.x) {
    const double away = (u.solution[i] - u.data[i]) / (2. * u.scale[i]);
    const double weight = 1. / (1. + away * away), precision = weight / (u.scale[i] * u.scale[i]);
    u.weight[i] = weight;
    u.rows[i] = u.smoothness[i] + precision;
    u.rows[5 * g.padded + i] = precision * u.data[i];
  }
}

// Columns that array number `lane` of the rows lies below the diagonal.
__device__ __forceinline__ int band_offset(const Grid& g, int lane) {
  return lane == 1 || lane == 2 ? lane : (lane == 3 || lane == 4 ? (lane - 2) * g.minors : 0);
}

// Number `lane` of row i; beyond the last unknown follows the unit matrix.
__device__ __forceinline__ double row_entry(const Grid& g, const Unknowns& u, int i, int lane) {
  const int j = i - band_offset(g, lane);
  if (lane > 5 || j < 0) return 0.;
  return i < g.padded ? u.rows[lane * g.padded + j] : (lane == 0 ? 1. : 0.);
}

// The window and what the threads exchange, in shared memory.
struct Window {
  int size;         // band + PANEL
  double* matrix;   // (size, size + 1), circular
  double* right;    // (size), circular: right side, then the solution
  double* panel;    // (PANEL, size): factored columns by offset from the panel's first row
  double* diagonal; // (PANEL, PANEL): diagonal block of the back substitution
  double* solved;   // (PANEL): the panel's part of the solved right side
};

__device__ __forceinline__ int place(const Window& w, int start, int offset) {
  const int p = start + offset;
  return p < w.size ? p : p - w.size;
}

// Cholesky factor of the panel's diagonal block, with the inverse of its diagonal. Every thread
// makes its own: quicker than to wait for one that shares it.
__device__ __forceinline__ void factor_diagonal(
    const Window& w, int start, double (&l)[PANEL][PANEL], double (&inverse)[PANEL]) {
#pragma unroll
  for (int i = 0; i < PANEL; i++)
#pragma unroll
    for (int j = 0; j <= i; j++) l[i][j] = w.matrix[(start + i) * (w.size + 1) + start + j];
#pragma unroll
  for (int k = 0; k < PANEL; k++) {
    inverse[k] = rsqrt(l[k][k]);
#pragma unroll
    for (int i = k; i < PANEL; i++) l[i][k] *= inverse[k];
#pragma unroll
    for (int i = k + 1; i < PANEL; i++)
#pragma unroll
      for (int j = k + 1; j <= i; j++) l[i][j] -= l[i][k] * l[j][k];
  }
}

// Rows below the diagonal block, and the right side as one more row, times its inverse transpose.
// The stored factor has the inverse of its diagonal in the diagonal's place.
__device__ void solve_panel(const Window& w, int start, int first, double* factor, double* solved) {
  double l[PANEL][PANEL], inverse[PANEL];
  factor_diagonal(w, start, l, inverse);
  for (int o = threadIdx.x; o <= w.size; o += blockDim.x) {
    const double* row = o < w.size ? w.matrix + place(w, start, o) * (w.size + 1) : w.right;
    double x[PANEL];
#pragma unroll
    for (int k = 0; k < PANEL; k++) {
      double s = row[start + k];
#pragma unroll
      for (int m = 0; m < k; m++) s -= x[m] * l[k][m];
      x[k] = o == k ? inverse[k] : s * inverse[k];
      if (o < w.size) {
        w.panel[k * w.size + o] = x[k];
        factor[k * w.size + o] = x[k];
      } else {
        w.solved[k] = x[k];
        solved[first + k] = x[k];
      }
    }
  }
}

// Subtract the panel's products from a 4 x 4 tile of the rest of the window, or from its right side.
__device__ void update_window(const Window& w, int start) {
  const int tiles = (w.size - PANEL) / 4, pairs = tiles * (tiles + 1) / 2;
  for (int e = threadIdx.x; e < pairs + w.size - PANEL; e += blockDim.x) {
    if (e >= pairs) {
      const int o = e - pairs + PANEL;
      double sum = 0.;
      for (int k = 0; k < PANEL; k++) sum += w.panel[k * w.size + o] * w.solved[k];
      w.right[place(w, start, o)] -= sum;
      continue;
    }
    int ti = (int)((sqrtf(8.f * e + 1.f) - 1.f) * 0.5f);
    while (ti * (ti + 1) / 2 > e) ti--;
    while ((ti + 1) * (ti + 2) / 2 <= e) ti++;
    const int i0 = PANEL + 4 * ti, j0 = PANEL + 4 * (e - ti * (ti + 1) / 2);
    double sum[4][4] = {};
#pragma unroll
    for (int k = 0; k < PANEL; k++) {
      const double *a = w.panel + k * w.size + i0, *b = w.panel + k * w.size + j0;
#pragma unroll
      for (int i = 0; i < 4; i++)
#pragma unroll
        for (int j = 0; j < 4; j++) sum[i][j] += a[i] * b[j];
    }
    double* tile = w.matrix + place(w, start, i0) * (w.size + 1) + place(w, start, j0);
#pragma unroll
    for (int i = 0; i < 4; i++)
#pragma unroll
      for (int j = 0; j < 4; j++) tile[i * (w.size + 1) + j] -= sum[i][j];
  }
}

// Row i takes its place in the window: one warp.
__device__ __forceinline__ void enter_row(
    const Grid& g, const Window& w, int position, double value) {
  const int lane = threadIdx.x & 31, column = position - band_offset(g, lane);
  for (int p = lane; p < w.size; p += 32) w.matrix[position * (w.size + 1) + p] = 0.;
  __syncwarp();
  if (lane < 5) w.matrix[position * (w.size + 1) + (column < 0 ? column + w.size : column)] = value;
  if (lane == 5) w.right[position] = value;
}

// factor (padded / PANEL, PANEL, size) and the solved right side.
__device__ void factorise(
    const Grid& g, const Unknowns& u, const Window& w, double* factor, double* solved) {
  const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
  for (int i = warp; i < w.size; i += WARPS) enter_row(g, w, i, row_entry(g, u, i, lane));
  __syncthreads();
  int start = 0;
  for (int first = 0; first < g.padded; first += PANEL) {
    solve_panel(w, start, first, factor + (long long)first * w.size, solved);
    __syncthreads();
    // The next rows are fetched while the window is updated; they take the panel's place.
    const double value = row_entry(g, u, first + w.size + warp, lane);
    update_window(w, start);
    enter_row(g, w, start + warp, value);
    start = place(w, start, PANEL);
    __syncthreads();
  }
}

// One column of a panel of the factor, spread over the lanes.
__device__ __forceinline__ void hold_column(
    const double* column, int size, double (&held)[MAX_HELD]) {
#pragma unroll
  for (int n = 0; n < MAX_HELD; n++) {
    const int o = 32 * n + (threadIdx.x & 31);
    held[n] = o < size ? column[o] : 0.;
  }
}

// Back substitution, panel by panel from the end: warp k works on the panel's column k.
__device__ void substitute(
    const Grid& g, const Unknowns& u, const Window& w, const double* factor, const double* solved) {
  const int lane = threadIdx.x & 31, k = threadIdx.x >> 5;
  for (int i = threadIdx.x; i < w.size; i += blockDim.x) w.right[i] = 0.;
  int first = g.padded - PANEL;
  double held[MAX_HELD], right = solved[first + k];
  hold_column(factor + (long long)(first + k) * w.size, w.size, held);
  __syncthreads();
  for (; first >= 0; first -= PANEL) {
    const int start = first % w.size;
    double sum = 0.;
#pragma unroll
    for (int n = 0; n < MAX_HELD; n++) {
      const int o = 32 * n + lane;
      if (o >= PANEL && o < w.size) sum += held[n] * w.right[place(w, start, o)];
    }
    sum = warp_sum(sum);
    if (lane < PANEL) w.diagonal[lane * PANEL + k] = held[0];
    if (lane == 0) w.solved[k] = right - sum;
    if (first > 0) {
      hold_column(factor + (long long)(first - PANEL + k) * w.size, w.size, held);
      right = solved[first - PANEL + k];
    }
    __syncthreads();
    if (threadIdx.x < 32) {
      const int c = lane & (PANEL - 1);
      double x = w.solved[c];
      const double inverse = w.diagonal[c * PANEL + c];
#pragma unroll
      for (int o = PANEL - 1; o >= 0; o--) {
        const double above = __shfl_sync(ALL_LANES, x * inverse, o);
        if (o > c) x -= w.diagonal[o * PANEL + c] * above;
      }
      if (lane < PANEL) {
        w.right[start + c] = x * inverse;
        u.solution[first + c] = x * inverse;
      }
    }
    __syncthreads();
  }
}

// Constants of the completion, in the order in which completion.py passes them.
struct CompletionSettings {
  float sigma_scale, bending, membrane, sure_deviation, tracker_scale, unknown_deviation,
      best_deviation, kink;
};

__device__ __forceinline__ float bend_at(const float* q, int cell, int at, int length, int step) {
  return at < 1 || at >= length - 1 ? 0.f : fabsf(q[cell + step] + q[cell - step] - 2.f * q[cell]);
}

// Inverse depth held within bounds; the prior's weight and the relative precision of each cell.
__device__ void write_evidence(
    const float* grids, const Grid& g, const Unknowns& u, float typical, const CompletionSettings& s,
    float* out) {
  for (int i = threadIdx.x; i < g.cells; i += blockDim.x)
    out[cell_of(g, i)] = fminf(fmaxf((float)u.solution[i], 0.12f * typical), 7.f * typical);
  __syncthreads();
  for (int i = threadIdx.x; i < g.cells; i += blockDim.x) {
    const int c = cell_of(g, i);
    const bool known = is_known(grids[c], grids[g.cells + c]);
    const bool inlier = known && u.weight[i] > 0.3;
    const double amount = known ? (double)grids[g.cells + c] : 0.;
    const float deviation = (float)(1. / (u.data[i] * sqrt(amount) + 1e-3));
    const float unsure = deviation / s.sure_deviation;
    const float sigma =
        fmaxf(s.tracker_scale * (inlier ? deviation : s.unknown_deviation), s.best_deviation);
    const float bend = fmaxf(bend_at(out, c, i % g.minors, g.minors, g.minor_stride),
                             bend_at(out, c, i / g.minors, g.majors, g.major_stride));
    const float kinked = bend / (s.kink * out[c]);
    const float flat = __expf(-kinked * kinked);
    out[g.cells + c] = inlier ? flat / (1.f + unsure * unsure) : 0.f;
    out[2 * g.cells + c] = flat * flat / (sigma * sigma);
  }
}

// grids (keyframes, 3, cells): the tracker's inverse depth, its information, smoothness weights;
// typical (keyframes): median inverse depth. out (keyframes, 3, cells): completed inverse depth,
// prior weight, relative precision. scratch (keyframes, padded (12 + window)).
// Block of 32 x PANEL threads; shared: (window^2 + window (PANEL + 2) + PANEL (PANEL + 1)) doubles
// with window = band + PANEL.
extern "C" __global__ void __launch_bounds__(256) complete_grids(
    const float* grids, const float* typical, const float* settings, int minors, int majors,
    int minor_stride, int major_stride, int padded, int band, double* scratch, float* out) {
  SHARED_MEMORY(double, shared);
  const Grid g = {minors, majors, minor_stride, major_stride, minors * majors, padded};
  Window w;
  w.size = band + PANEL;
  w.matrix = shared;
  w.right = w.matrix + w.size * (w.size + 1);
  w.panel = w.right + w.size;
  w.diagonal = w.panel + PANEL * w.size;
  w.solved = w.diagonal + PANEL * PANEL;
  double* own = scratch + (long long)blockIdx.x * padded * (12 + w.size);
  const Unknowns u = {own, own + 6 * padded, own + 7 * padded, own + 8 * padded, own + 9 * padded,
                      own + 10 * padded};
  double *solved = own + 11 * padded, *factor = own + 12 * padded;
  const CompletionSettings s = *(const CompletionSettings*)settings;
  grids += (long long)blockIdx.x * 3 * g.cells;
  const double usual = typical[blockIdx.x];
  prepare_unknowns(grids, g, usual, 1. / (s.bending * usual), 1. / (s.membrane * usual),
                   s.sigma_scale, u);
  __syncthreads();
  for (int round = 0; round < ROUNDS; round++) {
    weigh_data(g, u);
    __syncthreads();
    factorise(g, u, w, factor, solved);
    substitute(g, u, w, factor, solved);
  }
  weigh_data(g, u);
  __syncthreads();
  write_evidence(grids, g, u, typical[blockIdx.x], s, out + (long long)blockIdx.x * 3 * g.cells);
}
