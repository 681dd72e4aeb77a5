// Poses of frames against fixed keyframes: all iterations of a frame in one block.
#include "projection.cuh"

// Solves the damped 6 x 6 normal equations by elimination; zero where the step is not finite.
__device__ void solve_step(const double* sums, double* xi) {
  double A[6][7];
  for (int r = 0; r < 6; r++) {
    for (int c = 0; c < 6; c++) A[r][c] = sums[upper_entry(r, c)];
    A[r][r] += 1e-4 * A[r][r] + 1e-6;
    A[r][6] = sums[21 + r];
  }
#pragma unroll
  for (int k = 0; k < 6; k++)
#pragma unroll
    for (int r = k + 1; r < 6; r++) {
      double f = A[r][k] / A[k][k];
#pragma unroll
      for (int c = k + 1; c < 7; c++) A[r][c] -= f * A[k][c];
    }
#pragma unroll
  for (int r = 5; r >= 0; r--) {
    double x = A[r][6];
#pragma unroll
    for (int c = r + 1; c < 6; c++) x -= A[r][c] * xi[c];
    xi[r] = x / A[r][r];
  }
  for (int k = 0; k < 6; k++)
    if (!isfinite(xi[k])) xi[k] = 0.0;
}

// Motion-only adjustment. Frame f is seen through the edges order[first[f]] to order[first[f + 1]];
// information, where given, is that of the edge's keyframe, whose cells without any do not count.
// T (4 x 4 per frame) is changed in place. One block per frame.
extern "C" __global__ void __launch_bounds__(512) solve_poses(
    const int* first, const int* order, const float* inverse_depth, const double* T_source,
    const float2* pixels, const float2* weight, const float* information, const float* rays,
    int cells, float fx, float fy, float cx, float cy, float k1, float k2, float p1, float p2,
    float k3, float k4, float k5, float k6, float fisheye, int iterations, float huber, double* T,
    float2* residual) {
  __shared__ double pose[12], sums[32];
  __shared__ Motion shared_motion;
  Camera camera = {fx, fy, cx, cy, LENS};
  int begin = first[blockIdx.x], end = first[blockIdx.x + 1];
  if (threadIdx.x < 12) pose[threadIdx.x] = T[16 * blockIdx.x + threadIdx.x];
  for (int n = 0; n <= iterations; n++) {
    float v[32];
#pragma unroll
    for (int k = 0; k < 32; k++) v[k] = 0.f;
    for (int k = begin; k < end; k++) {
      size_t e = order[k];
      __syncthreads();
      if (threadIdx.x == 0) {
        double relative[12];
        relative_motion(pose, T_source + 16 * e, relative);
        for (int m = 0; m < 12; m++) shared_motion.m[m] = (float)relative[m];
      }
      __syncthreads();
      Motion motion = shared_motion;
      for (int p = threadIdx.x; p < cells; p += blockDim.x) {
        size_t at = e * cells + p;
        float2 w = weight[at];
        if (information && !(information[at] > 0.f)) w = make_float2(0.f, 0.f);
        LinearCell c = linearise_cell(camera, motion, rays, p, inverse_depth[at], pixels[at], w, huber);
        if (n < iterations) add_normal_equations(c, v);
        else residual[at] = make_float2(c.rx, c.ry);
      }
    }
    if (n == iterations) break;
    block_sums(v, sums);
    if (threadIdx.x == 0) {
      double xi[6];
      solve_step(sums, xi);
      move_pose(xi, pose);
    }
    __syncthreads();
  }
  __syncthreads();
  if (threadIdx.x < 12) T[16 * blockIdx.x + threadIdx.x] = pose[threadIdx.x];
}

// What tells whether a frame was found: the share of the cells that are matched, the share whose
// residual is below `limit`, the medians over the matched of the residual, of the motion and of its
// parallax (from where the rotation alone takes a cell), the share of the cells that have
// information, and of those that are matched and have enough of it to know their depth to
// sqrt(known). Also the upper rows of the motion from the keyframe at T_source to the frame at T.
// One block.
extern "C" __global__ void __launch_bounds__(512) judge_match(
    const float2* pixels, const float2* weight, const float* information,
    const float* inverse_depth, const float2* residual, const float2* grid_pixels,
    const float* rays, int cells, float fx, float fy, float cx, float cy, float k1, float k2,
    float p1, float p2, float k3, float k4, float k5, float k6, float fisheye, float limit,
    float known, const double* T, const double* T_source, double* judgement, double* T_ji) {
  SHARED_MEMORY(u32, keys);
  __shared__ Motion motion;
  if (threadIdx.x == 0) {
    relative_motion(T, T_source, T_ji);
    for (int m = 0; m < 12; m++) motion.m[m] = (float)T_ji[m];
  }
  float used = 0.f, agree = 0.f, informed = 0.f, placed = 0.f;
  for (int p = threadIdx.x; p < cells; p += blockDim.x) {
    float d = inverse_depth[p], told = information[p];
    bool counts = weight[p].x > 0.f && told > 0.f;
    informed += told > 0.f;
    placed += weight[p].x > 0.f && known * d * d * told > 1.f;
    float error = sqrtf(residual[p].x * residual[p].x + residual[p].y * residual[p].y);
    used += counts;
    agree += counts && error < limit;
    keys[p] = counts ? median_key(error) : LEFT_OUT;
  }
  used = block_sum(used);
  agree = block_sum(agree);
  informed = block_sum(informed);
  placed = block_sum(placed);
  float median_error = block_median(keys, cells);
  __syncthreads();
  for (int p = threadIdx.x; p < cells; p += blockDim.x) {
    float x = pixels[p].x - grid_pixels[p].x, y = pixels[p].y - grid_pixels[p].y;
    if (keys[p] != LEFT_OUT) keys[p] = median_key(sqrtf(x * x + y * y));
  }
  float median_flow = block_median(keys, cells);
  __syncthreads();
  Camera camera = {fx, fy, cx, cy, LENS};
  for (int p = threadIdx.x; p < cells; p += blockDim.x) {
    if (keys[p] == LEFT_OUT) continue;
    float2 turned = pixel_of(camera, project_cell(motion, rays, p, 0.f));
    float x = pixels[p].x - turned.x, y = pixels[p].y - turned.y;
    keys[p] = median_key(sqrtf(x * x + y * y));
  }
  float median_parallax = block_median(keys, cells);
  if (threadIdx.x == 0) {
    judgement[0] = used / cells;
    judgement[1] = agree / cells;
    judgement[2] = median_error;
    judgement[3] = median_flow;
    judgement[4] = median_parallax;
    judgement[5] = informed / cells;
    judgement[6] = placed / cells;
  }
}
