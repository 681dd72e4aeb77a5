// Projection of the cells of a source frame with inverse depth d: pi(K (R ray + d t)).
#pragma once
#include "block.cuh"
#include "lens.cuh"
#include "pose.cuh"

#define MIN_Z 0.05f

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

__device__ __forceinline__ float2 pixel_of(const Camera& camera, const Projected& p) {
  return lens_pixel(camera, p.x, p.y);
}

// Whether a point lies before the target, and where the lens does not fold the image over.
__device__ __forceinline__ bool is_shown(const Camera& camera, const Projected& p) {
  return p.valid && growth_at(camera, p.x * p.x + p.y * p.y).steepness > LEAST_SLOPE;
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
