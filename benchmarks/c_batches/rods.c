/* Many rods, one in each lane of a vector: the law of rod.c, step by step.

   Written to be fast: a step is one pass along the rods. What neighbours share stays in
   registers. State is in the order [element][component][lane]. */
#include <immintrin.h>

#ifndef N
#define N 20
#endif
#ifndef T
#define T double
#endif
#define LANES (64 / (int)sizeof(T))
#define SINGLE (sizeof(T) == 4)

typedef T V __attribute__((vector_size(64)));

typedef struct {
    V x[N + 1][3], v[N + 1][3], q[N][4], p[N][3];
} State;

/* The same numbers as in rod.c, for all rods, in the same order. */
typedef struct {
    T inverse_length[N], stretch[3][N], joint[3][N], wall[4], force[3][N + 1];
    T gain[N + 1], loss[N + 1], spin_gain[N], spin_loss[N];
    T inverse_inertia[N], contrast[N];
} Rods;

#define advance advance_one
#define State OneState
#define Rod OneRod
#include "../c_programs/rod.c"
#undef advance
#undef State
#undef Rod

static inline V series(V u, int n, const T *c) {
    V total = u * 0 + c[n - 1];
    for (int k = n - 2; k >= 0; k--) total = total * u + c[k];
    return total;
}

static inline V roots(V a) {
    return SINGLE ? (V)_mm512_sqrt_ps((__m512)a) : (V)_mm512_sqrt_pd((__m512d)a);
}

static inline V least(V a, T b) {
    return SINGLE ? (V)_mm512_min_ps((__m512)a, _mm512_set1_ps((float)b))
                  : (V)_mm512_min_pd((__m512d)a, _mm512_set1_pd((double)b));
}

/* -1 in lanes below zero, 1 in others. */
static inline V signs(V a) {
    if (SINGLE)
        return (V)_mm512_mask_blend_ps(
            _mm512_cmp_ps_mask((__m512)a, _mm512_setzero_ps(), _CMP_LT_OQ),
            _mm512_set1_ps(1), _mm512_set1_ps(-1));
    return (V)_mm512_mask_blend_pd(
        _mm512_cmp_pd_mask((__m512d)a, _mm512_setzero_pd(), _CMP_LT_OQ),
        _mm512_set1_pd(1), _mm512_set1_pd(-1));
}

static inline void ratio_and_cosine(V square, V *ratio, V *cosine) {
    V u = (T)0.25 * least(square, (T)9.869604401089358);
    V sine = SINGLE ? series(u, 6, SINE_S) : series(u, 10, SINE_D);
    V versine = u * (SINGLE ? series(u, 6, VERSINE_S) : series(u, 10, VERSINE_D));
    *ratio = sine * (1 - versine);
    *cosine = 1 - 2 * versine * (2 - versine);
}

/* Turns the quaternion q by the angular momentum p for the time dt. */
static inline void turn(V *q, const V *p, T inverse_inertia, T contrast, T dt) {
    V w = q[0], x = q[1], y = q[2], z = q[3], a = p[0], b = p[1], c = p[2];
    V axial = 2 * ((x * z + w * y) * a + (y * z - w * x) * b) +
              (1 - 2 * (x * x + y * y)) * c;
    V half = (T)0.5 * dt * contrast * axial, sine, cosine, ratio, e;
    ratio_and_cosine(half * half, &sine, &cosine);
    sine *= half;
    T h = (T)0.5 * dt * inverse_inertia;
    V ha = h * a, hb = h * b, hc = h * c;
    ratio_and_cosine(ha * ha + hb * hb + hc * hc, &ratio, &e);
    ha *= ratio, hb *= ratio, hc *= ratio;
    V tw = e * w - ha * x - hb * y - hc * z, tx = e * x + ha * w + hb * z - hc * y;
    V ty = e * y - ha * z + hb * w + hc * x, tz = e * z + ha * y - hb * x + hc * w;
    w = tw * cosine - tz * sine, x = tx * cosine + ty * sine;
    y = ty * cosine - tx * sine, z = tz * cosine + tw * sine;
    V inverse = 1 / roots(w * w + x * x + y * y + z * z);
    q[0] = w * inverse, q[1] = x * inverse, q[2] = y * inverse, q[3] = z * inverse;
}

/* Odd and even parts of the couple of joint k, between the quaternions g and q. */
static inline void bend(const V *g, const V *q, const Rods *r, int k, V *odd, V *even) {
    V a = g[0], b = g[1], c = g[2], d = g[3], w = q[0], x = q[1], y = q[2], z = q[3];
    V rw = a * w + b * x + c * y + d * z, rx = a * x - b * w - c * z + d * y;
    V ry = a * y + b * z - c * w - d * x, rz = a * z - b * y + c * x - d * w;
    V sign = signs(rw);
    rw *= sign;
    V quarter = roots((T)0.5 * (1 + rw));
    V s = quarter / ((1 + rw) * (1 + quarter));
    V u = (rx * rx + ry * ry + rz * rz) * s * s;
    V coupling = SINGLE ? series(u, 6, COUPLING_S) : series(u, 13, COUPLING_D);
    V angle = sign * 8 * s * (SINGLE ? series(u, 6, ATAN_S) : series(u, 13, ATAN_D));
    rx *= angle, ry *= angle, rz *= angle;
    V mx = r->joint[0][k] * rx, my = r->joint[1][k] * ry, mz = r->joint[2][k] * rz;
    V tx = ry * mz - rz * my, ty = rz * mx - rx * mz, tz = rx * my - ry * mx;
    odd[0] = mx + coupling * (ry * tz - rz * ty);
    odd[1] = my + coupling * (rz * tx - rx * tz);
    odd[2] = mz + coupling * (rx * ty - ry * tx);
    even[0] = (T)0.5 * tx, even[1] = (T)0.5 * ty, even[2] = (T)0.5 * tz;
}

static inline void kick_and_drift(State *restrict s, const Rods *restrict r, T dt) {
    V wall[4], pull[3], odd[3], even[3], here[3];
    for (int c = 0; c < 4; c++) wall[c] = s->q[0][c] * 0 + r->wall[c];
    for (int c = 0; c < 3; c++) pull[c] = s->x[0][c] * 0;
    for (int c = 0; c < 3; c++) here[c] = s->x[0][c];
    bend(wall, s->q[0], r, 0, odd, even);
    for (int i = 0; i < N; i++) {
        V q[4], more_odd[3], more_even[3], stress[3], sum[3], local[3], edge[3];
        for (int c = 0; c < 4; c++) q[c] = s->q[i][c];
        if (i + 1 < N)
            bend(q, s->q[i + 1], r, i + 1, more_odd, more_even);
        else
            for (int c = 0; c < 3; c++) more_odd[c] = more_even[c] = q[0] * 0;
        V w = q[0], x = q[1], y = q[2], z = q[3];
        V d[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)},
                     {2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)},
                     {2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)}};
        for (int c = 0; c < 3; c++) edge[c] = s->x[i + 1][c] - here[c];
        for (int k = 0; k < 3; k++) {
            local[k] = d[k][0] * edge[0] + d[k][1] * edge[1] + d[k][2] * edge[2];
            stress[k] = r->stretch[k][i] * (local[k] * r->inverse_length[i] - (T)(k == 2));
        }
        for (int c = 0; c < 3; c++) {
            V after = d[0][c] * stress[0] + d[1][c] * stress[1] + d[2][c] * stress[2];
            V v = s->v[i][c];
            v += r->gain[i] * (after - pull[c] + r->force[c][i]) - r->loss[i] * v;
            if (i == 0) v *= 0;
            s->v[i][c] = v;
            s->x[i][c] = here[c] + dt * v;
            here[c] = s->x[i + 1][c];
            pull[c] = after;
            sum[c] = more_odd[c] - odd[c] + more_even[c] + even[c];
            odd[c] = more_odd[c], even[c] = more_even[c];
        }
        sum[0] += local[1] * stress[2] - local[2] * stress[1];
        sum[1] += local[2] * stress[0] - local[0] * stress[2];
        sum[2] += local[0] * stress[1] - local[1] * stress[0];
        for (int c = 0; c < 3; c++) {
            V couple = d[0][c] * sum[0] + d[1][c] * sum[1] + d[2][c] * sum[2];
            s->p[i][c] += r->spin_gain[i] * couple - r->spin_loss[i] * s->p[i][c];
        }
        turn(q, s->p[i], r->inverse_inertia[i], r->contrast[i], dt);
        for (int c = 0; c < 4; c++) s->q[i][c] = q[c];
    }
    for (int c = 0; c < 3; c++) {
        V v = s->v[N][c];
        v += r->gain[N] * (r->force[c][N] - pull[c]) - r->loss[N] * v;
        s->v[N][c] = v;
        s->x[N][c] += dt * v;
    }
}

static void drift_many(State *restrict s, const Rods *restrict r, T dt) {
    for (int i = 0; i <= N; i++)
        for (int c = 0; c < 3; c++) s->x[i][c] += dt * s->v[i][c];
    for (int i = 0; i < N; i++)
        turn(s->q[i], s->p[i], r->inverse_inertia[i], r->contrast[i], dt);
}

/* Copies numbers [component][element] of rods, `apart` from rod to rod, to vectors. */
static void fetch(V *to, const T *from, int components, int elements, long apart) {
    for (int c = 0; c < components; c++)
        for (int i = 0; i < elements; i++)
            for (int lane = 0; lane < LANES; lane++)
                to[i * components + c][lane] = from[lane * apart + c * elements + i];
}

static void bring(T *to, const V *from, int components, int elements, long apart) {
    for (int c = 0; c < components; c++)
        for (int i = 0; i < elements; i++)
            for (int lane = 0; lane < LANES; lane++)
                to[lane * apart + c * elements + i] = from[i * components + c][lane];
}

/* `rods` is a multiple of the lanes; each rod has its numbers in the order of rod.c. */
void advance(T *states, const Rods *r, double dt, int steps, int rods) {
    static State s;
    /* Numbers too small for full precision are zero, as in XLA's threads. */
    const unsigned before = _mm_getcsr();
    _mm_setcsr(before | 0x8040);
    const long v = 3 * (N + 1), q = 2 * v, p = q + 4 * N, size = p + 3 * N;
    for (T *one = states; one < states + size * rods; one += size * LANES) {
        fetch(s.x[0], one, 3, N + 1, size), fetch(s.v[0], one + v, 3, N + 1, size);
        fetch(s.q[0], one + q, 4, N, size), fetch(s.p[0], one + p, 3, N, size);
        drift_many(&s, r, (T)(0.5 * dt));
        for (int k = 1; k < steps; k++) kick_and_drift(&s, r, (T)dt);
        kick_and_drift(&s, r, (T)(0.5 * dt));
        bring(one, s.x[0], 3, N + 1, size), bring(one + v, s.v[0], 3, N + 1, size);
        bring(one + q, s.q[0], 4, N, size), bring(one + p, s.p[0], 3, N, size);
    }
    _mm_setcsr(before);
}
