// Dense bundle adjustment: one Gauss-Newton step over poses and inverse depths.
// Edges are sorted by source; the edges of frame f are first[f] to first[f + 1].
#include "projection.cuh"

#define NORMAL_STRIDE 32  // of an edge: 21 of J^T W J, 6 of J^T W r

// Linearises an edge in the motion T_ji of its target relative to its source. One block per edge.
extern "C" __global__ void __launch_bounds__(256) linearise_edges(
    const double* T, const float* inverse_depth, const int* source, const int* target,
    const float2* pixels, const float2* weight, const float* rays, int cells, float fx, float fy,
    float cx, float cy, float k1, float k2, float p1, float p2, float k3, float k4, float k5,
    float k6, float fisheye, float huber, double* motion, double* normal, float* coupling,
    float* curvature, float* gradient) {
  __shared__ Motion T_ji;
  __shared__ double sums[32];
  size_t e = blockIdx.x;
  int i = source[e];
  if (threadIdx.x == 0) {
    double relative[12];
    relative_motion(T + 16 * target[e], T + 16 * i, relative);
    for (int k = 0; k < 12; k++) {
      motion[12 * e + k] = relative[k];
      T_ji.m[k] = (float)relative[k];
    }
  }
  __syncthreads();
  Motion pose = T_ji;
  Camera camera = {fx, fy, cx, cy, LENS};
  float v[32];
#pragma unroll
  for (int k = 0; k < 32; k++) v[k] = 0.f;
  for (int p = threadIdx.x; p < cells; p += blockDim.x) {
    LinearCell c = linearise_cell(camera, pose, rays, p, inverse_depth[(size_t)i * cells + p],
                                  pixels[e * cells + p], weight[e * cells + p], huber);
    add_normal_equations(c, v);
    float wx = c.wx * c.dx, wy = c.wy * c.dy;
    curvature[e * cells + p] = wx * c.dx + wy * c.dy;
    gradient[e * cells + p] = wx * c.rx + wy * c.ry;
#pragma unroll
    for (int k = 0; k < 6; k++)
      coupling[(6 * e + k) * cells + p] = wx * c.jx[k] + wy * c.jy[k];
  }
  block_sums(v, sums);
  if (threadIdx.x < 27) normal[NORMAL_STRIDE * e + threadIdx.x] = sums[threadIdx.x];
}

// Huber's cost of the matched cells of an edge, in variances; one behind its target is `behind`
// times `huber` off. One block per edge.
extern "C" __global__ void __launch_bounds__(256) find_edge_costs(
    const double* T, const float* inverse_depth, const int* source, const int* target,
    const float2* pixels, const float2* weight, const float* rays, int cells, float fx, float fy,
    float cx, float cy, float k1, float k2, float p1, float p2, float k3, float k4, float k5,
    float k6, float fisheye, float huber, float behind, double* cost) {
  __shared__ Motion T_ji;
  size_t e = blockIdx.x;
  int i = source[e];
  if (threadIdx.x == 0) {
    double relative[12];
    relative_motion(T + 16 * target[e], T + 16 * i, relative);
    for (int k = 0; k < 12; k++) T_ji.m[k] = (float)relative[k];
  }
  __syncthreads();
  Motion pose = T_ji;
  Camera camera = {fx, fy, cx, cy, LENS};
  float sum = 0.f;
  for (int p = threadIdx.x; p < cells; p += blockDim.x) {
    Projected seen = project_cell(pose, rays, p, inverse_depth[(size_t)i * cells + p]);
    float2 at = pixel_of(camera, seen), measured = pixels[e * cells + p], w = weight[e * cells + p];
    float rx = measured.x - at.x, ry = measured.y - at.y;
    float norm = is_shown(camera, seen) ? sqrtf(w.x * rx * rx + w.y * ry * ry) : behind * huber;
    if (w.x > 0.f) sum += norm <= huber ? norm * norm : huber * (2.f * norm - huber);
  }
  sum = block_sum(sum);
  if (threadIdx.x == 0) cost[e] = sum;
}

// Curvature and gradient of the inverse depths of a frame over all of its edges. One block each.
// added: further damping of every cell, or null. measured: inverse depths measured beside the
// matches with their information, both or null; robust by Huber's factor, as on the CPU.
extern "C" __global__ void __launch_bounds__(256) sum_sources(
    const int* first, const float* curvature, const float* gradient, int cells,
    float depth_damping, const float* added, const float* inverse_depth, const float* measured,
    const float* measured_information, float huber, float* information, float* inverse_curvature,
    float* depth_gradient) {
  size_t at = (size_t)blockIdx.x * cells;
  int begin = first[blockIdx.x], end = first[blockIdx.x + 1];
  float total = 0.f;
  for (int p = threadIdx.x; p < cells; p += blockDim.x) {
    float c = 0.f, g = 0.f;
    for (size_t e = begin; e < end; e++) {
      c += curvature[e * cells + p];
      g += gradient[e * cells + p];
    }
    total += c;
    if (measured) {
      float a = measured_information[at + p], r = measured[at + p] - inverse_depth[at + p];
      a *= huber / fmaxf(sqrtf(a) * fabsf(r), huber);
      c += a;
      g += a * r;
    }
    information[at + p] = c;
    depth_gradient[at + p] = g;
  }
  float damping = depth_damping * block_sum(total) / cells + 1e-8f;
  for (int p = threadIdx.x; p < cells; p += blockDim.x)
    inverse_curvature[at + p] =
        1.f / (information[at + p] + damping + (added ? added[at + p] : 0.f));
}

// out = sign a b, or sign a^T b, by 36 threads; all threads of the block call it.
__device__ __forceinline__ void multiply_blocks(
    const double* a, bool transposed, const double* b, double sign, double* out) {
  if (threadIdx.x < 36) {
    int r = threadIdx.x / 6, c = threadIdx.x % 6;
    double s = 0.0;
    for (int k = 0; k < 6; k++) s += (transposed ? a[6 * k + r] : a[6 * r + k]) * b[6 * k + c];
    out[threadIdx.x] = sign * s;
  }
  __syncthreads();
}

// Products E_a C^-1 E_b^T and, for the same edge, E_a C^-1 b over the cells of a source.
__device__ __forceinline__ void eliminate_cells(
    const float* coupling_a, const float* coupling_b, const float* inverse_curvature,
    const float* gradient, int cells, bool same, double* sums) {
  float v[36], w[32];
#pragma unroll
  for (int k = 0; k < 36; k++) v[k] = 0.f;
#pragma unroll
  for (int k = 0; k < 32; k++) w[k] = 0.f;
  for (int p = threadIdx.x; p < cells; p += blockDim.x) {
    float c = inverse_curvature[p], a[6], b[6];
#pragma unroll
    for (int k = 0; k < 6; k++) {
      a[k] = coupling_a[(size_t)k * cells + p] * c;
      b[k] = coupling_b[(size_t)k * cells + p];
    }
#pragma unroll
    for (int k = 0; k < 36; k++) v[k] += a[k / 6] * b[k % 6];
    if (same) {
      float g = gradient[p];
#pragma unroll
      for (int k = 0; k < 6; k++) w[4 + k] += a[k] * g;
    }
  }
#pragma unroll
  for (int k = 0; k < 4; k++) w[k] = v[32 + k];
  block_sums(v, sums);
  block_sums(w, sums + 32);
}

// Eliminates the inverse depths between two edges a <= b of one source and carries what is left to
// the poses by xi_rel = xi_target - Ad xi_source. One block per pair of edges. Per pair: blocks
// holds S at (target_a, target_b), -S Ad_b at (target_a, source), -Ad_a^T S at (source, target_b)
// and Ad_a^T S Ad_b at (source, source); vectors holds v at target_a and -Ad_a^T v at source.
extern "C" __global__ void __launch_bounds__(256) eliminate_depths(
    const int* pair_a, const int* pair_b, const int* source, const int* free_depth,
    const float* coupling, const float* inverse_curvature, const float* depth_gradient,
    const double* motion, const double* normal, int cells, double* blocks, double* vectors) {
  __shared__ double sums[64], parts[4][36], left[36], right[36], v[6];
  size_t a = pair_a[blockIdx.x], b = pair_b[blockIdx.x];
  int i = source[a], t = threadIdx.x;
  bool same = a == b;
  if (free_depth[i]) {
    size_t at = (size_t)i * cells;
    eliminate_cells(coupling + 6 * a * cells, coupling + 6 * b * cells, inverse_curvature + at,
                    depth_gradient + at, cells, same, sums);
  } else {
    if (t < 64) sums[t] = 0.0;
    __syncthreads();
  }
  if (t < 36) {
    int r = t / 6, c = t % 6;
    double direct = same ? normal[NORMAL_STRIDE * a + upper_entry(r, c)] : 0.0;
    parts[0][t] = direct - sums[t];
    left[t] = adjoint_entry(motion + 12 * a, r, c);
    right[t] = adjoint_entry(motion + 12 * b, r, c);
  }
  if (t < 6) v[t] = normal[NORMAL_STRIDE * a + 21 + t] - sums[36 + t];
  __syncthreads();
  multiply_blocks(parts[0], false, right, -1.0, parts[1]);
  multiply_blocks(left, true, parts[0], -1.0, parts[2]);
  multiply_blocks(left, true, parts[1], -1.0, parts[3]);
  for (int k = t; k < 144; k += blockDim.x) blocks[144 * (size_t)blockIdx.x + k] = parts[k / 36][k % 36];
  if (same && t < 6) {
    double s = 0.0;
    for (int k = 0; k < 6; k++) s -= left[6 * k + t] * v[k];
    vectors[12 * (size_t)blockIdx.x + t] = v[t];
    vectors[12 * (size_t)blockIdx.x + 6 + t] = s;
  }
}

// Sums up the lower triangle of the camera system, always in the same order, and damps it; below it
// the right-hand side is one more row. One block of 256 threads per place p (poses + 1) + q: the
// 6 x 6 block (p, q), or the right-hand side of pose p for q = poses. Parts first[n] to
// first[n + 1] of place n are vectors, or twice a block, plus one if transposed.
extern "C" __global__ void __launch_bounds__(256) assemble_system(
    const int* places, const int* first, const int* parts, const double* blocks,
    const double* vectors, int poses, float damping, double* system) {
  __shared__ double partial[7][36];
  int place = places[blockIdx.x], p = place / (poses + 1), q = place % (poses + 1);
  int group = threadIdx.x / 36, t = threadIdx.x % 36, end = first[blockIdx.x + 1];
  bool right_hand_side = q == poses;
  double sum = 0.0;
  if (group < 7 && (t < 6 || !right_hand_side))
    for (int n = first[blockIdx.x] + group; n < end; n += 7) {
      size_t part = parts[n];
      if (right_hand_side) sum += vectors[6 * part + t];
      else sum += blocks[36 * (part >> 1) + (part & 1 ? t % 6 * 6 + t / 6 : t)];
    }
  if (group < 7) partial[group][t] = sum;
  __syncthreads();
  if (group || (right_hand_side && t >= 6)) return;
  for (int n = 1; n < 7; n++) sum += partial[n][t];
  if (!right_hand_side && p == q && t % 7 == 0) sum += damping * fabs(sum) + 1e-2;
  size_t size = 6 * poses, row = right_hand_side ? size : 6 * p + t / 6;
  system[row * size + (right_hand_side ? 6 * p + t : 6 * q + t % 6)] = sum;
}

// Back-substitution (b - E^T xi_rel) / C; a step that is not finite sets `failed` for good.
// Blocks of cells along x, frames along y.
extern "C" __global__ void __launch_bounds__(256) find_depth_steps(
    const int* first, const int* target, const int* free_depth, const double* motion,
    const double* xi, const float* coupling, const float* inverse_curvature,
    const float* depth_gradient, int cells, float* delta, int* failed) {
  __shared__ float relative[32][6];
  int frame = blockIdx.y, p = blockIdx.x * blockDim.x + threadIdx.x;
  int begin = first[frame], end = first[frame + 1];
  if (threadIdx.x < 6 && !isfinite(xi[6 * frame + threadIdx.x])) *failed = 1;
  float moved = 0.f, step = 0.f;
  if (free_depth[frame] && begin < end) {
    for (int e = begin; e < end; e += 32) {
      int count = min(end - e, 32);
      __syncthreads();
      for (int k = threadIdx.x; k < 6 * count; k += blockDim.x) {
        int edge = e + k / 6;
        relative[k / 6][k % 6] = (float)relative_step(motion + 12 * (size_t)edge, xi + 6 * target[edge], xi + 6 * frame, k % 6);
      }
      __syncthreads();
      if (p < cells)
        for (int n = 0; n < count; n++)
          for (int k = 0; k < 6; k++)
            moved += coupling[(6 * (size_t)(e + n) + k) * cells + p] * relative[n][k];
    }
    size_t at = (size_t)frame * cells + p;
    if (p < cells) step = (depth_gradient[at] - moved) * inverse_curvature[at];
    if (!isfinite(step)) *failed = 1;
  }
  if (p < cells) delta[(size_t)frame * cells + p] = step;
}

// Takes the steps of free poses and inverse depths unless one failed. Layout as above.
extern "C" __global__ void __launch_bounds__(256) take_steps(
    const int* slot, const int* free_depth, const double* xi, const float* delta, int cells,
    float lowest, float highest, const int* failed, double* T, float* inverse_depth) {
  int frame = blockIdx.y, p = blockIdx.x * blockDim.x + threadIdx.x;
  if (*failed) return;
  if (p < cells && free_depth[frame]) {
    size_t at = (size_t)frame * cells + p;
    inverse_depth[at] = fminf(fmaxf(inverse_depth[at] + delta[at], lowest), highest);
  }
  if (p == 0 && slot[frame] >= 0) {
    double pose[12];
    for (int k = 0; k < 12; k++) pose[k] = T[16 * frame + k];
    move_pose(xi + 6 * frame, pose);
    for (int k = 0; k < 12; k++) T[16 * frame + k] = pose[k];
  }
}
