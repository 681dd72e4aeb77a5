// A small CUDA machine for tests on computers without a GPU: blocks run one after another, the
// threads of a block are fibers of one operating-system thread that switch at every barrier.
#pragma once
#include <setjmp.h>
#include <sys/mman.h>
#include <ucontext.h>

#include <algorithm>
#include <cfloat>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <vector>

#define __global__
#define __device__
#define __host__
#define __forceinline__ inline
#define __noinline__
#define __constant__ static
#define __shared__ static
#define __align__(n) __attribute__((aligned(n)))
#define __launch_bounds__(...)

struct Index3 { unsigned x, y, z; };
static Index3 threadIdx, blockIdx, blockDim, gridDim;
static const int warpSize = 32;

struct int2 { int x, y; };
struct uint2 { unsigned x, y; };
struct int4 { int x, y, z, w; };
struct uchar4 { unsigned char x, y, z, w; };
struct float2 { float x, y; };
struct float3 { float x, y, z; };
struct __attribute__((aligned(16))) float4 { float x, y, z, w; };
struct double3 { double x, y, z; };
static inline int2 make_int2(int x, int y) { return {x, y}; }
static inline uint2 make_uint2(unsigned x, unsigned y) { return {x, y}; }
static inline int4 make_int4(int x, int y, int z, int w) { return {x, y, z, w}; }
static inline float2 make_float2(float x, float y) { return {x, y}; }
static inline float3 make_float3(float x, float y, float z) { return {x, y, z}; }
static inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }
static inline double3 make_double3(double x, double y, double z) { return {x, y, z}; }

template <class To, class From> static inline To emu_bits(From from) { To to; memcpy(&to, &from, sizeof to); return to; }
static inline float __int_as_float(int i) { return emu_bits<float>(i); }
static inline int __float_as_int(float f) { return emu_bits<int>(f); }
static inline float __uint_as_float(unsigned i) { return emu_bits<float>(i); }
static inline unsigned __float_as_uint(float f) { return emu_bits<unsigned>(f); }
static inline float rsqrtf(float x) { return 1.f / sqrtf(x); }
static inline double rsqrt(double x) { return 1. / sqrt(x); }
static inline float __fdividef(float a, float b) { return a / b; }
static inline float __frcp_rn(float x) { return 1.f / x; }
static inline float __saturatef(float x) { return x < 0.f ? 0.f : (x > 1.f ? 1.f : x); }
static inline float emu_expf(float x) { return expf(x); }
static inline float emu_logf(float x) { return logf(x); }
#define __expf emu_expf
#define __logf emu_logf
static inline float __exp2f_(float x) { return exp2f(x); }
static inline int __ffs(int x) { return __builtin_ffs(x); }
static inline int __clz(int x) { return x ? __builtin_clz(x) : 32; }
static inline int __popc(unsigned x) { return __builtin_popcount(x); }
static inline int __float2int_rd(float x) { return (int)floorf(x); }
static inline int __float2int_rn(float x) { return (int)nearbyintf(x); }
template <class T> static inline T __ldg(const T* p) { return *p; }
using std::isfinite; using std::isnan; using std::max; using std::min;
static inline float max(float a, int b) { return a > b ? a : b; }

template <class T, class V> static inline T emu_exchange(T* p, V next) { T old = *p; *p = next; return old; }
template <class T> static inline T atomicAdd(T* p, T v) { return emu_exchange(p, (T)(*p + v)); }
template <class T> static inline T atomicMax(T* p, T v) { return emu_exchange(p, std::max(*p, v)); }
template <class T> static inline T atomicMin(T* p, T v) { return emu_exchange(p, std::min(*p, v)); }
template <class T> static inline T atomicExch(T* p, T v) { return emu_exchange(p, v); }
template <class T> static inline T atomicOr(T* p, T v) { return emu_exchange(p, (T)(*p | v)); }
template <class T> static inline T atomicAnd(T* p, T v) { return emu_exchange(p, (T)(*p & v)); }
template <class T> static inline T atomicCAS(T* p, T expected, T v) { T old = *p; if (old == expected) *p = v; return old; }
static inline void __threadfence() {}
static inline void __threadfence_block() {}

// ---------------------------------------------------------------- fibers and barriers
struct Barrier { int arrived, generation; };
// A fiber is made once and runs one thread of every block. Between fibers _longjmp jumps, which unlike
// swapcontext asks the operating system for nothing.
struct Fiber { jmp_buf place; bool done; Index3 index; };
static jmp_buf emu_main;
static std::vector<Fiber> emu_fibers;
static std::vector<char> emu_dynamic;
static int emu_current, emu_count, emu_live, emu_live_in_warp[64], emu_predicates[1024];
static Barrier emu_block, emu_warp[64];
static uint64_t emu_lane[64][32];
static std::function<void()> emu_body;

static inline int emu_thread() { return emu_current; }
static inline void emu_switch_out() {
  if (!_setjmp(emu_fibers[emu_current].place)) _longjmp(emu_main, 1);
  threadIdx = emu_fibers[emu_current].index;
}
static inline void emu_arrive(Barrier& b, const int& live) {
  int generation = b.generation;
  b.arrived++;
  while (b.generation == generation) {
    if (b.arrived >= live) { b.arrived = 0; b.generation++; break; }
    emu_switch_out();
  }
}
static inline void emu_warp_barrier() { int w = emu_current >> 5; emu_arrive(emu_warp[w], emu_live_in_warp[w]); }
static inline void __syncthreads() { emu_arrive(emu_block, emu_live); }
static inline void __syncwarp(unsigned = 0xffffffffu) { emu_warp_barrier(); }
template <class Fold> static inline int emu_vote(int p, int start, Fold fold) {
  emu_predicates[emu_current] = p;
  __syncthreads();
  int r = start;
  for (int i = 0; i < emu_count; i++) if (!emu_fibers[i].done) r = fold(r, emu_predicates[i] != 0);
  __syncthreads();
  return r;
}
static inline int __syncthreads_and(int p) { return emu_vote(p, 1, [](int a, int b) { return a & b; }); }
static inline int __syncthreads_or(int p) { return emu_vote(p, 0, [](int a, int b) { return a | b; }); }
static inline int __syncthreads_count(int p) { return emu_vote(p, 0, [](int a, int b) { return a + b; }); }
template <class T> static inline T emu_read_lane(T v, int source) {
  int w = emu_current >> 5;
  uint64_t bits = 0;
  memcpy(&bits, &v, sizeof(T));
  emu_lane[w][emu_current & 31] = bits;
  emu_warp_barrier();
  bits = emu_lane[w][source & 31];
  emu_warp_barrier();
  T out;
  memcpy(&out, &bits, sizeof(T));
  return out;
}
template <class T> static inline T __shfl_sync(unsigned, T v, int s) { return emu_read_lane(v, s); }
template <class T> static inline T __shfl_xor_sync(unsigned, T v, int m) { return emu_read_lane(v, (emu_current & 31) ^ m); }
template <class T> static inline T __shfl_up_sync(unsigned, T v, int d) { int l = emu_current & 31; return emu_read_lane(v, l >= d ? l - d : l); }
template <class T> static inline T __shfl_down_sync(unsigned, T v, int d) { int l = emu_current & 31; return emu_read_lane(v, l + d < 32 ? l + d : l); }
static inline unsigned __ballot_sync(unsigned, int p) {
  int w = emu_current >> 5;
  emu_lane[w][emu_current & 31] = p != 0;
  emu_warp_barrier();
  unsigned r = 0;
  for (int i = 0; i < 32; i++) if (w * 32 + i < emu_count && !emu_fibers[w * 32 + i].done) r |= (unsigned)(emu_lane[w][i] & 1) << i;
  emu_warp_barrier();
  return r;
}
static inline int __any_sync(unsigned m, int p) { return __ballot_sync(m, p) != 0; }
static inline int __all_sync(unsigned m, int p) { return __ballot_sync(m, !p) == 0; }

static void emu_enter() {
  threadIdx = emu_fibers[emu_current].index;
  for (;;) {
    emu_body();
    emu_fibers[emu_current].done = true;
    emu_live--;
    emu_live_in_warp[emu_current >> 5]--;
    emu_switch_out();
  }
}

// Stacks of all threads of a block; memory is only taken where it is used.
static const size_t EMU_STACK = 256 * 1024;
static char* emu_stacks() {
  static char* stacks = (char*)mmap(nullptr, EMU_STACK * 1024, PROT_READ | PROT_WRITE,
                                    MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
  return stacks;
}
static void emu_begin(int thread) {
  static ucontext_t fresh;
  getcontext(&fresh);
  fresh.uc_stack.ss_sp = emu_stacks() + EMU_STACK * thread;
  fresh.uc_stack.ss_size = EMU_STACK;
  fresh.uc_link = nullptr;
  makecontext(&fresh, emu_enter, 0);
  if (!_setjmp(emu_main)) setcontext(&fresh);
}
static void emu_go_on(int thread) {
  if (!_setjmp(emu_main)) _longjmp(emu_fibers[thread].place, 1);
}

static void emu_run(const unsigned* grid, const unsigned* block, size_t shared, std::function<void()> body) {
  static int begun = 0;
  emu_body = body;
  blockDim = {block[0], block[1], block[2]};
  gridDim = {grid[0], grid[1], grid[2]};
  emu_count = block[0] * block[1] * block[2];
  if (emu_count > 1024) abort();
  if ((int)emu_fibers.size() < emu_count) emu_fibers.resize(emu_count);
  emu_dynamic.assign(shared + 16, 0x7f);
  for (int t = 0; t < emu_count; t++)
    emu_fibers[t].index = {t % block[0], t / block[0] % block[1], t / (block[0] * block[1])};
  for (unsigned z = 0; z < grid[2]; z++) for (unsigned y = 0; y < grid[1]; y++) for (unsigned x = 0; x < grid[0]; x++) {
    blockIdx = {x, y, z};
    emu_block = {0, 0};
    emu_live = emu_count;
    for (int w = 0; w < 64; w++) { emu_warp[w] = {0, 0}; emu_live_in_warp[w] = std::max(0, std::min(32, emu_count - 32 * w)); }
    for (int t = 0; t < emu_count; t++) emu_fibers[t].done = false;
    while (emu_live) for (int t = 0; t < emu_count; t++) if (!emu_fibers[t].done) {
      emu_current = t;
      if (t < begun) { emu_go_on(t); continue; }
      begun = t + 1;
      emu_begin(t);
    }
  }
}
// Dynamic shared memory: a kernel writes SHARED_MEMORY(float, name);
#define SHARED_MEMORY(type, name) type* name = (type*)(((uintptr_t)emu_dynamic.data() + 15) & ~(uintptr_t)15)
