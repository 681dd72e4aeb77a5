// What the flow kernels share: the image pyramid, sampling, the start flow on the sample grid.
#include "common.cuh"

// Pixels of one pyramid level. Those of level l are means of 2^l x 2^l pixels of the image, whose
// border is repeated, so pixel x lies at 2^l x + (2^l - 1) / 2 of the image.
struct Level {
  int width, height;
  int offset;  // of its first pixel in the pyramid's buffer
};

__device__ __forceinline__ Level pyramid_level(int width, int height, int level) {
  Level l = {width, height, 0};
  for (int k = 0; k < level; k++) {
    l.offset += l.width * l.height;
    l.width = (l.width + 1) >> 1;
    l.height = (l.height + 1) >> 1;
  }
  return l;
}

__device__ __forceinline__ float clampf(float x, float low, float high) {
  return fminf(fmaxf(x, low), high);
}
__device__ __forceinline__ int clampi(int x, int low, int high) {
  return min(max(x, low), high);
}

// Cell and share of the way to the next for linear interpolation; the border is repeated.
struct Linear {
  int i, next;
  float share;
};
__device__ __forceinline__ Linear linear_at(float x, int size) {
  x = clampf(x, 0.f, (float)(size - 1));
  int i = min((int)x, max(size - 2, 0));
  return {i, min(i + 1, size - 1), x - i};
}

__device__ __forceinline__ float sample(const float* image, int width, int height, float x, float y) {
  Linear u = linear_at(x, width), v = linear_at(y, height);
  const float *top = image + v.i * width, *below = image + v.next * width;
  float a = top[u.i] + u.share * (top[u.next] - top[u.i]);
  float b = below[u.i] + u.share * (below[u.next] - below[u.i]);
  return a + v.share * (b - a);
}

__device__ __forceinline__ float2 sample(const float2* field, int width, int height, float x, float y) {
  Linear u = linear_at(x, width), v = linear_at(y, height);
  float2 a = field[v.i * width + u.i], b = field[v.i * width + u.next];
  float2 c = field[v.next * width + u.i], d = field[v.next * width + u.next];
  float top_x = a.x + u.share * (b.x - a.x), below_x = c.x + u.share * (d.x - c.x);
  float top_y = a.y + u.share * (b.y - a.y), below_y = c.y + u.share * (d.y - c.y);
  return make_float2(top_x + v.share * (below_x - top_x), top_y + v.share * (below_y - top_y));
}

// Weights of the four pixels around a position for cubic convolution (Keys 1981, a = -1/2).
__device__ __forceinline__ void cubic_weights(float t, float* w) {
  w[0] = ((-0.5f * t + 1.f) * t - 0.5f) * t;
  w[1] = (1.5f * t - 2.5f) * t * t + 1.f;
  w[2] = ((-1.5f * t + 2.f) * t + 0.5f) * t;
  w[3] = (0.5f * t - 0.5f) * t * t;
}

__device__ __forceinline__ float sample_cubic(const float* image, int width, int height, float x, float y) {
  x = clampf(x, 0.f, (float)(width - 1));
  y = clampf(y, 0.f, (float)(height - 1));
  int i = (int)x, j = (int)y;
  float wx[4], wy[4], sum = 0.f;
  cubic_weights(x - i, wx);
  cubic_weights(y - j, wy);
  for (int r = 0; r < 4; r++) {
    const float* row = image + clampi(j + r - 1, 0, height - 1) * width;
    float value = 0.f;
    for (int c = 0; c < 4; c++) value += wx[c] * row[clampi(i + c - 1, 0, width - 1)];
    sum += wy[r] * value;
  }
  return sum;
}

__device__ __forceinline__ int mirrored(int i, int size) {
  return i < 0 ? -i : (i >= size ? 2 * size - 2 - i : i);
}

// Gradient at a pixel by Sobel's operator, mirrored at the border; grey levels / pixel.
__device__ __forceinline__ float2 gradient_at(const float* image, int width, int height, int u, int v) {
  int l = mirrored(u - 1, width), r = mirrored(u + 1, width);
  const float *above = image + mirrored(v - 1, height) * width, *row = image + v * width;
  const float* below = image + mirrored(v + 1, height) * width;
  return make_float2((above[r] - above[l] + 2.f * (row[r] - row[l]) + below[r] - below[l]) / 8.f,
                     (below[l] - above[l] + 2.f * (below[u] - above[u]) + below[r] - above[r]) / 8.f);
}

// Position of the sample grid's first cell and its spacing, in pixels.
#define GRID_OFFSET 4
#define GRID_STRIDE 8

// Where the start flow is capped, in pixels: positions behind the camera may be anywhere.
#define FARTHEST 1e4f

// Start flow of one cell: the estimated position in the other image minus the cell's own.
__device__ __forceinline__ float2 cell_flow(const float2* start, int grid_width, int c, int r) {
  float2 q = start[r * grid_width + c];
  return make_float2(clampf(q.x - (GRID_OFFSET + GRID_STRIDE * c), -FARTHEST, FARTHEST),
                     clampf(q.y - (GRID_OFFSET + GRID_STRIDE * r), -FARTHEST, FARTHEST));
}

// The smaller one of two numbers of the same sign, else nothing.
__device__ __forceinline__ float minmod(float a, float b) {
  return a * b > 0.f ? (fabsf(a) < fabsf(b) ? a : b) : 0.f;
}

// Second difference between the two inner ones of four cells in a row, the smaller one of either
// end; `first` and `last` say whether the outer ones exist.
__device__ __forceinline__ float2 limited_bend(float2 before, float2 a, float2 b, float2 after, bool first, bool last) {
  float2 at_a = make_float2(before.x - 2.f * a.x + b.x, before.y - 2.f * a.y + b.y);
  float2 at_b = make_float2(a.x - 2.f * b.x + after.x, a.y - 2.f * b.y + after.y);
  if (!first) at_a = at_b;
  if (!last) at_b = at_a;
  return make_float2(minmod(at_a.x, at_b.x), minmod(at_a.y, at_b.y));
}

// Start flow at any pixel, zero on a cold start: linear between the cells, less what a quadratic
// with the second differences around bends, see StartFlow in classical_flow.py. The grid has four
// cells or more across and down.
__device__ __forceinline__ float2 start_flow(const float2* start, int grid_width, int grid_height, float x, float y) {
  if (!start) return make_float2(0.f, 0.f);
  Linear u = linear_at((x - GRID_OFFSET) / GRID_STRIDE, grid_width);
  Linear v = linear_at((y - GRID_OFFSET) / GRID_STRIDE, grid_height);
  int left = max(u.i - 1, 0), right = min(u.next + 1, grid_width - 1);
  int above = max(v.i - 1, 0), below = min(v.next + 1, grid_height - 1);
  bool has_left = u.i > 0, has_right = u.next + 1 < grid_width;
  bool has_above = v.i > 0, has_below = v.next + 1 < grid_height;
  float2 a = cell_flow(start, grid_width, u.i, v.i), b = cell_flow(start, grid_width, u.next, v.i);
  float2 c = cell_flow(start, grid_width, u.i, v.next), d = cell_flow(start, grid_width, u.next, v.next);
  float2 top = limited_bend(cell_flow(start, grid_width, left, v.i), a, b, cell_flow(start, grid_width, right, v.i), has_left, has_right);
  float2 bottom = limited_bend(cell_flow(start, grid_width, left, v.next), c, d, cell_flow(start, grid_width, right, v.next), has_left, has_right);
  float2 left_side = limited_bend(cell_flow(start, grid_width, u.i, above), a, c, cell_flow(start, grid_width, u.i, below), has_above, has_below);
  float2 right_side = limited_bend(cell_flow(start, grid_width, u.next, above), b, d, cell_flow(start, grid_width, u.next, below), has_above, has_below);
  float bend_u = 0.5f * u.share * (1.f - u.share), bend_v = 0.5f * v.share * (1.f - v.share);
  float top_x = a.x + u.share * (b.x - a.x), below_x = c.x + u.share * (d.x - c.x);
  float top_y = a.y + u.share * (b.y - a.y), below_y = c.y + u.share * (d.y - c.y);
  return make_float2(
      top_x + v.share * (below_x - top_x) - bend_u * (top.x + v.share * (bottom.x - top.x)) - bend_v * (left_side.x + u.share * (right_side.x - left_side.x)),
      top_y + v.share * (below_y - top_y) - bend_u * (top.y + v.share * (bottom.y - top.y)) - bend_v * (left_side.y + u.share * (right_side.y - left_side.y)));
}

// Directed pair d < pairs goes from image d to image d + pairs, d >= pairs the other way.
__device__ __forceinline__ const float* source_image(const long long* images, int d) {
  return (const float*)images[d];
}
__device__ __forceinline__ const float* target_image(const long long* images, int d, int pairs) {
  return (const float*)images[d < pairs ? d + pairs : d - pairs];
}
__device__ __forceinline__ const float2* start_of(const float2* forward, const float2* backward, int d, int pairs, int cells) {
  if (!forward) return 0;
  return d < pairs ? forward + d * cells : backward + (d - pairs) * cells;
}
