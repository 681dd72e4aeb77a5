// Bilinear samples of images in global memory, shared by the sweep and the refinement.
#pragma once

// Where a homogeneous pixel (q0, q1, q2) falls in a w x h image, moved into it if it is outside.
struct ImagePoint {
  float u, v;
  float inverse;  // 1 / q2
  bool inside;
};

__device__ __forceinline__ ImagePoint project_into(float q0, float q1, float q2, int w, int h) {
  ImagePoint p;
  p.inverse = 1.f / fmaxf(q2, 1e-3f);
  float u = q0 * p.inverse, v = q1 * p.inverse;
  p.u = fminf(fmaxf(u, 0.f), w - 1.001f);
  p.v = fminf(fmaxf(v, 0.f), h - 1.001f);
  p.inside = p.u == u && p.v == v && q2 >= 1e-3f;
  return p;
}

// Bilinear sample between the pixel (column, row) and the next ones.
__device__ __forceinline__ float bilinear(
    const float* image, int w, int column, int row, float fu, float fv) {
  const float* p = image + row * w + column;
  float top = p[0] + fu * (p[1] - p[0]), bottom = p[w] + fu * (p[w + 1] - p[w]);
  return top + fv * (bottom - top);
}

// Bilinear sample anywhere; the image's border repeats.
__device__ __forceinline__ float bilinear_repeated(
    const float* image, int w, int h, float u, float v) {
  u = fminf(fmaxf(u, 0.f), w - 1.f);
  v = fminf(fmaxf(v, 0.f), h - 1.f);
  int column = min((int)u, w - 2), row = min((int)v, h - 2);
  return bilinear(image, w, column, row, u - column, v - row);
}
