// Refinement: evidence of the tracker, photometric steps on slanted patches, local plane fits,
// confidence. Maps are (h, w); inverse depth with its slopes per render pixel.
#include "common.cuh"
#include "sampling.cuh"

#define PATCH 5
#define SAMPLES (PATCH * PATCH)
#define REACH (PATCH / 2)
#define MAX_NEIGHBOURS 16

// The tracker's grids (3, gh, gw) at the render size: inverse depth, prior weight, relative
// precision. columns (w) and rows (h) are the grid coordinates of the pixels.
extern "C" __global__ void upsample_grids(
    const float* grids, const float* columns, const float* rows, int gh, int gw, int h, int w,
    float* out) {
  const int x = blockIdx.x * blockDim.x + threadIdx.x, y = blockIdx.y;
  if (x >= w) return;
  const int k = blockIdx.z;
  out[(k * h + y) * w + x] = bilinear_repeated(grids + k * gh * gw, gw, gh, columns[x], rows[y]);
}

// Per pixel the sweep's inverse depth, or the prior's where it is sure and the sweep is not better;
// `sure` is a rough confidence plus 0.02.
extern "C" __global__ void choose_start(
    const float* prior, const float* prior_weight, const float* sweep, const float* cost,
    const float* margin, int pixels, float* rho, float* sure) {
  const int p = blockIdx.x * blockDim.x + threadIdx.x;
  if (p >= pixels) return;
  const float weight = prior_weight[p];
  float unique = fminf(fmaxf(0.5f * margin[p] - 0.25f, 0.f), 1.f);
  if (!(cost[p] < 0.8f)) unique = 0.f;
  const bool agree = fabsf(sweep[p] / prior[p] - 1.f) < 0.05f;
  const bool tracker = (agree && weight > 0.3f) || (weight > 0.5f && unique < 0.3f);
  rho[p] = tracker ? prior[p] : sweep[p];
  sure[p] = (tracker ? (agree ? fmaxf(weight, unique) : weight) : 0.7f * unique) + 0.02f;
}

// The fine reference image (centred about zero) around every render pixel: samples (25, h, w).
// columns (5, w) and rows (5, h): fine coordinates of the patch samples.
extern "C" __global__ void gather_patches(
    const float* fine, const float* columns, const float* rows, int fh, int fw, int h, int w,
    float* samples) {
  const int x = blockIdx.x * blockDim.x + threadIdx.x, y = blockIdx.y, s = blockIdx.z;
  if (x >= w) return;
  samples[(s * h + y) * w + x] =
      bilinear_repeated(fine, fw, fh, columns[s % PATCH * w + x], rows[s / PATCH * h + y]);
}

// Weighted moments of reference a, sample b and its derivative g by inverse depth.
struct Moments { float w, a, b, g, aa, bb, gg, ab, ag, bg; };

__device__ __forceinline__ void add_sample(Moments& m, float weight, float a, float b, float g) {
  const float wa = weight * a, wb = weight * b, wg = weight * g;
  m.w += weight;
  m.a += wa;
  m.b += wb;
  m.g += wg;
  m.aa += wa * a;
  m.bb += wb * b;
  m.gg += wg * g;
  m.ab += wa * b;
  m.ag += wa * g;
  m.bg += wb * g;
}

// NCC of one neighbour: its climb and Gauss-Newton curvature times its weight.
__device__ __forceinline__ float2 weigh_neighbour(const Moments& m, bool inside, float floor) {
  const float norm = 1.f / m.w;
  const float a = m.a * norm, b = m.b * norm, g = m.g * norm;
  const float va = fmaxf(m.aa * norm - a * a, 0.f) + floor;
  const float vb = fmaxf(m.bb * norm - b * b, 0.f) + floor;
  const float vg = fmaxf(m.gg * norm - g * g, 0.f);
  const float ab = m.ab * norm - a * b, ag = m.ag * norm - a * g, bg = m.bg * norm - b * g;
  const float scale = rsqrtf(va * vb), ncc = ab * scale, slant = bg / vb;
  const float good = fmaxf(ncc - 0.4f, 0.f), weight = inside ? good * good : 0.f;
  return make_float2(weight * (ag * scale - ncc * slant),
                     weight * fmaxf(vg / vb - slant * slant, 0.f));
}

// Climb and curvature of one neighbour at one pixel, from every so many-th sample of its patch.
__device__ __forceinline__ float2 match_patch(
    const float* samples, const float* image, const float* hom, int pixel, int pixels, int x,
    int y, float rho, float slope_x, float slope_y, float contrast, float floor, int fh, int fw,
    int every) {
  const float centre = samples[(SAMPLES / 2) * pixels + pixel];
  Moments m = {0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f};
  bool inside = true;
  for (int s = 0; s < SAMPLES; s += every) {
    const float ox = s % PATCH - REACH, oy = s / PATCH - REACH;
    const float r = rho + ox * slope_x + oy * slope_y, px = x + ox, py = y + oy;
    const ImagePoint q = project_into(
        hom[0] * px + hom[1] * py + hom[2] + r * hom[9],
        hom[3] * px + hom[4] * py + hom[5] + r * hom[10],
        hom[6] * px + hom[7] * py + hom[8] + r * hom[11], fw, fh);
    inside = inside && q.inside;
    const int column = (int)q.u, row = (int)q.v;
    const float fu = q.u - column, fv = q.v - row;
    const float* p = image + row * fw + column;
    const float across_top = p[1] - p[0], across_low = p[fw + 1] - p[fw];
    const float top = p[0] + fu * across_top, low = p[fw] + fu * across_low;
    const float across = across_top * (1.f - fv) + across_low * fv;
    const float g = across * (hom[9] - q.u * hom[11]) * q.inverse +
                    (low - top) * (hom[10] - q.v * hom[11]) * q.inverse;
    const float a = samples[s * pixels + pixel], difference = a - centre;
    add_sample(m, 1.f / (1.f + contrast * difference * difference), a, top + fv * (low - top), g);
  }
  return weigh_neighbour(m, inside, floor);
}

// One bounded Gauss-Newton step per pixel over all neighbours, then the mean of its optimum and the
// tracker's value by relative precision. Writes the mean, its precision, and how much the pixel
// counts in the plane fits. Block (32, neighbours); grid (columns / 32, rows).
extern "C" __global__ void photometric_step(
    const float* samples, const float* images, const float* homographies, const float* rho,
    const float* slope_x, const float* slope_y, const float* tracker, const float* tracker_weight,
    int h, int w, int fh, int fw, int every, float contrast, float floor, float step_limit,
    float photo_variance, float least_variance, float fit_variance, float* data, float* precision,
    float* sure) {
  __shared__ float2 sums[MAX_NEIGHBOURS][32];
  const int lane = threadIdx.x, j = threadIdx.y, y = blockIdx.y;
  const int x = min((int)(blockIdx.x * 32 + lane), w - 1), p = y * w + x;
  const float start = rho[p];
  sums[j][lane] = match_patch(samples, images + j * fh * fw, homographies + 12 * j, p, h * w, x, y,
                              start, slope_x[p], slope_y[p], contrast, floor, fh, fw, every);
  __syncthreads();
  if (j > 0 || blockIdx.x * 32 + lane >= w) return;
  float climb = 0.f, curvature = 0.f;
  for (int k = 0; k < blockDim.y; k++) {
    climb += sums[k][lane].x;
    curvature += sums[k][lane].y;
  }
  const float limit = step_limit * start;
  const float moved = start + fminf(fmaxf(climb / (curvature + 1e-6f), -limit), limit);
  const float variance = photo_variance / (curvature * moved * moved + 1e-6f);
  const float photo = 1.f / (variance + least_variance);
  const float away = tracker[p] / moved - 1.f, weight = tracker_weight[p];
  const float known = weight / (1.f + away * away * weight / 4.f);
  const float total = photo + known;
  data[p] = (photo * moved + known * tracker[p]) / total;
  precision[p] = total;
  sure[p] = 1.f / (1.f + 1.f / (total * fit_variance)) + 1e-3f;
}

// Weighted least-squares plane of inverse depth around each pixel (bilateral, robust): weights
// sure / (1 + contrast |dI|^2) / (1 + (d rho / (tolerance rho))^2) over the colours (3, h, w).
// Where `precision` is given, the plane is averaged with rho by precision; its own is
// plane_precision times the support over full_support, at most 1.
extern "C" __global__ void fit_planes(
    const float* rho, const float* slope_x, const float* slope_y, const float* sure,
    const float* colours, const float* precision, int h, int w, int radius, float contrast,
    float tolerance, float stiffness, float full_support, float plane_precision, float* new_rho,
    float* new_x, float* new_y, float* support) {
  const int x = blockIdx.x * blockDim.x + threadIdx.x, y = blockIdx.y * blockDim.y + threadIdx.y;
  if (x >= w || y >= h) return;
  const int p = y * w + x, pixels = h * w;
  const float own = rho[p], gx = slope_x[p], gy = slope_y[p];
  const float c0 = colours[p], c1 = colours[pixels + p], c2 = colours[2 * pixels + p];
  const float sharpness = 1.f / (tolerance * own);
  float s0 = 0.f, sx = 0.f, sy = 0.f, sxx = 0.f, sxy = 0.f, syy = 0.f, r0 = 0.f, rx = 0.f, ry = 0.f;
  for (int dy = max(-radius, -y); dy <= min(radius, h - 1 - y); dy++)
    for (int dx = max(-radius, -x); dx <= min(radius, w - 1 - x); dx++) {
      const int q = p + dy * w + dx;
      const float r = rho[q] - own - dx * gx - dy * gy, far = r * sharpness;
      const float d0 = colours[q] - c0, d1 = colours[pixels + q] - c1;
      const float d2 = colours[2 * pixels + q] - c2;
      const float like = 1.f + contrast * (d0 * d0 + d1 * d1 + d2 * d2);
      const float m = sure[q] / (like * (1.f + far * far));
      const float mx = m * dx, my = m * dy;
      s0 += m;
      sx += mx;
      sy += my;
      sxx += mx * dx;
      sxy += mx * dy;
      syy += my * dy;
      r0 += m * r;
      rx += mx * r;
      ry += my * r;
    }
  const float total = s0;
  s0 += 1e-9f;
  sxx += stiffness - sx * sx / s0;
  sxy -= sx * sy / s0;
  syy += stiffness - sy * sy / s0;
  rx -= sx * r0 / s0;
  ry -= sy * r0 / s0;
  const float determinant = sxx * syy - sxy * sxy + 1e-12f;
  const float ax = (rx * syy - ry * sxy) / determinant;
  const float ay = (ry * sxx - rx * sxy) / determinant;
  float fitted = own + (r0 - ax * sx - ay * sy) / s0;
  if (!(fitted > 0.2f * own)) fitted = own;
  if (precision) {
    const float plane = fminf(total / full_support, 1.f) * plane_precision;
    fitted = (precision[p] * own + plane * fitted) / (precision[p] + plane);
  }
  new_rho[p] = fitted;
  new_x[p] = gx + ax;
  new_y[p] = gy + ay;
  support[p] = total;
}

// Of a logistic regression, and the relative depth error that still counts as right.
struct ConfidenceWeights {
  float bias, margin, tracker_agrees, tracker_differs, jump, support, tolerance;
};

// rho held within [least, most], and the chance that the depth 1 / rho is right.
// weights: ConfidenceWeights.
extern "C" __global__ void judge_depth(
    const float* rho, const float* margin, const float* support, const float* tracker,
    const float* tracker_weight, const float* weights, int h, int w, float least, float most,
    float* held, float* confidence) {
  const int x = blockIdx.x * blockDim.x + threadIdx.x, y = blockIdx.y * blockDim.y + threadIdx.y;
  if (x >= w || y >= h) return;
  const int p = y * w + x;
  float near = fminf(fmaxf(rho[p], least), most), far = near;  // extreme inverse depths around
  const float z = 1.f / near;
  held[p] = near;
  for (int v = max(y - 1, 0); v <= min(y + 1, h - 1); v++)
    for (int u = max(x - 1, 0); u <= min(x + 1, w - 1); u++) {
      const float other = fminf(fmaxf(rho[v * w + u], least), most);
      near = fmaxf(near, other);
      far = fminf(far, other);
    }
  const ConfidenceWeights c = *(const ConfidenceWeights*)weights;
  const float jump = fminf(__logf(near / far) / c.tolerance, 5.f);
  const float known = fminf(tracker_weight[p] * c.tolerance * c.tolerance, 1.f);
  const float away = (tracker[p] * z - 1.f) / 0.03f, agrees = __expf(-0.5f * away * away);
  float score = c.bias + c.margin * fminf(fmaxf(margin[p], 0.f), 4.f);
  score += known * (c.tracker_agrees * agrees + c.tracker_differs * (1.f - agrees));
  score += c.jump * jump + c.support * __logf(support[p] + 0.1f);
  confidence[p] = 1.f / (1.f + __expf(-score));
}
