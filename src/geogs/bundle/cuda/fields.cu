// Fields on the sample grid: filling holes, carrying depth from view to view. One block per field.
#include "projection.cuh"

// Size of a level of the pyramid, of which each halves the one before, rounded up.
__device__ __forceinline__ int level_size(int size, int level) { return (size + (1 << level) - 1) >> level; }

// Start of the values of level >= 1 in the scratch memory; as many weights follow them.
__device__ __forceinline__ int level_start(int width, int height, int level) {
  int start = 0;
  for (int l = 1; l < level; l++) start += 2 * level_size(width, l) * level_size(height, l);
  return start;
}

// Bilinear value of the coarser level at a cell; aligned by the corners of the fields.
__device__ __forceinline__ float sample_coarse(
    const float* coarse, int width, int height, int fine_width, int fine_height, int x, int y) {
  float u = fmaxf((x + 0.5f) * ((float)width / fine_width) - 0.5f, 0.f);
  float v = fmaxf((y + 0.5f) * ((float)height / fine_height) - 0.5f, 0.f);
  int u0 = min((int)u, width - 1), v0 = min((int)v, height - 1);
  int u1 = min(u0 + 1, width - 1), v1 = min(v0 + 1, height - 1);
  float a = u - u0, b = v - v0;
  return (1.f - b) * ((1.f - a) * coarse[v0 * width + u0] + a * coarse[v0 * width + u1]) +
         b * ((1.f - a) * coarse[v1 * width + u0] + a * coarse[v1 * width + u1]);
}

// Values where confidence is positive, elsewhere confidence-weighted means over growing blocks.
__device__ void fill_holes(
    const float* value, const float* confidence, int width, int height, float* scratch, float* out) {
  int cells = width * height, known = 0;
  float total = 0.f;
  for (int p = threadIdx.x; p < cells; p += blockDim.x) {
    known |= confidence[p] > 0.f;
    total += value[p];
  }
  total = block_sum(total);
  if (!__syncthreads_or(known)) {
    for (int p = threadIdx.x; p < cells; p += blockDim.x) out[p] = total / cells;
    return;
  }
  int levels = 0, w = width, h = height;
  const float *v = value, *c = confidence;
  while (min(w, h) > 2) {
    levels++;
    int nw = level_size(width, levels), nh = level_size(height, levels);
    float* coarse = scratch + level_start(width, height, levels);
    for (int p = threadIdx.x; p < nw * nh; p += blockDim.x) {
      int x = 2 * (p % nw), y = 2 * (p / nw), count = 0;
      float sum = 0.f, weight = 0.f;
      for (int j = y; j < min(y + 2, h); j++)
        for (int i = x; i < min(x + 2, w); i++) {
          float k = fmaxf(c[j * w + i], 0.f);
          sum += k * v[j * w + i];
          weight += k;
          count++;
        }
      coarse[p] = sum / count / fmaxf(weight / count, 1e-30f);
      coarse[nw * nh + p] = weight / count;
    }
    __syncthreads();
    v = coarse;
    c = coarse + nw * nh;
    w = nw;
    h = nh;
  }
  float sum = 0.f, weight = 0.f;
  for (int p = threadIdx.x; p < w * h; p += blockDim.x) {
    float k = fmaxf(c[p], 0.f);
    sum += k * v[p];
    weight += k;
  }
  float mean = block_sum(sum) / block_sum(weight);
  __syncthreads();
  float* coarse = levels ? scratch + level_start(width, height, levels) : out;
  for (int p = threadIdx.x; p < w * h; p += blockDim.x)
    coarse[p] = levels || !(confidence[p] > 0.f) ? mean : value[p];
  __syncthreads();
  for (int l = levels - 1; l >= 0; l--) {
    int fw = level_size(width, l), fh = level_size(height, l), n = fw * fh;
    float* to = l ? scratch + level_start(width, height, l) : out;
    const float* from = l ? to : value;
    const float* known_here = l ? to + n : confidence;
    for (int p = threadIdx.x; p < n; p += blockDim.x)
      to[p] = known_here[p] > 0.f ? from[p] : sample_coarse(coarse, w, h, fw, fh, p % fw, p / fw);
    __syncthreads();
    coarse = to;
    w = fw;
    h = fh;
  }
}

extern "C" __global__ void __launch_bounds__(1024) fill_fields(
    const float* value, const float* confidence, int width, int height, int scratch_size,
    float* scratch, float* out) {
  size_t at = (size_t)blockIdx.x * width * height;
  fill_holes(value + at, confidence + at, width, height, scratch + (size_t)blockIdx.x * scratch_size, out + at);
}

// Nearest cell of a pixel position, -1 where there is none.
__device__ __forceinline__ int cell_of(float2 pixel, float offset, float stride, int width, int height) {
  // Written so that NaN falls outside.
  float u = rintf((pixel.x - offset) / stride), v = rintf((pixel.y - offset) / stride);
  bool inside = u >= 0.f && u < (float)width && v >= 0.f && v < (float)height;
  return inside ? (int)v * width + (int)u : -1;
}

// Inverse depth and information of source frames as seen from other views, the nearest surface in
// front; then, where asked for, the source's cells in the view and the view's in the source.
// T is 4 x 4 of the views, T_source of the sources; source gives the row of each job.
extern "C" __global__ void __launch_bounds__(1024) carry_depth(
    const double* T, const double* T_source, const int* source, const float* inverse_depth,
    const float* information, const float* rays, int width, int height, float offset, float stride,
    float fx, float fy, float cx, float cy, float k1, float k2, float p1, float p2, float k3,
    float k4, float k5, float k6, float fisheye, int scratch_size, float* scratch, float* carried,
    float* carried_information, float2* there, float2* back) {
  __shared__ Motion shared_motion[2];
  Camera camera = {fx, fy, cx, cy, LENS};
  int cells = width * height, job = blockIdx.x;
  size_t from = (size_t)source[job] * cells, to = (size_t)job * cells;
  if (threadIdx.x == 0) {
    double relative[12], inverse[12];
    relative_motion(T + 16 * job, T_source + 16 * source[job], relative);
    inverse_motion(relative, inverse);
    for (int k = 0; k < 12; k++) {
      shared_motion[0].m[k] = (float)relative[k];
      shared_motion[1].m[k] = (float)inverse[k];
    }
  }
  float* depth = scratch + (size_t)job * scratch_size;
  float *kept = depth + cells, *pyramid = depth + 2 * cells;
  for (int p = threadIdx.x; p < cells; p += blockDim.x) depth[p] = kept[p] = 0.f;
  __syncthreads();
  Motion motion = shared_motion[0], inverse = shared_motion[1];
  const float* d = inverse_depth + from;
  for (int pass = 0; pass < 2; pass++) {
    for (int p = threadIdx.x; p < cells; p += blockDim.x) {
      Projected at = project_cell(motion, rays, p, d[p]);
      if (pass == 0 && there) there[to + p] = pixel_of(camera, at);
      int cell = is_shown(camera, at) ? cell_of(pixel_of(camera, at), offset, stride, width, height) : -1;
      if (cell < 0) continue;
      float moved = d[p] / at.z;
      // Positive numbers are ordered as their bits.
      if (pass == 0) atomicMax((int*)&depth[cell], __float_as_int(moved));
      else if (moved >= 0.98f * depth[cell])
        atomicMax((int*)&kept[cell], __float_as_int(information[from + p] * at.z * at.z));
    }
    __syncthreads();
  }
  for (int p = threadIdx.x; p < cells; p += blockDim.x) {
    bool seen = depth[p] > 0.f;
    float k = kept[p];
    if (carried_information) carried_information[to + p] = seen ? k : 0.f;
    // A token confidence lets cells without information still be filled from, if weakly.
    kept[p] = seen ? k + 1e-6f : 0.f;
  }
  __syncthreads();
  fill_holes(depth, kept, width, height, pyramid, carried + to);
  if (!back) return;
  __syncthreads();
  for (int p = threadIdx.x; p < cells; p += blockDim.x)
    back[to + p] = pixel_of(camera, project_cell(inverse, rays, p, carried[to + p]));
}
