// Disks into the camera: a record for the pixels and an outline of the pixels they reach.
//
// record, 4 x float4:  MX MY UX UY | VX VY WX WY | WC O NX NY | NZ Z_NEAREST Z_FURTHEST 0
//   With (dx, dy) a pixel's offset from the projected centre (MX, MY), the plane's inverse depth is
//   w = WX dx + WY dy + WC and the hit is at (UX dx + UY dy, VX dx + VY dy) / w on the disk, in
//   units of sqrt(2) deviations: the Gaussian is exp(-min(u^2 + v^2, dx^2 + dy^2)).
// outline, 2 x float4: X Y A B | C R2 BOX_X BOX_Y
//   The pixels with A x^2 + 2 B x y + C y^2 <= 1 about (X, Y), and those within sqrt(R2) of the
//   projected centre; BOX holds first and last (exclusive) pixel as 16 bits each.
#pragma once
#include "disk.cuh"

#define MARGIN 0.01

struct Outline {
  double x, y, xx, xy, yy;
  bool is_bounded;
};

// The ellipse of the disk's plane where it has at least MIN_ALPHA: the dual conic of the circle.
// u and v are the scaled tangents in the camera.
__device__ __forceinline__ Outline outline_of(double mx, double my, Vec c, Vec u, Vec v,
                                              double radius2, double fx, double fy) {
  Outline o = {mx, my, 0, 0, 0, false};
  const double d = radius2 * (u.z * u.z + v.z * v.z) - c.z * c.z;
  if (d > -1e-6 * c.z * c.z) return o;
  const double x = c.x / c.z, y = c.y / c.z, k = radius2 / d;
  const double ux = fx * (u.x - x * u.z), vx = fx * (v.x - x * v.z);
  const double uy = fy * (u.y - y * u.z), vy = fy * (v.y - y * v.z);
  const double ox = k * (ux * u.z + vx * v.z), oy = k * (uy * u.z + vy * v.z);
  o.x = mx + ox;
  o.y = my + oy;
  o.xx = fmax(ox * ox - k * (ux * ux + vx * vx), 1e-6);
  o.yy = fmax(oy * oy - k * (uy * uy + vy * vy), 1e-6);
  o.xy = ox * oy - k * (ux * uy + vx * vy);
  o.is_bounded = true;
  return o;
}

__device__ __forceinline__ int pixel_range(double low, double high, int count) {
  low = fmin(fmax(low - MARGIN, -1.0), (double)count);
  high = fmin(fmax(high + MARGIN, -1.0), (double)count);
  const int first = max((int)ceil(low), 0), last = min((int)floor(high) + 1, count);
  return first < last ? first | (last << 16) : 0;
}

// Whether a disk reaches the pixels [x0, x1] x [y0, y1]: the least value of its ellipse's quadratic
// form over the rectangle lies on an edge that faces the ellipse's middle.
__device__ __forceinline__ bool reaches(float4 p, float4 q, float mx, float my, float x0, float x1,
                                        float y0, float y1) {
  const float ex = fmaxf(fmaxf(x0 - mx, mx - x1), 0.f), ey = fmaxf(fmaxf(y0 - my, my - y1), 0.f);
  if (ex * ex + ey * ey <= q.y) return true;
  x0 -= p.x; x1 -= p.x; y0 -= p.y; y1 -= p.y;
  const float A = p.z, B = p.w, C = q.x;
  const float cx = fminf(fmaxf(0.f, x0), x1), cy = fminf(fmaxf(0.f, y0), y1);
  const float y = fminf(fmaxf(-B * cx / C, y0), y1), x = fminf(fmaxf(-B * cy / A, x0), x1);
  const float across = A * cx * cx + 2.f * B * cx * y + C * y * y;
  const float down = A * x * x + 2.f * B * x * cy + C * cy * cy;
  return fminf(across, down) <= 1.005f;
}

// Of the bits: as floats small boxes are denormal, which fast arithmetic takes for zero.
__device__ __forceinline__ bool has_box(float4 q) { return __float_as_uint(q.z) != 0u; }

struct TileBox {
  int x0, x1, y0, y1;  // tiles, the last ones exclusive
};
__device__ __forceinline__ TileBox tiles_of(float4 q) {
  const u32 bx = __float_as_uint(q.z), by = __float_as_uint(q.w);
  return {(int)(bx & 0xffff) / TILE, ((int)(bx >> 16) + TILE - 1) / TILE,
          (int)(by & 0xffff) / TILE, ((int)(by >> 16) + TILE - 1) / TILE};
}

__device__ __forceinline__ bool reaches_tile(float4 p, float4 q, float mx, float my, int x, int y) {
  const float left = x * TILE, top = y * TILE;
  return reaches(p, q, mx, my, left, left + TILE - 1, top, top + TILE - 1);
}

// Calls visit(tile column, tile row, key) for every tile that a lane's disk reaches; the key is the
// disk's. All lanes of a warp must take part; disks with many tiles are shared out among them.
template <class Visit>
__device__ __forceinline__ void visit_tiles(bool active, float4 p, float4 q, float mx, float my,
                                            u64 key, Visit visit) {
  const int lane = threadIdx.x & 31;
  const TileBox box = active ? tiles_of(q) : TileBox{0, 0, 0, 0};
  const int columns = box.x1 - box.x0, count = columns * (box.y1 - box.y0);
  const bool many = count > 24;
  if (!many)
    for (int y = box.y0; y < box.y1; y++)
      for (int x = box.x0; x < box.x1; x++)
        if (reaches_tile(p, q, mx, my, x, y)) visit(x, y, key);
  u32 left = __ballot_sync(ALL_LANES, many);
  while (left) {
    const int owner = __ffs((int)left) - 1;
    left &= left - 1;
    const int x0 = __shfl_sync(ALL_LANES, box.x0, owner), y0 = __shfl_sync(ALL_LANES, box.y0, owner);
    const int n = __shfl_sync(ALL_LANES, count, owner);
    const int width = __shfl_sync(ALL_LANES, columns, owner);
    const float4 a = make_float4(
        __shfl_sync(ALL_LANES, p.x, owner), __shfl_sync(ALL_LANES, p.y, owner),
        __shfl_sync(ALL_LANES, p.z, owner), __shfl_sync(ALL_LANES, p.w, owner));
    const float4 b = make_float4(
        __shfl_sync(ALL_LANES, q.x, owner), __shfl_sync(ALL_LANES, q.y, owner), 0.f, 0.f);
    const u64 theirs = __shfl_sync(ALL_LANES, key, owner);
    const float cx = __shfl_sync(ALL_LANES, mx, owner), cy = __shfl_sync(ALL_LANES, my, owner);
    for (int k = lane; k < n; k += 32) {
      const int x = x0 + k % width, y = y0 + k / width;
      if (reaches_tile(a, b, cx, cy, x, y)) visit(x, y, theirs);
    }
  }
}

// Grid: disks / 256, views. Writes records and outlines (no box where no pixel can blend the disk)
// and counts the disks of every tile in ``counts`` (views, tile rows, tile columns), zero on entry.
// Clears ``visible`` (disks).
extern "C" __global__ void __launch_bounds__(256) project_disks(
    int capacity, const int* count, const float* position, const float* quaternion,
    const float* log_scale, const float* opacity_logit, const double* poses, int pose_size,
    const int* batch, double fx, double fy, double cx, double cy, double near, int width,
    int height, float4* records, float4* outlines, int* counts, unsigned char* visible) {
  const int i = blockIdx.x * blockDim.x + threadIdx.x, b = blockIdx.y;
  const double* T = pose_of(poses, pose_size, batch, b);
  float4 p = make_float4(0.f, 0.f, 0.f, 0.f), q = p;
  float mx = 0.f, my = 0.f;
  if (T && i < disk_count(count, capacity)) {
    const size_t at = (size_t)b * capacity + i;
    const Vec c = place(position + 3 * i, T);
    const double o = sigmoid(opacity_logit[i]);
    if (c.z > near && o >= MIN_ALPHA &&
        is_usable(position + 3 * i, quaternion + 4 * i, log_scale + 2 * i, opacity_logit[i])) {
      const Axes w = rotate_axes(T, axes_of(unit_quaternion(quaternion + 4 * i)));
      const double su = exp((double)log_scale[2 * i]), sv = exp((double)log_scale[2 * i + 1]);
      const Vec u = su * w.u, v = sv * w.v;
      const double x = fx * c.x / c.z + cx, y = fy * c.y / c.z + cy;
      const double radius2 = 2 * log(o * 255), blur = sqrt(radius2 / 2);
      const Outline e = outline_of(x, y, c, u, v, radius2, fx, fy);
      int bx = width << 16, by = height << 16;
      p = make_float4(0.f, 0.f, 1e-20f, 0.f);
      q = make_float4(1e-20f, (float)(radius2 / 2 + 1e-2), 0.f, 0.f);
      if (e.is_bounded) {
        const double hx = sqrt(e.xx), hy = sqrt(e.yy);
        bx = pixel_range(fmin(e.x - hx, x - blur), fmax(e.x + hx, x + blur), width);
        by = pixel_range(fmin(e.y - hy, y - blur), fmax(e.y + hy, y + blur), height);
        const double xx = 1.001 * e.xx + 2.5e-3, yy = 1.001 * e.yy + 2.5e-3;
        const double k = 1 / (xx * yy - e.xy * e.xy);
        p = make_float4((float)e.x, (float)e.y, (float)(k * yy), (float)(-k * e.xy));
        q.x = (float)(k * xx);
      }
      if (bx && by) {
        q.z = __int_as_float(bx);
        q.w = __int_as_float(by);
        mx = (float)x;
        my = (float)y;
        bool is_bounded;
        const double facing = bounded_facing(w.n, c, is_bounded);
        const double ex = w.n.x / facing, ey = w.n.y / facing;
        const double ac = dot(w.u, c), bc = dot(w.v, c), ku = SQRT_HALF / su, kv = SQRT_HALF / sv;
        const double reach = 3 * sqrt(u.z * u.z + v.z * v.z), away = facing > 0 ? -1 : 1;
        float4* r = records + 4 * at;
        r[0] = make_float4(mx, my, (float)(ku * (w.u.x - ac * ex) / fx),
                           (float)(ku * (w.u.y - ac * ey) / fy));
        r[1] = make_float4((float)(kv * (w.v.x - bc * ex) / fx), (float)(kv * (w.v.y - bc * ey) / fy),
                           (float)(ex / fx), (float)(ey / fy));
        r[2] = make_float4((float)(1 / c.z), (float)o, (float)(away * w.n.x), (float)(away * w.n.y));
        r[3] = make_float4((float)(away * w.n.z), (float)(c.z - fmin(reach, c.z - near)),
                           (float)(c.z + fmin(reach, MAX_REACH_RATIO * c.z)), 0.f);
      } else {
        q.z = q.w = 0.f;
      }
    }
  }
  if (i < capacity) {
    if (b == 0) visible[i] = 0;
    outlines[2 * ((size_t)b * capacity + i)] = p;
    outlines[2 * ((size_t)b * capacity + i) + 1] = q;
  }
  const int columns = (width + TILE - 1) / TILE, rows = (height + TILE - 1) / TILE;
  int* own = counts + (size_t)b * columns * rows;
  visit_tiles(has_box(q), p, q, mx, my, 0,
              [&](int x, int y, u64) { atomicAdd(own + y * columns + x, 1); });
}
