// Rays through discs with the BVH and traversal of Embree, with which `python -m benchmarks.rays` compares the tracer.
//
// Each disc is a primitive of one user geometry, whose callback treats it like glassplat/kernels/trace: the same hit
// maths, the same nearest 16 hits, and the next search starting after the last of them. The library ships without
// headers, so the parts of its C interface (version 4) in use are declared here. One thread.
#include <cmath>
#include <cstdint>
#include <cstring>

extern "C" {
typedef struct Device *RTCDevice;
typedef struct Scene *RTCScene;
typedef struct Geometry *RTCGeometry;
struct alignas(16) RTCBounds { float lower[3], align0, upper[3], align1; };
struct BoundsArguments { void *user; unsigned primitive, time_step; RTCBounds *bounds; };
struct alignas(16) RTCRayHit {
    float origin[3], tnear, direction[3], time, tfar;
    unsigned mask, id, flags;
    float normal[3], u, v;
    unsigned primitive, geometry, instance[2];
};
struct Context { unsigned instance[4]; };
struct HitArguments { int *valid; void *user; unsigned primitive; Context *context; RTCRayHit *ray; unsigned n, geometry; };
typedef void (*HitFunction)(const HitArguments *);
struct IntersectArguments {
    int flags;
    unsigned features;
    Context *context;
    void *filter;
    HitFunction intersect;
    float width;
};
RTCDevice rtcNewDevice(const char *config);
RTCScene rtcNewScene(RTCDevice device);
RTCGeometry rtcNewGeometry(RTCDevice device, int type);
void rtcSetGeometryUserPrimitiveCount(RTCGeometry geometry, unsigned count);
void rtcSetGeometryUserData(RTCGeometry geometry, void *user);
void rtcSetGeometryBoundsFunction(RTCGeometry geometry, void (*bounds)(const BoundsArguments *), void *user);
void rtcSetGeometryIntersectFunction(RTCGeometry geometry, HitFunction intersect);
void rtcCommitGeometry(RTCGeometry geometry);
unsigned rtcAttachGeometry(RTCScene scene, RTCGeometry geometry);
void rtcReleaseGeometry(RTCGeometry geometry);
void rtcSetSceneFlags(RTCScene scene, int flags);
void rtcCommitScene(RTCScene scene);
void rtcIntersect1(RTCScene scene, RTCRayHit *ray, IntersectArguments *arguments);
void rtcReleaseScene(RTCScene scene);
}

namespace {

constexpr int USER_GEOMETRY = 120, CHUNK = 16, LAST_ID = 2147483647, ROBUST = 4;
constexpr float ALPHA_MIN = 1 / 255.f, ALPHA_MAX = 0.99f, T_MIN = 1e-4f, EDGE_ON = 1e-3f, FARTHEST = 9;

struct Discs {
    const float *means, *frames, *opacities, *extents;
};

struct Search : Context {
    float ts[CHUNK], alphas[CHUNK], first;
    int ids[CHUNK], first_id, count;
};

Discs discs;

float dot(const float *a, const float *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

float exp2_of(float t) {
    t = t > -80.f ? t : -80.f;
    int32_t whole = (int32_t)t, power = (whole + 127) << 23;
    float f = t - (float)whole, scale;
    std::memcpy(&scale, &power, sizeof scale);
    return (((((0.000944903083f * f + 0.00920579680f) * f + 0.0552973572f) * f + 0.240180143f) * f + 0.693143721f) * f
            + 1.0f) * scale;
}

void bounds_of(const BoundsArguments *given) {
    const unsigned g = given->primitive;
    float squares[3] = {0, 0, 0};
    for (int axis = 0; axis < 2; axis++) {
        const float *row = discs.frames + 9 * g + 3 * axis;
        const float inverse = 1 / dot(row, row);
        for (int j = 0; j < 3; j++) squares[j] += row[j] * inverse * row[j] * inverse;
    }
    for (int j = 0; j < 3; j++) {
        const float half = discs.extents[g] * std::sqrt(squares[j]);
        given->bounds->lower[j] = discs.means[3 * g + j] - half;
        given->bounds->upper[j] = discs.means[3 * g + j] + half;
    }
}

void meet(const HitArguments *given) {
    if (!given->valid[0]) return;
    Search &search = *static_cast<Search *>(given->context);
    RTCRayHit &ray = *given->ray;
    const int g = (int)given->primitive;
    const float *d = ray.direction, *frame = discs.frames + 9 * g, *mean = discs.means + 3 * g;
    const float slope = dot(frame + 6, d);
    if (!(slope * slope > EDGE_ON * EDGE_ON * dot(d, d))) return;
    const float offset[3] = {mean[0] - ray.origin[0], mean[1] - ray.origin[1], mean[2] - ray.origin[2]};
    const float t = dot(frame + 6, offset) / slope;
    const bool full = search.count == CHUNK;
    if (!(t > search.first || (t == search.first && g > search.first_id))) return;
    if (full && !(t < search.ts[CHUNK - 1] || (t == search.ts[CHUNK - 1] && g < search.ids[CHUNK - 1]))) return;
    const float x[3] = {t * d[0] - offset[0], t * d[1] - offset[1], t * d[2] - offset[2]};
    const float u = dot(frame, x), v = dot(frame + 3, x), squared = u * u + v * v;
    if (!(squared <= FARTHEST)) return;
    const float covered = discs.opacities[g] * exp2_of(-0.5f / 0.6931471805599453f * squared);
    if (!(covered >= ALPHA_MIN)) return;
    int place = full ? CHUNK - 1 : search.count++;
    for (; place > 0 && (search.ts[place - 1] > t || (search.ts[place - 1] == t && search.ids[place - 1] > g)); place--) {
        search.ts[place] = search.ts[place - 1];
        search.ids[place] = search.ids[place - 1];
        search.alphas[place] = search.alphas[place - 1];
    }
    search.ts[place] = t;
    search.ids[place] = g;
    search.alphas[place] = covered < ALPHA_MAX ? covered : ALPHA_MAX;
    if (search.count == CHUNK) ray.tfar = search.ts[CHUNK - 1];
}

}  // namespace

extern "C" {

RTCDevice new_device() { return rtcNewDevice("threads=1"); }

RTCScene new_scene(RTCDevice device, long count, int robust, const float *means, const float *frames,
                   const float *opacities, const float *extents) {
    discs = Discs{means, frames, opacities, extents};
    RTCGeometry geometry = rtcNewGeometry(device, USER_GEOMETRY);
    rtcSetGeometryUserPrimitiveCount(geometry, (unsigned)count);
    rtcSetGeometryBoundsFunction(geometry, bounds_of, nullptr);
    rtcSetGeometryIntersectFunction(geometry, meet);
    rtcCommitGeometry(geometry);
    RTCScene scene = rtcNewScene(device);
    rtcSetSceneFlags(scene, robust ? ROBUST : 0);
    rtcAttachGeometry(scene, geometry);
    rtcReleaseGeometry(geometry);
    rtcCommitScene(scene);
    return scene;
}

void release_scene(RTCScene scene) { rtcReleaseScene(scene); }

void trace(RTCScene scene, long count, const float *origins, const float *directions, float near, float *alphas,
           float *depths, int *hits) {
    for (long r = 0; r < count; r++) {
        const float *o = origins + 3 * r, *d = directions + 3 * r;
        const float length = std::sqrt(dot(d, d));
        float left = 1, depth = 0;
        int blended = 0;
        Search search;
        search.first = near, search.first_id = LAST_ID, search.count = CHUNK;
        while (search.count == CHUNK) {
            std::memset(search.instance, 0xff, sizeof search.instance);
            search.count = 0;
            RTCRayHit ray;
            std::memset(&ray, 0, sizeof ray);
            std::memcpy(ray.origin, o, sizeof ray.origin);
            std::memcpy(ray.direction, d, sizeof ray.direction);
            ray.tnear = search.first, ray.tfar = INFINITY, ray.mask = 0xffffffffu;
            ray.geometry = ray.primitive = 0xffffffffu;
            IntersectArguments arguments{0, 0xffffffffu, &search, nullptr, nullptr, 0};
            rtcIntersect1(scene, &ray, &arguments);
            for (int k = 0; k < search.count; k++) {
                const float after = left * (1 - search.alphas[k]);
                if (after < T_MIN) {
                    search.count = 0;
                    break;
                }
                depth += search.alphas[k] * left * (search.ts[k] * length);
                left = after, blended++;
            }
            search.first = search.ts[CHUNK - 1], search.first_id = search.ids[CHUNK - 1];
        }
        alphas[r] = 1 - left, depths[r] = depth, hits[r] = blended;
    }
}

}
