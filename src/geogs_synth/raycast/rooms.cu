// Views of random rooms, and where their points are in other views.
#include "shading.cuh"

#define CAMERA_FLOATS 24
#define ROUNDS 8

// A view: camera to world by rows (rotation, centre), fx fy cx cy, what it does from its first row
// to the last (rotation vector, way), and the share of that from row to row.
__device__ __forceinline__ float share_of_row(const float* c, float y) { return clampf(y * c[22] - 0.5f, -1.f, 1.f); }
__device__ __forceinline__ V3 cross(V3 a, V3 b) { return v3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x); }
__device__ __forceinline__ V3 to_world(const float* c, V3 d) {
  return v3(c[0] * d.x + c[1] * d.y + c[2] * d.z, c[4] * d.x + c[5] * d.y + c[6] * d.z, c[8] * d.x + c[9] * d.y + c[10] * d.z);
}
__device__ __forceinline__ V3 from_world(const float* c, V3 d) {
  return v3(c[0] * d.x + c[4] * d.y + c[8] * d.z, c[1] * d.x + c[5] * d.y + c[9] * d.z, c[2] * d.x + c[6] * d.y + c[10] * d.z);
}
// Turns by a share of what the camera turns by while its rows are read.
__device__ __forceinline__ V3 turned_by_row(const float* c, float share, V3 d) {
  V3 w = share * load3(c + 16);
  float angle = norm(w);
  if (angle < 1e-9f) return d;
  V3 axis = (1.f / angle) * w, once = cross(axis, d);
  return d + sinf(angle) * once + (1.f - cosf(angle)) * cross(axis, once);
}
__device__ __forceinline__ V3 world_ray(const float* c, float x, float y) {
  V3 d = v3((x - c[14]) / c[12], (y - c[15]) / c[13], 1.f);
  return to_world(c, turned_by_row(c, share_of_row(c, y), d));
}
__device__ __forceinline__ V3 centre_of(const float* c) { return v3(c[3], c[7], c[11]); }
__device__ __forceinline__ V3 centre_at(const float* c, float y) { return centre_of(c) + share_of_row(c, y) * to_world(c, load3(c + 19)); }

// Through the samples of a pixel: no two in a row or column.
__device__ __forceinline__ float sample_row(int y, int k) { return y + (0.25f * k - 0.375f); }
__device__ __forceinline__ V3 sample_ray(const float* c, int x, int y, int k) {
  return world_ray(c, x + (k == 0 ? -0.125f : k == 1 ? 0.375f : k == 2 ? -0.375f : 0.125f), sample_row(y, k));
}

// The solids that pixels left..right, top..bottom may see; all threads of the block.
__device__ void select_visible(const Stock& stock, u32* mask, const float* camera, int count, float left, float top, float right, float bottom, int thread) {
  V3 axis = unit(world_ray(camera, 0.5f * (left + right), 0.5f * (top + bottom)));
  float cosine = fminf(fminf(dot(axis, unit(world_ray(camera, left, top))), dot(axis, unit(world_ray(camera, right, top)))), fminf(dot(axis, unit(world_ray(camera, left, bottom))), dot(axis, unit(world_ray(camera, right, bottom)))));
  float opening = acosf(fminf(cosine, 1.f));
  if (thread < MOST_SOLIDS / 32) mask[thread] = 0;
  __syncthreads();
  if (thread < count && stock.present[thread >> 5] >> (thread & 31) & 1) {
    const Solid& s = stock.solid[thread];
    V3 offset = load3(s.centre) - centre_at(camera, 0.5f * (top + bottom));
    float distance = norm(offset), radius = s.radius + 1e-3f + (bottom - top) * camera[22] * norm(load3(camera + 19));
    bool seen = distance <= radius;
    if (!seen) seen = acosf(clampf(dot(offset, axis) / distance, -1.f, 1.f)) <= opening + asinf(radius / distance) + 2e-3f;
    if (seen) atomicOr(&mask[thread >> 5], 1u << (thread & 31));
  }
  __syncthreads();
}

// Finds what can shade the points in the ball; all threads of the block.
__device__ void find_nearby(const Room& room, const Stock& stock, const Ball& ball, Nearby& nearby, int thread) {
  V3 middle = middle_of(ball);
  float radius = radius_of(ball);
  for (int k = 0; k < room.light_count; k++) {
    const float* lamp = room.lights + k * LIGHT_FLOATS;
    mark_between(stock, nearby.before_light[k], load3(lamp), middle, fmaxf(radius, 1.74f * lamp[6]), thread);
  }
  mark_between(stock, nearby.around, middle, middle, radius + 2.f * FURTHEST_CREASE, thread);
  __syncthreads();
}

// Linear colour as the mean of four samples, depth and normal by the ray through the centre; a
// thread per pixel, MOST_SOLIDS threads per block, a view per blockIdx.z.
extern "C" __global__ void __launch_bounds__(128) render_rooms(const float* sizes, const float* solids, const float* surfaces, const float* lights, const float* cameras, const unsigned* texels, float* colour, float* depth, float* normal, int* solid, int views, int count, int light_count, int texture_size, int texture_levels, long long texture_stride, int width, int height) {
  __shared__ Stock stock;
  __shared__ u32 mask[MOST_SOLIDS / 32];
  __shared__ Nearby nearby;
  __shared__ Ball ball;
  int view = blockIdx.z, room_index = view / views, thread = threadIdx.y * blockDim.x + threadIdx.x, threads = blockDim.x * blockDim.y;
  const float *camera = cameras + view * CAMERA_FLOATS, *light = lights + view * (8 + LIGHT_FLOATS * light_count);
  for (int k = thread; k < (int)(sizeof(Nearby) / sizeof(u32)); k += threads) ((u32*)&nearby)[k] = 0;
  load_stock(stock, solids + room_index * count * SOLID_FLOATS, count, thread, threads);
  int left = blockIdx.x * blockDim.x, top = blockIdx.y * blockDim.y, x = left + threadIdx.x, y = top + threadIdx.y;
  select_visible(stock, mask, camera, count, left - 0.5f, top - 0.5f, left + blockDim.x - 0.5f, top + blockDim.y - 0.5f, thread);

  Room room = {load3(sizes + room_index * 3), surfaces + (long long)room_index * (6 + 2 * count) * SURFACE_FLOATS, light, light + 8, light_count, {texels, texture_size, texture_levels, texture_stride}};
  V3 origin = centre_at(camera, y), direction = world_ray(camera, x, y);
  Hit hit = closest_hit(stock, mask, room.size, origin, direction), seen[4];
  V3 position = origin + hit.t * direction;
  begin_ball(ball, position, thread == threads / 2 + (int)blockDim.x / 2);
  float furthest = norm(position - middle_of(ball));
#pragma unroll
  for (int k = 0; k < 4; k++) {
    V3 ray = sample_ray(camera, x, y, k), from = centre_at(camera, sample_row(y, k));
    seen[k] = closest_hit(stock, mask, room.size, from, ray);
    furthest = fmaxf(furthest, norm(from + seen[k].t * ray - middle_of(ball)));
  }
  end_ball(ball, furthest, thread);
  find_nearby(room, stock, ball, nearby, thread);
  if (x >= width || y >= height) return;

  Point middle = point_at(stock, room.size, hit, origin, direction);
  float access = ambient_access(stock, nearby.around, room.size, middle);
  float focal = sqrtf(camera[12] * camera[13]);
  V3 sum = v3(0.f, 0.f, 0.f);
#pragma unroll
  for (int k = 0; k < 4; k++) {
    V3 ray = sample_ray(camera, x, y, k);
    Point point = point_at(stock, room.size, seen[k], centre_at(camera, sample_row(y, k)), ray);
    sum = sum + shade(room, stock, nearby, point, k, ray, 0.5f * seen[k].t * norm(ray) / focal, access);
  }
  long long area = (long long)width * height, pixel = (long long)y * width + x;
  depth[view * area + pixel] = hit.t;
  solid[view * area + pixel] = hit.solid;
  float* out = colour + view * 3 * area + pixel;
  out[0] = 0.25f * sum.x;
  out[area] = 0.25f * sum.y;
  out[2 * area] = 0.25f * sum.z;
  V3 n = from_world(camera, middle.normal);
  float* facing = normal + view * 3 * area + pixel;
  facing[0] = n.x;
  facing[area] = n.y;
  facing[2 * area] = n.z;
}

// The first thing that each ray meets; a thread per ray, a room per blockIdx.y.
extern "C" __global__ void first_hits(const float* sizes, const float* solids, const float* origins, const float* directions, float* t, int* solid, int rays, int count) {
  __shared__ Stock stock;
  int room = blockIdx.y, index = blockIdx.x * blockDim.x + threadIdx.x;
  load_stock(stock, solids + room * count * SOLID_FLOATS, count, threadIdx.x, blockDim.x);
  if (index >= rays) return;
  long long ray = (long long)room * rays + index;
  Hit hit = closest_hit(stock, stock.present, load3(sizes + 3 * room), load3(origins + 3 * ray), load3(directions + 3 * ray));
  t[ray] = hit.t;
  solid[ray] = hit.solid;
}

// Where points of the world are in views, and whether nothing hides them there.
// A thread per point, MOST_SOLIDS threads per block, a room per blockIdx.z.
extern "C" __global__ void __launch_bounds__(128) flow_rooms(const float* solids, const float* cameras, const float* points, float2* pixels, bool* visible, bool* valid, int count, int width, int height, float margin) {
  __shared__ Stock stock;
  __shared__ u32 between[MOST_SOLIDS / 32];
  __shared__ Ball ball;
  int room = blockIdx.z, x = blockIdx.x * blockDim.x + threadIdx.x, y = blockIdx.y * blockDim.y + threadIdx.y;
  int thread = threadIdx.y * blockDim.x + threadIdx.x, threads = blockDim.x * blockDim.y;
  if (thread < MOST_SOLIDS / 32) between[thread] = 0;
  load_stock(stock, solids + room * count * SOLID_FLOATS, count, thread, threads);
  const float* c = cameras + room * CAMERA_FLOATS;
  long long pixel = ((long long)room * height + min(y, height - 1)) * width + min(x, width - 1);
  V3 way = load3(c + 19), point = load3(points + 3 * pixel);
  begin_ball(ball, point, thread == threads / 2 + (int)blockDim.x / 2);
  end_ball(ball, norm(point - middle_of(ball)), thread);
  mark_between(stock, between, centre_of(c), middle_of(ball), radius_of(ball) + norm(way), thread);
  __syncthreads();
  if (x >= width || y >= height) return;

  V3 middle = from_world(c, point - centre_of(c));
  float share = 0.f, u = 0.f, v = 0.f;
  bool before = false;
  // The camera is that of the row that sees the point.
  for (int round = 0; round <= ROUNDS; round++) {
    V3 p = turned_by_row(c, -share, middle - share * way);
    before = p.z > 0.01f;
    float z = fmaxf(p.z, 0.01f);
    u = c[12] * p.x / z + c[14], v = c[13] * p.y / z + c[15];
    if (round < ROUNDS) share = share_of_row(c, v);
  }
  pixels[pixel] = make_float2(u, v);
  valid[pixel] = before;
  bool inside = before && u >= 0.f && v >= 0.f && u <= width - 1 && v <= height - 1;
  V3 centre = centre_at(c, v), ray = point - centre;
  visible[pixel] = inside && !occluded(stock, between, centre, ray, 1.f - margin / norm(ray));
}
