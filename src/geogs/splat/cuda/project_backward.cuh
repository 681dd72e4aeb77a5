// From the sums over pixels to the gradients of the ten parameters and of the poses.
#pragma once
#include "unblend.cuh"

struct FrameGradient {
  Vec u, v, n, c;  // of the camera-frame tangents, normal and centre
};

// Through the record's formulas, see project_disks.
__device__ __forceinline__ FrameGradient record_backward(const float* g, const Axes& w, Vec c,
                                                         double ku, double kv, double fx,
                                                         double fy) {
  bool is_bounded;
  const double facing = bounded_facing(w.n, c, is_bounded), h = 1 / facing;
  const double ac = dot(w.u, c), bc = dot(w.v, c);
  // With e = n / (n . c): u = ku (a - (a . c) e) / f, v = kv (b - (b . c) e) / f, w = e / f.
  const double pux = ku * g[2] / fx, puy = ku * g[3] / fy;
  const double pvx = kv * g[4] / fx, pvy = kv * g[5] / fy;
  const double g_ex = g[6] / fx - ac * pux - bc * pvx, g_ey = g[7] / fy - ac * puy - bc * pvy;
  const double g_ac = -h * (pux * w.n.x + puy * w.n.y), g_bc = -h * (pvx * w.n.x + pvy * w.n.y);
  const double g_facing = is_bounded ? 0 : -h * h * (g_ex * w.n.x + g_ey * w.n.y);
  const double away = facing > 0 ? -1 : 1, inverse = 1 / c.z;
  const double g_mx = fx * g[0] * inverse, g_my = fy * g[1] * inverse;
  FrameGradient d;
  d.u = vec(pux, puy, 0) + g_ac * c;
  d.v = vec(pvx, pvy, 0) + g_bc * c;
  d.n = vec(h * g_ex + away * g[10], h * g_ey + away * g[11], away * g[12]) + g_facing * c;
  d.c = g_ac * w.u + g_bc * w.v + g_facing * w.n;
  d.c.x += g_mx;
  d.c.y += g_my;
  d.c.z -= (g_mx * c.x + g_my * c.y + g[8] * inverse) * inverse;
  return d;
}

// Through the rotation matrix, given the gradients of its columns, and the normalisation.
__device__ __forceinline__ void quaternion_backward(const Quaternion& q, Vec a, Vec b, Vec n,
                                                    float* out) {
  const double w = q.w, x = q.x, y = q.y, z = q.z;
  const double gw = x * (b.z - n.y) + y * (n.x - a.z) + z * (a.y - b.x);
  const double gx = -2 * x * (b.y + n.z) + y * (b.x + a.y) + z * (n.x + a.z) + w * (b.z - n.y);
  const double gy = x * (b.x + a.y) - 2 * y * (a.x + n.z) + z * (n.y + b.z) + w * (n.x - a.z);
  const double gz = x * (n.x + a.z) + y * (n.y + b.z) - 2 * z * (a.x + b.y) + w * (a.y - b.x);
  const double radial = gw * w + gx * x + gy * y + gz * z, k = 2 * q.inverse_norm;
  out[0] = (float)(k * (gw - radial * w));
  out[1] = (float)(k * (gx - radial * x));
  out[2] = (float)(k * (gy - radial * y));
  out[3] = (float)(k * (gz - radial * z));
}

__device__ __forceinline__ void outer(const Vec a, const Vec b, float* m) {
  m[0] += (float)(a.x * b.x); m[1] += (float)(a.x * b.y); m[2] += (float)(a.x * b.z);
  m[4] += (float)(a.y * b.x); m[5] += (float)(a.y * b.y); m[6] += (float)(a.y * b.z);
  m[8] += (float)(a.z * b.x); m[9] += (float)(a.z * b.y); m[10] += (float)(a.z * b.z);
}

#define POSE_COPIES 32

// Grid: disks / 256. Sums the views of each disk and writes every disk below ``capacity``, unless
// ``d_position`` is null; clears ``sums``. ``d_poses`` (POSE_COPIES, views, 12), unless null, is
// added to: many copies, so that blocks seldom meet.
extern "C" __global__ void __launch_bounds__(256) project_backward(
    int capacity, const int* count, int views, const float* position, const float* quaternion,
    const float* log_scale, const float* opacity_logit, const double* poses, int pose_size,
    const int* batch, double fx, double fy, const float4* outlines, float4* sums, float* d_position,
    float* d_quaternion, float* d_log_scale, float* d_opacity_logit, double* d_poses) {
  __shared__ double shared[8][12];
  const int i = blockIdx.x * blockDim.x + threadIdx.x, lane = threadIdx.x & 31;
  const int warp = threadIdx.x >> 5;
  const bool exists = i < disk_count(count, capacity);
  Vec p = vec(0, 0, 0), g_p = p, g_u = p, g_v = p, g_n = p;
  Quaternion q = {1, 0, 0, 0, 1};
  Axes axes = {};
  double ku = 0, kv = 0, su = 0, sv = 0, g_o = 0;
  bool is_loaded = false;
  for (int b = 0; b < views; b++) {
    const double* T = pose_of(poses, pose_size, batch, b);
    const size_t at = (size_t)b * capacity + i;
    float m[SUMS] = {};
    if (T && exists && has_box(outlines[2 * at + 1])) {
      if (!is_loaded) {
        p = vec(position[3 * i], position[3 * i + 1], position[3 * i + 2]);
        q = unit_quaternion(quaternion + 4 * i);
        axes = axes_of(q);
        ku = SQRT_HALF * exp(-(double)log_scale[2 * i]);
        kv = SQRT_HALF * exp(-(double)log_scale[2 * i + 1]);
        is_loaded = true;
      }
      float g[SUMS];
      #pragma unroll
      for (int k = 0; k < SUMS / 4; k++) {
        const float4 four = sums[SUMS / 4 * at + k];
        g[4 * k] = four.x; g[4 * k + 1] = four.y; g[4 * k + 2] = four.z; g[4 * k + 3] = four.w;
        sums[SUMS / 4 * at + k] = make_float4(0.f, 0.f, 0.f, 0.f);
      }
      const Vec c = place(position + 3 * i, T);
      const Axes w = rotate_axes(T, axes);
      const FrameGradient d = record_backward(g, w, c, ku, kv, fx, fy);
      bool is_bounded;
      const double facing = bounded_facing(w.n, c, is_bounded);
      const double ex = w.n.x / facing, ey = w.n.y / facing, ac = dot(w.u, c), bc = dot(w.v, c);
      su -= ku * (g[2] * (w.u.x - ac * ex) / fx + g[3] * (w.u.y - ac * ey) / fy);
      sv -= kv * (g[4] * (w.v.x - bc * ex) / fx + g[5] * (w.v.y - bc * ey) / fy);
      g_o += g[9];
      g_p = g_p + rotate_back(T, d.c);
      g_u = g_u + rotate_back(T, d.u);
      g_v = g_v + rotate_back(T, d.v);
      g_n = g_n + rotate_back(T, d.n);
      if (d_poses) {
        outer(d.u, axes.u, m);
        outer(d.v, axes.v, m);
        outer(d.n, axes.n, m);
        outer(d.c, p, m);
        m[3] = (float)d.c.x;
        m[7] = (float)d.c.y;
        m[11] = (float)d.c.z;
      }
    }
    if (d_poses) {
      const float sum = sum_lanes(m, lane);
      if (!(lane & 1) && lane < 24) shared[warp][lane >> 1] = sum;
      __syncthreads();
      if (threadIdx.x < 12) {
        double total = 0;
        for (int k = 0; k < 8; k++) total += shared[k][threadIdx.x];
        const int copy = blockIdx.x % POSE_COPIES;
        if (total != 0) atomicAdd(d_poses + 12 * ((size_t)copy * views + b) + threadIdx.x, total);
      }
      __syncthreads();
    }
  }
  if (i >= capacity || !d_position) return;
  d_position[3 * i] = (float)g_p.x;
  d_position[3 * i + 1] = (float)g_p.y;
  d_position[3 * i + 2] = (float)g_p.z;
  quaternion_backward(q, g_u, g_v, g_n, d_quaternion + 4 * i);
  d_log_scale[2 * i] = (float)su;
  d_log_scale[2 * i + 1] = (float)sv;
  const double o = exists ? sigmoid(opacity_logit[i]) : 0;
  d_opacity_logit[i] = is_loaded ? (float)(g_o * o * (1 - o)) : 0.f;
}

// One block per view. Sums and clears the copies; writes the (4, 4) gradient of each pose.
extern "C" __global__ void sum_poses(int views, double* copies, double* d_poses) {
  const int k = threadIdx.x, b = blockIdx.x;
  double total = 0;
  if (k < 12)
    for (int copy = 0; copy < POSE_COPIES; copy++) {
      double* own = copies + 12 * ((size_t)copy * views + b) + k;
      total += *own;
      *own = 0;
    }
  if (k < 16) d_poses[16 * b + k] = total;
}
