/* Rods that touch: arithmetic of pairs of elements, one pair in each lane of a vector.

   A law includes this file, and contact_steps.h after its own functions. */
#include <string.h>

#include "rod.h"

#ifndef RODS
#define RODS 2
#endif
#ifndef ROOM
#define ROOM 32 /* pairs that a list can hold */
#endif
#define LOOKED_AT (16 * ROOM) /* pairs whose exact distance a search can compute */
#ifndef EVERY
#define EVERY 32 /* steps between searches */
#endif
#ifndef SKIP
#define SKIP 1 /* whether pairs too far apart to touch are left out */
#endif
#define ELEMENTS (RODS * N)
#ifdef __AVX512F__
#define W (64 / (int)sizeof(T)) /* pairs of a chunk: numbers in a register */
#else
#define W (32 / (int)sizeof(T))
#endif
#define ROUND_UP(n) (((n) + W - 1) / W * W)

typedef struct {
    T stiffness, damping;
    T onset; /* width of the onset over the mean radius */
    T skin;  /* gap up to which elements are listed [m] */
    T radius[ELEMENTS], start[ELEMENTS], rest_length[ELEMENTS], follows[ELEMENTS];
    T first_radius[ELEMENTS], first_length[ELEMENTS], last[ELEMENTS];
} Law;
typedef struct {
    Rod rods[RODS];
    Law law;
} Constants;
typedef struct {
    State rods[RODS];
    T missed, moved, used; /* what jaxrod records of its lists */
    T kept;                /* pairs that were not left out, summed over the steps */
} States;
typedef struct {
    int count, own[ROUND_UP(ROOM)], other[ROUND_UP(ROOM)];
    T places[RODS][3][N + 1]; /* of the nodes at the search */
} List;

/* Rod of an element, which is numbered among the elements of all rods. */
static inline int rod_of(int element) { return RODS == 1 ? 0 : element >= N; }
static inline T most(T a, T b) { return a > b ? a : b; }

/* A number of each pair of a chunk, in one or several registers. */
typedef T V __attribute__((vector_size(W * sizeof(T))));
typedef __typeof__((V){0} > (V){0}) Mask;
typedef struct {
    V x, y, z;
} V3;

static inline V all(T a) { return a - (V){0}; }
static inline V choose(Mask which, V a, V b) {
    return (V)((which & (Mask)a) | (~which & (Mask)b));
}
static inline V larger(V a, V b) { return choose(a > b, a, b); }
static inline V smaller(V a, V b) { return choose(a < b, a, b); }
static inline V clip(V a) { return smaller(larger(a, all(0)), all(1)); }
static inline V roots(V a) {
    V found;
    for (int l = 0; l < W; l++) found[l] = root(a[l]);
    return found;
}
static inline T largest_of(V a) {
    T found = a[0];
    for (int l = 1; l < W; l++) found = most(found, a[l]);
    return found;
}
static inline V dot(V3 a, V3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
static inline V3 plus(V3 a, V3 b) { return (V3){a.x + b.x, a.y + b.y, a.z + b.z}; }
static inline V3 minus(V3 a, V3 b) { return (V3){a.x - b.x, a.y - b.y, a.z - b.z}; }
static inline V3 times(V s, V3 a) { return (V3){s * a.x, s * a.y, s * a.z}; }
static inline V3 with(V3 a, V s, V3 b) { return plus(a, times(s, b)); }
/* One number of a row of each component, put into a lane of a vector. */
static inline void put(V3 *a, int l, const T *row, int size) {
    a->x[l] = row[0], a->y[l] = row[size], a->z[l] = row[2 * size];
}

#define STARTED (SINGLE ? (T)3.4526698300124393e-4 : (T)1.4901161193847656e-8)

/* Penetration plus half the width of the onset; the width where nothing touches. */
static inline Mask started(V depth, V width, V *inside) {
    V d = depth + (T)0.5 * width;
    Mask touches = d > STARTED * width;
    *inside = choose(touches, d, width);
    return touches;
}

static inline V spring(V depth, V width, T stiffness) {
    V d;
    Mask touches = started(depth, width, &d);
    V over = choose(d >= width, d - (T)0.5 * width, d * d / (2 * width));
    return choose(touches, stiffness * over, all(0));
}

/* Force of a spring and a dashpot, at a speed of separation. */
static inline V normal_force(V depth, V width, V leaving, T stiffness, T damping) {
    V d;
    Mask touches = started(depth, width, &d), full = d >= width;
    V over = d - (T)0.5 * width, part = d * (1 / width);
    V force = stiffness * choose(full, over, (T)0.5 * part * d);
    V ratio = choose(full, over, (T)0.5 * d);
    V way = damping / stiffness * larger(leaving, all(0));
    V resisting = damping * choose(full, all(1), part) * smaller(leaving, all(0));
    return choose(touches, force * (ratio / (ratio + way)) - resisting, all(0));
}

static inline V rounded(V3 way, V together) {
    V small = (T)1e-7 * together;
    return roots(dot(way, way) + small * small);
}

/* Products of two segments' edges and the vector between their starts. */
typedef struct {
    V own, other, mixed, own_way, other_way;
} Products;

static inline Products products(V3 way, V3 e, V3 f) {
    return (Products){dot(e, e), dot(f, f), dot(e, f), dot(e, way), dot(f, way)};
}
static inline V on_own(Products h, V fraction) {
    return clip((h.mixed * fraction - h.own_way) / h.own);
}
static inline V on_other(Products h, V fraction) {
    return clip((h.mixed * fraction + h.other_way) / h.other);
}

static inline void nearer(V3 way, V3 e, V3 f, V a, V b, V *s, V *t, V *square) {
    V3 r = with(with(way, a, e), -b, f);
    V found = dot(r, r);
    Mask is = found < *square;
    *s = choose(is, a, *s), *t = choose(is, b, *t), *square = choose(is, found, *square);
}

/* Closest points of two segments: fractions along both; returns the square of their
   distance. */
static inline V nearest(V3 way, V3 e, V3 f, V *s, V *t) {
    Products h = products(way, e, f);
    V most = h.own * h.other;
    V determinant = larger(most - h.mixed * h.mixed, (T)1e-6 * most);
    V across = h.mixed * h.other_way - h.other * h.own_way;
    *t = on_other(h, clip(across / determinant)), *s = on_own(h, *t);
    V3 r = with(with(way, *s, e), -*t, f);
    V square = dot(r, r), zero = all(0), one = all(1);
    nearer(way, e, f, zero, on_other(h, zero), s, t, &square);
    nearer(way, e, f, one, on_other(h, one), s, t, &square);
    nearer(way, e, f, on_own(h, zero), zero, s, t, &square);
    nearer(way, e, f, on_own(h, one), one, s, t, &square);
    return square;
}

/* Chords of the elements of all rods, and the distances within which they touch. */
typedef struct {
    T first[3][ELEMENTS], edge[3][ELEMENTS], reach[ELEMENTS];
} Chords;

/* Squared distances of the chords of pairs less their reaches, and closest points. */
typedef struct {
    T beyond[ROUND_UP(LOOKED_AT)], s[ROUND_UP(LOOKED_AT)], t[ROUND_UP(LOOKED_AT)];
} Distances;

static void distances(const Chords *h, const int *own, const int *other, int count, T more,
                      Distances *found) {
    for (int p = 0; p < count; p += W) {
        V3 one, two, e, f;
        V far, s, t;
        for (int l = 0; l < W; l++) {
            int i = own[p + l], j = other[p + l];
            put(&one, l, h->first[0] + i, ELEMENTS), put(&e, l, h->edge[0] + i, ELEMENTS);
            put(&two, l, h->first[0] + j, ELEMENTS), put(&f, l, h->edge[0] + j, ELEMENTS);
            far[l] = h->reach[i] + h->reach[j] + more;
        }
        V beyond = nearest(minus(one, two), e, f, &s, &t) - far * far;
        memcpy(found->beyond + p, &beyond, sizeof beyond);
        memcpy(found->s + p, &s, sizeof s), memcpy(found->t + p, &t, sizeof t);
    }
}
