// What no depth explains of matches whose poses are known.
#include "projection.cuh"

struct Seen {
  float x, y, q;    // where a cell lies on the plane z = 1, and 1 / z, z held at MIN_Z
  float rx, ry;     // what is missing to its match, in units of the focal lengths
  float wx, wy;     // inverse variances in those units
  float norm;       // residual in deviations
  bool valid;
};

__device__ __forceinline__ Seen see(
    const Camera& c, const Motion& T, const float* rays, int cell, float d, float2 pixel,
    float2 weight) {
  Projected p = project_cell(T, rays, cell, d);
  Seen s;
  s.x = p.x;
  s.y = p.y;
  s.q = p.q;
  s.valid = p.valid;
  s.rx = (pixel.x - c.cx) / c.fx - p.x;
  s.ry = (pixel.y - c.cy) / c.fy - p.y;
  s.wx = weight.x * c.fx * c.fx;
  s.wy = weight.y * c.fy * c.fy;
  s.norm = sqrtf(s.wx * s.rx * s.rx + s.wy * s.ry * s.ry);
  return s;
}

// Residuals of the matches in their deviations, each cell at the depth that suits it best: damped
// Gauss-Newton steps under Huber's loss from its inverse depth on, which is changed in place. The
// edges of source s are order[first[s]] to order[first[s + 1]]; T has the upper three rows of the
// motion along each. One block for each source; `scratch` has two floats for each of its cells.
extern "C" __global__ void __launch_bounds__(512) best_residuals(
    const int* first, const int* order, const float* T, const float* rays, const float2* pixels,
    const float2* weight, int cells, float fx, float fy, float cx, float cy, float huber,
    int iterations, float least, float largest, float behind, float* inverse_depth, float* scratch,
    float* residual) {
  Camera camera = {fx, fy, cx, cy};
  int begin = first[blockIdx.x], end = first[blockIdx.x + 1];
  if (begin == end) return;
  float* depth = inverse_depth + (size_t)blockIdx.x * cells;
  float* curvature = scratch + 2 * (size_t)blockIdx.x * cells;
  float* gradient = curvature + cells;
  for (int n = 0; n < iterations; n++) {
    float sum = 0.f;
    for (int p = threadIdx.x; p < cells; p += blockDim.x) {
      float d = depth[p], c = 0.f, g = 0.f;
      for (int k = begin; k < end; k++) {
        size_t e = order[k], at = e * cells + p;
        Motion motion;
        for (int m = 0; m < 12; m++) motion.m[m] = T[12 * e + m];
        Seen s = see(camera, motion, rays, p, d, pixels[at], weight[at]);
        float share = s.valid ? huber / fmaxf(s.norm, huber) : 0.f;
        float jx = (motion.m[3] - motion.m[11] * s.x) * s.q;
        float jy = (motion.m[7] - motion.m[11] * s.y) * s.q;
        float gx = s.wx * jx * share, gy = s.wy * jy * share;
        c += gx * jx + gy * jy;
        g += gx * s.rx + gy * s.ry;
      }
      curvature[p] = c;
      gradient[p] = g;
      sum += c;
    }
    float damping = 1e-3f * block_sum(sum) / cells + 1e-8f;
    for (int p = threadIdx.x; p < cells; p += blockDim.x)
      depth[p] = fminf(fmaxf(depth[p] + gradient[p] / (curvature[p] + damping), least), largest);
  }
  for (int p = threadIdx.x; p < cells; p += blockDim.x)
    for (int k = begin; k < end; k++) {
      size_t e = order[k], at = e * cells + p;
      Motion motion;
      for (int m = 0; m < 12; m++) motion.m[m] = T[12 * e + m];
      Seen s = see(camera, motion, rays, p, depth[p], pixels[at], weight[at]);
      residual[at] = s.valid || s.wx == 0.f ? s.norm : behind;
    }
}
