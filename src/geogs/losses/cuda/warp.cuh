// The target image through the reference's depth (paper Eqs. back_project, bilinear, valid_mask)
// and L_1 of what comes out.
#pragma once
#include "enlargement.cuh"

// From a pixel (x, y, 1) of the reference times depth to the target: diag(fx, fy, 1) [R K^-1 | t],
// so that X / Z and Y / Z of the result are pixels but for the principal point.
struct MotionRow { float x, y, z, t; };
struct PixelMotion { MotionRow u, v, w; };

__device__ __forceinline__ float along_row(MotionRow m, float x, float y) {
  return fmaf(m.y, y, fmaf(m.x, x, m.z));
}

// Where a pixel with depth falls in the target.
struct Landing {
  float u, v, z;  // pixel and depth there; z is 0 where out of view
  float du, dv;   // d pixel / d depth
};

__device__ __forceinline__ Landing land(
    const PixelMotion& m, float x, float y, float d, int height, int width, const PhotoSettings& c) {
  const float qx = along_row(m.u, x, y), qy = along_row(m.v, x, y), qz = along_row(m.w, x, y);
  const float z = fmaf(d, qz, m.w.t);
  const bool front = d > 0.f && z > c.min_depth_ratio * d;
  const float inverse = 1.f / (front ? z : 1.f);
  const float u = fmaf(fmaf(d, qx, m.u.t), inverse, c.cx), v = fmaf(fmaf(d, qy, m.v.t), inverse, c.cy);
  const bool inside = front && u >= 0.f && v >= 0.f && u <= (float)(width - 1) && v <= (float)(height - 1);
  // (qx - qz X / Z) / Z without its cancellation.
  const float rate = inverse * inverse;
  return {u, v, inside ? z : 0.f, rate * (qx * m.w.t - m.u.t * qz), rate * (qy * m.w.t - m.v.t * qz)};
}

struct Sample { float value, dx, dy; };

__device__ __forceinline__ Sample sample_image(const float* image, int height, int width, float u, float v) {
  const int i = min((int)u, width - 2), j = min((int)v, height - 2);
  const float fx = u - (float)i, fy = v - (float)j;
  const float* at = image + (size_t)j * width + i;
  const float p = at[0], q = at[1], r = at[width], s = at[width + 1];
  const float upper = p + (q - p) * fx, lower = r + (s - r) * fx;
  return {upper + (lower - upper) * fy, (q - p) * (1.f - fy) + (s - r) * fy, lower - upper};
}

// Whether the target's rendered depth (0 unknown) at pixel (u, v) of the big image agrees with z.
__device__ __forceinline__ bool is_visible(
    const float* depth, int height, int width, int big_height, int big_width, float u, float v,
    float z, float tolerance) {
  const float x = fmaf(u + 0.5f, (float)width / big_width, -0.5f);
  const float y = fmaf(v + 0.5f, (float)height / big_height, -0.5f);
  const float s = fminf(fmaxf(x, 0.f), (float)(width - 1)), t = fminf(fmaxf(y, 0.f), (float)(height - 1));
  const int i = min((int)s, width - 2), j = min((int)t, height - 2);
  const float* at = depth + (size_t)j * width + i;
  const float p = at[0], q = at[1], r = at[width], w = at[width + 1], fx = s - (float)i, fy = t - (float)j;
  const float upper = p + (q - p) * fx, lower = r + (w - r) * fx;
  const bool known = p > 0.f && q > 0.f && r > 0.f && w > 0.f;
  return known && fabsf(z - upper - (lower - upper) * fy) < tolerance * z;
}

// What counts of a pixel by its texture: half at ``weak``, all where that is 0.
__device__ __forceinline__ float share_of(float texture, float weak) {
  return weak > 0.f ? texture / (texture + weak) : 1.f;
}

// Derivative of the weighted L_1 in the warped image at a pixel of a texture, and the loss.
__device__ __forceinline__ float l1_push(float a, float b, float texture, const PhotoSettings& c) {
  const float e = b - a;
  return fabsf(e) < c.cut ? c.l1 * share_of(texture, c.texture) * fminf(fmaxf(e / c.huber, -1.f), 1.f) : 0.f;
}
__device__ __forceinline__ float l1_loss(float a, float b, float texture, const PhotoSettings& c) {
  const float size = fminf(fabsf(b - a), c.cut), small = fminf(size, c.huber);
  return c.l1 * share_of(texture, c.texture) * (small / c.huber) * (size - 0.5f * small);
}

// A warped image holds its mask in the sign: filled from the reference, negative where not seen.
__device__ __forceinline__ float packed(float value, bool seen) {
  return __uint_as_float((__float_as_uint(value) & 0x7fffffffu) | (seen ? 0u : 0x80000000u));
}
__device__ __forceinline__ bool is_seen(float warped) { return (__float_as_uint(warped) >> 31) == 0; }

// A row of R_t R_r^T and of the translation that belongs to it: T_target T_reference^-1, 3x4 rows.
__device__ __forceinline__ void relative_row(const double* target, const double* reference, int row, double* out) {
  out[3] = target[4 * row + 3];
  for (int k = 0; k < 3; k++) {
    out[k] = 0.0;
    for (int n = 0; n < 3; n++) out[k] += target[4 * row + n] * reference[4 * k + n];
    out[3] -= out[k] * reference[4 * k + 3];
  }
}

// Motions of the pairs (pairs, 12), see PixelMotion, and their target slots, -1 where there is
// none; clears the loss and, unless null, d loss / d motion (pairs, 12).
extern "C" __global__ void __launch_bounds__(128) begin_window(
    const int* batch, const int* pairs, const double* poses, const float* settings, int* targets,
    float* motions, float* loss, double* d_motion, int views, int partners) {
  const int i = blockIdx.x * 128 + threadIdx.x;
  if (i < views) loss[i] = 0.f;
  if (i >= views * partners) return;
  const int reference = batch[i / partners], target = reference < 0 ? -1 : pairs[i];
  targets[i] = target;
  if (d_motion)
    for (int k = 0; k < 12; k++) d_motion[12 * i + k] = 0.0;
  if (target < 0) return;
  const PhotoSettings& c = *(const PhotoSettings*)settings;
  for (int j = 0; j < 3; j++) {
    double row[4];
    relative_row(poses + 12 * target, poses + 12 * reference, j, row);
    const double zoom = j == 0 ? c.fx : j == 1 ? c.fy : 1.f, x = row[0] / c.fx, y = row[1] / c.fy;
    float* out = motions + 12 * i + 4 * j;
    out[0] = (float)(zoom * x);
    out[1] = (float)(zoom * y);
    out[2] = (float)(zoom * (row[2] - x * c.cx - y * c.cy));
    out[3] = (float)(zoom * row[3]);
  }
}

#define WARP_ROWS 32

// depth (B, h, w), 0 unknown -> per pair (H, W): the packed warped image and ``slope``, its
// derivative in the enlarged depth. Adds L_1 to the loss (B). With ``last`` no other term follows:
// ``slope`` becomes d loss / d enlarged depth, and ``push`` (unless null) d loss / d warped.
extern "C" __global__ void __launch_bounds__(256, 4) warp_pairs(
    const int* batch, const int* targets, const float* motions, const long long* maps,
    const int* rendered, const float* deviations, const float* settings, const float* depth,
    float* warped, float* slope, float* push, float* loss, int height, int width, int big_height, int big_width, int partners,
    int last) {
  const int pair = blockIdx.z, b = pair / partners, target = targets[pair];
  if (target < 0) return;
  PhotoSettings c = *(const PhotoSettings*)settings;
  c.huber *= deviations[batch[b]];
  const PixelMotion motion = *(const PixelMotion*)(motions + 12 * pair);
  const float* image = view_map(maps, target, GREY);
  const float* hidden = rendered[target] ? view_map(maps, target, RENDERED_DEPTH) : 0;
  const float* grey = view_map(maps, batch[b], GREY);
  const float* texture = view_map(maps, batch[b], TEXTURE);
  const int x = blockIdx.x * 32 + threadIdx.x, end = min((int)(blockIdx.y + 1) * WARP_ROWS, big_height);
  depth += (size_t)b * height * width;
  const Source column = source_pixels(x, width, (float)width / big_width);
  const float ratio = (float)height / big_height;
  float total = 0.f;
  for (int y = blockIdx.y * WARP_ROWS + threadIdx.y; y < end && x < big_width; y += 8) {
    const float d = enlarged_depth(depth, width, source_pixels(y, height, ratio), column);
    const Landing p = land(motion, (float)x, (float)y, d, big_height, big_width, c);
    bool seen = p.z > 0.f;
    if (seen && hidden)
      seen = is_visible(hidden, height, width, big_height, big_width, p.u, p.v, p.z, c.occlusion);
    const size_t pixel = (size_t)y * big_width + x, at = (size_t)pair * big_height * big_width + pixel;
    const float a = grey[pixel];
    Sample s = {a, 0.f, 0.f};
    if (seen) s = sample_image(image, big_height, big_width, p.u, p.v);
    const float rate = seen ? s.dx * p.du + s.dy * p.dv : 0.f;
    const bool counts = seen && c.l1 > 0.f;
    if (counts) total += l1_loss(a, s.value, texture[pixel], c);
    warped[at] = packed(s.value, seen);
    if (!last) {
      slope[at] = rate;
      continue;
    }
    const float g = counts ? l1_push(a, s.value, texture[pixel], c) : 0.f;
    slope[at] = g * rate;
    if (push) push[at] = g;
  }
  add_block_sum(total, loss + b);
}
