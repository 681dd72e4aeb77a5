// Matches of the grid's cells from the dense flows of both directions.
#include "flow.cuh"

#define FAR 1e3f  // stands for a position outside the image, pixels

// Dense flow of a level (in its pixels) on top of the start flow.
struct Composed {
  const float2 *rest, *start;
  int width, height, grid_width, grid_height;
  float scale;  // image pixels per pixel of the level
};

// Total flow at a point of the first image: what was left over, then the warp from there.
__device__ __forceinline__ float2 flow_at(const Composed& c, float x, float y) {
  float shift = 0.5f * (c.scale - 1.f);
  float2 f = sample(c.rest, c.width, c.height, (x - shift) / c.scale, (y - shift) / c.scale);
  f = make_float2(c.scale * f.x, c.scale * f.y);
  float2 s = start_flow(c.start, c.grid_width, c.grid_height, x + f.x, y + f.y);
  return make_float2(f.x + s.x, f.y + s.y);
}

// Mean norm of the gradient of the rest in a window of about 9 image pixels; one warp.
__device__ float roughness_at(const Composed& c, float x, float y) {
  float shift = 0.5f * (c.scale - 1.f);
  int radius = c.scale > 1.f ? 2 : 4, side = 2 * radius + 1;
  int u0 = (int)floorf((x - shift) / c.scale + 0.5f), v0 = (int)floorf((y - shift) / c.scale + 0.5f);
  float sum = 0.f;
  for (int k = threadIdx.x; k < side * side; k += 32) {
    int u = clampi(u0 + k % side - radius, 1, c.width - 2), v = clampi(v0 + k / side - radius, 1, c.height - 2);
    const float2 *row = c.rest + v * c.width + u, *above = row - c.width, *below = row + c.width;
    float ux = above[1].x - above[-1].x + 2.f * (row[1].x - row[-1].x) + below[1].x - below[-1].x;
    float vx = above[1].y - above[-1].y + 2.f * (row[1].y - row[-1].y) + below[1].y - below[-1].y;
    float uy = below[-1].x - above[-1].x + 2.f * (below[0].x - above[0].x) + below[1].x - above[1].x;
    float vy = below[-1].y - above[-1].y + 2.f * (below[0].y - above[0].y) + below[1].y - above[1].y;
    sum += sqrtf(ux * ux + vx * vx + uy * uy + vy * vy) / 8.f;
  }
  return warp_sum(sum) / (side * side);
}

// The second image, warped already, where the rest of the flow says that each pixel is.
extern "C" __global__ void flow_found(const float* warped, const float2* flow, float* found, int stride, int width, int height, int level) {
  Level size = pyramid_level(width, height, level);
  int x = blockIdx.x * blockDim.x + threadIdx.x, y = blockIdx.y * blockDim.y + threadIdx.y, d = blockIdx.z;
  if (x >= size.width || y >= size.height) return;
  long long at = (long long)d * size.width * size.height + y * size.width + x;
  const float* image = warped + (long long)d * stride + size.offset;
  found[at] = sample_cubic(image, size.width, size.height, x + flow[at].x, y + flow[at].y);
}

// What a match says along x and y, by the structure that two images have in common in a window of
// about 9 image pixels (common_tensor in cell_texture.py): each eigenvalue l becomes
// min(1, l / sharp + uninformed), and of either axis counts what is known while the other is open;
// one warp.
__device__ float2 certainty_at(const Composed& c, const float* source, const float* found, float x, float y, float sharp, float uninformed) {
  float shift = 0.5f * (c.scale - 1.f);
  int radius = c.scale > 1.f ? 2 : 4, side = 2 * radius + 1;
  int u0 = (int)floorf((x - shift) / c.scale + 0.5f), v0 = (int)floorf((y - shift) / c.scale + 0.5f);
  float xx = 0.f, yy = 0.f, xy = 0.f;
  for (int k = threadIdx.x; k < side * side; k += 32) {
    int u = mirrored(u0 + k % side - radius, c.width), v = mirrored(v0 + k / side - radius, c.height);
    float2 a = gradient_at(source, c.width, c.height, u, v), b = gradient_at(found, c.width, c.height, u, v);
    xx += a.x * b.x;
    yy += a.y * b.y;
    xy += 0.5f * (a.x * b.y + a.y * b.x);
  }
  float by = 1.f / (side * side * c.scale * c.scale);  // gradients of the level are by its own pixels
  xx = by * warp_sum(xx);
  yy = by * warp_sum(yy);
  xy = by * warp_sum(xy);
  float half = 0.5f * (xx - yy), mean = 0.5f * (xx + yy), radius_of = sqrtf(half * half + xy * xy);
  float across = clampf((mean + radius_of) / sharp, 0.f, 1.f - uninformed) + uninformed;
  float along = clampf((mean - radius_of) / sharp, 0.f, 1.f - uninformed) + uninformed;
  float in_x = 0.5f + 0.5f * half / fmaxf(radius_of, 1e-6f);  // squared cosine of the direction across
  return make_float2(across * along / (across + (along - across) * in_x),
                     across * along / (along + (across - along) * in_x));
}

// Positions and weights (inverse variances) of all cells; a warp each. The deviation of a match is
// base + by_disagreement |forward + backward| + by_roughness (mean gradient of the rest).
extern "C" __global__ void flow_match(const long long* images, const float2* flow, const float2* forward, const float2* backward, const float* found, float2* pixels, float2* weight, int pairs, int width, int height, int grid_width, int grid_height, int level, float sharp, float uninformed, float most, float base, float by_disagreement, float by_roughness) {
  int cells = grid_width * grid_height, d = blockIdx.y, reverse = d < pairs ? d + pairs : d - pairs;
  int index = blockIdx.x * blockDim.y + threadIdx.y;
  if (index >= cells) return;
  Level size = pyramid_level(width, height, level);
  long long area = size.width * size.height;
  float scale = 1 << level;
  Composed there = {flow + d * area, start_of(forward, backward, d, pairs, cells), size.width, size.height, grid_width, grid_height, scale};
  Composed back = {flow + reverse * area, start_of(forward, backward, reverse, pairs, cells), size.width, size.height, grid_width, grid_height, scale};

  float x = GRID_OFFSET + GRID_STRIDE * (index % grid_width), y = GRID_OFFSET + GRID_STRIDE * (index / grid_width);
  float roughness = roughness_at(there, x, y);
  float2 certainty = certainty_at(there, source_image(images, d) + size.offset, found + d * area, x, y, sharp, uninformed);
  if (threadIdx.x) return;
  float2 f = flow_at(there, x, y);
  float2 q = make_float2(x + f.x, y + f.y);
  float variance_inverse = 0.f;
  if (q.x > 1.f && q.y > 1.f && q.x < width - 2 && q.y < height - 2) {
    float2 b = flow_at(back, q.x, q.y);
    float disagreement = sqrtf((f.x + b.x) * (f.x + b.x) + (f.y + b.y) * (f.y + b.y));
    if (disagreement < most) {
      float deviation = base + by_disagreement * disagreement + by_roughness * roughness;
      variance_inverse = 1.f / (deviation * deviation);
    }
  }
  if (!isfinite(q.x) || !isfinite(q.y)) q = make_float2(FAR, FAR);
  pixels[d * cells + index] = q;
  // Without texture the flow stays where it started, smooth and consistent but uninformed.
  weight[d * cells + index] = make_float2(certainty.x * variance_inverse, certainty.y * variance_inverse);
}
