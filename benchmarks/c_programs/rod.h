/* A damped rod by jaxrod's consistent law: its drift and its kick.

   Written to be fast: numbers of elements and the type are known to the compiler, each
   component is an array along the rod, and every loop over elements can fill vectors. */
#include <math.h>

#ifndef N
#define N 20 /* elements of a rod */
#endif
#ifndef T
#define T double
#endif
#ifndef BENT
#define BENT 0 /* whether rods have strains and joint angles at rest */
#endif
#define SINGLE (sizeof(T) == 4)

typedef struct {
    T x[3][N + 1], v[3][N + 1], q[4][N], p[3][N];
} State;

typedef struct {
    T inverse_length[N], stretch[3][N];
    T joint[3][N]; /* joint k lies before element k; the first is that of the wall,
                      zero if there is none */
    T wall[4];
    T force[3][N + 1]; /* loads that do not change: weight */
    T gain[N + 1], loss[N + 1], spin_gain[N], spin_loss[N];
    T inverse_inertia[N], contrast[N];
    T free; /* 0 where the first node is held, else 1 */
#if BENT
    T rest_strain[3][N], rest_angle[3][N];
#endif
} Rod;

static inline T polynomial(T u, int n, const T *c) {
    T total = c[n - 1];
    for (int k = n - 2; k >= 0; k--) total = total * u + c[k];
    return total;
}

static const T SINE_S[] = {1, -1. / 6, 1. / 120, -1. / 5040, 1. / 362880, -1. / 39916800};
static const T VERSINE_S[] = {1. / 2, -1. / 24, 1. / 720, -1. / 40320, 1. / 3628800,
                              -1. / 479001600};
static const T SINE_D[] = {1, -1. / 6, 1. / 120, -1. / 5040, 1. / 362880,
                           -1. / 39916800, 1. / 6227020800., -1. / 1307674368000.,
                           1. / 355687428096000., -1. / 121645100408832000.};
static const T VERSINE_D[] = {1. / 2, -1. / 24, 1. / 720, -1. / 40320, 1. / 3628800,
                              -1. / 479001600, 1. / 87178291200.,
                              -1. / 20922789888000., 1. / 6402373705728000.,
                              -1. / 2432902008176640000.};
static const T ATAN_S[] = {0.9999999993712282, -0.33333306893048514,
                           0.19998183041083206, -0.14239532669648974,
                           0.10569828806414448, -0.06026305227658459};
static const T ATAN_D[] = {1.0, -0.33333333333333326, 0.19999999999997015,
                           -0.1428571428532971, 0.11111111085322109,
                           -0.09090908059031191, 0.07692281099937744,
                           -0.06666205259976526, 0.05876834004614161,
                           -0.05217312574061591, 0.04499500728984032,
                           -0.03338782450121195, 0.015113765096600925};
static const T COUPLING_S[] = {0.08333333161961404, 0.0888896063198832,
                               0.07614229722934435, 0.08271958106603673,
                               0.06573262919711573, 0.13880859371963714};
static const T COUPLING_D[] = {0.08333333333333333, 0.08888888888888717,
                               0.07619047619103696, 0.08155202814712977,
                               0.07822564740289835, 0.08058588550713681,
                               0.07878776607404814, 0.08014902205173824,
                               0.07991587012208509, 0.07323473600504803,
                               0.11390451090234865, -0.03000161688187721,
                               0.2626840495356016};

static inline void sine_and_cosine(T square, T *ratio, T *cosine) {
    T most = (T)9.869604401089358;
    T u = (T)0.25 * (square < most ? square : most);
    T sine = SINGLE ? polynomial(u, 6, SINE_S) : polynomial(u, 10, SINE_D);
    T versine = u * (SINGLE ? polynomial(u, 6, VERSINE_S) : polynomial(u, 10, VERSINE_D));
    *ratio = sine * (1 - versine);
    *cosine = 1 - 2 * versine * (2 - versine);
}

static inline T root(T a) { return SINGLE ? (T)sqrtf((float)a) : (T)sqrt((double)a); }

/* Numbers too small for full precision become zero, as in XLA; they are slow. Returns the
   processor's mode before. */
static inline unsigned flush_small_numbers(void) {
    unsigned mode = __builtin_ia32_stmxcsr();
    __builtin_ia32_ldmxcsr(mode | 0x8040);
    return mode;
}
static inline void restore(unsigned mode) { __builtin_ia32_ldmxcsr(mode); }

static void drift(State *restrict s, const Rod *restrict r, T dt) {
    for (int c = 0; c < 3; c++)
        for (int i = 0; i <= N; i++) s->x[c][i] += dt * s->v[c][i];
    for (int i = 0; i < N; i++) {
        T w = s->q[0][i], x = s->q[1][i], y = s->q[2][i], z = s->q[3][i];
        T a = s->p[0][i], b = s->p[1][i], c = s->p[2][i];
        T axial = 2 * ((x * z + w * y) * a + (y * z - w * x) * b) +
                  (1 - 2 * (x * x + y * y)) * c;
        T half = (T)0.5 * dt * r->contrast[i] * axial, sine, cosine;
        sine_and_cosine(half * half, &sine, &cosine);
        sine *= half;
        T h = (T)0.5 * dt * r->inverse_inertia[i];
        T ha = h * a, hb = h * b, hc = h * c, ratio, e;
        sine_and_cosine(ha * ha + hb * hb + hc * hc, &ratio, &e);
        ha *= ratio, hb *= ratio, hc *= ratio;
        T tw = e * w - ha * x - hb * y - hc * z;
        T tx = e * x + ha * w + hb * z - hc * y;
        T ty = e * y - ha * z + hb * w + hc * x;
        T tz = e * z + ha * y - hb * x + hc * w;
        w = tw * cosine - tz * sine, x = tx * cosine + ty * sine;
        y = ty * cosine - tx * sine, z = tz * cosine + tw * sine;
        T inverse = 1 / root(w * w + x * x + y * y + z * z);
        s->q[0][i] = w * inverse, s->q[1][i] = x * inverse;
        s->q[2][i] = y * inverse, s->q[3][i] = z * inverse;
    }
}

/* Changes velocities and angular momenta by the rod's own loads and forces on nodes. */
static void kick(State *restrict s, const Rod *restrict r, const T (*restrict force)[N + 1]) {
    /* Pulls of elements [N] and couples of joints [N m], with room for both ends. */
    T pull[3][N + 2], odd[3][N + 1], even[3][N + 1], couple[3][N], before[4][N];
    for (int c = 0; c < 4; c++) {
        before[c][0] = r->wall[c];
        for (int i = 1; i < N; i++) before[c][i] = s->q[c][i - 1];
    }
    for (int c = 0; c < 3; c++)
        pull[c][0] = pull[c][N + 1] = odd[c][N] = even[c][N] = 0;
    for (int i = 0; i < N; i++) {
        T a = before[0][i], b = before[1][i], c = before[2][i], d = before[3][i];
        T w = s->q[0][i], x = s->q[1][i], y = s->q[2][i], z = s->q[3][i];
        T rw = a * w + b * x + c * y + d * z, rx = a * x - b * w - c * z + d * y;
        T ry = a * y + b * z - c * w - d * x, rz = a * z - b * y + c * x - d * w;
        T sign = rw < 0 ? -1 : 1;
        rw *= sign;
        T quarter = root((T)0.5 * (1 + rw));
        T k = 1 / ((1 + rw) * (1 + quarter)) * quarter;
        T u = (rx * rx + ry * ry + rz * rz) * k * k;
        T coupling = SINGLE ? polynomial(u, 6, COUPLING_S) : polynomial(u, 13, COUPLING_D);
        T angle = sign * 8 * k *
                  (SINGLE ? polynomial(u, 6, ATAN_S) : polynomial(u, 13, ATAN_D));
        rx *= angle, ry *= angle, rz *= angle;
#if BENT
        T bx = rx - r->rest_angle[0][i], by = ry - r->rest_angle[1][i],
          bz = rz - r->rest_angle[2][i];
#else
        T bx = rx, by = ry, bz = rz;
#endif
        T mx = r->joint[0][i] * bx, my = r->joint[1][i] * by, mz = r->joint[2][i] * bz;
        T tx = ry * mz - rz * my, ty = rz * mx - rx * mz, tz = rx * my - ry * mx;
        odd[0][i] = mx + coupling * (ry * tz - rz * ty);
        odd[1][i] = my + coupling * (rz * tx - rx * tz);
        odd[2][i] = mz + coupling * (rx * ty - ry * tx);
        even[0][i] = (T)0.5 * tx, even[1][i] = (T)0.5 * ty, even[2][i] = (T)0.5 * tz;
    }
    for (int i = 0; i < N; i++) {
        T w = s->q[0][i], x = s->q[1][i], y = s->q[2][i], z = s->q[3][i];
        T d[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)},
                     {2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)},
                     {2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)}};
        T edge[3], local[3], stress[3], sum[3];
        for (int c = 0; c < 3; c++) edge[c] = s->x[c][i + 1] - s->x[c][i];
        for (int k = 0; k < 3; k++) {
            local[k] = d[k][0] * edge[0] + d[k][1] * edge[1] + d[k][2] * edge[2];
            T strain = local[k] * r->inverse_length[i] - (k == 2);
#if BENT
            strain -= r->rest_strain[k][i];
#endif
            stress[k] = r->stretch[k][i] * strain;
        }
        for (int c = 0; c < 3; c++) {
            pull[c][i + 1] = d[0][c] * stress[0] + d[1][c] * stress[1] + d[2][c] * stress[2];
            sum[c] = odd[c][i + 1] - odd[c][i] + even[c][i + 1] + even[c][i];
        }
        sum[0] += local[1] * stress[2] - local[2] * stress[1];
        sum[1] += local[2] * stress[0] - local[0] * stress[2];
        sum[2] += local[0] * stress[1] - local[1] * stress[0];
        for (int c = 0; c < 3; c++)
            couple[c][i] = d[0][c] * sum[0] + d[1][c] * sum[1] + d[2][c] * sum[2];
    }
    for (int c = 0; c < 3; c++) {
        for (int i = 0; i <= N; i++)
            s->v[c][i] += r->gain[i] * (pull[c][i + 1] - pull[c][i] + force[c][i]) -
                          r->loss[i] * s->v[c][i];
        for (int i = 0; i < N; i++)
            s->p[c][i] += r->spin_gain[i] * couple[c][i] - r->spin_loss[i] * s->p[c][i];
        s->v[c][0] *= r->free;
    }
}
