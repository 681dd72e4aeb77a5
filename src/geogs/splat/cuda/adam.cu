// Adam on the ten parameters of every disk, and the row of the schedule that a step works on.
#include "common.cuh"

// One block. Copies row *completed of ``schedule`` (steps, width) to ``current`` and the base rates
// times that row's factor to ``rates``.
extern "C" __global__ void begin_step(int width, const int* schedule, const float* factors,
                                      const int* completed, const float* base_rates, int* current,
                                      float* rates) {
  const int row = *completed;
  for (int k = threadIdx.x; k < width; k += blockDim.x) current[k] = schedule[row * width + k];
  if (threadIdx.x < 4) rates[threadIdx.x] = base_rates[threadIdx.x] * factors[row];
}

struct AdamSettings {
  float beta1, beta2, eps, gradient_limit, least_log_scale, largest_log_scale;
};

template <int N>
__device__ __forceinline__ bool is_sane(const float* g, int i, float limit) {
  bool sane = true;
  for (int k = 0; k < N; k++) sane = sane && fabsf(g[N * i + k]) < limit;  // NaN is not
  return sane;
}

template <int N>
__device__ __forceinline__ void step_rows(float* p, const float* g, float* first, float* second,
                                          int i, float pace, float shrink, AdamSettings s) {
  for (int k = N * i; k < N * i + N; k++) {
    const float m = s.beta1 * first[k] + (1.f - s.beta1) * g[k];
    const float v = s.beta2 * second[k] + (1.f - s.beta2) * g[k] * g[k];
    first[k] = m;
    second[k] = v;
    p[k] -= pace * m / (sqrtf(v) * shrink + s.eps);
  }
}

// Grid: disks / 256. Steps the visible disks whose gradients are finite and below a limit, with the
// bias correction of their own step count; counts their visibility; bounds all scales.
// If ``status[1]`` says that the lists had no room, nothing is stepped or counted as completed.
extern "C" __global__ void __launch_bounds__(256) adam_step(
    int capacity, const int* count, const int* status, int* completed, float* position,
    float* quaternion, float* log_scale, float* opacity_logit, const float* d_position,
    const float* d_quaternion, const float* d_log_scale, const float* d_opacity_logit,
    float* first_position, float* first_quaternion, float* first_log_scale, float* first_opacity,
    float* second_position, float* second_quaternion, float* second_log_scale,
    float* second_opacity, long long* steps, long long* seen, const unsigned char* visible,
    const float* rates, float beta1, float beta2, float eps, float gradient_limit,
    float least_log_scale, float largest_log_scale) {
  const int i = blockIdx.x * blockDim.x + threadIdx.x;
  const bool failed = status[1] != 0;
  if (i == 0 && !failed) *completed += 1;
  if (failed || i >= min(*count, capacity)) return;
  const bool shown = visible[i] != 0;
  const AdamSettings s = {beta1, beta2, eps, gradient_limit, least_log_scale, largest_log_scale};
  if (shown) {
    seen[i] += 1;
    const bool sane = is_sane<3>(d_position, i, s.gradient_limit) &&
                      is_sane<4>(d_quaternion, i, s.gradient_limit) &&
                      is_sane<2>(d_log_scale, i, s.gradient_limit) &&
                      is_sane<1>(d_opacity_logit, i, s.gradient_limit);
    if (sane) {
      const long long t = steps[i] + 1;
      steps[i] = t;
      const double c1 = -expm1((double)t * log((double)beta1));
      const double c2 = -expm1((double)t * log((double)beta2));
      const float shrink = (float)(1 / sqrt(c2)), k = (float)(1 / c1);
      step_rows<3>(position, d_position, first_position, second_position, i, k * rates[0], shrink, s);
      step_rows<4>(quaternion, d_quaternion, first_quaternion, second_quaternion, i, k * rates[1],
                   shrink, s);
      step_rows<2>(log_scale, d_log_scale, first_log_scale, second_log_scale, i, k * rates[2],
                   shrink, s);
      step_rows<1>(opacity_logit, d_opacity_logit, first_opacity, second_opacity, i, k * rates[3],
                   shrink, s);
    }
  }
  for (int k = 2 * i; k < 2 * i + 2; k++)
    log_scale[k] = fminf(fmaxf(log_scale[k], s.least_log_scale), s.largest_log_scale);
}
