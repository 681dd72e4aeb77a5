// Variational refinement of a dense flow (Brox et al. 2004, normalised as by Kroeger et al. 2016).
//
// Minimises over the image   delta psi(E_I) + gamma psi(E_G) + alpha psi(E_S),  psi(s^2) =
// sqrt(s^2 + eps^2): constancy of brightness and of its gradient, each divided by the norm of its
// own derivative, and the squared gradient of the flow. One launch warps by the present flow,
// linearises, fixes the robust weights and runs red-black successive over-relaxation in tiles that
// overlap; values around a tile stay as they were (restricted additive Schwarz).
#include "flow.cuh"

#define TILE 32
#define OVERLAP 4
#define INNER (TILE - 2 * OVERLAP)
#define ROWS 8  // of threads; each has TILE / ROWS pixels of a column
#define EACH (TILE / ROWS)
#define IMAGE (TILE + 4)
#define FIELD (TILE + 2)

// Quadratic data term of one pixel: half of f^T A f - c^T f in the flow f.
struct DataTerm {
  float xx, xy, yy, cx, cy;
};

// Add weight (f - f0) . (g_x, g_y) = -difference in least squares.
__device__ __forceinline__ void add_constraint(DataTerm& t, float weight, float gx, float gy, float difference, float u, float v) {
  float b = gx * u + gy * v - difference;
  t.xx += weight * gx * gx;
  t.xy += weight * gx * gy;
  t.yy += weight * gy * gy;
  t.cx += weight * gx * b;
  t.cy += weight * gy * b;
}

__device__ __forceinline__ DataTerm data_term(const float (*mean)[IMAGE + 1], const float (*diff)[IMAGE + 1], int i, int j, float u, float v, float gamma, float delta, float zeta2, float eps2) {
  // (i, j) is in the image tiles' own coordinates.
  float ix = 0.5f * (mean[j][i + 1] - mean[j][i - 1]), iy = 0.5f * (mean[j + 1][i] - mean[j - 1][i]);
  float ixx = 0.25f * (mean[j][i + 2] - 2.f * mean[j][i] + mean[j][i - 2]);
  float iyy = 0.25f * (mean[j + 2][i] - 2.f * mean[j][i] + mean[j - 2][i]);
  float ixy = 0.25f * (mean[j + 1][i + 1] - mean[j + 1][i - 1] - mean[j - 1][i + 1] + mean[j - 1][i - 1]);
  float iz = diff[j][i];
  float ixz = 0.5f * (diff[j][i + 1] - diff[j][i - 1]), iyz = 0.5f * (diff[j + 1][i] - diff[j - 1][i]);

  DataTerm t = {0.f, 0.f, 0.f, 0.f, 0.f};
  float n = 1.f / (ix * ix + iy * iy + zeta2);
  add_constraint(t, delta * n * rsqrtf(iz * iz * n + eps2), ix, iy, iz, u, v);
  float nx = 1.f / (ixx * ixx + ixy * ixy + zeta2), ny = 1.f / (ixy * ixy + iyy * iyy + zeta2);
  float weight = gamma * rsqrtf(ixz * ixz * nx + iyz * iyz * ny + eps2);
  add_constraint(t, weight * nx, ixx, ixy, ixz, u, v);
  add_constraint(t, weight * ny, ixy, iyy, iyz, u, v);
  return t;
}

// One relaxation step of a pixel: f += c + M (weighted sum of the neighbours) - relaxation f.
struct Stencil {
  float xx, xy, yy, cx, cy;  // M = relaxation (A + sum of weights)^-1, and M c
  float west, east, north, south;
};

// Row in U and V of pixel k of this thread.
__device__ __forceinline__ int row_of(int k) {
  return threadIdx.y * EACH + (k & ~1) + ((threadIdx.x + k) & 1) + 1;
}

extern "C" __global__ void __launch_bounds__(256) flow_refine(const long long* images, const float* warped, const float2* before, float2* after, int stride, int width, int height, int level, int sweeps, float alpha, float gamma, float delta, float zeta2, float eps2, float relaxation) {
  __shared__ float mean[IMAGE][IMAGE + 1], diff[IMAGE][IMAGE + 1];
  // Rows of even length: lanes of a warp that work on alternating rows then meet no bank twice.
  __shared__ float U[FIELD][FIELD], V[FIELD][FIELD], smooth[FIELD][FIELD];
  Level size = pyramid_level(width, height, level);
  int d = blockIdx.z, thread = threadIdx.y * TILE + threadIdx.x;
  int left = blockIdx.x * INNER - OVERLAP, top = blockIdx.y * INNER - OVERLAP;
  const float* image = source_image(images, d) + size.offset;
  const float* target = warped + (long long)d * stride + size.offset;
  const float2* flow = before + (long long)d * size.width * size.height;

  for (int k = thread; k < IMAGE * IMAGE; k += TILE * ROWS) {
    int i = k % IMAGE, j = k / IMAGE;
    int x = clampi(left + i - 2, 0, size.width - 1), y = clampi(top + j - 2, 0, size.height - 1);
    float2 f = flow[y * size.width + x];
    float a = image[y * size.width + x], b = sample_cubic(target, size.width, size.height, x + f.x, y + f.y);
    mean[j][i] = 0.5f * (a + b);
    diff[j][i] = b - a;
    if (i >= 1 && j >= 1 && i <= FIELD && j <= FIELD) {
      U[j - 1][i - 1] = f.x;
      V[j - 1][i - 1] = f.y;
    }
  }
  __syncthreads();
  // Weight of the differences to the next pixel in x and y. Outside, the border is repeated: its
  // differences are zero and pull nothing.
  for (int k = thread; k < (FIELD - 1) * (FIELD - 1); k += TILE * ROWS) {
    int i = k % (FIELD - 1), j = k / (FIELD - 1);
    float ux = U[j][i + 1] - U[j][i], uy = U[j + 1][i] - U[j][i];
    float vx = V[j][i + 1] - V[j][i], vy = V[j + 1][i] - V[j][i];
    smooth[j][i] = alpha * rsqrtf(ux * ux + uy * uy + vx * vx + vy * vy + eps2);
  }
  __syncthreads();
  // Pixel k of a thread has colour k % 2, so that all lanes work on both colours.
  int x = left + (int)threadIdx.x, i = threadIdx.x + 1;
  Stencil stencil[EACH];
#pragma unroll
  for (int k = 0; k < EACH; k++) {
    int j = row_of(k), y = top + j - 1;
    DataTerm t = data_term(mean, diff, i + 1, j + 1, U[j][i], V[j][i], gamma, delta, zeta2, eps2);
    Stencil m;
    m.west = x > 0 ? smooth[j][i - 1] : 0.f;
    m.east = x < size.width - 1 ? smooth[j][i] : 0.f;
    m.north = y > 0 ? smooth[j - 1][i] : 0.f;
    m.south = y < size.height - 1 ? smooth[j][i] : 0.f;
    float sum = m.west + m.east + m.north + m.south, a = t.xx + sum, c = t.yy + sum;
    float scale = relaxation / (a * c - t.xy * t.xy);
    m.xx = scale * c;
    m.xy = -scale * t.xy;
    m.yy = scale * a;
    m.cx = m.xx * t.cx + m.xy * t.cy;
    m.cy = m.xy * t.cx + m.yy * t.cy;
    stencil[k] = m;
  }
  // Pixels outside the image are relaxed like the others; nothing inside depends on them.
  for (int sweep = 0; sweep < sweeps; sweep++) {
#pragma unroll
    for (int colour = 0; colour < 2; colour++) {
#pragma unroll
      for (int k = colour; k < EACH; k += 2) {
        const Stencil& m = stencil[k];
        int j = row_of(k);
        float su = m.west * U[j][i - 1] + m.east * U[j][i + 1] + m.north * U[j - 1][i] + m.south * U[j + 1][i];
        float sv = m.west * V[j][i - 1] + m.east * V[j][i + 1] + m.north * V[j - 1][i] + m.south * V[j + 1][i];
        U[j][i] += m.cx + m.xx * su + m.xy * sv - relaxation * U[j][i];
        V[j][i] += m.cy + m.xy * su + m.yy * sv - relaxation * V[j][i];
      }
      __syncthreads();
    }
  }
  if (threadIdx.x < OVERLAP || threadIdx.x >= TILE - OVERLAP || x >= size.width) return;
  for (int k = 0; k < EACH; k++) {
    int j = threadIdx.y * EACH + k, y = top + j;
    if (j >= OVERLAP && j < TILE - OVERLAP && y < size.height)
      after[((long long)d * size.height + y) * size.width + x] = make_float2(U[j + 1][i], V[j + 1][i]);
  }
}
