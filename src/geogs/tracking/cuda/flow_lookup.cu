// Correlation of every cell's descriptor with the other image's around where the cell is believed
// to lie, at all levels of a pyramid; nothing but the windows is ever stored.
#include "common.cuh"

#define TAPS 8        // integer positions along the edge of a window
#define SIDE 7        // interpolated positions
#define WINDOW 49
#define CHANNELS 64   // of a descriptor: two for each lane of a warp
#define WARPS 8       // of a block

struct Window {
  int u, v;    // of the first tap
  float a, b;  // how far the window lies beyond it
};

__device__ __forceinline__ float low_half(u32 pair) { return __uint_as_float(pair << 16); }
__device__ __forceinline__ float high_half(u32 pair) { return __uint_as_float(pair & 0xffff0000u); }

__device__ __forceinline__ Window window_at(float2 p, const float* scale) {
  float x = p.x * scale[0] + scale[1], y = p.y * scale[0] + scale[1];
  // Far outside everything is zero; NaN ends there, too.
  x = x > -100.f && x < 10000.f ? x : -100.f;
  y = y > -100.f && y < 10000.f ? y : -100.f;
  float u = floorf(x), v = floorf(y);
  return {(int)u - SIDE / 2, (int)v - SIDE / 2, x - u, y - v};
}

// Sums of 32 values over the lanes of a warp; lane k keeps the k-th.
__device__ __forceinline__ float transposed_sum(float (&v)[32]) {
  int lane = threadIdx.x;
#pragma unroll
  for (int s = 16; s; s >>= 1) {
#pragma unroll
    for (int i = 0; i < s; i++) {
      float give = lane & s ? v[i] : v[i + s], keep = lane & s ? v[i + s] : v[i];
      v[i] = keep + __shfl_xor_sync(ALL_LANES, give, s);
    }
  }
  return v[0];
}

// levels: for each level offset (in descriptors), width and height; scales: factor and shift from
// pixels. A warp for each cell of each edge at each level. Descriptors are pairs of bfloat16.
extern "C" __global__ void lookup_windows(const unsigned* source, const unsigned* target, const int* first, const int* second, const float2* centres, const int* levels, const float* scales, float* out, int cells, int positions, float norm) {
  __shared__ float shared[WARPS][TAPS * TAPS];
  int lane = threadIdx.x, warp = threadIdx.y, level = blockIdx.y, edge = blockIdx.z, count = gridDim.y;
  int cell = blockIdx.x * WARPS + warp;
  if (cell >= cells) return;
  int offset = levels[3 * level], width = levels[3 * level + 1], height = levels[3 * level + 2];
  Window w = window_at(centres[(long long)edge * cells + cell], scales + 2 * level);
  u32 mine = source[((long long)first[edge] * cells + cell) * 32 + lane];
  float s0 = norm * low_half(mine), s1 = norm * high_half(mine);
  const u32* field = target + ((long long)second[edge] * positions + offset) * 32 + lane;
#pragma unroll
  for (int half = 0; half < 2; half++) {
    float v[32];
#pragma unroll
    for (int k = 0; k < 32; k++) {
      int x = w.u + k % TAPS, y = w.v + half * 4 + k / TAPS;
      bool inside = x >= 0 && y >= 0 && x < width && y < height;
      u32 t = inside ? field[(y * width + x) * 32] : 0u;
      v[k] = s0 * low_half(t) + s1 * high_half(t);
    }
    shared[warp][half * 32 + lane] = transposed_sum(v);
  }
  __syncwarp();
  float* to = out + (((long long)edge * cells + cell) * count + level) * WINDOW;
  for (int k = lane; k < WINDOW; k += 32) {
    const float* t = shared[warp] + k / SIDE * TAPS + k % SIDE;
    float top = t[0] + w.a * (t[1] - t[0]), bottom = t[TAPS] + w.a * (t[TAPS + 1] - t[TAPS]);
    to[k] = top + w.b * (bottom - top);
  }
}

__device__ __forceinline__ void add_pair(float* p, float x, float y) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
  asm volatile("red.global.add.v2.f32 [%0], {%1, %2};" ::"l"(p), "f"(x), "f"(y) : "memory");
#else
  atomicAdd(p, x);
  atomicAdd(p + 1, y);
#endif
}

// Gradients of lookup_windows in both descriptors, added to float buffers of their shapes.
extern "C" __global__ void lookup_gradients(const unsigned* source, const unsigned* target, const int* first, const int* second, const float2* centres, const int* levels, const float* scales, const float* grad, float* grad_source, float* grad_target, int cells, int positions, float norm) {
  __shared__ float shared[WARPS][WINDOW];
  int lane = threadIdx.x, warp = threadIdx.y, level = blockIdx.y, edge = blockIdx.z, count = gridDim.y;
  int cell = blockIdx.x * WARPS + warp;
  if (cell >= cells) return;
  int offset = levels[3 * level], width = levels[3 * level + 1], height = levels[3 * level + 2];
  Window w = window_at(centres[(long long)edge * cells + cell], scales + 2 * level);
  const float* from = grad + (((long long)edge * cells + cell) * count + level) * WINDOW;
  for (int k = lane; k < WINDOW; k += 32) shared[warp][k] = norm * from[k];
  __syncwarp();
  long long own = (((long long)first[edge] * cells + cell) * 32 + lane);
  long long other = ((long long)second[edge] * positions + offset) * 32 + lane;
  u32 mine = source[own];
  float s0 = low_half(mine), s1 = high_half(mine), g0 = 0.f, g1 = 0.f;
  for (int k = 0; k < TAPS * TAPS; k++) {
    int i = k % TAPS, j = k / TAPS, x = w.u + i, y = w.v + j;
    if (x < 0 || y < 0 || x >= width || y >= height) continue;
    const float* g = shared[warp] + j * SIDE + i;
    float weight = 0.f;
    if (j < SIDE) weight += (1.f - w.b) * ((i < SIDE ? (1.f - w.a) * g[0] : 0.f) + (i > 0 ? w.a * g[-1] : 0.f));
    if (j > 0) weight += w.b * ((i < SIDE ? (1.f - w.a) * g[-SIDE] : 0.f) + (i > 0 ? w.a * g[-SIDE - 1] : 0.f));
    long long at = other + (long long)(y * width + x) * 32;
    u32 t = target[at];
    g0 += weight * low_half(t);
    g1 += weight * high_half(t);
    add_pair(grad_target + 2 * at, weight * s0, weight * s1);
  }
  add_pair(grad_source + 2 * own, g0, g1);
}
