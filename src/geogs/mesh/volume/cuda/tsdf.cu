// One depth map into the voxels of a sparse volume.
#include "common.cuh"

#define SIDE 8
#define VOXELS 512

// Whether the sphere around a block meets the camera's view up to depth far. All in camera
// coordinates; slopes are those of the image's edges.
__device__ __forceinline__ bool in_view(const double c[3], float radius, float far, float fx,
                                        float fy, float cx, float cy, int width, int height) {
  const float x = (float)c[0], y = (float)c[1], z = (float)c[2];
  if (!(z > -radius && z < far + radius)) return false;
  const float left = (-0.5f - cx) / fx, right = (width - 0.5f - cx) / fx;
  const float top = (-0.5f - cy) / fy, bottom = (height - 0.5f - cy) / fy;
  return x - left * z > -radius * sqrtf(1.f + left * left) &&
         right * z - x > -radius * sqrtf(1.f + right * right) &&
         y - top * z > -radius * sqrtf(1.f + top * top) &&
         bottom * z - y > -radius * sqrtf(1.f + bottom * bottom);
}

// Where a place y of contracted space lies in the world, from the centre of the contraction: y itself
// within the radius. False where it lies at infinity or beyond.
__device__ __forceinline__ bool expand(double y[3], double radius) {
  const double away = sqrt(y[0] * y[0] + y[1] * y[1] + y[2] * y[2]) / radius;
  if (!(away < 2.0 - 1e-6)) return false;
  if (away > 1.0)
    for (int c = 0; c < 3; ++c) y[c] /= away * (2.0 - away);
  return true;
}

// One thread block per volume block, one thread per voxel. planes (h, w, 4) holds inverse depth, its
// two slopes and the weight of each pixel, truncation (h, w) that along the axis in map units; T_cw
// (4, 4) is world to camera; far (1) the depth behind which nothing changes; space is contracted
// around (ox, oy, oz) beyond the radius, which may be infinite. distance and weight (blocks, 512) are
// averaged in place.
extern "C" __global__ void integrate(const long long* __restrict__ coordinates,
                                     float* __restrict__ distance, float* __restrict__ weight,
                                     const float4* __restrict__ planes,
                                     const float* __restrict__ truncation,
                                     const double* __restrict__ T_cw,
                                     const float* __restrict__ far, int width, int height,
                                     float fx, float fy, float cx, float cy, double voxel,
                                     double ox, double oy, double oz, double radius) {
  const int block = blockIdx.x, i = threadIdx.x;
  const double* T = T_cw;
  const double origin[3] = {ox, oy, oz};
  const int step[3] = {i / (SIDE * SIDE), i / SIDE % SIDE, i % SIDE};
  double middle[3], place[3], centre[3];
  for (int c = 0; c < 3; ++c) {
    const double corner = (double)(coordinates[3 * block + c] * SIDE);
    middle[c] = voxel * (corner + 0.5 * SIDE) - origin[c];
    place[c] = voxel * (corner + step[c]) - origin[c];
  }
  const double reach = voxel * SIDE * 0.8660254037844386;
  const double outermost =
      (sqrt(middle[0] * middle[0] + middle[1] * middle[1] + middle[2] * middle[2]) + reach) / radius;
  if (outermost < 2.0 - 1e-6) {  // else its ball reaches to infinity
    expand(middle, radius);
    for (int r = 0; r < 3; ++r) {
      centre[r] = T[4 * r + 3];
      for (int c = 0; c < 3; ++c) centre[r] += T[4 * r + c] * (middle[c] + origin[c]);
    }
    const double least = 2.0 - fmax(outermost, 1.0);
    const float ball = (float)(reach / (least * least));
    if (!in_view(centre, ball, far[0], fx, fy, cx, cy, width, height)) return;
  }
  if (!expand(place, radius)) return;
  float p[3];
  for (int r = 0; r < 3; ++r) {
    double x = T[4 * r + 3];
    for (int c = 0; c < 3; ++c) x += T[4 * r + c] * (place[c] + origin[c]);
    p[r] = (float)x;
  }
  if (!(p[2] > 1e-6f)) return;
  const float u = fx * p[0] / p[2] + cx, v = fy * p[1] / p[2] + cy;
  const float column = rintf(u), row = rintf(v);
  if (!(column >= 0.f && row >= 0.f && column < width && row < height)) return;
  const int pixel = (int)row * width + (int)column;
  const float4 plane = planes[pixel];
  const float surface = plane.x + plane.y * (u - column) + plane.z * (v - row);
  const float ahead = (1.f / surface - p[2]) / truncation[pixel];
  if (!(ahead > -1.f)) return;
  const float gain = plane.w * fminf(2.f + 2.f * ahead, 1.f);
  if (!(gain > 0.f)) return;
  const int voxel_index = block * VOXELS + i;
  const float total = weight[voxel_index] + gain;
  distance[voxel_index] += (fminf(ahead, 1.f) - distance[voxel_index]) * (gain / total);
  weight[voxel_index] = total;
}
