// Gradients through the compositing, back to front.
//
// A disk's sums, 16 floats: MX MY UX UY VX VY WX WY WC O NX NY NZ 0 0 0, those of its record. The
// depth that is held at a bound moves with the centre, which is a gradient of WC, too.
#pragma once
#include "blend.cuh"

#define SUMS 16
#define USED_SUMS 13

// One step of the transposing sum: halves the values of a lane, adds those of its partner.
#define FOLD(step, n)                                                   \
  {                                                                     \
    const bool high = (lane & step) != 0;                               \
    _Pragma("unroll") for (int k = 0; k < n; k++) {                     \
      const float kept = high ? g[k + n] : g[k], sent = high ? g[k] : g[k + n]; \
      g[k] = kept + __shfl_xor_sync(ALL_LANES, sent, step);             \
    }                                                                   \
  }

// Sums of 16 values over the lanes of a warp in 16 shuffles; lane l ends with value l / 2.
__device__ __forceinline__ float sum_lanes(float (&g)[SUMS], int lane) {
  FOLD(16, 8) FOLD(8, 4) FOLD(4, 2) FOLD(2, 1)
  return g[0] + __shfl_xor_sync(ALL_LANES, g[0], 1);
}

// What a pixel carries from the back to the front. With q = z A - Z, s its sign, and sums over the
// disks behind: of w dL/dw, of w s and of w s z, the distortion 2 sum w |q| gives
//   dL/dw = 2 |q| + 2 sum_behind w_i s_i (z_i - z),  dL/dz = 2 w (s A - sum_behind w_i s_i).
struct Carried {
  float light, moment, behind, signs, signed_z;
};
struct PixelGradient {
  float constant, z, nx, ny, nz, distortion;
};

__device__ __forceinline__ void unblend_hit(const Hit& h, float4 r0, float4 r1, float4 r2, float4 r3,
                                            float z_reference, const PixelGradient& d, Carried& s,
                                            float (&g)[SUMS]) {
  const float a = fminf(h.alpha, MAX_ALPHA), inverse = 1.f / (1.f - a);
  const float light = s.light * inverse, weight = light * a, zc = h.z - z_reference;
  const float moment = s.moment - weight * zc, covered = 1.f - light, q = zc * covered - moment;
  const float sign = q > 0.f ? 1.f : -1.f;
  const float g_weight = d.constant + d.z * zc + d.nx * r2.z + d.ny * r2.w + d.nz * r3.x +
                         d.distortion * (fabsf(q) + s.signed_z - zc * s.signs);
  const float g_z = weight * (d.z + d.distortion * (sign * covered - s.signs));
  const float g_alpha = h.alpha < MAX_ALPHA ? (s.light * g_weight - s.behind) * inverse : 0.f;
  s.light = light;
  s.moment = moment;
  s.behind += weight * g_weight;
  s.signs += weight * sign;
  s.signed_z += weight * sign * zc;

  const float g_rho = -2.f * g_alpha * a, on_plane = h.on_plane ? g_rho : 0.f;
  const float blurred = g_rho - on_plane;
  const float g_u = on_plane * h.u * h.z, g_v = on_plane * h.v * h.z;
  const float g_w = h.is_free ? -h.z * (h.z * g_z + on_plane * h.rho) : 0.f;
  g[0] = -(g_u * r0.z + g_v * r1.x + g_w * r1.z + blurred * h.dx);
  g[1] = -(g_u * r0.w + g_v * r1.y + g_w * r1.w + blurred * h.dy);
  g[2] = g_u * h.dx;
  g[3] = g_u * h.dy;
  g[4] = g_v * h.dx;
  g[5] = g_v * h.dy;
  g[6] = g_w * h.dx;
  g[7] = g_w * h.dy;
  g[8] = h.is_free ? g_w : -g_z / (r2.x * r2.x);
  g[9] = g_alpha * h.gauss;
  g[10] = weight * d.nx;
  g[11] = weight * d.ny;
  g[12] = weight * d.nz;
}

// Depth is Z / A, so dL/dw collects d_depth / A (z - depth); what has no z in it is the constant.
__device__ __forceinline__ PixelGradient pixel_gradient(float light, float moment, float d_depth,
                                                        float d_alpha, float d_distortion) {
  const float total = 1.f - light, z = d_depth / total;
  return {d_alpha - z * moment / total, z, 0.f, 0.f, 0.f, 2.f * d_distortion};
}

// Grid: tiles of one view, views. ``sums`` (views, disks, 16) is added to. The normal's gradient has
// its own strides between pixels and components, so that both layouts can be read.
extern "C" __global__ void __launch_bounds__(TILE_THREADS) unblend_tiles(
    int capacity, const float4* records, const float4* outlines, const int* offsets,
    const int* lists, int room, float inverse_near, int width, int height, const float* saved,
    const int* ranks, const float* d_depth, const float* d_normal, int pixel_stride,
    int component_stride, const float* d_alpha, const float* d_distortion, float* sums) {
  __shared__ Batch batch;
  __shared__ int ids[TILE_THREADS];
  __shared__ int most;
  const int t = threadIdx.x, lane = t & 31, b = blockIdx.y, tile = b * gridDim.x + blockIdx.x;
  const Pixel p = pixel_of(blockIdx.x, width, height);
  const size_t view = (size_t)b * capacity, area = (size_t)width * height;
  const size_t at = (size_t)p.y * width + p.x, o = b * area + at;
  const int first = min(offsets[tile], room), last = min(offsets[tile + 1], room);
  const float z_reference = reference_depth(records, lists, first, last, view);
  const int rank = p.inside ? ranks[o] : 0;
  Carried state = {1.f, 0.f, 0.f, 0.f, 0.f};
  PixelGradient d = {0.f, 0.f, 0.f, 0.f, 0.f, 0.f};
  if (rank) {
    state.light = saved[2 * b * area + at];
    state.moment = saved[(2 * b + 1) * area + at];
    d = pixel_gradient(state.light, state.moment, d_depth[o], d_alpha[o], d_distortion[o]);
    const float* n = d_normal + 3 * b * area + at * pixel_stride;
    d.nx = n[0];
    d.ny = n[component_stride];
    d.nz = n[2 * component_stride];
  }
  if (t == 0) most = 0;
  __syncthreads();
  const int own_most = warp_max(rank);
  if (lane == 0) atomicMax(&most, own_most);
  __syncthreads();
  const float x = p.x, y = p.y;
  for (int end = most; end > 0; end -= TILE_THREADS) {
    const int base = max(0, end - TILE_THREADS), count = end - base;
    __syncthreads();
    if (t < count) {
      ids[t] = lists[first + base + t];
      stage(batch, t, records, outlines, view + ids[t]);
    }
    __syncthreads();
    for (int c = (count - 1) / 32 * 32; c >= 0; c -= 32) {
      const bool candidate = c + lane < count && base + c + lane < own_most;
      u32 left = __ballot_sync(
          ALL_LANES, candidate && reaches_part(batch, c + lane, p.left, p.top));
      while (left) {
        const int bit = 31 - __clz((int)left), j = c + bit;
        left &= ~(1u << bit);
        const float4 r0 = batch.part[0][j], r1 = batch.part[1][j];
        const float4 r2 = batch.part[2][j], r3 = batch.part[3][j];
        const Hit h = hit_of(r0, r1, r2, r3, x, y, inverse_near);
        const bool blended = h.alpha >= MIN_ALPHA && base + j < rank;
        if (!__any_sync(ALL_LANES, blended)) continue;
        float g[SUMS];
        #pragma unroll
        for (int k = 0; k < SUMS; k++) g[k] = 0.f;
        if (blended) unblend_hit(h, r0, r1, r2, r3, z_reference, d, state, g);
        const float sum = sum_lanes(g, lane);
        if (!(lane & 1) && lane < 2 * USED_SUMS)
          atomicAdd(sums + SUMS * (view + ids[j]) + (lane >> 1), sum);
      }
    }
  }
}
