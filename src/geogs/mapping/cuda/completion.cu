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

// Bands of the smoothness term and what belongs to each unknown, in global memory, `padded` each.
struct Unknowns {
  double *diagonal, *next_minor, *second_minor, *next_major, *second_major;
  double *data, *scale, *weight, *solution;
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
    u.diagonal[i] = diagonal;
    u.next_minor[i] = next[0];
    u.second_minor[i] = second[0];
    u.next_major[i] = next[1];
    u.second_major[i] = second[1];
    u.data[i] = data;
    u.scale[i] = scale;
    u.weight[i] = 1.;
  }
}

// Entry (i, j) of the normal matrix, j <= i; the unit matrix beyond the last unknown.
__device__ __forceinline__ double entry(const Grid& g, const Unknowns& u, int i, int j) {
  if (j < 0 || i >= g.padded) return i == j ? 1. : 0.;
  const int k = i - j;
  if (k == 0) return u.diagonal[i] + u.weight[i] / (u.scale[i] * u.scale[i]);
  if (k == 1) return u.next_minor[j];
  if (k == 2) return u.second_minor[j];
  if (k == g.minors) return u.next_major[j];
  return k == 2 * g.minors ? u.second_major[j] : 0.;
}

__device__ __forceinline__ double right_side(const Grid& g, const Unknowns& u, int i) {
  return i < g.cells ? u.weight[i] / (u.scale[i] * u.scale[i]) * u.data[i] : 0.;
}

// The window and what the threads exchange, in shared memory.
struct Window {
  int size;         // band + PANEL
  double* matrix;   // (size, size + 1), circular
  double* right;    // (size), circular: right side, then the solution
  double* panel;    // (PANEL, size): factored columns by offset from the panel's first row
  double* diagonal; // (PANEL, PANEL): factored diagonal block
  double* inverse;  // (PANEL): 1 / its diagonal
  double* solved;   // (PANEL): the panel's part of the solved right side
};

__device__ __forceinline__ int place(const Window& w, int start, int offset) {
  const int p = start + offset;
  return p < w.size ? p : p - w.size;
}

// Factor the panel's diagonal block: lane r of the first warp holds row r.
__device__ void factor_diagonal(const Window& w, int start) {
  const int lane = threadIdx.x, row = lane & (PANEL - 1);
  double a[PANEL];
#pragma unroll
  for (int k = 0; k < PANEL; k++)
    a[k] = k <= row ? w.matrix[(start + row) * (w.size + 1) + start + k] : 0.;
#pragma unroll
  for (int k = 0; k < PANEL; k++) {
    const double inverse = rsqrt(__shfl_sync(ALL_LANES, a[k], k));
    a[k] *= inverse;
    if (lane == k) w.inverse[k] = inverse;
#pragma unroll
    for (int j = k + 1; j < PANEL; j++) a[j] -= a[k] * __shfl_sync(ALL_LANES, a[k], j);
  }
  if (lane < PANEL)
    for (int k = 0; k < PANEL; k++) w.diagonal[row * PANEL + k] = k <= row ? a[k] : 0.;
}

// Rows below the diagonal block, and the right side as one more row, times its inverse transpose.
__device__ void solve_panel(const Window& w, int start, int first, double* factor, double* solved) {
  for (int o = threadIdx.x; o <= w.size; o += blockDim.x) {
    double l[PANEL];
    if (o < PANEL) {
#pragma unroll
      for (int k = 0; k < PANEL; k++) l[k] = w.diagonal[o * PANEL + k];
    } else {
      const double* row = o < w.size ? w.matrix + place(w, start, o) * (w.size + 1) : w.right;
#pragma unroll
      for (int k = 0; k < PANEL; k++) {
        double s = row[start + k];
#pragma unroll
        for (int m = 0; m < k; m++) s -= l[m] * w.diagonal[k * PANEL + m];
        l[k] = s * w.inverse[k];
      }
    }
#pragma unroll
    for (int k = 0; k < PANEL; k++) {
      if (o < w.size) {
        w.panel[k * w.size + o] = l[k];
        factor[k * w.size + o] = l[k];
      } else {
        w.solved[k] = l[k];
        solved[first + k] = l[k];
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

// Rows first + size ... + PANEL - 1 take the place of the panel's.
__device__ void enter_rows(const Grid& g, const Unknowns& u, const Window& w, int start, int first) {
  for (int e = threadIdx.x; e < PANEL * (w.size + 1); e += blockDim.x) {
    const int a = e / (w.size + 1), o = e % (w.size + 1), i = first + w.size + a;
    if (o == w.size) {
      w.right[start + a] = right_side(g, u, i);
    } else {
      const int j = first + PANEL + o;
      w.matrix[(start + a) * (w.size + 1) + place(w, start, (PANEL + o) % w.size)] =
          j <= i ? entry(g, u, i, j) : 0.;
    }
  }
}

// factor (padded / PANEL, PANEL, size) and the solved right side.
__device__ void factorise(
    const Grid& g, const Unknowns& u, const Window& w, double* factor, double* solved) {
  for (int e = threadIdx.x; e < w.size * w.size; e += blockDim.x) {
    const int i = e / w.size, j = e % w.size;
    w.matrix[i * (w.size + 1) + j] = j <= i ? entry(g, u, i, j) : 0.;
    if (j == 0) w.right[i] = right_side(g, u, i);
  }
  __syncthreads();
  int start = 0;
  for (int first = 0; first < g.padded; first += PANEL) {
    if (threadIdx.x < 32) factor_diagonal(w, start);
    __syncthreads();
    solve_panel(w, start, first, factor + (long long)first * w.size, solved);
    __syncthreads();
    update_window(w, start);
    enter_rows(g, u, w, start, first);
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
    for (int s = 16; s; s >>= 1) sum += __shfl_xor_sync(ALL_LANES, sum, s);
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
      const double inverse = 1. / w.diagonal[c * PANEL + c];
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

__device__ void reweight(const Grid& g, const Unknowns& u) {
  for (int i = threadIdx.x; i < g.padded; i += blockDim.x) {
    const double away = (u.solution[i] - u.data[i]) / (2. * u.scale[i]);
    u.weight[i] = 1. / (1. + away * away);
  }
}

// Constants of the completion, in the order in which completion.py passes them.
struct Settings {
  float sigma_scale, bending, membrane, sure_deviation, tracker_scale, unknown_deviation,
      best_deviation, kink;
};

__device__ __forceinline__ float bend_at(const float* q, int cell, int at, int length, int step) {
  return at < 1 || at >= length - 1 ? 0.f : fabsf(q[cell + step] + q[cell - step] - 2.f * q[cell]);
}

// Inverse depth held within bounds; the prior's weight and the relative precision of each cell.
__device__ void write_evidence(
    const float* grids, const Grid& g, const Unknowns& u, float typical, const Settings& s,
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
    out[g.cells + c] = inlier ? 1.f / (1.f + unsure * unsure) : 0.f;
    const float sigma =
        fmaxf(s.tracker_scale * (inlier ? deviation : s.unknown_deviation), s.best_deviation);
    const float bend = fmaxf(bend_at(out, c, i % g.minors, g.minors, g.minor_stride),
                             bend_at(out, c, i / g.minors, g.majors, g.major_stride));
    const float kinked = bend / (s.kink * out[c]);
    out[2 * g.cells + c] = __expf(-2.f * kinked * kinked) / (sigma * sigma);
  }
}

// grids (keyframes, 3, cells): the tracker's inverse depth, its information, smoothness weights;
// typical (keyframes): median inverse depth. out (keyframes, 3, cells): completed inverse depth,
// prior weight, relative precision. scratch (keyframes, 10 padded + padded (band + PANEL)).
// Block of 32 x PANEL threads; shared: (window^2 + window (PANEL + 2) + PANEL (PANEL + 2)) doubles
// with window = band + PANEL.
extern "C" __global__ void complete_grids(
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
  w.inverse = w.diagonal + PANEL * PANEL;
  w.solved = w.inverse + PANEL;
  double* own = scratch + (long long)blockIdx.x * padded * (10 + w.size);
  const Unknowns u = {own, own + padded, own + 2 * padded, own + 3 * padded, own + 4 * padded,
                      own + 5 * padded, own + 6 * padded, own + 7 * padded, own + 8 * padded};
  double *solved = own + 9 * padded, *factor = own + 10 * padded;
  const Settings s = {settings[0], settings[1], settings[2], settings[3],
                      settings[4], settings[5], settings[6], settings[7]};
  grids += (long long)blockIdx.x * 3 * g.cells;
  const double usual = typical[blockIdx.x];
  prepare_unknowns(grids, g, usual, 1. / (s.bending * usual), 1. / (s.membrane * usual),
                   s.sigma_scale, u);
  __syncthreads();
  for (int round = 0; round < ROUNDS; round++) {
    factorise(g, u, w, factor, solved);
    substitute(g, u, w, factor, solved);
    reweight(g, u);
    __syncthreads();
  }
  write_evidence(grids, g, u, typical[blockIdx.x], s, out + (long long)blockIdx.x * 3 * g.cells);
}
