// Rays against the solids of a room; the arithmetic of rays.py and surface.py.
#include "common.cuh"

#define MOST_SOLIDS 128
#define SOLID_FLOATS 16
#define NEAREST 1e-4f
#define TINY 1e-9f
#define NO_HIT 3e38f
#define BOX 0
#define FRUSTUM 1

struct V3 { float x, y, z; };
__device__ __forceinline__ V3 v3(float x, float y, float z) { V3 v = {x, y, z}; return v; }
__device__ __forceinline__ V3 operator+(V3 a, V3 b) { return v3(a.x + b.x, a.y + b.y, a.z + b.z); }
__device__ __forceinline__ V3 operator-(V3 a, V3 b) { return v3(a.x - b.x, a.y - b.y, a.z - b.z); }
__device__ __forceinline__ V3 operator*(float s, V3 a) { return v3(s * a.x, s * a.y, s * a.z); }
__device__ __forceinline__ V3 operator*(V3 a, V3 b) { return v3(a.x * b.x, a.y * b.y, a.z * b.z); }
__device__ __forceinline__ float dot(V3 a, V3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
__device__ __forceinline__ float norm(V3 a) { return sqrtf(dot(a, a)); }
__device__ __forceinline__ V3 unit(V3 a) { return rsqrtf(fmaxf(dot(a, a), 1e-20f)) * a; }
__device__ __forceinline__ V3 load3(const float* p) { return v3(p[0], p[1], p[2]); }
__device__ __forceinline__ float clampf(float x, float low, float high) { return fminf(fmaxf(x, low), high); }
__device__ __forceinline__ float away(float d) { return fabsf(d) < TINY ? (d < 0.f ? -TINY : TINY) : d; }

// A solid as packed_solids() stores it, the radius of the ball around it, the second of its widths.
struct Solid {
  float to_local[9], centre[3], half[3], kind, radius, bulk;
};

// Those of a room, in shared memory; a bit for each place that is not empty.
struct Stock {
  Solid solid[MOST_SOLIDS];
  u32 present[MOST_SOLIDS / 32];
};

__device__ __forceinline__ V3 turn(const Solid& s, V3 v) {
  const float* r = s.to_local;
  return v3(r[0] * v.x + r[1] * v.y + r[2] * v.z, r[3] * v.x + r[4] * v.y + r[5] * v.z, r[6] * v.x + r[7] * v.y + r[8] * v.z);
}
__device__ __forceinline__ V3 turn_back(const Solid& s, V3 v) {
  const float* r = s.to_local;
  return v3(r[0] * v.x + r[3] * v.y + r[6] * v.z, r[1] * v.x + r[4] * v.y + r[7] * v.z, r[2] * v.x + r[5] * v.y + r[8] * v.z);
}

// Fills the stock with a room's solids; all threads of the block.
__device__ void load_stock(Stock& stock, const float* packed, int count, int thread, int threads) {
  if (thread < MOST_SOLIDS / 32) stock.present[thread] = 0;
  __syncthreads();
  for (int i = thread; i < count; i += threads) {
    const float* p = packed + i * SOLID_FLOATS;
    Solid& s = stock.solid[i];
    for (int k = 0; k < 9; k++) s.to_local[k] = p[k];
    for (int k = 0; k < 3; k++) { s.centre[k] = p[9 + k]; s.half[k] = p[12 + k]; }
    s.kind = p[15];
    float wide = fmaxf(s.half[0], s.half[1]), other = s.kind == FRUSTUM ? 0.f : fminf(s.half[0], s.half[1]);
    s.radius = s.kind == 2.f ? fmaxf(wide, s.half[2]) : sqrtf(wide * wide + other * other + s.half[2] * s.half[2]);
    float other_wide = s.kind == FRUSTUM ? wide : fminf(s.half[0], s.half[1]);
    s.bulk = 2.f * fmaxf(other_wide, fminf(wide, s.half[2]));
    if (s.kind >= 0.f) atomicOr(&stock.present[i >> 5], 1u << (i & 31));
  }
  __syncthreads();
}

__device__ __forceinline__ float enter_box(V3 o, V3 d, V3 half) {
  V3 inverse = v3(1.f / away(d.x), 1.f / away(d.y), 1.f / away(d.z));
  V3 middle = -1.f * (o * inverse), reach = v3(half.x * fabsf(inverse.x), half.y * fabsf(inverse.y), half.z * fabsf(inverse.z));
  float near = fmaxf(fmaxf(middle.x - reach.x, middle.y - reach.y), middle.z - reach.z);
  float far = fminf(fminf(middle.x + reach.x, middle.y + reach.y), middle.z + reach.z);
  return near <= far ? near : NO_HIT;
}

__device__ __forceinline__ float enter_ellipsoid(V3 o, V3 d, V3 half) {
  V3 inverse = v3(1.f / half.x, 1.f / half.y, 1.f / half.z);
  o = o * inverse; d = d * inverse;
  float a = dot(d, d), b = dot(o, d);
  V3 nearest = o - (b / a) * d;
  float rest = 1.f - dot(nearest, nearest);
  return rest >= 0.f ? (-b - sqrtf(rest * a)) / a : NO_HIT;
}

__device__ __forceinline__ float enter_frustum(V3 o, V3 d, V3 half, float least) {
  float slope = (half.y - half.x) / (2.f * half.z), level = 0.5f * (half.x + half.y) + slope * o.z;
  float steep = slope * d.z, a = away(d.x * d.x + d.y * d.y - steep * steep);
  float b = o.x * d.x + o.y * d.y - steep * level, c = o.x * o.x + o.y * o.y - level * level;
  float rest = b * b - a * c, best = NO_HIT;
  if (rest >= 0.f) {
    float root = sqrtf(rest);
    for (int sign = -1; sign <= 1; sign += 2) {
      float t = (-b + sign * root) / a;
      if (fabsf(o.z + t * d.z) <= half.z && t > least && t < best) best = t;
    }
  }
  float dz = away(d.z);
  for (int sign = -1; sign <= 1; sign += 2) {
    float t = (sign * half.z - o.z) / dz, x = o.x + t * d.x, y = o.y + t * d.y, radius = sign > 0 ? half.y : half.x;
    if (x * x + y * y <= radius * radius && t > least && t < best) best = t;
  }
  return best;
}

// t at which a ray enters a solid, NO_HIT where it does not.
__device__ __forceinline__ float enter(const Solid& s, V3 origin, V3 direction) {
  V3 offset = origin - load3(s.centre);
  // From the point nearest to the solid's centre the equations lose no digits to distance.
  float t0 = -dot(offset, direction) / dot(direction, direction);
  V3 nearest = offset + t0 * direction;
  if (dot(nearest, nearest) > s.radius * s.radius * 1.0001f + 1e-8f) return NO_HIT;
  V3 o = turn(s, nearest), d = turn(s, direction), half = load3(s.half);
  float t = s.kind == BOX ? enter_box(o, d, half) : s.kind == FRUSTUM ? enter_frustum(o, d, half, NEAREST - t0) : enter_ellipsoid(o, d, half);
  t = t < NO_HIT ? t + t0 : NO_HIT;
  return t > NEAREST ? t : NO_HIT;
}

// Whether one of the solids in the mask is met before t = end.
__device__ bool occluded(const Stock& stock, const u32* mask, V3 origin, V3 direction, float end) {
  for (int word = 0; word < MOST_SOLIDS / 32; word++)
    for (u32 left = mask[word]; left; left &= left - 1)
      if (enter(stock.solid[32 * word + __ffs(left) - 1], origin, direction) < end) return true;
  return false;
}

__device__ __forceinline__ float room_exit(V3 size, V3 o, V3 d) {
  d = v3(away(d.x), away(d.y), away(d.z));
  return fminf(fminf((d.x > 0.f ? size.x - o.x : -o.x) / d.x, (d.y > 0.f ? size.y - o.y : -o.y) / d.y), (d.z > 0.f ? size.z - o.z : -o.z) / d.z);
}

// A ball around all points that the threads of a block look at, so that most solids can be left out.
struct Ball { float x, y, z; int radius_bits; };

// Prepares a ball; to be called by all threads, each with a point of its own.
__device__ void begin_ball(Ball& ball, V3 point, bool middle) {
  if (middle) { ball.x = point.x; ball.y = point.y; ball.z = point.z; ball.radius_bits = 0; }
  __syncthreads();
}
// Widens it by what each thread measured from its middle; the bits of floats >= 0 sort like integers.
__device__ void end_ball(Ball& ball, float distance, int thread) {
  int widest = warp_max(__float_as_int(distance));
  if ((thread & 31) == 0) atomicMax(&ball.radius_bits, widest);
  __syncthreads();
}
__device__ __forceinline__ V3 middle_of(const Ball& ball) { return v3(ball.x, ball.y, ball.z); }
__device__ __forceinline__ float radius_of(const Ball& ball) { return __int_as_float(ball.radius_bits) * 1.001f + 2e-3f; }

// Marks the solids nearer than a reach to a segment: no other can be between its two ends, each
// widened by as much. A solid per thread; the mask must be zero.
__device__ void mark_between(const Stock& stock, u32* mask, V3 from, V3 to, float reach, int thread) {
  if (thread >= MOST_SOLIDS || !(stock.present[thread >> 5] >> (thread & 31) & 1)) return;
  const Solid& s = stock.solid[thread];
  V3 along = to - from, offset = load3(s.centre) - from;
  float share = clampf(dot(offset, along) / fmaxf(dot(along, along), 1e-12f), 0.f, 1.f);
  V3 gap = offset - share * along;
  float most = s.radius * 1.001f + reach;
  if (dot(gap, gap) <= most * most) atomicOr(&mask[thread >> 5], 1u << (thread & 31));
}

struct Hit { float t; int solid; };

// The first of the solids in the mask that a ray meets, or the room itself (-1).
__device__ Hit closest_hit(const Stock& stock, const u32* mask, V3 size, V3 origin, V3 direction) {
  Hit hit = {room_exit(size, origin, direction), -1};
  for (int word = 0; word < MOST_SOLIDS / 32; word++)
    for (u32 left = mask[word]; left; left &= left - 1) {
      int i = 32 * word + __ffs(left) - 1;
      float t = enter(stock.solid[i], origin, direction);
      if (t < hit.t) { hit.t = t; hit.solid = i; }
    }
  return hit;
}

// Distance to a solid, negative inside; exact outside boxes, close to it near the others.
__device__ float signed_distance(const Solid& s, V3 point) {
  V3 p = turn(s, point - load3(s.centre)), half = load3(s.half);
  V3 q = v3(fabsf(p.x) - half.x, fabsf(p.y) - half.y, fabsf(p.z) - half.z);
  if (s.kind == BOX) {
    V3 out = v3(fmaxf(q.x, 0.f), fmaxf(q.y, 0.f), fmaxf(q.z, 0.f));
    return norm(out) + fminf(fmaxf(fmaxf(q.x, q.y), q.z), 0.f);
  }
  if (s.kind == FRUSTUM) {
    float slope = (half.y - half.x) / (2.f * half.z);
    float side = (sqrtf(p.x * p.x + p.y * p.y) - 0.5f * (half.x + half.y) - slope * p.z) * rsqrtf(1.f + slope * slope);
    float a = fmaxf(side, 0.f), b = fmaxf(q.z, 0.f);
    return sqrtf(a * a + b * b) + fminf(fmaxf(side, q.z), 0.f);
  }
  V3 inverse = v3(1.f / half.x, 1.f / half.y, 1.f / half.z), r = p * inverse;
  float k0 = norm(r), k1 = norm(r * inverse);
  return k0 * (k0 - 1.f) / fmaxf(k1, 1e-6f);
}
