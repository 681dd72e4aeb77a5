// The single-view loss of all views of a window with its gradients (paper Eq. single_loss).
#pragma once
#include "consistency.cuh"
#include "smoothness.cuh"

#define TILE_W 32
#define TILE_H 16
#define TILE_THREADS 256
// Depths reach two pixels around the tile, centres of L_nc one.
#define DEPTH_W (TILE_W + 4)
#define DEPTH_H (TILE_H + 4)
#define CENTRE_W (TILE_W + 2)
#define CENTRE_H (TILE_H + 2)

struct SingleViewTile {
  float depth[DEPTH_H][DEPTH_W];
  Neighbours push[CENTRE_H][CENTRE_W];
};

__device__ __forceinline__ Vector load_normal(const float* normal, size_t at, size_t plane) {
  return {finite_or_zero(normal[at]), finite_or_zero(normal[at + plane]), finite_or_zero(normal[at + 2 * plane])};
}

// L_n and L_nc at the pixel (y, x) in the image; writes its push, and where ``own`` its normal's
// gradient. Returns the loss where ``own``.
__device__ __forceinline__ float normal_terms(
    SingleViewTile& tile, int row, int column, int y, int x, bool own, int height, int width,
    const float* normal, float* d_normal, const float* edge, const float* prior,
    const SingleViewSettings& c) {
  const size_t at = (size_t)y * width + x, plane = (size_t)height * width;
  const float* line = &tile.depth[row + 1][column + 1];
  const float centre = *line;
  const Neighbours d = {line[-1], line[1], line[-DEPTH_W], line[DEPTH_W]};
  const bool inner = c.consistency > 0.f && all_known(centre, d);
  const bool compared = own && centre > 0.f && c.normal > 0.f && prior != 0;
  Neighbours push = {0.f, 0.f, 0.f, 0.f};
  Vector g = {0.f, 0.f, 0.f};
  float loss = 0.f;
  if (inner || compared) {
    const Vector blended = load_normal(normal, at, plane);
    const UnitNormal unit = unit_normal(blended, c.normal_epsilon);
    if (inner) {
      const float rx = ((float)x - c.cx) / c.fx, ry = ((float)y - c.cy) / c.fy;
      const float weight = c.consistency * (1.f - edge[at]);
      loss = normal_consistency(unit.n, d, rx, ry, 1.f / c.fx, 1.f / c.fy, weight, push, g);
    }
    if (compared) loss += normal_l1(unit.n, load_normal(prior, at, plane), c.normal, g);
    g = through_unit(unit, g);
  }
  tile.push[row][column] = push;
  if (!own) return 0.f;
  // What was not finite was taken for 0 and has no gradient.
  d_normal[at] = fabsf(normal[at]) < HUGE_VALUE ? g.x : 0.f;
  d_normal[at + plane] = fabsf(normal[at + plane]) < HUGE_VALUE ? g.y : 0.f;
  d_normal[at + 2 * plane] = fabsf(normal[at + 2 * plane]) < HUGE_VALUE ? g.z : 0.f;
  return loss;
}

// d L_nc / d depth of the tile's pixel (r, k): what the four centres around it push.
__device__ __forceinline__ float gathered_push(const SingleViewTile& tile, int r, int k) {
  return tile.push[r + 1][k + 2].left + tile.push[r + 1][k].right + tile.push[r + 2][k + 1].top +
         tile.push[r][k + 1].bottom;
}

// L_ds of the tile's pixel and d/d depth from it and from its left and upper neighbours.
__device__ __forceinline__ float smoothness_terms(
    const SingleViewTile& tile, int r, int k, const float* contrast, int y, int x, int width,
    float scale, const SingleViewSettings& c, float& pull) {
  const float* d = &tile.depth[r + 2][k + 2];
  const float* g = contrast + (size_t)y * width + x;
  const Smoothness own = depth_smoothness(d[0], d[1], d[DEPTH_W], g[0], scale, c);
  pull -= own.across + own.down;
  if (x > 0) pull += depth_smoothness(d[-1], d[0], d[DEPTH_W - 1], g[-1], scale, c).across;
  if (y > 0) pull += depth_smoothness(d[-DEPTH_W], d[1 - DEPTH_W], d[0], g[-width], scale, c).down;
  return own.loss;
}

// Weighted L_d at a visible depth and its derivative.
__device__ __forceinline__ float depth_term(
    float d, float prior, float confidence, const SingleViewSettings& c, float& pull) {
  if (!(d > 0.f && prior > 0.f)) return 0.f;
  const float weight = c.depth * confidence / (c.relative > 0.f ? prior : 1.f);
  pull += weight * sign(d - prior);
  return weight * fabsf(d - prior);
}

// Maps (B, h, w), normals (B, 3, h, w); gradients are written everywhere, the loss (B) is added
// to. ``clean`` receives the visible depth, 0 elsewhere, for the multi-view losses.
extern "C" __global__ void __launch_bounds__(256) single_view(
    const int* batch, const long long* maps, const float* settings, const float* depth,
    const float* normal, const float* alpha, const float* distortion, const float* inverse_median,
    float* clean, float* d_depth, float* d_normal, float* d_alpha, float* d_distortion, float* loss,
    int height, int width) {
  __shared__ SingleViewTile tile;
  const SingleViewSettings c = *(const SingleViewSettings*)settings;
  const int b = blockIdx.z, x0 = blockIdx.x * TILE_W, y0 = blockIdx.y * TILE_H;
  const int slot = batch[b];
  const size_t plane = (size_t)height * width, start = b * plane;
  const float* prior = slot >= 0 ? view_map(maps, slot, PRIOR_DEPTH) : 0;
  for (int i = threadIdx.x; i < DEPTH_H * DEPTH_W && slot >= 0; i += TILE_THREADS) {
    const int r = i / DEPTH_W, k = i % DEPTH_W, y = y0 + r - 2, x = x0 + k - 2;
    const bool inside = y >= 0 && y < height && x >= 0 && x < width;
    const size_t pixel = (size_t)y * width + x, at = start + pixel;
    tile.depth[r][k] = inside ? shown(depth[at], alpha[at], prior[pixel], c.min_alpha) : 0.f;
  }
  __syncthreads();
  float total = 0.f;
  for (int i = threadIdx.x; i < CENTRE_H * CENTRE_W && slot >= 0; i += TILE_THREADS) {
    const int r = i / CENTRE_W, k = i % CENTRE_W, y = y0 + r - 1, x = x0 + k - 1;
    if (y < 0 || y >= height || x < 0 || x >= width) {
      tile.push[r][k] = {0.f, 0.f, 0.f, 0.f};
      continue;
    }
    const bool own = r > 0 && r <= TILE_H && k > 0 && k <= TILE_W;
    total += normal_terms(tile, r, k, y, x, own, height, width, normal + 3 * start,
                          d_normal + 3 * start, view_map(maps, slot, EDGE),
                          view_map(maps, slot, PRIOR_NORMAL), c);
  }
  __syncthreads();
  for (int i = threadIdx.x; i < TILE_H * TILE_W; i += TILE_THREADS) {
    const int r = i / TILE_W, k = i % TILE_W, y = y0 + r, x = x0 + k;
    if (y >= height || x >= width) continue;
    const size_t pixel = (size_t)y * width + x, at = start + pixel;
    if (slot < 0) {
      d_depth[at] = d_alpha[at] = d_distortion[at] = 0.f;
      for (int n = 0; n < 3; n++) d_normal[3 * start + n * plane + pixel] = 0.f;
      continue;
    }
    const float d = tile.depth[r + 2][k + 2], a = alpha[at], s = distortion[at];
    float pull = d > 0.f ? gathered_push(tile, r, k) : 0.f;
    total += depth_term(d, prior[pixel], view_map(maps, slot, CONFIDENCE)[pixel], c, pull);
    if (c.smoothness > 0.f)
      total += smoothness_terms(tile, r, k, view_map(maps, slot, IMAGE_GRADIENT), y, x, width,
                                inverse_median[b], c, pull);
    const bool solid = fabsf(a) < HUGE_VALUE, thick = d > 0.f && fabsf(s) < HUGE_VALUE;
    const bool filled = prior[pixel] >= 0.f;
    total += solid ? (filled ? c.opacity * (1.f - a) : c.silhouette * a) : 0.f;
    total += thick ? c.distortion * s : 0.f;
    clean[at] = d;
    d_depth[at] = pull;
    d_alpha[at] = solid ? (filled ? -c.opacity : c.silhouette) : 0.f;
    d_distortion[at] = thick ? c.distortion : 0.f;
  }
  add_block_sum(total, loss + b);
}

// The visible depth of views into their slots' maps, and that it is known from now on.
extern "C" __global__ void __launch_bounds__(256) store_rendered(
    const int* batch, const long long* maps, int* rendered, const float* depth, const float* alpha,
    int pixels, float min_alpha) {
  const int slot = batch[blockIdx.y], i = blockIdx.x * 256 + threadIdx.x;
  if (slot < 0 || i >= pixels) return;
  const size_t at = (size_t)blockIdx.y * pixels + i;
  const float prior = view_map(maps, slot, PRIOR_DEPTH)[i];
  view_map(maps, slot, RENDERED_DEPTH)[i] = shown(depth[at], alpha[at], prior, min_alpha);
  if (i == 0) rendered[slot] = 1;
}
