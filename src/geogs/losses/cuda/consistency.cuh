// L_n and L_nc of one pixel (paper Eqs. normal_l1, normal_consistency) with their gradients.
#pragma once
#include "view_maps.cuh"

struct Vector { float x, y, z; };
__device__ __forceinline__ float dot(Vector a, Vector b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
__device__ __forceinline__ Vector scaled(Vector a, float s) { return {a.x * s, a.y * s, a.z * s}; }
__device__ __forceinline__ Vector cross(Vector a, Vector b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// A blended normal made (nearly) unit, and the factor that did it.
struct UnitNormal { Vector n; float shrink; };
__device__ __forceinline__ UnitNormal unit_normal(Vector blended, float epsilon) {
  const float shrink = rsqrtf(dot(blended, blended) + epsilon);
  return {scaled(blended, shrink), shrink};
}

// Gradient in the blended normal from one in the unit normal.
__device__ __forceinline__ Vector through_unit(UnitNormal unit, Vector g) {
  const float along = dot(g, unit.n);
  return {unit.shrink * (g.x - along * unit.n.x), unit.shrink * (g.y - along * unit.n.y),
          unit.shrink * (g.z - along * unit.n.z)};
}

// Weighted |N - N_f|_1; adds d/dN (unit) to ``g``. A zero prior is unknown.
__device__ __forceinline__ float normal_l1(Vector n, Vector prior, float weight, Vector& g) {
  if (!(dot(prior, prior) > 0.f)) return 0.f;
  const Vector e = {n.x - prior.x, n.y - prior.y, n.z - prior.z};
  g.x += weight * sign(e.x);
  g.y += weight * sign(e.y);
  g.z += weight * sign(e.z);
  return weight * (fabsf(e.x) + fabsf(e.y) + fabsf(e.z));
}

// Depths of a pixel's neighbours, 0 where unknown.
struct Neighbours { float left, right, top, bottom; };

__device__ __forceinline__ bool all_known(float centre, Neighbours d) {
  return centre > 0.f && d.left > 0.f && d.right > 0.f && d.top > 0.f && d.bottom > 0.f;
}

// Weighted 1 - N . N_d at a pixel with the ray (rx, ry, 1); ``push`` is d/dD of the neighbours,
// and d/dN is added to ``g``. N_d = h x v, h from the left to the right point, v from the bottom
// to the top one, whose rays differ by a step in one coordinate.
__device__ __forceinline__ float normal_consistency(
    Vector n, Neighbours d, float rx, float ry, float step_x, float step_y, float weight,
    Neighbours& push, Vector& g) {
  const float hz = d.right - d.left, vz = d.top - d.bottom;
  const Vector h = {d.right * (rx + step_x) - d.left * (rx - step_x), ry * hz, hz};
  const Vector v = {rx * vz, d.top * (ry - step_y) - d.bottom * (ry + step_y), vz};
  Vector k = cross(h, v);
  const float inverse = rsqrtf(dot(k, k) + 1e-30f);
  k = scaled(k, inverse);
  const float cosine = dot(n, k);
  g.x -= weight * k.x;
  g.y -= weight * k.y;
  g.z -= weight * k.z;
  const float s = -weight * inverse;
  const Vector gk = {s * (n.x - cosine * k.x), s * (n.y - cosine * k.y), s * (n.z - cosine * k.z)};
  // Through k = h x v: d/dh = v x g, d/dv = g x h; then along the neighbours' rays.
  const Vector gh = cross(v, gk), gv = cross(gk, h);
  const float across = rx * gh.x + ry * gh.y + gh.z, down = rx * gv.x + ry * gv.y + gv.z;
  push.left = step_x * gh.x - across;
  push.right = step_x * gh.x + across;
  push.top = down - step_y * gv.y;
  push.bottom = -down - step_y * gv.y;
  return weight * (1.f - cosine);
}
