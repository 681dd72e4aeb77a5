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

// One thread block per volume block, one thread per voxel. planes (h, w, 4) holds inverse depth, its
// two slopes and the weight of each pixel, truncation (h, w) that along the axis in map units; T_cw
// (4, 4) is world to camera; far (1) the depth behind which nothing changes. distance and weight
// (blocks, 512) are averaged in place.
extern "C" __global__ void integrate(const long long* __restrict__ coordinates,
                                     float* __restrict__ distance, float* __restrict__ weight,
                                     const float4* __restrict__ planes,
                                     const float* __restrict__ truncation,
                                     const double* __restrict__ T_cw,
                                     const float* __restrict__ far, int width, int height,
                                     float fx, float fy, float cx, float cy, double voxel) {
  const int block = blockIdx.x, i = threadIdx.x;
  const double* T = T_cw;
  double corner[3], centre[3];
  for (int c = 0; c < 3; ++c) corner[c] = (double)(coordinates[3 * block + c] * SIDE);
  for (int r = 0; r < 3; ++r) {
    centre[r] = T[4 * r + 3];
    for (int c = 0; c < 3; ++c) centre[r] += T[4 * r + c] * voxel * (corner[c] + 0.5 * SIDE);
  }
  const float radius = (float)(voxel * SIDE * 0.8660254037844386);
  if (!in_view(centre, radius, far[0], fx, fy, cx, cy, width, height)) return;
  const double place[3] = {corner[0] + i / (SIDE * SIDE), corner[1] + i / SIDE % SIDE,
                           corner[2] + i % SIDE};
  float p[3];
  for (int r = 0; r < 3; ++r) {
    double x = T[4 * r + 3];
    for (int c = 0; c < 3; ++c) x += T[4 * r + c] * voxel * place[c];
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
