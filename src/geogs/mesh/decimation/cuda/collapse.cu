// Parallel edge collapse: what decimation_kernels.py does for a CPU, one thread per vertex or face.
// Corner 3 f + k is that of face f at its k-th vertex, and stands for the edge from there to the
// next vertex of the face. The corners at vertex v are corners[first[v]] to corners[first[v + 1]].
#include "common.cuh"

#define NONE (1ll << 62)
#define SCATTER 2654435769u
#define GATHER 340573321u
#define LEVEL 21
#define TOWARDS_MIDDLE 1e-3
#define FLATTEST 0.01
#define SHORT_FIRST 1e-4
#define LEAST_COSINE 0.2

struct Vec {
  double x, y, z;
};

__device__ __forceinline__ Vec at(const double* p, int v) {
  return Vec{p[3 * v], p[3 * v + 1], p[3 * v + 2]};
}

__device__ __forceinline__ Vec minus(Vec a, Vec b) { return Vec{a.x - b.x, a.y - b.y, a.z - b.z}; }

__device__ __forceinline__ double dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

__device__ __forceinline__ Vec normal(Vec a, Vec b, Vec c) {
  const Vec u = minus(b, a), v = minus(c, a);
  return Vec{u.y * v.z - u.z * v.y, u.z * v.x - u.x * v.z, u.x * v.y - u.y * v.x};
}

__device__ __forceinline__ int after(const int* faces, int corner) {
  return faces[corner % 3 == 2 ? corner - 2 : corner + 1];
}

__device__ __forceinline__ int before(const int* faces, int corner) {
  return faces[corner % 3 == 0 ? corner + 2 : corner - 1];
}

__device__ __forceinline__ void add_plane(const double* position, const int* face, double* q) {
  const Vec a = at(position, face[0]);
  Vec n = normal(a, at(position, face[1]), at(position, face[2]));
  const double length = sqrt(dot(n, n));
  if (!(length > 0)) return;
  const double area = 0.5 * length;
  n = Vec{n.x / length, n.y / length, n.z / length};
  const double d = -dot(n, a);
  q[0] += area * n.x * n.x;
  q[1] += area * n.x * n.y;
  q[2] += area * n.x * n.z;
  q[3] += area * n.x * d;
  q[4] += area * n.y * n.y;
  q[5] += area * n.y * n.z;
  q[6] += area * n.y * d;
  q[7] += area * n.z * n.z;
  q[8] += area * n.z * d;
  q[9] += area * d * d;
}

extern "C" __global__ void begin(int count, const double* __restrict__ position,
                                 const int* __restrict__ faces, const int* __restrict__ first,
                                 const int* __restrict__ corners, double* __restrict__ quadric,
                                 bool* __restrict__ fixed) {
  const int v = blockIdx.x * blockDim.x + threadIdx.x;
  if (v >= count) return;
  double q[10] = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0};
  bool is_fixed = false;
  for (int i = first[v]; i < first[v + 1]; ++i) {
    add_plane(position, faces + corners[i] / 3 * 3, q);
    const int next = after(faces, corners[i]), last = before(faces, corners[i]);
    int twins = 0;
    for (int j = first[v]; j < first[v + 1]; ++j) {
      const int other_next = after(faces, corners[j]), other_last = before(faces, corners[j]);
      twins += (other_last == next) + (other_next == last);
      is_fixed |= j != i && (other_next == next || other_last == last);
    }
    is_fixed |= twins != 2;
  }
  for (int n = 0; n < 10; ++n) quadric[10 * v + n] = q[n];
  fixed[v] = is_fixed;
}

// Where two vertices are merged; squared distances to the planes of both, summed up by area.
__device__ double merged(const double* position, const double* quadric, int a, int b, Vec* place,
                         double* area) {
  double q[10];
  for (int n = 0; n < 10; ++n) q[n] = quadric[10 * a + n] + quadric[10 * b + n];
  const double xx = q[0], xy = q[1], xz = q[2], x1 = q[3], yy = q[4], yz = q[5], y1 = q[6];
  const double zz = q[7], z1 = q[8], one = q[9];
  const Vec p = at(position, a), r = at(position, b);
  double x = 0.5 * (p.x + r.x), y = 0.5 * (p.y + r.y), z = 0.5 * (p.z + r.z);
  const double gx = xx * x + xy * y + xz * z + x1, gy = xy * x + yy * y + yz * z + y1;
  const double gz = xz * x + yz * y + zz * z + z1;
  const double damping = TOWARDS_MIDDLE * (xx + yy + zz);
  const double a0 = xx + damping, b0 = yy + damping, c0 = zz + damping;
  const double i00 = b0 * c0 - yz * yz, i01 = xz * yz - xy * c0, i02 = xy * yz - xz * b0;
  const double i11 = a0 * c0 - xz * xz, i12 = xy * xz - a0 * yz, i22 = a0 * b0 - xy * xy;
  const double det = a0 * i00 + xy * i01 + xz * i02;
  if (det > 0) {
    const double step = 1 / det;
    x -= (i00 * gx + i01 * gy + i02 * gz) * step;
    y -= (i01 * gx + i11 * gy + i12 * gz) * step;
    z -= (i02 * gx + i12 * gy + i22 * gz) * step;
  }
  *place = Vec{x, y, z};
  *area = xx + yy + zz;
  const double error = x * (xx * x + 2 * (xy * y + xz * z + x1)) +
                       y * (yy * y + 2 * (yz * z + y1)) + z * (zz * z + 2 * z1) + one;
  return error > 0 ? error : 0.0;
}

// Cost of the edge that a corner stands for; infinite where it stands for none or costs, by area,
// more than the square of a bound.
__device__ float edge_cost(const double* position, const int* faces, const double* quadric,
                           const bool* fixed, double bound, int corner) {
  const float none = __int_as_float(0x7f800000);
  const int a = faces[corner], b = after(faces, corner);
  if (a >= b || fixed[a] || fixed[b]) return none;
  Vec place;
  double area;
  const double error = merged(position, quadric, a, b, &place, &area);
  const Vec edge = minus(at(position, a), at(position, b));
  const double cost = error + SHORT_FIRST * area * dot(edge, edge);
  return cost <= bound * bound * area ? (float)cost : none;
}

extern "C" __global__ void edge_costs(int count, const double* __restrict__ position,
                                      const int* __restrict__ faces,
                                      const double* __restrict__ quadric,
                                      const bool* __restrict__ fixed,
                                      const double* __restrict__ bound,
                                      float* __restrict__ cost) {
  const int c = blockIdx.x * blockDim.x + threadIdx.x;
  if (c < count) cost[c] = edge_cost(position, faces, quadric, fixed, bound[0], c);
}

extern "C" __global__ void best_edges(int count, const int* __restrict__ first,
                                      const int* __restrict__ corners,
                                      const float* __restrict__ cost,
                                      const float* __restrict__ limit,
                                      long long* __restrict__ best) {
  const int v = blockIdx.x * blockDim.x + threadIdx.x;
  if (v >= count) return;
  long long found = NONE;
  for (int i = first[v]; i < first[v + 1]; ++i) {
    const int ends[2] = {corners[i], corners[i] % 3 == 0 ? corners[i] + 2 : corners[i] - 1};
    for (int n = 0; n < 2; ++n) {
      const int c = ends[n];
      if (!(cost[c] <= limit[0])) continue;
      const long long level = __float_as_int(cost[c]) >> LEVEL;
      found = min(found, (level << 32) | ((u32)c * SCATTER));
    }
  }
  best[v] = found;
}

// The corner of an edge of some rank.
__device__ __forceinline__ int ranked_corner(long long rank) { return (int)((u32)rank * GATHER); }

extern "C" __global__ void match_vertices(int count, const int* __restrict__ faces,
                                          const long long* __restrict__ best,
                                          long long* __restrict__ matched) {
  const int v = blockIdx.x * blockDim.x + threadIdx.x;
  if (v >= count) return;
  matched[v] = NONE;
  if (best[v] == NONE) return;
  const int c = ranked_corner(best[v]);
  if (best[faces[c]] == best[after(faces, c)]) matched[v] = best[v];
}

// Whether no vertex next to a matched one is matched by an edge that ranks lower.
__device__ bool is_first(const int* faces, const int* first, const int* corners,
                         const long long* matched, int v) {
  for (int i = first[v]; i < first[v + 1]; ++i)
    if (matched[after(faces, corners[i])] < matched[v] ||
        matched[before(faces, corners[i])] < matched[v])
      return false;
  return true;
}

// Whether no face at v without the other vertex turns over or becomes a needle if v moves.
__device__ bool keeps_sides(const int* faces, const int* first, const int* corners,
                            const double* position, int v, int other, Vec place) {
  for (int i = first[v]; i < first[v + 1]; ++i) {
    const int b = after(faces, corners[i]), c = before(faces, corners[i]);
    if (b == other || c == other) continue;
    const Vec pb = at(position, b), pc = at(position, c);
    const Vec old = normal(at(position, v), pb, pc), now = normal(place, pb, pc);
    const double turn = dot(old, now), size = dot(now, now);
    if (!(turn > 0 && turn * turn > LEAST_COSINE * LEAST_COSINE * dot(old, old) * size))
      return false;
    const Vec u = minus(pb, place), w = minus(pc, place), e = minus(u, w);
    const double edges = FLATTEST * (dot(u, u) + dot(w, w) + dot(e, e));
    if (size < edges * edges) return false;
  }
  return true;
}

// Neighbours that two vertices share.
__device__ int common(const int* faces, const int* first, const int* corners, int a, int b) {
  int count = 0;
  for (int i = first[a]; i < first[a + 1]; ++i)
    for (int j = first[b]; j < first[b + 1]; ++j)
      count += after(faces, corners[i]) == after(faces, corners[j]);
  return count;
}

// Those that are collapsed at once share no face, and none has an end next to another's: what one
// writes no other reads but to find that it comes later, as it does of what was there before, too.
extern "C" __global__ void collapse(int count, int* faces, const int* __restrict__ first,
                                    const int* __restrict__ corners,
                                    const long long* __restrict__ matched,
                                    const bool* __restrict__ fixed,
                                    const double* __restrict__ bound, double* position,
                                    double* quadric, float* cost, int* parent) {
  const int a = blockIdx.x * blockDim.x + threadIdx.x;
  if (a >= count || matched[a] == NONE) return;
  const int c = ranked_corner(matched[a]), b = after(faces, c);
  if (faces[c] != a || !is_first(faces, first, corners, matched, a) ||
      !is_first(faces, first, corners, matched, b))
    return;
  Vec place;
  double area;
  merged(position, quadric, a, b, &place, &area);
  if (common(faces, first, corners, a, b) != 2 ||
      !keeps_sides(faces, first, corners, position, a, b, place) ||
      !keeps_sides(faces, first, corners, position, b, a, place)) {
    cost[c] = __int_as_float(0x7f800000);
    return;
  }
  position[3 * a] = place.x;
  position[3 * a + 1] = place.y;
  position[3 * a + 2] = place.z;
  for (int n = 0; n < 10; ++n) quadric[10 * a + n] += quadric[10 * b + n];
  parent[b] = a;
  for (int i = first[b]; i < first[b + 1]; ++i) faces[corners[i]] = a;
  const int ends[2] = {a, b};
  for (int n = 0; n < 2; ++n)
    for (int i = first[ends[n]]; i < first[ends[n] + 1]; ++i) {
      const int leaving = corners[i], coming = leaving % 3 == 0 ? leaving + 2 : leaving - 1;
      cost[leaving] = edge_cost(position, faces, quadric, fixed, bound[0], leaving);
      cost[coming] = edge_cost(position, faces, quadric, fixed, bound[0], coming);
    }
}
