// Plane sweep: matching costs, their support average, semi-global aggregation, the winner.
//
// Cost volumes are (pixels, slots). A warp holds a pixel's planes, `per` consecutive ones in each
// lane; slot i * 32 + lane holds plane lane * per + i, so that lanes read side by side. Slots beyond
// the last plane hold FAR, and their entry of `slot_rho` is negative.
#include "common.cuh"
#include "sampling.cuh"

#define FAR 1e9f
#define OUTSIDE 1.2f
#define TILE_W 32
#define TILE_H 8
#define SLOT_GROUP 8
#define MAX_KEPT 8

__device__ __forceinline__ float warp_least(float x) {
  for (int s = 16; s; s >>= 1) x = fminf(x, __shfl_xor_sync(ALL_LANES, x, s));
  return x;
}

// ------------------------------------------------------------------ matching

// The sample of a neighbour where pixel (x, y) of a plane projects; the lowest bit says whether it
// lies outside, which costs less than an array of its own.
__device__ __forceinline__ float warped_sample(
    const float* image, const float* hom, float rho, int x, int y, int w, int h) {
  float q0 = hom[0] * x + (hom[1] * y + hom[2] + rho * hom[9]);
  float q1 = hom[3] * x + (hom[4] * y + hom[5] + rho * hom[10]);
  float q2 = hom[6] * x + (hom[7] * y + hom[8] + rho * hom[11]);
  ImagePoint p = project_into(q0, q1, q2, w, h);
  int column = (int)p.u, row = (int)p.v;
  float value = bilinear(image, w, column, row, p.u - column, p.v - row);
  return __int_as_float((__float_as_int(value) & ~1) | (p.inside ? 0 : 1));
}

__device__ __forceinline__ bool is_outside(float sample) { return __float_as_int(sample) & 1; }

__device__ __forceinline__ void insert_cost(float (&best)[MAX_KEPT], int keep, float cost) {
#pragma unroll
  for (int k = 0; k < MAX_KEPT; k++)
    if (k < keep) {
      float low = fminf(best[k], cost);
      cost = fmaxf(best[k], cost);
      best[k] = low;
    }
}

// Window sums of the reference at one pixel.
struct Window { float mean, scale; };

__device__ __forceinline__ Window reference_window(
    const float* tile, int row, int side, float norm, float floor) {
  float sum = 0.f, square = 0.f;
  for (int i = 0; i < side; i++)
    for (int j = 0; j < side; j++) {
      float a = tile[i * row + j];
      sum += a;
      square += a * a;
    }
  float mean = sum * norm;
  return {mean, rsqrtf(fmaxf(square * norm - mean * mean, 0.f) + floor)};
}

// 1 - NCC of two windows of a tile in shared memory.
template <int RADIUS>
__device__ __forceinline__ float window_cost(
    const float* reference, const float* warped, int row, int radius, Window own, float norm,
    float floor) {
  const int side = 2 * (RADIUS ? RADIUS : radius) + 1;
  float b1 = 0.f, bb = 0.f, ab = 0.f;
#pragma unroll
  for (int i = 0; i < side; i++)
#pragma unroll
    for (int j = 0; j < side; j++) {
      float a = reference[i * row + j], b = warped[i * row + j];
      b1 += b;
      bb += b * b;
      ab += a * b;
    }
  float m = b1 * norm, spread = fmaxf(bb * norm - m * m, 0.f) + floor;
  float ncc = (ab * norm - own.mean * m) * own.scale * rsqrtf(spread);
  return fminf(1.f - ncc, OUTSIDE);
}

template <int RADIUS>
__device__ void match_tile(
    const float* grey, const float* images, const float* homographies, const float* slot_rho,
    int slots, int neighbours, int h, int w, int given_radius, int keep, float floor,
    float* volume, float* shared) {
  const int radius = RADIUS ? RADIUS : given_radius, side = 2 * radius + 1;
  const int row = TILE_W + 2 * radius, size = row * (TILE_H + 2 * radius);
  const int x0 = blockIdx.x * TILE_W - radius, y0 = blockIdx.y * TILE_H - radius;
  const int t = threadIdx.x, px = t % TILE_W, py = t / TILE_W;
  const int x = x0 + radius + px, y = y0 + radius + py;
  const bool matches = py < TILE_H, writes = matches && x < w && y < h;
  const float norm = 1.f / (side * side), share = 1.f / keep;
  float *reference = shared, *warped = shared + size;
  for (int s = t; s < size; s += blockDim.x) {
    int u = min(max(x0 + s % row, 0), w - 1), v = min(max(y0 + s / row, 0), h - 1);
    reference[s] = grey[v * w + u];
  }
  __syncthreads();
  const int corner = py * row + px, centre = corner + radius * (row + 1);
  Window own = {0.f, 0.f};
  if (matches) own = reference_window(reference + corner, row, side, norm, floor);
  int turn = 0;
  for (int g = 0; g < SLOT_GROUP; g++) {
    const int slot = blockIdx.z * SLOT_GROUP + g;
    const float rho = slot_rho[slot];
    float best[MAX_KEPT];
#pragma unroll
    for (int k = 0; k < MAX_KEPT; k++) best[k] = FAR;
    // Two buffers in turn: one barrier between writing and reading is enough.
    for (int j = 0; j < neighbours && rho >= 0.f; j++, turn ^= 1) {
      float* tile = warped + turn * size;
      const float* image = images + j * h * w;
      for (int s = t; s < size; s += blockDim.x) {
        int u = min(max(x0 + s % row, 0), w - 1), v = min(max(y0 + s / row, 0), h - 1);
        tile[s] = warped_sample(image, homographies + 12 * j, rho, u, v, w, h);
      }
      __syncthreads();
      if (matches) {
        float cost = window_cost<RADIUS>(
            reference + corner, tile + corner, row, radius, own, norm, floor);
        insert_cost(best, keep, fmaxf(cost, is_outside(tile[centre]) ? OUTSIDE : 0.f));
      }
    }
    if (!writes) continue;
    float mean = 0.f;
#pragma unroll
    for (int k = 0; k < MAX_KEPT; k++) mean += k < keep ? best[k] * share : 0.f;
    volume[((long long)y * w + x) * slots + slot] = rho >= 0.f ? mean : FAR;
  }
}

// volume[pixel, slot] = mean of the `keep` smallest 1 - NCC over the neighbours at the slot's plane.
// grey (h, w) and images (n, h, w) are centred about zero; homographies (n, 12): a (3 x 3), b (3);
// pixel p at inverse depth rho appears at a p + rho b. Grid: tiles of 32 x 8 pixels, slots / 8.
extern "C" __global__ void match_planes(
    const float* grey, const float* images, const float* homographies, const float* slot_rho,
    int slots, int neighbours, int h, int w, int radius, int keep, float floor, float* volume) {
  SHARED_MEMORY(float, shared);
  if (radius == 1)
    match_tile<1>(grey, images, homographies, slot_rho, slots, neighbours, h, w, radius, keep,
                  floor, volume, shared);
  else
    match_tile<0>(grey, images, homographies, slot_rho, slots, neighbours, h, w, radius, keep,
                  floor, volume, shared);
}

// ------------------------------------------------------------------ support average

template <int PER>
__device__ void average_pixel(
    const float* volume, const float* weights, const float* slot_rho, float total, int x, int y,
    int h, int w, int radius, float prior, float pull, float tolerance, float* out) {
  const int lane = threadIdx.x, side = 2 * radius + 1, slots = 32 * PER;
  float mean[PER];
#pragma unroll
  for (int i = 0; i < PER; i++) mean[i] = 0.f;
  for (int dy = max(-radius, -y); dy <= min(radius, h - 1 - y); dy++)
    for (int dx = max(-radius, -x); dx <= min(radius, w - 1 - x); dx++) {
      const float weight = weights[(dy + radius) * side + dx + radius];
      const float* cost = volume + ((long long)(y + dy) * w + x + dx) * slots + lane;
#pragma unroll
      for (int i = 0; i < PER; i++) mean[i] += weight * cost[32 * i];
    }
  const float norm = 1.f / total, inverse = 1.f / prior;
#pragma unroll
  for (int i = 0; i < PER; i++) {
    const float rho = slot_rho[32 * i + lane];
    float cost = mean[i] * norm;
    if (pull > 0.f) cost += pull * fminf(fabsf(rho * inverse - 1.f) / tolerance, 1.f);
    out[((long long)y * w + x) * slots + 32 * i + lane] = rho >= 0.f ? cost : FAR;
  }
}

// Mean cost over (2 radius + 1)^2 pixels, weighted by 1 / (1 + contrast |dI|^2)^2 over the colours
// (3, h, w), plus the pull to the prior: weight min(|rho / prior - 1| / tolerance, 1).
// One warp per pixel; block (32, 8, 4), shared: blockDim warps x (2 radius + 1)^2 floats.
extern "C" __global__ void average_support(
    const float* volume, const float* colours, const float* slot_rho, const float* prior,
    const float* prior_weight, int per, int h, int w, int radius, float contrast, float strength,
    float tolerance, float* out) {
  SHARED_MEMORY(float, shared);
  const int lane = threadIdx.x, side = 2 * radius + 1, pixels = h * w;
  const int x = blockIdx.x * blockDim.y + threadIdx.y, y = blockIdx.y * blockDim.z + threadIdx.z;
  if (x >= w || y >= h) return;
  float* weights = shared + (threadIdx.z * blockDim.y + threadIdx.y) * side * side;
  const int p = y * w + x;
  float total = 0.f;
  for (int q = lane; q < side * side; q += 32) {
    const int u = x + q % side - radius, v = y + q / side - radius;
    float weight = 0.f;
    if (u >= 0 && v >= 0 && u < w && v < h) {
      float like = 0.f;
      for (int c = 0; c < 3; c++) {
        float difference = colours[c * pixels + p] - colours[c * pixels + v * w + u];
        like += difference * difference;
      }
      like = 1.f + contrast * like;
      weight = 1.f / (like * like);
    }
    weights[q] = weight;
    total += weight;
  }
  total = warp_sum(total);
  __syncwarp();
  const float near = prior[p], pull = strength * prior_weight[p];
#define AVERAGE(PER) \
  average_pixel<PER>(volume, weights, slot_rho, total, x, y, h, w, radius, near, pull, tolerance, out)
  switch (per) {
    case 1: AVERAGE(1); break;
    case 3: AVERAGE(3); break;
    case 4: AVERAGE(4); break;
    case 5: AVERAGE(5); break;
    default: AVERAGE(8);
  }
#undef AVERAGE
}

// ------------------------------------------------------------------ semi-global aggregation

struct Path { int x, y, dx, dy, length; };

// Steps that stay in [0, size) from `start` on, the first included.
__device__ __forceinline__ int steps_within(int start, int step, int size) {
  return step == 0 ? 1 << 30 : (step > 0 ? size - start : start + 1);
}

// Path number `index` of a direction; its length is 0 where there is none.
__device__ __forceinline__ Path find_path(int direction, int index, int h, int w) {
  // Steps (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1).
  const int dx = direction < 2 ? 1 - 2 * direction
               : direction < 4 ? 0 : (direction == 4 || direction == 6 ? 1 : -1);
  const int dy = direction < 2 ? 0
               : direction < 4 ? 5 - 2 * direction : (direction == 4 || direction == 7 ? 1 : -1);
  const int first_x = dx > 0 ? 0 : w - 1, first_y = dy > 0 ? 0 : h - 1;
  Path p = {0, 0, dx, dy, 0};
  int count = dy == 0 ? h : (dx == 0 ? w : w + h - 1);
  if (index >= count) return p;
  if (dy == 0) {
    p.x = first_x;
    p.y = index;
  } else if (index < w) {
    p.x = index;
    p.y = first_y;
  } else {
    p.x = first_x;
    p.y = first_y + dy * (index - w + 1);
  }
  p.length = min(steps_within(p.x, dx, w), steps_within(p.y, dy, h));
  return p;
}

template <int PER>
__device__ void follow_path(
    const float* volume, const float* guide, Path path, int w, float small, float large,
    float edge, float* out) {
  const int lane = threadIdx.x, slots = 32 * PER;
  int pixel = path.y * w + path.x;
  const int step = path.dy * w + path.dx;
  float previous[PER], cost[PER];
  float grey = guide[pixel];
#pragma unroll
  for (int i = 0; i < PER; i++) cost[i] = volume[(long long)pixel * slots + 32 * i + lane];
#pragma unroll
  for (int i = 0; i < PER; i++) {
    previous[i] = cost[i];
    out[(long long)pixel * slots + 32 * i + lane] = cost[i];
  }
  // Costs are loaded one pixel ahead, so that memory is not waited for.
  float ahead_grey = 0.f, ahead[PER];
  if (path.length > 1) {
    ahead_grey = guide[pixel + step];
#pragma unroll
    for (int i = 0; i < PER; i++)
      ahead[i] = volume[(long long)(pixel + step) * slots + 32 * i + lane];
  }
  for (int n = 1; n < path.length; n++) {
    pixel += step;
    const float jump = fmaxf(1.5f * small, large / (1.f + edge * fabsf(ahead_grey - grey)));
    grey = ahead_grey;
#pragma unroll
    for (int i = 0; i < PER; i++) cost[i] = ahead[i];
    if (n + 1 < path.length) {
      ahead_grey = guide[pixel + step];
#pragma unroll
      for (int i = 0; i < PER; i++)
        ahead[i] = volume[(long long)(pixel + step) * slots + 32 * i + lane];
    }
    float low = previous[0];
#pragma unroll
    for (int i = 1; i < PER; i++) low = fminf(low, previous[i]);
    low = warp_least(low);
    float below = __shfl_up_sync(ALL_LANES, previous[PER - 1], 1);
    const float above = __shfl_down_sync(ALL_LANES, previous[0], 1);
    if (lane == 0) below = FAR;
    const float top = low + jump;
#pragma unroll
    for (int i = 0; i < PER; i++) {
      const float next = i + 1 < PER ? previous[i + 1 < PER ? i + 1 : i] : (lane < 31 ? above : FAR);
      const float own = previous[i], near = fminf(below, next) + small;
      previous[i] = cost[i] + fminf(fminf(own, top), near) - low;
      below = own;
      out[(long long)pixel * slots + 32 * i + lane] = previous[i];
    }
  }
}

// Path costs of Hirschmueller's Eq. 13 (without the constant) in eight directions:
// paths[direction, pixel, slot]. A jump of more than one plane costs
// max(1.5 small, large / (1 + edge |dI|)) with the grey `guide`. One warp per path; grid.y = 8.
extern "C" __global__ void follow_paths(
    const float* volume, const float* guide, int per, int h, int w, float small, float large,
    float edge, float* paths) {
  const Path path = find_path(blockIdx.y, blockIdx.x * blockDim.y + threadIdx.y, h, w);
  if (path.length == 0) return;
  float* out = paths + (long long)blockIdx.y * h * w * 32 * per;
  switch (per) {
    case 1: follow_path<1>(volume, guide, path, w, small, large, edge, out); break;
    case 3: follow_path<3>(volume, guide, path, w, small, large, edge, out); break;
    case 4: follow_path<4>(volume, guide, path, w, small, large, edge, out); break;
    case 5: follow_path<5>(volume, guide, path, w, small, large, edge, out); break;
    default: follow_path<8>(volume, guide, path, w, small, large, edge, out);
  }
}

// ------------------------------------------------------------------ winner

// A warp's value at plane k, in every lane.
template <int PER>
__device__ __forceinline__ float at_plane(const float (&t)[PER], int k) {
  float value = t[0];
#pragma unroll
  for (int i = 1; i < PER; i++)
    if (i == k % PER) value = t[i];
  return __shfl_sync(ALL_LANES, value, k / PER);
}

template <int PER>
__device__ void pick_pixel(
    const float* paths, const float* volume, long long pixel, long long pixels, int planes,
    float first, float spacing, float* inverse_depth, float* cost, float* margin) {
  const int lane = threadIdx.x, slots = 32 * PER;
  float t[PER];
#pragma unroll
  for (int i = 0; i < PER; i++) {
    t[i] = 0.f;
#pragma unroll
    for (int d = 0; d < 8; d++) t[i] += paths[(d * pixels + pixel) * slots + 32 * i + lane];
  }
  float low = t[0];
  int best = lane * PER;
#pragma unroll
  for (int i = 1; i < PER; i++)
    if (t[i] < low) {
      low = t[i];
      best = lane * PER + i;
    }
  for (int s = 16; s; s >>= 1) {
    const float other = __shfl_xor_sync(ALL_LANES, low, s);
    const int plane = __shfl_xor_sync(ALL_LANES, best, s);
    if (other < low || (other == low && plane < best)) {
      low = other;
      best = plane;
    }
  }
  float second = FAR;
#pragma unroll
  for (int i = 0; i < PER; i++)
    if (abs(lane * PER + i - best) > 2) second = fminf(second, t[i]);
  second = warp_least(second);
  const float before = at_plane(t, max(best - 1, 0)), after = at_plane(t, min(best + 1, slots - 1));
  if (lane != 0) return;
  float shift = 0.f;
  const float curvature = before + after - 2.f * low;
  if (best > 0 && best < planes - 1 && curvature > 1e-6f)
    shift = (before - after) / (2.f * curvature);
  inverse_depth[pixel] = first + (best + shift) * spacing;
  cost[pixel] = volume[pixel * slots + (best % PER) * 32 + best / PER];
  margin[pixel] = second - low;
}

// Winner of the summed path costs: inverse depth at its parabola's vertex, matching cost, and the
// smallest summed cost more than two planes away less the winner's. One warp per pixel.
extern "C" __global__ void pick_planes(
    const float* paths, const float* volume, int per, int pixels, int planes, float first,
    float spacing, float* inverse_depth, float* cost, float* margin) {
  const int pixel = blockIdx.x * blockDim.y + threadIdx.y;
  if (pixel >= pixels) return;
#define PICK(PER) \
  pick_pixel<PER>(paths, volume, pixel, pixels, planes, first, spacing, inverse_depth, cost, margin)
  switch (per) {
    case 1: PICK(1); break;
    case 3: PICK(3); break;
    case 4: PICK(4); break;
    case 5: PICK(5); break;
    default: PICK(8);
  }
#undef PICK
}
