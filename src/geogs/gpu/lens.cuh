// Cameras of geogs/geometry/camera.py.
#pragma once

#define LEAST_SLOPE 0.1f

// Pixel = c + f b(x) of a point x on the plane z = 1: see geogs/geometry/camera.py.
struct Camera { float fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, fisheye; };

// The distortion in the arguments of a kernel, in the order of Camera.numbers.
#define LENS k1, k2, p1, p2, k3, k4, k5, k6, fisheye

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

// The pixel of a point on the plane z = 1.
__device__ __forceinline__ float2 lens_pixel(const Camera& c, float u, float v) {
  float uu = u * u, uv = u * v, vv = v * v, growth = growth_at(c, uu + vv).growth;
  float x = u * growth + 2.f * c.p1 * uv + c.p2 * (3.f * uu + vv);
  float y = v * growth + c.p1 * (uu + 3.f * vv) + 2.f * c.p2 * uv;
  return make_float2(c.fx * x + c.cx, c.fy * y + c.cy);
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
