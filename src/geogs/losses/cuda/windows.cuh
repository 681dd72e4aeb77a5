// Similarity measures over windows around each pixel, with their gradient, in one pass.
//
// A block walks down a strip of columns. Each row's sums along x come from shared memory, those
// along y from chains of partial sums in registers: a row is added to all windows that are open at
// it. What the windows give to their pixels is summed the same way, one window later, because the
// adjoint of a symmetric window sum is itself.
#pragma once
#include "warp.cuh"

#define STRIP 128

// Sum over the last SIDE rows, weighted. Fed once a row.
template <class Measure>
struct Chain {
  static const int SIDE = 2 * Measure::HALF + 1;
  float open[SIDE - 1];
  __device__ __forceinline__ void clear() {
#pragma unroll
    for (int i = 0; i < SIDE - 1; i++) open[i] = 0.f;
  }
  __device__ __forceinline__ float feed(float x) {
    const float sum = open[0] + Measure::weight(0) * x;
#pragma unroll
    for (int i = 0; i < SIDE - 2; i++) open[i] = open[i + 1] + Measure::weight(i + 1) * x;
    open[SIDE - 2] = Measure::weight(SIDE - 1) * x;
    return sum;
  }
};

// Window sums of the reference a, the warped image b, their products, and the seen share.
struct Moments { float a, aa, b, bb, ab, seen; };

// What a window gives to d loss / d b of its pixels: constant + to_a * a + to_b * b.
struct WindowGradient { float constant, to_a, to_b; };

// One pixel of the two images. Outside of the image all is 0.
struct PixelPair { float a, b; bool seen; };

struct PairImages {
  const float *grey, *warped;
  int height, width;
  __device__ __forceinline__ PixelPair load(int y, int x) const {
    if (y < 0 || y >= height || x < 0 || x >= width) return {0.f, 0.f, false};
    const size_t at = (size_t)y * width + x;
    const float w = warped[at];
    return {grey[at], fabsf(w), is_seen(w)};
  }
};

template <int SIDE>
__device__ __forceinline__ u32 bits_from(const u32* words, int start) {
  const u64 two = (u64)words[start >> 5] | ((u64)words[(start >> 5) + 1] << 32);
  return (u32)(two >> (start & 31)) & ((1u << SIDE) - 1u);
}

// Bits of ``flags``: what there is around this measure.
enum { ADD_EARLIER = 1, FINISH = 2, KEEP_GRADIENT = 4 };

// Adds the measure's loss to ``loss`` (B). Unless FINISH, d loss / d warped is written to
// ``gradient`` (pairs, H, W); with FINISH that of L_1 and (ADD_EARLIER) what stands in
// ``gradient`` are added, ``pull`` (pairs, H, W) turns from d warped / d depth into d loss / d
// depth, and with KEEP_GRADIENT the sum is kept in ``gradient``.
template <class Measure>
__device__ __forceinline__ void compare_windows(
    const int* batch, const int* targets, const long long* maps, const float* deviations,
    const float* settings, const float* warped, float* pull, float* gradient, float* loss, int height, int width,
    int partners, int rows, int flags) {
  const int HALF = Measure::HALF, SIDE = 2 * HALF + 1;
  __shared__ float2 images[2][STRIP];
  __shared__ float4 gradients[2][STRIP];
  __shared__ u32 seen[2][STRIP / 32 + 1];
  const int pair = blockIdx.z, b = pair / partners;
  if (targets[pair] < 0) return;
  // In shared memory, because registers are short here.
  __shared__ PhotoSettings c;
  if (threadIdx.x == 0) {
    c = *(const PhotoSettings*)settings;
    c.huber *= deviations[batch[b]];
  }
  const size_t plane = (size_t)height * width;
  const PairImages source = {view_map(maps, batch[b], GREY), warped + pair * plane, height, width};
  const float* textures = view_map(maps, batch[b], TEXTURE);
  const int t = threadIdx.x, x = blockIdx.x * (STRIP - 4 * HALF) - 2 * HALF + t;
  const int first = blockIdx.y * rows, end = min(first + rows, height);
  const bool summed = t >= HALF && t < STRIP - HALF;
  const bool owned = t >= 2 * HALF && t < STRIP - 2 * HALF && x < width;
  if (t < 2) seen[t][STRIP / 32] = 0;

  Chain<Measure> moments[6], shares[3];
  for (int i = 0; i < 6; i++) moments[i].clear();
  for (int i = 0; i < 3; i++) shares[i].clear();
  WindowGradient given = {0.f, 0.f, 0.f};
  float total = 0.f;
  u32 history = 0;  // whether the pixel was seen, bit i: i rows ago
  PixelPair next = source.load(first - 2 * HALF, x);
  for (int y = first - 2 * HALF; y <= end + 2 * HALF; y++) {
    const int turn = y & 1;
    const PixelPair own = Measure::prepared(next);
    const u32 ballot = __ballot_sync(ALL_LANES, next.seen);
    history = (history << 1) | (u32)next.seen;
    if ((t & 31) == 0) seen[turn][t >> 5] = ballot;
    images[turn][t] = make_float2(own.a, own.b);
    gradients[turn][t] = make_float4(given.constant, given.to_a, given.to_b, 0.f);
    next = source.load(y + 1, x);
    // The pixel whose windows are all complete, one row late.
    const int centre = y - HALF, done = y - 1 - 2 * HALF;
    const bool finished = owned && done >= first;
    const size_t at = pair * plane + (size_t)done * width + x;
    PixelPair out = {0.f, 0.f, false};
    float rate = 0.f, texture = 0.f;
    if (finished) {
      out = source.load(done, x);
      if (flags & FINISH) {
        rate = pull[at];
        texture = textures[(size_t)done * width + x];
      }
    }
    const bool counts = Measure::counts(centre, x, height, width, (history >> HALF) & 1u);
    const float texture_around = counts ? textures[(size_t)centre * width + x] : 0.f;
    __syncthreads();
    if (!summed) continue;

    Moments line = {0.f, 0.f, 0.f, 0.f, 0.f, 0.f};
#pragma unroll
    for (int k = 0; k < SIDE; k++) {
      const float2 g = images[turn][t - HALF + k];
      const float wa = Measure::weight(k) * g.x, wb = Measure::weight(k) * g.y;
      line.a += wa;
      line.aa += wa * g.x;
      line.b += wb;
      line.bb += wb * g.y;
      line.ab += wa * g.y;
    }
    line.seen = Measure::seen_share(bits_from<SIDE>(seen[turn], t - HALF));
    const Moments m = {moments[0].feed(line.a), moments[1].feed(line.aa), moments[2].feed(line.b),
                       moments[3].feed(line.bb), moments[4].feed(line.ab), moments[5].feed(line.seen)};
    given = {0.f, 0.f, 0.f};
    if (counts) {
      const float value = Measure::compare(m, texture_around, c, given);
      if (owned && centre >= first && centre < end) total += value;
    }

    WindowGradient g = {0.f, 0.f, 0.f};
#pragma unroll
    for (int k = 0; k < SIDE; k++) {
      const float4 w = gradients[turn][t - HALF + k];
      g.constant += Measure::weight(k) * w.x;
      g.to_a += Measure::weight(k) * w.y;
      g.to_b += Measure::weight(k) * w.z;
    }
    g = {shares[0].feed(g.constant), shares[1].feed(g.to_a), shares[2].feed(g.to_b)};
    if (!finished) continue;
    const PixelPair q = Measure::prepared(out);
    float push = out.seen ? g.constant + g.to_a * q.a + g.to_b * q.b : 0.f;
    if (!(flags & FINISH)) {
      gradient[at] = push;
      continue;
    }
    if (flags & ADD_EARLIER) push += gradient[at];
    if (out.seen && c.l1 > 0.f) push += l1_push(out.a, out.b, texture, c);
    if (flags & KEEP_GRADIENT) gradient[at] = push;
    pull[at] = rate * push;
  }
  add_block_sum(total, loss + b);
}
