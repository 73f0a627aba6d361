// The two hot loops of compositing in C++, with which `python -m benchmarks.twin` compares the kernels.
//
// The steps are those of glassplat/kernels/composite/cpu.py and cpu_backward.py, for four channels, images of whole
// tiles, and neither glass nor deviations. Names are those of glassplat/kernels/composite/cpu_tile.py.
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>
#ifdef __AVX2__
#include <immintrin.h>
#endif

namespace {

constexpr int TILE = 16, BLOCK = 4, LANES = 16, PIXELS = 256, BLOCKS = 16, ACROSS = 4, CHUNK = 128, WIDTH = 16;
constexpr int T = 0, LAST = PIXELS, T_GLASS = 2 * PIXELS, LAST_GLASS = 3 * PIXELS, STATE = 4 * PIXELS;
enum { MEAN_X, MEAN_Y, FORM_XX, FORM_XY, FORM_YY, BITS, SLOPE_X, SLOPE_Y, VALUES, ORDER = SLOPE_X };
constexpr int STOP_AFTER = 8, SUMS = 0, BEHIND = PIXELS, V_IMAGE = 2 * PIXELS;
constexpr float ALPHA_MIN = 1 / 255.f, ALPHA_MAX = 0.99f, T_MIN = 1e-4f, SLACK = 0.02f;

typedef float Vec __attribute__((vector_size(64)));
typedef int32_t Ints __attribute__((vector_size(64)));

Vec load(const float *at) { Vec v; std::memcpy(&v, at, sizeof v); return v; }
void store(float *at, Vec v) { std::memcpy(at, &v, sizeof v); }
Vec full(float x) { return Vec{} + x; }
Vec smaller(Vec a, Vec b) { return a < b ? a : b; }
Vec larger(Vec a, Vec b) { return a > b ? a : b; }
Vec absolute(Vec a) { return (Vec)((Ints)a & 0x7fffffff); }
Vec lanes(int columns, int step, float first) {
    Vec v;
    for (int i = 0; i < LANES; i++) v[i] = (columns ? i % BLOCK : i / BLOCK) * step + first;
    return v;
}

uint32_t bits_of(Ints mask) {
#ifdef __AVX512DQ__
    return _mm512_movepi32_mask((__m512i)mask);
#elif defined __AVX2__
    __m256 halves[2];
    std::memcpy(halves, &mask, sizeof mask);
    return _mm256_movemask_ps(halves[0]) | _mm256_movemask_ps(halves[1]) << 8;
#else
    uint32_t bits = 0;
    for (int i = 0; i < LANES; i++) bits |= (mask[i] & 1u) << i;
    return bits;
#endif
}

Vec exp2_of(Vec t) {
    Ints whole = __builtin_convertvector(t, Ints);
    Vec f = t - __builtin_convertvector(whole, Vec);
    Vec value = f * 0.000944903083f + 0.00920579680f;
    value = value * f + 0.0552973572f;
    value = value * f + 0.240180143f;
    value = value * f + 0.693143721f;
    value = value * f + 1.0f;
    return (Vec)((Ints)value + (whole << 23));
}

Vec exponent(const float *splat, Vec dx, Vec dy) {
    Vec along = dx * splat[FORM_XX] + dy * splat[FORM_XY];
    return along * dx + (dy * splat[FORM_YY] * dy + splat[BITS]);
}

uint32_t reached(const float *splat) {
    const Vec lefts = lanes(1, BLOCK, 0.5f), tops = lanes(0, BLOCK, 0.5f);
    Vec left = lefts - splat[MEAN_X], top = tops - splat[MEAN_Y], nowhere = full(0);
    Vec right = left + (BLOCK - 1.f), bottom = top + (BLOCK - 1.f);
    Vec near_x = larger(left, smaller(right, nowhere)), near_y = larger(top, smaller(bottom, nowhere));
    Vec far_x = larger(left, smaller(right, near_y * splat[SLOPE_X]));
    Vec far_y = larger(top, smaller(bottom, near_x * splat[SLOPE_Y]));
    Vec most = larger(exponent(splat, near_x, far_y), exponent(splat, far_x, near_y));
    return bits_of(most >= std::log2(ALPHA_MIN) - SLACK);
}

void pack(float *packed, const float *mean, const float *conic, float opacity, const float *channels) {
    const float half = -0.5 / std::log(2.0), whole = -1 / std::log(2.0);
    float xx = half * conic[0], xy = whole * conic[1], yy = half * conic[2];
    double determinant = (double)conic[0] * conic[2] - (double)conic[1] * conic[1];
    bool drawn = determinant > 0 && determinant < INFINITY && conic[0] > 0 && opacity > ALPHA_MIN && opacity < INFINITY;
    packed[MEAN_X] = mean[0], packed[MEAN_Y] = mean[1];
    packed[FORM_XX] = xx, packed[FORM_XY] = xy, packed[FORM_YY] = yy;
    packed[SLOPE_X] = -0.5f * xy / xx, packed[SLOPE_Y] = -0.5f * xy / yy;
    packed[BITS] = drawn ? (float)(std::log((double)opacity) / std::log(2.0)) : -INFINITY;
    for (int d = 0; d < 4; d++) packed[VALUES + d] = channels[d], packed[VALUES + 4 + d] = 0;
}

void fetch(float *batch, const float *packed, const int32_t *pairs, long first, long last, int x0, int y0) {
    for (long p = first; p < last; p++) {
        float *to = batch + (p - first) * WIDTH;
        store(to, load(packed + pairs[p] * (long)WIDTH));
        to[MEAN_X] -= x0, to[MEAN_Y] -= y0;
    }
}

struct Taken { long count; bool runs; };

Taken blend_block(float *state, float *planes, const float *batch, const int32_t *entries, long count, Vec xs, Vec ys) {
    const Vec none = full(0), most = full(ALPHA_MAX);
    const float least = std::log2(ALPHA_MIN);
    Vec t = load(state + T), last = load(state + LAST);
    Vec s0 = load(planes), s1 = load(planes + PIXELS), s2 = load(planes + 2 * PIXELS), s3 = load(planes + 3 * PIXELS);
    long e = 0;
    while (e < count) {
        const float *splat = batch + entries[e] * (long)WIDTH;
        Vec bits = exponent(splat, xs - splat[MEAN_X], ys - splat[MEAN_Y]);
        Vec alpha = bits >= least ? smaller(exp2_of(bits), most) : none;
        Vec weight = alpha * t, after = t - weight;
        Ints alive = after >= T_MIN;
        weight = alive ? weight : none;
        t = alive ? after : -absolute(t);
        last = alive ? full(splat[ORDER]) : last;
        s0 += weight * splat[VALUES], s1 += weight * splat[VALUES + 1];
        s2 += weight * splat[VALUES + 2], s3 += weight * splat[VALUES + 3];
        e++;
        if (e % STOP_AFTER == 0 && !bits_of(t > none)) break;
    }
    store(state + T, t), store(state + LAST, last);
    store(planes, s0), store(planes + PIXELS, s1), store(planes + 2 * PIXELS, s2), store(planes + 3 * PIXELS, s3);
    return {e, bits_of(t > none) != 0};
}

void write_tile(const float *state, const float *planes, float *image, float *alpha, long corner, int width) {
    for (int lane = 0; lane < PIXELS; lane++) {
        int b = lane / LANES, i = lane % LANES;
        long pixel = corner + (long)(b / ACROSS * BLOCK + i / BLOCK) * width + b % ACROSS * BLOCK + i % BLOCK;
        alpha[pixel] = 1 - state[T + lane];
        for (int d = 0; d < 4; d++) image[pixel * 4 + d] = planes[SUMS + d * PIXELS + lane];
    }
}

// One step of a lane reduction: adds the two halves of each group of W lanes of two vectors into one vector.
template <int W> Vec halved(Vec a, Vec b) {
    Ints near, far;
    for (int i = 0; i < LANES; i++) {
        int lane = i / (W / 2) * W + i % (W / 2);
        near[i] = lane, far[i] = lane + W / 2;
    }
    return __builtin_shuffle(a, b, near) + __builtin_shuffle(a, b, far);
}

Vec sums_of(const Vec (&v)[LANES]) {
    Vec eight[8], four[4];
    for (int i = 0; i < 8; i++) eight[i] = halved<16>(v[2 * i], v[2 * i + 1]);
    for (int i = 0; i < 4; i++) four[i] = halved<8>(eight[2 * i], eight[2 * i + 1]);
    return halved<2>(halved<4>(four[0], four[1]), halved<4>(four[2], four[3]));
}

void unblend(float *planes, float *t_plane, const float *state, const float *splat, uint32_t blocks, float *row) {
    const Vec none = full(0), most = full(ALPHA_MAX), columns = lanes(1, 1, 0.5f), lines = lanes(0, 1, 0.5f);
    const float least = std::log2(ALPHA_MIN);
    Vec g = none, g_x = none, g_y = none, g_xx = none, g_xy = none, g_yy = none, pull_x = none, pull_y = none;
    Vec s0 = none, s1 = none, s2 = none, s3 = none;
    while (blocks) {
        int b = __builtin_ctz(blocks), i = b * LANES;
        blocks &= blocks - 1;
        Vec dx = columns + (b % ACROSS * BLOCK - splat[MEAN_X]), dy = lines + (b / ACROSS * BLOCK - splat[MEAN_Y]);
        Vec bits = exponent(splat, dx, dy), coverage = exp2_of(bits);
        Ints shown = (bits >= least) & (load(state + LAST + i) >= splat[ORDER]);
        Vec alpha = shown ? smaller(coverage, most) : none;
        Vec inverse = 1.f / (1.f - alpha), t = load(t_plane + i) * inverse, weight = alpha * t;
        const float *v = planes + V_IMAGE + i;
        Vec v0 = load(v), v1 = load(v + PIXELS), v2 = load(v + 2 * PIXELS), v3 = load(v + 3 * PIXELS);
        Vec dot = v0 * splat[VALUES] + v1 * splat[VALUES + 1];
        dot = dot + (v2 * splat[VALUES + 2] + v3 * splat[VALUES + 3]);
        Vec behind = load(planes + BEHIND + i), v_alpha = t * dot - behind * inverse;
        store(planes + BEHIND + i, behind + weight * dot);
        store(t_plane + i, t);
        Vec gain = coverage < most ? v_alpha * alpha : none, gain_x = gain * dx, gain_y = gain * dy;
        g += gain, g_x += gain_x, g_y += gain_y;
        g_xx += gain_x * dx, g_xy += gain_x * dy, g_yy += gain_y * dy;
        pull_x += absolute(gain_x * (2 * splat[FORM_XX]) + gain_y * splat[FORM_XY]);
        pull_y += absolute(gain_y * (2 * splat[FORM_YY]) + gain_x * splat[FORM_XY]);
        s0 += weight * v0, s1 += weight * v1, s2 += weight * v2, s3 += weight * v3;
    }
    store(row, sums_of({g, g_x, g_y, g_xx, g_xy, g_yy, pull_x, pull_y, s0, s1, s2, s3, none, none, none, none}));
}

void load_gradients(float *planes, const float *t, const float *v_image, const float *v_alpha, long corner, int width) {
    for (int lane = 0; lane < PIXELS; lane++) {
        int b = lane / LANES, i = lane % LANES;
        long pixel = corner + (long)(b / ACROSS * BLOCK + i / BLOCK) * width + b % ACROSS * BLOCK + i % BLOCK;
        planes[BEHIND + lane] = -v_alpha[pixel] * t[lane];
        for (int d = 0; d < 4; d++) planes[V_IMAGE + d * PIXELS + lane] = v_image[pixel * 4 + d];
    }
}

}  // namespace

extern "C" void composite_forward(
    const float *means, const float *conics, const float *opacities, const float *channels, long num_splats, int width,
    int height, const int32_t *pair_splats, const int64_t *tile_offsets, const int64_t *splat_offsets, float *packed,
    int32_t *pairs, float *states, float *image, float *alpha) {
    for (long s = 0; s < num_splats; s++)
        if (splat_offsets[s + 1] > splat_offsets[s])
            pack(packed + s * WIDTH, means + 2 * s, conics + 3 * s, opacities[s], channels + 4 * s);
    const Vec columns = lanes(1, 1, 0.5f), lines = lanes(0, 1, 0.5f);
    alignas(64) float planes[4 * PIXELS], batch[CHUNK * WIDTH];
    int32_t entries[CHUNK + 1];
    const int across = width / TILE;
    for (long n = 0; n < (long)across * (height / TILE); n++) {
        const int x0 = n % across * TILE, y0 = n / across * TILE;
        float *state = states + n * STATE;
        for (int i = 0; i < PIXELS; i++) {
            state[T + i] = state[T_GLASS + i] = 1;
            state[LAST + i] = state[LAST_GLASS + i] = -1;
        }
        const long start = tile_offsets[n], stop = tile_offsets[n + 1];
        if (start == stop) continue;
        std::memset(planes, 0, sizeof planes);
        uint32_t running = (1u << BLOCKS) - 1;
        for (long first = start; first < stop && running; first += CHUNK) {
            const long last = first + CHUNK < stop ? first + CHUNK : stop;
            fetch(batch, packed, pair_splats, first, last, x0, y0);
            for (long p = first; p < last; p++) {
                float *splat = batch + (p - first) * WIDTH;
                pairs[p] = reached(splat) & running;
                splat[ORDER] = p - start;
            }
            for (int b = 0; b < BLOCKS; b++) {
                long count = 0;
                for (long p = first; p < last; p++) {
                    entries[count] = p - first;
                    count += pairs[p] >> b & 1;
                }
                if (!count) continue;
                Vec xs = columns + b % ACROSS * (float)BLOCK, ys = lines + b / ACROSS * (float)BLOCK;
                Taken done = blend_block(state + b * LANES, planes + b * LANES, batch, entries, count, xs, ys);
                if (done.runs) continue;
                running &= ~(1u << b);
                for (long e = done.count; e < count; e++) pairs[first + entries[e]] &= ~(1 << b);
            }
        }
        for (int i = 0; i < PIXELS; i += LANES) store(state + T + i, absolute(load(state + T + i)));
        write_tile(state, planes, image, alpha, (long)y0 * width + x0, width);
    }
}

extern "C" void composite_backward(
    int width, int height, const int32_t *pair_splats, const int64_t *tile_offsets, const float *packed,
    const int32_t *pairs, const float *states, const float *v_image, const float *v_alpha, float *rows) {
    alignas(64) float planes[(2 + 4) * PIXELS], t[PIXELS], batch[CHUNK * WIDTH];
    const int across = width / TILE, row_width = LANES;
    for (long n = 0; n < (long)across * (height / TILE); n++) {
        const long start = tile_offsets[n], stop = tile_offsets[n + 1];
        if (start == stop) continue;
        const int x0 = n % across * TILE, y0 = n / across * TILE;
        const float *state = states + n * STATE;
        std::memcpy(t, state + T, sizeof t);
        load_gradients(planes, t, v_image, v_alpha, (long)y0 * width + x0, width);
        float most = -1;
        for (int i = 0; i < PIXELS; i++) most = state[LAST + i] > most ? state[LAST + i] : most;
        const long looked_at = (long)most + 1;
        std::memset(rows + (start + looked_at) * row_width, 0, (stop - start - looked_at) * row_width * sizeof(float));
        for (long behind = 0; behind < looked_at; behind += CHUNK) {
            const long last = start + looked_at - behind, first = last - CHUNK > start ? last - CHUNK : start;
            fetch(batch, packed, pair_splats, first, last, x0, y0);
            for (long p = last - 1; p >= first; p--) {
                float *splat = batch + (p - first) * WIDTH, *row = rows + p * row_width;
                splat[ORDER] = p - start;
                if (pairs[p]) unblend(planes, t, state, splat, pairs[p], row);
                else std::memset(row, 0, row_width * sizeof(float));
            }
        }
    }
}
