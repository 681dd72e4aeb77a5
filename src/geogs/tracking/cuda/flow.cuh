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

// Cells beyond the border after which flow changes no further.
#define REACH 2.f

// Which interval between cells a place lies in (-1 before the first cell, size - 1 beyond the last)
// and by what its bend is multiplied.
struct Interval {
  int i;
  float factor;
};
__device__ __forceinline__ Interval interval_at(float x, int size) {
  if (x < 0.f) return {-1, fmaxf(x, -REACH)};
  if (x > size - 1) return {size - 1, fminf(x - (size - 1), REACH)};
  int i = min((int)x, size - 2);
  float share = x - i;
  return {i, -0.5f * share * (1.f - share)};
}

__device__ __forceinline__ float2 minmod(float2 a, float2 b) {
  return make_float2(minmod(a.x, b.x), minmod(a.y, b.y));
}
__device__ __forceinline__ float2 difference(float2 a, float2 b) {
  return make_float2(b.x - a.x, b.y - a.y);
}

// Bend of an interval along a line of cells from (c, r) on by steps of (dc, dr): between cells the
// smaller one of the second differences at both ends, beyond the border that of the first
// differences there and one cell further in.
__device__ float2 limited_bend(const float2* start, int grid_width, int size, int i, int c, int r, int dc, int dr) {
  int first = clampi(i - 1, 0, size - 3), last = clampi(i, 0, size - 3);
  if (i < 0 || i >= size - 1) first = last = i < 0 ? 0 : size - 3;
  float2 f[4];
  for (int k = 0; k < 4; k++) {
    int at = min(first + k, size - 1);
    f[k] = cell_flow(start, grid_width, c + at * dc, r + at * dr);
  }
  float2 a = difference(f[0], f[1]), b = difference(f[1], f[2]);
  if (i < 0 || i >= size - 1) return minmod(a, b);
  float2 second = difference(a, b);
  return first == last ? second : minmod(second, difference(b, difference(f[2], f[3])));
}

// Start flow at any pixel, zero on a cold start: linear between the cells, and the bends along
// either axis, see start_flow.py. The grid has four cells or more across and down.
__device__ __forceinline__ float2 start_flow(const float2* start, int grid_width, int grid_height, float x, float y) {
  if (!start) return make_float2(0.f, 0.f);
  x = (x - GRID_OFFSET) / GRID_STRIDE;
  y = (y - GRID_OFFSET) / GRID_STRIDE;
  Linear u = linear_at(x, grid_width), v = linear_at(y, grid_height);
  Interval p = interval_at(x, grid_width), q = interval_at(y, grid_height);
  float2 a = cell_flow(start, grid_width, u.i, v.i), b = cell_flow(start, grid_width, u.next, v.i);
  float2 c = cell_flow(start, grid_width, u.i, v.next), d = cell_flow(start, grid_width, u.next, v.next);
  float2 top = limited_bend(start, grid_width, grid_width, p.i, 0, v.i, 1, 0);
  float2 bottom = limited_bend(start, grid_width, grid_width, p.i, 0, v.next, 1, 0);
  float2 left = limited_bend(start, grid_width, grid_height, q.i, u.i, 0, 0, 1);
  float2 right = limited_bend(start, grid_width, grid_height, q.i, u.next, 0, 0, 1);
  float top_x = a.x + u.share * (b.x - a.x), below_x = c.x + u.share * (d.x - c.x);
  float top_y = a.y + u.share * (b.y - a.y), below_y = c.y + u.share * (d.y - c.y);
  return make_float2(
      top_x + v.share * (below_x - top_x) + p.factor * (top.x + v.share * (bottom.x - top.x)) + q.factor * (left.x + u.share * (right.x - left.x)),
      top_y + v.share * (below_y - top_y) + p.factor * (top.y + v.share * (bottom.y - top.y)) + q.factor * (left.y + u.share * (right.y - left.y)));
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
