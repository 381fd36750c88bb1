/* Rods that touch by jaxrod's `crossing_contact`, which counts each crossing once. */
#include "contact.h"

#define FARTHEST 1.165
#define BOTH_ORDERS 0
#define INWARDS ((T)(1. / 24))
#define FLAT ((T)-0.041)
#define TANGENT ((T)-0.136)
#define NEWTON 8
#define PARALLEL ((T)1e-6)
#define CROSSED ((T)1e-5)

/* Tangents of the smooth axes of elements at both nodes, less the edges. */
static T bulges[2][3][ELEMENTS];
static T weight[ROUND_UP(ROOM)]; /* of listed pairs */

/* First node, edge and bulges of an element, from a field at the six nodes around. */
static inline void piece(const T *x, T *first, T *edge, T *one, T *two) {
    T d1 = x[2] - 2 * x[1] + x[0], d2 = x[3] - 2 * x[2] + x[1];
    T d3 = x[4] - 2 * x[3] + x[2], d4 = x[5] - 2 * x[4] + x[3];
    T y = x[2] + INWARDS * d2 + FLAT * (d3 - 2 * d2 + d1);
    T e = x[3] + INWARDS * d3 + FLAT * (d4 - 2 * d3 + d2) - y;
    *first = y, *edge = e;
    *one = (T)0.5 * (x[3] - x[1] + TANGENT * (d3 - d1)) - e;
    *two = (T)0.5 * (x[4] - x[2] + TANGENT * (d4 - d2)) - e;
}

/* The same for all elements of a rod, which is continued by reflection at its ends. */
static inline void pieces(const T *restrict x, T *restrict first, T *restrict edge,
                          T *restrict one, T *restrict two) {
    for (int i = 2; i < N - 2; i++)
        piece(x + i - 2, first + i, edge + i, one + i, two + i);
    T start[7] = {2 * x[0] - x[2], 2 * x[0] - x[1], x[0], x[1], x[2], x[3], x[4]};
    T end[7] = {x[N - 4], x[N - 3], x[N - 2], x[N - 1], x[N], 2 * x[N] - x[N - 1],
                2 * x[N] - x[N - 2]};
    for (int i = 0; i < 2; i++) {
        int j = N - 2 + i;
        piece(start + i, first + i, edge + i, one + i, two + i);
        piece(end + i, first + j, edge + j, one + j, two + j);
    }
}

static void chords(const States *s, const Law *law, Chords *h) {
    for (int k = 0; k < RODS; k++)
        for (int c = 0; c < 3; c++)
            pieces(s->rods[k].x[c], h->first[c] + k * N, h->edge[c] + k * N,
                   bulges[0][c] + k * N, bulges[1][c] + k * N);
    for (int i = 0; i < ELEMENTS; i++) {
        T size[2] = {0, 0};
        for (int c = 0; c < 3; c++)
            for (int b = 0; b < 2; b++)
                size[b] += bulges[b][c][i] * bulges[b][c][i];
        h->reach[i] = (1 + (T)0.25 * law->onset) * law->radius[i] +
                      (T)(4. / 27) * (root(size[0]) + root(size[1]));
    }
}

static T share_of(const Law *law, int i, int j) {
    T gap = most(law->start[i] - law->start[j] - law->rest_length[j],
                 law->start[j] - law->start[i] - law->rest_length[i]);
    T radius = (T)0.5 * (law->radius[i] + law->radius[j]);
    T length = (T)0.5 * (law->rest_length[i] + law->rest_length[j]);
    T share = (gap - (T)3.141592653589793 * radius) / length;
    return share < 0 ? 0 : share > 1 ? 1 : share;
}

static int may_touch(const Law *law, int i, int j) { return share_of(law, i, j) > 0; }

static void prepare(const Law *law, const List *list) {
    for (int p = 0; p < list->count; p++)
        weight[p] = RODS == 1 ? share_of(law, list->own[p], list->other[p]) : 1;
}

/* One element of each pair of a chunk. */
typedef struct {
    V3 edge, one, two;           /* its axis: the chord, and bulges at both nodes */
    V3 speed, change, rate, last; /* velocities of the first node, edge and bulges */
    V radius, follows;
} Side;

static inline V3 on_cubic(V3 edge, V3 one, V3 two, V s) {
    V rest = 1 - s;
    return with(with(times(s, edge), s * rest * rest, one), -s * s * rest, two);
}
static inline V3 on_axis(const Side *d, V s) { return on_cubic(d->edge, d->one, d->two, s); }
static inline V3 tangent(const Side *d, V s) {
    V3 u = with(d->edge, (1 - s) * (1 - 3 * s), d->one);
    return with(u, s * (3 * s - 2), d->two);
}
static inline V3 bend(const Side *d, V s) {
    return with(times(6 * s - 4, d->one), 6 * s - 2, d->two);
}
static inline V3 velocity(const Side *d, V s) {
    return plus(d->speed, on_cubic(d->change, d->rate, d->last, s));
}
static inline V3 apart(V3 way, const Side *a, const Side *b, V s, V t) {
    return minus(plus(way, on_axis(a, s)), on_axis(b, t));
}

/* One Newton step towards the closest points of two axes. */
static inline void newton(V3 way, const Side *a, const Side *b, V *s, V *t) {
    V3 r = apart(way, a, b, *s, *t), u = tangent(a, *s), v = tangent(b, *t);
    V uu = dot(u, u), vv = dot(v, v), mixed = dot(u, v);
    V own = uu + dot(r, bend(a, *s)), other = vv - dot(r, bend(b, *t));
    own = choose(own > (T)0.5 * uu, own, uu);
    other = choose(other > (T)0.5 * vv, other, vv);
    Products h = {own, other, mixed, dot(r, u) - own * *s + mixed * *t,
                  dot(r, v) + other * *t - mixed * *s};
    V most = own * other, determinant = most - mixed * mixed;
    V across = mixed * h.other_way - other * h.own_way;
    Mask convex = determinant > (T)1e-6 * most;
    V inside = clip(across / choose(convex, determinant, most));
    V border = choose(across > determinant * *s, all(1), all(0));
    *t = on_other(h, choose(convex, inside, border)), *s = on_own(h, *t);
}

/* One Newton step towards the point of an axis nearest to a node. */
static inline V to_node(V3 node, const Side *b, V t) {
    V3 r = minus(node, on_axis(b, t)), v = tangent(b, t);
    V flat = dot(v, v), bent = flat - dot(r, bend(b, t));
    return clip(t + dot(r, v) / choose(bent > (T)0.5 * flat, bent, flat));
}

/* Forces conjugate to the vector between the first nodes, to edges and to bulges. */
typedef struct {
    V3 all, own, other, own_one, own_two, other_one, other_two;
} Forces;

static inline void add(Forces *f, V s, V t, V3 force) {
    V a = s * (1 - s) * (1 - s), b = -s * s * (1 - s);
    V p = -t * (1 - t) * (1 - t), q = t * t * (1 - t);
    f->all = plus(f->all, force);
    f->own = with(f->own, s, force), f->other = with(f->other, -t, force);
    f->own_one = with(f->own_one, a, force), f->own_two = with(f->own_two, b, force);
    f->other_one = with(f->other_one, p, force), f->other_two = with(f->other_two, q, force);
}

/* Penetration at a pair of points, and the unit vector between them. */
static inline V touch(V3 way, const Side *a, const Side *b, V s, V t, V3 *normal) {
    V3 r = apart(way, a, b, s, t);
    V together = a->radius + b->radius, distance = rounded(r, together);
    *normal = times(1 / distance, r);
    return together - distance;
}

/* Spring of a pair of points that is subtracted, or added again. */
static inline V subtract(Forces *f, V3 way, const Side *a, const Side *b, V s, V t, V factor,
                         V width, const Law *law) {
    V3 normal;
    V depth = touch(way, a, b, s, t, &normal);
    V push = factor * spring(depth, width, law->stiffness);
    add(f, s, t, times(push, normal));
    return push;
}

/* Spring and dashpot at a pair of points; `left` is the dashpot's share. */
static inline void press(Forces *f, const Side *a, const Side *b, V s, V t, V depth,
                         V3 normal, V factor, V left, V width, const Law *law) {
    V leaving = dot(minus(velocity(a, s), velocity(b, t)), normal);
    V push = normal_force(depth, width, leaving, law->stiffness, law->damping);
    V at_rest = spring(depth, width, law->stiffness);
    add(f, s, t, times(factor * (at_rest + left * (push - at_rest)), normal));
}

static inline V energy(V depth, V width, T stiffness) {
    V d;
    Mask touches = started(depth, width, &d);
    V over = d - (T)0.5 * width, full = (T)0.5 * over * over + width * width / 24;
    V found = choose(d >= width, full, d * d * d / (6 * width));
    return choose(touches, stiffness * found, all(0));
}

/* Forces where the weights of closest points and midpoints change with the angle:
   `by_share`, `by_s`, `by_t` are the energy's derivatives with respect to the weight of
   closest points and, reversed, to the places of the midpoints. */
static inline void shift(Forces *f, V3 way, const Side *a, const Side *b, Products h,
                         V by_share, V by_s, V by_t) {
    V cosine = h.mixed / h.own, sine = 1 - cosine * h.mixed / h.other;
    V rise = choose((sine > PARALLEL) & (sine < CROSSED), by_share, all(0));
    rise = rise / h.other / (CROSSED - PARALLEL);
    Products d = {rise * cosine * cosine, rise * cosine * h.mixed / h.other,
                  -2 * rise * cosine, all(0), all(0)};
    for (int k = 0; k < 2; k++) {
        T end = k;
        V on = (h.mixed * end - h.own_way) / h.own;
        V slope = choose((on > 0) & (on < 1), (T)0.5 * by_s / h.own, all(0));
        d.own -= slope * on, d.mixed += slope * end, d.own_way -= slope;
        on = (h.mixed * end + h.other_way) / h.other;
        slope = choose((on > 0) & (on < 1), (T)0.5 * by_t / h.other, all(0));
        d.other -= slope * on, d.mixed += slope * end, d.other_way += slope;
    }
    f->all = with(with(f->all, d.own_way, a->edge), d.other_way, b->edge);
    f->own = with(with(with(f->own, 2 * d.own, a->edge), d.mixed, b->edge), d.own_way, way);
    f->other = with(with(with(f->other, 2 * d.other, b->edge), d.mixed, a->edge),
                    d.other_way, way);
}

/* Forces of a chunk of pairs, from the closest points s, t of their chords. */
static Forces chunk(V3 way, const Side *a, const Side *b, V weight, V s, V t,
                    const Law *law) {
    Products h = products(way, a->edge, b->edge);
    V sine = 1 - h.mixed * h.mixed / (h.own * h.other);
    V crossed = clip((sine - PARALLEL) / (CROSSED - PARALLEL)), one = all(1);
    V on_b = on_other(h, one), on_a = on_own(h, one);
    V3 last_a = plus(way, a->edge), last_b = minus(b->edge, way);
    for (int k = 0; k < NEWTON; k++) {
        newton(way, a, b, &s, &t);
        on_b = to_node(last_a, b, on_b), on_a = to_node(last_b, a, on_a);
    }
    V width = (T)0.5 * law->onset * (a->radius + b->radius);
    V3 normal, middle_normal;
    V depth = touch(way, a, b, s, t, &normal), factor = crossed * weight;
    V both = factor * spring(depth, width, law->stiffness);
    Forces f = {0};
    V left = subtract(&f, way, a, b, one, on_b, -a->follows * weight, width, law);
    left += subtract(&f, way, a, b, on_a, one, -b->follows * weight, width, law);
    left += subtract(&f, way, a, b, one, one, a->follows * b->follows * weight, width, law);
    V mid_s = all(0), mid_t = all(0), mid_depth = all(0), mid_factor = (1 - crossed) * weight;
    int parallel = largest_of(mid_factor) > 0;
    if (parallel) {
        V zero = all(0);
        mid_s = (T)0.5 * (on_own(h, zero) + on_own(h, one));
        mid_t = (T)0.5 * (on_other(h, zero) + on_other(h, one));
        mid_depth = touch(way, a, b, mid_s, mid_t, &middle_normal);
        V push = mid_factor * spring(mid_depth, width, law->stiffness);
        V more = energy(mid_depth, width, law->stiffness) -
                 energy(depth, width, law->stiffness);
        shift(&f, way, a, b, h, weight * more, push * dot(middle_normal, tangent(a, mid_s)),
              -push * dot(middle_normal, tangent(b, mid_t)));
        both += push;
    }
    left = clip((both + left) / choose(both > 0, both, one));
    press(&f, a, b, s, t, depth, normal, factor, left, width, law);
    if (parallel)
        press(&f, a, b, mid_s, mid_t, mid_depth, middle_normal, mid_factor, left, width, law);
    return f;
}

/* Adds the vector of one pair to rows of nodes. */
static inline void more(T *row, int l, V3 force, int sign) {
    row[0] += sign * force.x[l];
    row[N + 1] += sign * force.y[l], row[2 * (N + 1)] += sign * force.z[l];
}

/* Forces on the nodes of a rod, from those on its axis and on its tangents. */
static inline void from_axes(const T *restrict place, const T *restrict turn,
                             const T *restrict weight, T *restrict force) {
    T rows[4][N + 5], *p = rows[0] + 2, *m = rows[1] + 2, *u = rows[2] + 2,
                      *y = rows[3] + 2;
    memset(rows, 0, sizeof rows);
    for (int i = 1; i < N; i++) p[i] = place[i], m[i] = (T)0.5 * turn[i];
    m[0] = turn[0], m[N] = turn[N];
    for (int i = 0; i <= N; i++) u[i] = m[i - 1] - m[i + 1];
    u[0] -= m[0], u[N] += m[N];
    for (int i = 1; i < N; i++)
        y[i] = INWARDS * p[i] + TANGENT * u[i] + FLAT * (p[i - 1] - 2 * p[i] + p[i + 1]);
    for (int i = 0; i <= N; i++)
        force[i] = weight[i] + place[i] + u[i] + y[i - 1] - 2 * y[i] + y[i + 1];
}

static int contact(const States *s, const Constants *k, const List *list, const Chords *h,
                   T (*force)[3][N + 1]) {
    static Distances found;
    static T rates[4][3][ELEMENTS], on_axes[RODS][3][N + 1], on_tangents[RODS][3][N + 1];
    int kept[ROUND_UP(ROOM)], count = 0;
    const Law *law = &k->law;
    distances(h, list->own, list->other, list->count, 0, &found);
    for (int p = 0; p < list->count; p++) {
        kept[count] = p;
        count += !SKIP || found.beyond[p] <= 0;
    }
    if (!count) return 0;
    for (int r = 0; r < RODS; r++)
        for (int c = 0; c < 3; c++)
            pieces(s->rods[r].v[c], rates[0][c] + r * N, rates[1][c] + r * N,
                   rates[2][c] + r * N, rates[3][c] + r * N);
    memset(on_axes, 0, sizeof on_axes);
    memset(on_tangents, 0, sizeof on_tangents);
    for (int begin = 0; begin < count; begin += W) {
        Side sides[2];
        V3 firsts[2];
        V weights, s_of, t_of;
        for (int l = 0; l < W; l++) {
            /* The last chunk is filled up with a pair that does not count. */
            int there = begin + l < count, p = kept[there ? begin + l : begin];
            weights[l] = there ? weight[p] : 0, s_of[l] = found.s[p], t_of[l] = found.t[p];
            for (int side = 0; side < 2; side++) {
                Side *d = sides + side;
                int i = side ? list->other[p] : list->own[p];
                d->radius[l] = law->radius[i], d->follows[l] = law->follows[i];
                put(firsts + side, l, h->first[0] + i, ELEMENTS);
                put(&d->edge, l, h->edge[0] + i, ELEMENTS);
                put(&d->one, l, bulges[0][0] + i, ELEMENTS);
                put(&d->two, l, bulges[1][0] + i, ELEMENTS);
                put(&d->speed, l, rates[0][0] + i, ELEMENTS);
                put(&d->change, l, rates[1][0] + i, ELEMENTS);
                put(&d->rate, l, rates[2][0] + i, ELEMENTS);
                put(&d->last, l, rates[3][0] + i, ELEMENTS);
            }
        }
        V3 way = minus(firsts[0], firsts[1]);
        Forces f = chunk(way, sides, sides + 1, weights, s_of, t_of, law);
        V3 own_next = minus(f.own, plus(f.own_one, f.own_two));
        V3 other_next = minus(f.other, plus(f.other_one, f.other_two));
        V3 own_first = minus(f.all, own_next), other_first = plus(f.all, other_next);
        for (int l = 0; l < W && begin + l < count; l++) {
            int i = list->own[kept[begin + l]], j = list->other[kept[begin + l]];
            int a = rod_of(i), b = rod_of(j);
            T *at = on_axes[a][0] + i - a * N, *turn = on_tangents[a][0] + i - a * N;
            more(at, l, own_first, 1), more(at + 1, l, own_next, 1);
            more(turn, l, f.own_one, 1), more(turn + 1, l, f.own_two, 1);
            at = on_axes[b][0] + j - b * N, turn = on_tangents[b][0] + j - b * N;
            more(at, l, other_first, -1), more(at + 1, l, other_next, 1);
            more(turn, l, f.other_one, 1), more(turn + 1, l, f.other_two, 1);
        }
    }
    for (int r = 0; r < RODS; r++)
        for (int c = 0; c < 3; c++)
            from_axes(on_axes[r][c], on_tangents[r][c], k->rods[r].force[c], force[r][c]);
    return count;
}

#include "contact_steps.h"
