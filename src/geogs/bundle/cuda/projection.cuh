// Projection of the cells of a source frame with inverse depth d: pi(K (R ray + d t)).
#pragma once
#include "block.cuh"
#include "pose.cuh"

#define MIN_Z 0.05f
#define LEAST_SLOPE 0.1f

// Pixel = c + f b(x) of a point x on the plane z = 1: see geogs/geometry/camera.py.
struct Camera { float fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, fisheye; };

// The distortion in the arguments of a kernel, in the order of Camera.numbers.
#define LENS k1, k2, p1, p2, k3, k4, k5, k6, fisheye

// The upper three rows R | t of the motion from the source to the target.
struct Motion { float m[12]; };

struct Projected {
  float x, y;  // on the plane z = 1
  float z;     // depth in the target over depth in the source, as it is
  float q;     // 1 / z, z held at MIN_Z
  bool valid;
};

__device__ __forceinline__ Projected project_cell(
    const Motion& T, const float* rays, int cell, float d) {
  float a = rays[3 * cell], b = rays[3 * cell + 1], c = rays[3 * cell + 2];
  float x = T.m[0] * a + T.m[1] * b + T.m[2] * c + d * T.m[3];
  float y = T.m[4] * a + T.m[5] * b + T.m[6] * c + d * T.m[7];
  float z = T.m[8] * a + T.m[9] * b + T.m[10] * c + d * T.m[11];
  float q = 1.f / (z < MIN_Z ? MIN_Z : z);
  return {x * q, y * q, z, q, z > MIN_Z};
}

// Growth of the radius at a squared distance from the axis, twice its derivative by that, and the
// slope that is small where the image folds over.
struct Growth { float growth, slope, steepness; };

__device__ __forceinline__ Growth growth_at(const Camera& c, float square) {
  if (c.fisheye > 0.f) {
    float radius = sqrtf(square), angle = atanf(radius), s = angle * angle;
    float straight = square > 0.f ? angle / radius : 1.f;
    float growth = straight * (1.f + s * (c.k1 + s * (c.k2 + s * (c.k3 + s * c.k4))));
    float steepness =
        1.f + s * (3.f * c.k1 + s * (5.f * c.k2 + s * (7.f * c.k3 + s * 9.f * c.k4)));
    float slope = square > 1e-4f ? (steepness / (1.f + square) - growth) / square
                                 : 2.f * c.k1 - 2.f / 3.f;
    return {growth, slope, steepness};
  }
  float under = 1.f + square * (c.k4 + square * (c.k5 + square * c.k6));
  float growth = (1.f + square * (c.k1 + square * (c.k2 + square * c.k3))) / under;
  float slope = 2.f * c.k1 + square * (4.f * c.k2 + 6.f * square * c.k3);
  slope -= growth * (2.f * c.k4 + square * (4.f * c.k5 + 6.f * square * c.k6));
  slope /= under;
  return {growth, slope, growth + square * slope};
}

__device__ __forceinline__ float2 pixel_of(const Camera& c, const Projected& p) {
  float xx = p.x * p.x, xy = p.x * p.y, yy = p.y * p.y, growth = growth_at(c, xx + yy).growth;
  float x = p.x * growth + 2.f * c.p1 * xy + c.p2 * (3.f * xx + yy);
  float y = p.y * growth + c.p1 * (xx + 3.f * yy) + 2.f * c.p2 * xy;
  return make_float2(c.fx * x + c.cx, c.fy * y + c.cy);
}

// Whether a point lies before the target, and where the lens does not fold the image over.
__device__ __forceinline__ bool is_shown(const Camera& c, const Projected& p) {
  return p.valid && growth_at(c, p.x * p.x + p.y * p.y).steepness > LEAST_SLOPE;
}

// Derivatives of a pixel by its point on the plane z = 1.
struct Bend { float xx, xy, yx, yy; };

__device__ __forceinline__ Bend bend_of(const Camera& c, float x, float y) {
  Growth g = growth_at(c, x * x + y * y);
  float xx = g.growth + g.slope * x * x + 2.f * c.p1 * y + 6.f * c.p2 * x;
  float xy = g.slope * x * y + 2.f * c.p1 * x + 2.f * c.p2 * y;
  float yy = g.growth + g.slope * y * y + 6.f * c.p1 * y + 2.f * c.p2 * x;
  return {c.fx * xx, c.fx * xy, c.fy * xy, c.fy * yy};
}

// A measured cell, linearised in a left perturbation of the motion and in its inverse depth.
struct LinearCell {
  float jx[6], jy[6];  // d pixel / d xi
  float dx, dy;        // d pixel / d inverse depth
  float rx, ry;        // residual, measured minus projected
  float wx, wy;        // weights with Huber's factor
};

__device__ __forceinline__ LinearCell linearise_cell(
    const Camera& camera, const Motion& T, const float* rays, int cell, float d, float2 pixel,
    float2 weight, float huber) {
  Projected p = project_cell(T, rays, cell, d);
  float2 at = pixel_of(camera, p);
  float x = p.x, y = p.y, dq = d * p.q;
  Bend b = bend_of(camera, x, y);
  float by_depth_x = (T.m[3] - T.m[11] * x) * p.q, by_depth_y = (T.m[7] - T.m[11] * y) * p.q;
  float of_x[6] = {dq, 0.f, -x * dq, -x * y, 1.f + x * x, -y};
  float of_y[6] = {0.f, dq, -y * dq, -1.f - y * y, x * y, x};
  LinearCell c;
#pragma unroll
  for (int k = 0; k < 6; k++) {
    c.jx[k] = b.xx * of_x[k] + b.xy * of_y[k];
    c.jy[k] = b.yx * of_x[k] + b.yy * of_y[k];
  }
  c.dx = b.xx * by_depth_x + b.xy * by_depth_y;
  c.dy = b.yx * by_depth_x + b.yy * by_depth_y;
  c.rx = pixel.x - at.x;
  c.ry = pixel.y - at.y;
  float seen = is_shown(camera, p) ? 1.f : 0.f;
  c.wx = weight.x * seen;
  c.wy = weight.y * seen;
  float norm = sqrtf(c.wx * c.rx * c.rx + c.wy * c.ry * c.ry);
  float factor = norm <= huber ? 1.f : huber / norm;
  c.wx *= factor;
  c.wy *= factor;
  return c;
}

// Adds J^T W J (21 values of the upper triangle, row by row) and J^T W r (6 values) of a cell.
__device__ __forceinline__ void add_normal_equations(const LinearCell& c, float* sums) {
  int n = 0;
#pragma unroll
  for (int i = 0; i < 6; i++) {
    float wx = c.wx * c.jx[i], wy = c.wy * c.jy[i];
#pragma unroll
    for (int j = i; j < 6; j++) sums[n++] += wx * c.jx[j] + wy * c.jy[j];
    sums[21 + i] += wx * c.rx + wy * c.ry;
  }
}

// Place of entry (r, c) in the upper triangle of a 6 x 6 matrix, row by row.
__device__ __forceinline__ int upper_entry(int r, int c) {
  int i = r < c ? r : c, j = r < c ? c : r;
  return i * 6 - i * (i - 1) / 2 + j - i;
}
