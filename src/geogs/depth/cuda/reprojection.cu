// Depth maps seen from elsewhere: transfer, mutual check, votes on points.
//
// `transforms` (n, 12): rotation (3 x 3, row by row) and translation of each view.
// `maps` (n, 2): addresses of each view's depth and confidence (h, w).
#include "common.cuh"

#define NOTHING 0xffffffffffffffffull

__device__ __forceinline__ const float* depth_map(const long long* maps, int view) {
  return (const float*)maps[2 * view];
}

__device__ __forceinline__ const float* confidence_map(const long long* maps, int view) {
  return (const float*)maps[2 * view + 1];
}

struct Lens { float fx, fy, cx, cy; };
struct Point { float x, y, z; };

__device__ __forceinline__ Point transform(const float* T, Point p) {
  return {T[0] * p.x + T[1] * p.y + T[2] * p.z + T[9], T[3] * p.x + T[4] * p.y + T[5] * p.z + T[10],
          T[6] * p.x + T[7] * p.y + T[8] * p.z + T[11]};
}

__device__ __forceinline__ Point back_project(Lens lens, int x, int y, float depth) {
  return {(x - lens.cx) / lens.fx * depth, (y - lens.cy) / lens.fy * depth, depth};
}

// The pixel that sees a camera-frame point; -1 for none.
__device__ __forceinline__ int pixel_of(Lens lens, Point p, int h, int w) {
  if (!(p.z > 1e-4f)) return -1;
  const float u = floorf(lens.fx * p.x / p.z + lens.cx + 0.5f);
  const float v = floorf(lens.fy * p.y / p.z + lens.cy + 0.5f);
  return u >= 0.f && v >= 0.f && u < w && v < h ? (int)v * w + (int)u : -1;
}

// A camera-frame point's z over the depth at its pixel, and that pixel's confidence; 0, 0 unseen.
struct Seen { float ratio, sure; };

__device__ __forceinline__ Seen look_up(
    Lens lens, Point p, const float* depth, const float* confidence, int h, int w) {
  const int pixel = pixel_of(lens, p, h, w);
  if (pixel < 0) return {0.f, 0.f};
  const float d = depth[pixel];
  if (!(d > 0.f)) return {0.f, 0.f};
  return {p.z / d, confidence[pixel]};
}

// Nearest points of other views per pixel of this one, each covering 2 x 2 pixels: the bits of z
// above those of the confidence, which order as the numbers do. `seen` (n, h, w) starts as NOTHING.
extern "C" __global__ void splat_depths(
    const long long* maps, const float* transforms, int h, int w, float fx, float fy, float cx,
    float cy, float least, unsigned long long* seen) {
  const int pixel = blockIdx.x * blockDim.x + threadIdx.x, pixels = h * w, j = blockIdx.y;
  if (pixel >= pixels) return;
  const float sure = confidence_map(maps, j)[pixel];
  if (!(sure >= least)) return;
  const Lens lens = {fx, fy, cx, cy};
  const float depth = depth_map(maps, j)[pixel];
  const Point p = transform(transforms + 12 * j, back_project(lens, pixel % w, pixel / w, depth));
  if (!(p.z > 1e-4f)) return;
  const float left = floorf(fx * p.x / p.z + cx), top = floorf(fy * p.y / p.z + cy);
  if (!(left >= -1.f && top >= -1.f && left < w && top < h)) return;
  const u64 packed = ((u64)__float_as_uint(p.z) << 32) | __float_as_uint(sure);
  const int u0 = (int)left, v0 = (int)top;
  for (int v = max(v0, 0); v < min(v0 + 2, h); v++)
    for (int u = max(u0, 0); u < min(u0 + 2, w); u++)
      atomicMin(seen + (long long)j * pixels + v * w + u, packed);
}

// The best of the transferred depths at a pixel, 0 being none, and its score: the weights of those
// near it less `penalty` times those more than `clearance` in front of it.
struct Agreed { float depth, score; };

__device__ __forceinline__ Agreed agree_on_depth(
    const u64* seen, int count, int pixels, float reach, float clearance, float penalty) {
  Agreed best = {0.f, 0.f};
  for (int j = 0; j < count; j++) {
    const u64 candidate = seen[(long long)j * pixels];
    if (candidate == NOTHING) continue;
    const float depth = __uint_as_float((u32)(candidate >> 32));
    float votes = 0.f;
    for (int k = 0; k < count; k++) {
      const u64 other = seen[(long long)k * pixels];
      if (other == NOTHING) continue;
      const float weight = __uint_as_float((u32)other);
      const float away = __uint_as_float((u32)(other >> 32)) / depth - 1.f, near = away / reach;
      votes += weight * __expf(-0.5f * near * near);
      if (away < -clearance) votes -= penalty * weight;
    }
    if (votes > best.score) best = {depth, votes};
  }
  return best;
}

// The last four are bias and weights of the logistic regression that judges a depth.
struct CheckSettings {
  float average_reach, agreement_reach, violation_distance;
  float repair_below, repair_votes, repair_confidence;
  float occlusion_penalty;
  float bias, own, support, violation;
};

// A depth repaired where it is unsure, averaged with those of the other views, and judged by them.
// transforms: from this view to the others. settings: CheckSettings.
extern "C" __global__ void check_depth(
    const float* depth, const float* confidence, const long long* maps, const float* transforms,
    const unsigned long long* seen, const float* settings, int others, int h, int w, float fx,
    float fy, float cx, float cy, float* new_depth, float* new_confidence) {
  const int pixel = blockIdx.x * blockDim.x + threadIdx.x, pixels = h * w;
  if (pixel >= pixels) return;
  const Lens lens = {fx, fy, cx, cy};
  const CheckSettings c = *(const CheckSettings*)settings;
  float z = depth[pixel], own = confidence[pixel];
  if (own < c.repair_below) {
    const Agreed agreed = agree_on_depth(seen + pixel, others, pixels, c.agreement_reach,
                                         c.violation_distance, c.occlusion_penalty);
    if (agreed.score > c.repair_votes) {
      z = agreed.depth;
      own = c.repair_confidence;
    }
  }
  const Point point = back_project(lens, pixel % w, pixel / w, z);
  float shift = 0.f, votes = 0.f, support = 0.f, violation = 0.f;
  for (int j = 0; j < others; j++) {
    const Seen s = look_up(lens, transform(transforms + 12 * j, point), depth_map(maps, j),
                           confidence_map(maps, j), h, w);
    const float error = s.ratio - 1.f;
    const float close = error / c.average_reach, agreeing = error / c.agreement_reach;
    const float near = s.sure * __expf(-0.5f * close * close);
    shift += near * error;
    votes += near;
    support += s.sure * __expf(-0.5f * agreeing * agreeing);
    violation += error < -c.violation_distance ? s.sure : 0.f;
  }
  own = fminf(fmaxf(own, 1e-3f), 1.f - 1e-3f);
  float score = c.bias + c.own * __logf(own / (1.f - own));
  score += c.support * __logf(support + 0.2f) + c.violation * violation;
  new_depth[pixel] = z / (1.f + shift / (votes + 0.5f));
  new_confidence[pixel] = 1.f / (1.f + __expf(-score));
}

// Which world points to keep: those that are finite and that fewer than `free_views` views, or no
// more than see them on their surface, see in free space; what is seen in the sky is. transforms:
// world to view. skies (n): addresses of where each view sees the sky (h, w), 0 where it does not.
// votes (n, 2): how many views of earlier launches see each point on their surface and in free
// space; added to.
extern "C" __global__ void vote_on_points(
    const float* points, const long long* maps, const long long* skies, const float* transforms,
    int count, int views, int h, int w, float fx, float fy, float cx, float cy, float vote_confidence, float vote_support,
    float vote_violation, int free_views, int2* votes, bool* keep) {
  const int i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i >= count) return;
  const Lens lens = {fx, fy, cx, cy};
  const Point point = {points[3 * i], points[3 * i + 1], points[3 * i + 2]};
  int surface = votes[i].x, open = votes[i].y;
  for (int j = 0; j < views; j++) {
    const Point there = transform(transforms + 12 * j, point);
    const bool* sky = (const bool*)skies[j];
    const int pixel = sky ? pixel_of(lens, there, h, w) : -1;
    if (pixel >= 0 && sky[pixel]) {
      open++;
      continue;
    }
    const Seen s = look_up(lens, there, depth_map(maps, j), confidence_map(maps, j), h, w);
    if (!(s.sure > vote_confidence)) continue;
    surface += fabsf(s.ratio - 1.f) < vote_support;
    open += s.ratio < 1.f - vote_violation;
  }
  votes[i] = {surface, open};
  const bool finite = isfinite(point.x) && isfinite(point.y) && isfinite(point.z);
  keep[i] = finite && (open < free_views || open <= surface);
}
