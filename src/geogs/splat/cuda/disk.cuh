// A disk placed in the camera frame, in double: disks are few compared with pixels, and those seen
// edge-on keep their digits. Shared by the projection and by its backward pass.
#pragma once
#include "common.cuh"

#define MIN_ALPHA (1.0f / 255.0f)
#define MAX_ALPHA 0.99f
#define MIN_TRANSMITTANCE 1e-4f
#define MIN_FACING 1e-4
#define MIN_HIT_RATIO 1e-4f
#define MAX_REACH_RATIO 1e3
#define MAX_LOG_SCALE 40.0f
#define SQRT_HALF 0.70710678118654752

// Pixels of a tile, and of the part of it that a warp works on.
#define TILE 16
#define PART_WIDTH 8
#define PART_HEIGHT 4
#define TILE_THREADS 256

struct Vec {
  double x, y, z;
};
__device__ __forceinline__ Vec vec(double x, double y, double z) { return {x, y, z}; }
__device__ __forceinline__ Vec operator*(double k, Vec a) { return {k * a.x, k * a.y, k * a.z}; }
__device__ __forceinline__ Vec operator+(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
__device__ __forceinline__ double dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

// T is (3, 4) row-major, world to camera.
__device__ __forceinline__ Vec rotate(const double* T, Vec v) {
  return {T[0] * v.x + T[1] * v.y + T[2] * v.z, T[4] * v.x + T[5] * v.y + T[6] * v.z,
          T[8] * v.x + T[9] * v.y + T[10] * v.z};
}
__device__ __forceinline__ Vec rotate_back(const double* T, Vec v) {
  return {T[0] * v.x + T[4] * v.y + T[8] * v.z, T[1] * v.x + T[5] * v.y + T[9] * v.z,
          T[2] * v.x + T[6] * v.y + T[10] * v.z};
}

struct Quaternion {
  double w, x, y, z, inverse_norm;
};

struct Axes {
  Vec u, v, n;
};

__device__ __forceinline__ Quaternion unit_quaternion(const float* q) {
  const double w = q[0], x = q[1], y = q[2], z = q[3];
  const double k = rsqrt(w * w + x * x + y * y + z * z);
  return {w * k, x * k, y * k, z * k, k};
}

// Columns of the rotation matrix.
__device__ __forceinline__ Axes axes_of(const Quaternion& q) {
  const double w = q.w, x = q.x, y = q.y, z = q.z;
  return {{1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)},
          {2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)},
          {2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)}};
}

__device__ __forceinline__ Axes rotate_axes(const double* T, const Axes& a) {
  return {rotate(T, a.u), rotate(T, a.v), rotate(T, a.n)};
}

// n . c kept away from zero; is_bounded says whether it had to be.
__device__ __forceinline__ double bounded_facing(Vec normal, Vec center, bool& is_bounded) {
  const double facing = dot(normal, center), least = MIN_FACING * sqrt(dot(center, center));
  is_bounded = fabs(facing) < least;
  return is_bounded ? (facing < 0 ? -least : least) : facing;
}

__device__ __forceinline__ Vec place(const float* position, const double* T) {
  const Vec c = rotate(T, vec(position[0], position[1], position[2]));
  return {c.x + T[3], c.y + T[7], c.z + T[11]};
}

__device__ __forceinline__ bool is_usable(const float* p, const float* q, const float* s, float o) {
  const float total = p[0] + p[1] + p[2] + o;
  const float size = fabsf(q[0]) + fabsf(q[1]) + fabsf(q[2]) + fabsf(q[3]);
  return isfinite(total) && isfinite(size) && size > 0.f && fabsf(s[0]) < MAX_LOG_SCALE &&
         fabsf(s[1]) < MAX_LOG_SCALE;
}

__device__ __forceinline__ double sigmoid(float x) { return 1.0 / (1.0 + exp(-(double)x)); }

// How many disks there are: in memory where the host does not know when it launches.
__device__ __forceinline__ int disk_count(const int* count, int capacity) {
  return count ? min(*count, capacity) : capacity;
}

// The pose of view b, or none where its slot is negative; ``size`` numbers (12 or 16) are a pose.
__device__ __forceinline__ const double* pose_of(const double* poses, int size, const int* batch,
                                                 int b) {
  const int slot = batch ? batch[b] : b;
  return slot < 0 ? nullptr : poses + size * (size_t)slot;
}
