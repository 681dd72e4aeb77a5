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

// Positions and weights (inverse variances) of all cells; a warp each. The deviation of a match is
// base + by_disagreement |forward + backward| + by_roughness (mean gradient of the rest).
extern "C" __global__ void flow_match(const long long* images, const float2* flow, const float2* forward, const float2* backward, float2* pixels, float2* weight, int pairs, int width, int height, int grid_width, int grid_height, int level, int certainty_offset, float most, float base, float by_disagreement, float by_roughness) {
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
  const float* certainty = source_image(images, d) + certainty_offset + 2 * index;
  weight[d * cells + index] = make_float2(certainty[0] * variance_inverse, certainty[1] * variance_inverse);
}
