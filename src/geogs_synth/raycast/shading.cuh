// Colours of surface points; the arithmetic of shading.py.
#include "solids.cuh"

#define SURFACE_FLOATS 20
#define LIGHT_FLOATS 8
#define FURTHEST_CREASE 0.35f
#define LIFT 1e-3f
#define SOFTENING 0.3f

// The surface at a hit: world position and normal, metric coordinates on it, its index.
struct Point { V3 position, normal; float u, v; int surface; };

struct Textures { const u32* texels; int size, levels; long long stride; };

#define MOST_LIGHTS 4

// The solids that can matter to the points of a block: between them and each light, or near them.
struct Nearby { u32 before_light[MOST_LIGHTS][MOST_SOLIDS / 32], around[MOST_SOLIDS / 32]; };

// What a view sees by: the room and its light.
struct Room {
  V3 size;
  const float *surfaces, *ambient, *lights;
  int light_count;
  Textures textures;
};

__device__ __forceinline__ V3 axis_of(int axis, float sign) { return v3(axis == 0 ? sign : 0.f, axis == 1 ? sign : 0.f, axis == 2 ? sign : 0.f); }

__device__ Point room_point(V3 size, V3 p) {
  float gap[6] = {fabsf(p.x), fabsf(size.x - p.x), fabsf(p.y), fabsf(size.y - p.y), fabsf(p.z), fabsf(size.z - p.z)};
  int face = 0;
  for (int k = 1; k < 6; k++) if (gap[k] < gap[face]) face = k;
  int axis = face >> 1;
  Point point = {p, axis_of(axis, face & 1 ? -1.f : 1.f), axis == 0 ? p.y : p.x, axis == 2 ? p.y : p.z, face};
  return point;
}

__device__ Point solid_point(const Solid& s, int index, V3 position) {
  V3 p = turn(s, position - load3(s.centre)), half = load3(s.half), normal;
  float u, v, around = atan2f(p.y, p.x);
  bool end = false;
  if (s.kind == BOX) {
    V3 q = v3(fabsf(p.x) - half.x, fabsf(p.y) - half.y, fabsf(p.z) - half.z);
    int axis = q.y > q.x ? (q.z > q.y ? 2 : 1) : (q.z > q.x ? 2 : 0);
    float along = axis == 0 ? p.x : axis == 1 ? p.y : p.z;
    normal = axis_of(axis, along < 0.f ? -1.f : 1.f);
    u = axis == 0 ? p.y : p.x; v = axis == 2 ? p.y : p.z;
    end = axis == 2;
  } else if (s.kind == FRUSTUM) {
    float slope = (half.y - half.x) / (2.f * half.z), radius = sqrtf(p.x * p.x + p.y * p.y);
    end = fabsf(fabsf(p.z) - half.z) < fabsf(radius - 0.5f * (half.x + half.y) - slope * p.z);
    normal = end ? v3(0.f, 0.f, p.z < 0.f ? -1.f : 1.f) : unit(v3(p.x, p.y, -slope * radius));
    u = end ? p.x : around * fmaxf(half.x, half.y); v = end ? p.y : p.z;
  } else {
    normal = unit(v3(p.x / (half.x * half.x), p.y / (half.y * half.y), p.z / (half.z * half.z)));
    u = around * half.x; v = asinf(clampf(p.z / half.z, -1.f, 1.f)) * half.z;
  }
  Point point = {position, turn_back(s, normal), u, v, 6 + 2 * index + (int)end};
  return point;
}

__device__ __forceinline__ V3 texel(const u32* level, int side, int x, int y) {
  u32 c = level[y * side + x];
  return (1.f / 255.f) * v3(c & 255u, (c >> 8) & 255u, (c >> 16) & 255u);
}

// Bilinear colour of a texture at a position in repeats of it.
__device__ V3 sample(const Textures& bank, int texture, float u, float v, int level) {
  int side = bank.size >> level;
  const u32* texels = bank.texels + texture * bank.stride + (4 * bank.size * bank.size - 4 * side * side) / 3;
  float x = (u - floorf(u)) * side - 0.5f, y = (v - floorf(v)) * side - 0.5f;
  float left = floorf(x), top = floorf(y), wx = x - left, wy = y - top;
  int x0 = (int)left & (side - 1), y0 = (int)top & (side - 1), x1 = ((int)left + 1) & (side - 1), y1 = ((int)top + 1) & (side - 1);
  V3 above = (1.f - wx) * texel(texels, side, x0, y0) + wx * texel(texels, side, x1, y0);
  V3 below = (1.f - wx) * texel(texels, side, x0, y1) + wx * texel(texels, side, x1, y1);
  return (1.f - wy) * above + wy * below;
}

__device__ __forceinline__ int level_of(const Textures& bank, float repeats, int sample_) {
  float level = floorf(log2f(fmaxf(repeats * bank.size, 1e-6f)) + (sample_ + 0.5f) / 4.f);
  return (int)clampf(level, 0.f, bank.levels - 1.f);
}

__device__ V3 albedo_of(const float* s, const Textures& bank, float u, float v, float footprint, int sample_) {
  float scale = sqrtf(s[1] * s[1] + s[3] * s[3]);
  V3 t = sample(bank, (int)s[0], s[1] * u + s[2] * v + s[5], s[3] * u + s[4] * v + s[6], level_of(bank, scale * footprint, sample_));
  float noise = sample(bank, (int)s[11], u * s[12] + s[5], v * s[12] + s[6], level_of(bank, s[12] * footprint, sample_)).y - 0.5f;
  float detail = 1.f + 2.f * s[13] * noise, c = s[7];
  V3 colour = v3(s[8] * (0.5f + c * (t.x - 0.5f)) * detail, s[9] * (0.5f + c * (t.y - 0.5f)) * detail, s[10] * (0.5f + c * (t.z - 0.5f)) * detail);
  colour = v3(clampf(colour.x, 0.02f, 0.97f), clampf(colour.y, 0.02f, 0.97f), clampf(colour.z, 0.02f, 0.97f));
  return colour * colour;
}

// Share of the ambient light that reaches a point: less in corners and next to things.
__device__ float ambient_access(const Stock& stock, const u32* around, V3 size, const Point& point) {
  const float height[2] = {0.08f, FURTHEST_CREASE}, strength[2] = {0.35f, 0.45f};
  float share = 1.f;
  for (int k = 0; k < 2; k++) {
    V3 p = point.position + height[k] * point.normal, q = size - p;
    float wall = fminf(fminf(fminf(p.x, p.y), fminf(p.z, q.x)), fminf(q.y, q.z));
    float closed = 1.f - clampf(wall / height[k], 0.f, 1.f);
    for (int word = 0; word < MOST_SOLIDS / 32; word++)
      for (u32 left = around[word]; left; left &= left - 1) {
        const Solid& s = stock.solid[32 * word + __ffs(left) - 1];
        V3 gap = p - load3(s.centre);
        float reach = s.radius + height[k];
        // A wire lets nearly all light pass.
        if (dot(gap, gap) < reach * reach) closed = fmaxf(closed, fminf(s.bulk / height[k], 1.f) * (1.f - clampf(signed_distance(s, p) / height[k], 0.f, 1.f)));
      }
    share -= strength[k] * closed;
  }
  return share;
}

__device__ __forceinline__ V3 ambient_at(const Room& room, V3 normal, float access) {
  float share = (0.5f + 0.5f * normal.z) * access;
  return share * load3(room.ambient) + (access - share) * load3(room.ambient + 3);
}

// Irradiance of a surface from a light, if nothing is in the way; the direction to the light.
__device__ __forceinline__ V3 lamp_at(V3 ray, V3 normal, V3 colour, V3& to_light) {
  float squared = dot(ray, ray);
  to_light = rsqrtf(squared) * ray;
  return (fmaxf(dot(to_light, normal), 0.f) / (squared + SOFTENING)) * colour;
}

__device__ __forceinline__ V3 corner_of(int sample_) {
  return v3(sample_ < 2 ? 1.f : -1.f, sample_ % 2 ? -1.f : 1.f, sample_ == 0 || sample_ == 3 ? 1.f : -1.f);
}

__device__ __forceinline__ Point point_at(const Stock& stock, V3 size, Hit hit, V3 origin, V3 direction) {
  V3 position = origin + hit.t * direction;
  return hit.solid < 0 ? room_point(size, position) : solid_point(stock.solid[hit.solid], hit.solid, position);
}

// What a mirroring point reflects towards a direction; light there is without shadows.
__device__ V3 reflected(const Room& room, const Stock& stock, V3 start, V3 direction, int sample_, float footprint) {
  Hit hit = closest_hit(stock, stock.present, room.size, start, direction);
  Point point = point_at(stock, room.size, hit, start, direction);
  const float* s = room.surfaces + point.surface * SURFACE_FLOATS;
  float cosine = clampf(-dot(point.normal, direction), 0.05f, 1.f);
  V3 albedo = albedo_of(s, room.textures, point.u, point.v, (2.f * footprint + 0.004f * hit.t) * rsqrtf(cosine), sample_);
  V3 light = ambient_at(room, point.normal, 1.f) + v3(s[16], s[16], s[16]), to_light;
  for (int k = 0; k < room.light_count; k++) {
    const float* lamp = room.lights + k * LIGHT_FLOATS;
    light = light + lamp_at(load3(lamp) - point.position, point.normal, load3(lamp + 3), to_light);
  }
  return albedo * light;
}

// Linear colour that one of the four samples of a pixel sees.
__device__ V3 shade(const Room& room, const Stock& stock, const Nearby& nearby, const Point& point, int sample_, V3 direction, float footprint, float access) {
  const float* s = room.surfaces + point.surface * SURFACE_FLOATS;
  V3 towards = -1.f * unit(direction), n = point.normal;
  float cosine = clampf(dot(n, towards), 0.05f, 1.f);
  V3 albedo = albedo_of(s, room.textures, point.u, point.v, footprint * rsqrtf(cosine), sample_);
  V3 diffuse = ambient_at(room, n, access), highlight = v3(0.f, 0.f, 0.f), to_light;
  V3 start = point.position + LIFT * n;
  for (int k = 0; k < room.light_count; k++) {
    const float* lamp = room.lights + k * LIGHT_FLOATS;
    V3 ray = load3(lamp) + lamp[6] * corner_of(sample_) - start, power = lamp_at(ray, n, load3(lamp + 3), to_light);
    if (power.x + power.y + power.z <= 0.f || occluded(stock, nearby.before_light[k], start, ray, 1.f)) continue;
    diffuse = diffuse + power;
    if (s[14] > 0.f) highlight = highlight + powf(fmaxf(dot(unit(to_light + towards), n), 1e-4f), s[15]) * power;
  }
  V3 colour = albedo * (diffuse + v3(s[16], s[16], s[16])) + s[14] * highlight;
  if (s[17] <= 0.f) return colour;
  float grazing = 1.f - cosine, weight = s[17] * (0.3f + 0.7f * grazing * grazing * grazing);
  V3 mirrored = 2.f * dot(towards, n) * n - towards;
  return (1.f - weight) * colour + weight * reflected(room, stock, start, mirrored, sample_, footprint);
}
