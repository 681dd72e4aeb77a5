// Planes through neighbourhoods of points.
#include "common.cuh"

// Turns the symmetric a (rows xx xy xz yy yz zz) until entry (p, q) is zero, and the columns of v
// with it (Jacobi).
__device__ __forceinline__ void rotate(double a[3][3], double v[3][3], int p, int q) {
  const double off = a[p][q];
  if (off == 0.0) return;
  const double theta = (a[q][q] - a[p][p]) / (2.0 * off);
  const double t = (theta >= 0.0 ? 1.0 : -1.0) / (fabs(theta) + sqrt(theta * theta + 1.0));
  const double c = 1.0 / sqrt(t * t + 1.0), s = t * c;
  const int r = 3 - p - q;
  a[p][p] -= t * off;
  a[q][q] += t * off;
  a[p][q] = a[q][p] = 0.0;
  const double rp = a[r][p], rq = a[r][q];
  a[r][p] = a[p][r] = c * rp - s * rq;
  a[r][q] = a[q][r] = s * rp + c * rq;
  for (int i = 0; i < 3; ++i) {
    const double x = v[i][p], y = v[i][q];
    v[i][p] = c * x - s * y;
    v[i][q] = s * x + c * y;
  }
}

__device__ __forceinline__ void order(double value[3], double v[3][3], int p, int q) {
  if (value[p] <= value[q]) return;
  const double x = value[p];
  value[p] = value[q];
  value[q] = x;
  for (int i = 0; i < 3; ++i) {
    const double y = v[i][p];
    v[i][p] = v[i][q];
    v[i][q] = y;
  }
}

// One thread per point: principal axes of its k neighbours, of which the first is the point itself.
// normal and tangent (n, 3) belong to the smallest and largest eigenvalue, planarity is
// (l1 - l0) / l2, spacing the root mean square distance to the second to fourth neighbour.
extern "C" __global__ void local_planes(const float* __restrict__ points,
                                        const long long* __restrict__ neighbours, int n, int k,
                                        float* __restrict__ normal, float* __restrict__ tangent,
                                        float* __restrict__ planarity,
                                        float* __restrict__ spacing) {
  const int i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i >= n) return;
  const long long* own = neighbours + (long long)i * k;
  double origin[3], mean[3] = {0.0, 0.0, 0.0}, a[3][3] = {{0.0}};
  for (int c = 0; c < 3; ++c) origin[c] = points[3 * own[0] + c];
  double square = 0.0;
  for (int j = 1; j < k; ++j) {
    double d[3];
    for (int c = 0; c < 3; ++c) {
      d[c] = points[3 * own[j] + c] - origin[c];
      mean[c] += d[c];
    }
    for (int r = 0; r < 3; ++r)
      for (int c = r; c < 3; ++c) a[r][c] += d[r] * d[c];
    if (j < 4) square += d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
  }
  for (int r = 0; r < 3; ++r)
    for (int c = r; c < 3; ++c) a[r][c] = a[c][r] = a[r][c] - mean[r] * mean[c] / k;
  double v[3][3] = {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}};
  for (int sweep = 0; sweep < 8; ++sweep) {
    rotate(a, v, 0, 1);
    rotate(a, v, 0, 2);
    rotate(a, v, 1, 2);
  }
  double value[3] = {fmax(a[0][0], 0.0), fmax(a[1][1], 0.0), fmax(a[2][2], 0.0)};
  order(value, v, 0, 1);
  order(value, v, 1, 2);
  order(value, v, 0, 1);
  for (int c = 0; c < 3; ++c) {
    normal[3 * i + c] = (float)v[c][0];
    tangent[3 * i + c] = (float)v[c][2];
  }
  planarity[i] = (float)((value[1] - value[0]) / fmax(value[2], 1e-30));
  spacing[i] = (float)sqrt(square / max(1, min(3, k - 1)));
}
