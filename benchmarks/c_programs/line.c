/* Rods that touch by jaxrod's `rod_contact`, per length of contact. */
#ifndef POINTS
#define POINTS 6 /* contact points of an element before its second node */
#endif
#include "contact.h"

#define FARTHEST 1
#define BOTH_ORDERS 1
#define PI ((T)3.141592653589793)

static T lengths[POINTS + 1][ROUND_UP(ROOM)];

static void chords(const States *s, const Law *law, Chords *h) {
    for (int k = 0; k < RODS; k++)
        for (int c = 0; c < 3; c++) {
            const T *x = s->rods[k].x[c];
            for (int i = 0; i < N; i++) {
                h->first[c][k * N + i] = x[i];
                h->edge[c][k * N + i] = x[i + 1] - x[i];
            }
        }
    for (int i = 0; i < ELEMENTS; i++)
        h->reach[i] =
            (1 + (T)0.25 * law->onset) * most(law->radius[i], law->first_radius[i]);
}

static int may_touch(const Law *law, int i, int j) {
    T apart = most(law->start[j] - law->start[i], law->start[i] + law->rest_length[i] -
                                                      law->start[j] - law->rest_length[j]);
    return apart > PI * law->radius[j];
}

/* Rest lengths that the points of each listed element represent, times their shares. */
static void prepare(const Law *law, const List *list) {
    for (int q = 0; q <= POINTS; q++)
        for (int p = 0; p < list->count; p++) {
            int i = list->own[p], j = list->other[p];
            T spacing = law->rest_length[i] / POINTS;
            T place = law->start[i] + q * ((T)1 / POINTS) * law->rest_length[i];
            T gap = most(place - law->start[j] - law->rest_length[j], law->start[j] - place);
            T share = (gap - PI * law->radius[j]) / law->rest_length[j];
            share = share < 0 ? 0 : share > 1 ? 1 : share;
            T length = q == 0        ? law->first_length[i]
                       : q == POINTS ? (T)0.5 * law->last[i] * spacing
                                     : spacing;
            lengths[q][p] = (T)0.5 * length * (RODS == 1 ? share : 1);
        }
}

/* Force of a point on a segment, or on its second node. */
static inline V3 pressed(V3 way, V3 speed, V together, V factor, const Law *law) {
    V distance = rounded(way, together), inverse = 1 / distance;
    V push = normal_force(together - distance, (T)0.5 * law->onset * together,
                          inverse * dot(speed, way), law->stiffness, law->damping);
    return times(factor * push * inverse, way);
}

/* Elements of a chunk of pairs. */
typedef struct {
    V3 first, edge, speed, change; /* of the velocity from node to node */
    V radius, first_radius, follows;
} Side;

/* Adds the vector of one pair to rows of nodes. */
static inline void more(T *row, int l, V3 force, int sign) {
    row[0] += sign * force.x[l];
    row[N + 1] += sign * force.y[l], row[2 * (N + 1)] += sign * force.z[l];
}

/* Listed pairs of which a point may touch the other element; returns their number. */
static int near_pairs(const List *list, const Chords *h, int *kept) {
    int count = 0;
    for (int begin = 0; begin < list->count; begin += W) {
        V3 one, two, e, f;
        V far;
        for (int l = 0; l < W; l++) {
            int i = list->own[begin + l], j = list->other[begin + l];
            put(&one, l, h->first[0] + i, ELEMENTS), put(&e, l, h->edge[0] + i, ELEMENTS);
            put(&two, l, h->first[0] + j, ELEMENTS), put(&f, l, h->edge[0] + j, ELEMENTS);
            far[l] = h->reach[i] + h->reach[j];
        }
        V3 way = minus(one, two);
        V inverse = 1 / dot(f, f), along = inverse * dot(way, f);
        V step = inverse * dot(e, f), beyond = far;
        for (int q = 0; q <= POINTS; q++) {
            T fraction = q * ((T)1 / POINTS);
            V3 r = with(with(way, all(fraction), e), -clip(along + fraction * step), f);
            beyond = smaller(beyond, dot(r, r) - far * far);
        }
        for (int l = 0; l < W && begin + l < list->count; l++) {
            kept[count] = begin + l;
            count += !SKIP || beyond[l] <= 0;
        }
    }
    return count;
}

static int contact(const States *s, const Constants *k, const List *list, const Chords *h,
                   T (*force)[3][N + 1]) {
    const Law *law = &k->law;
    int kept[ROUND_UP(ROOM)], count = near_pairs(list, h, kept);
    if (!count) return 0;
    for (int r = 0; r < RODS; r++) memcpy(force[r], k->rods[r].force, sizeof force[r]);
    for (int begin = 0; begin < count; begin += W) {
        Side sides[2], *a = sides, *b = sides + 1;
        V length[POINTS + 1];
        for (int l = 0; l < W; l++) {
            /* The last chunk is filled up with a pair that does not count. */
            int there = begin + l < count, p = kept[there ? begin + l : begin];
            for (int q = 0; q <= POINTS; q++) length[q][l] = there ? lengths[q][p] : 0;
            for (int side = 0; side < 2; side++) {
                Side *d = sides + side;
                int i = side ? list->other[p] : list->own[p], r = rod_of(i);
                const T *v = s->rods[r].v[0] + i - r * N;
                d->radius[l] = law->radius[i], d->first_radius[l] = law->first_radius[i];
                d->follows[l] = law->follows[i];
                put(&d->first, l, h->first[0] + i, ELEMENTS);
                put(&d->edge, l, h->edge[0] + i, ELEMENTS);
                put(&d->speed, l, v, N + 1), put(&d->change, l, v + 1, N + 1);
            }
        }
        V3 way = minus(a->first, b->first), speed = minus(a->speed, b->speed);
        a->change = minus(a->change, a->speed), b->change = minus(b->change, b->speed);
        V3 sum = {0}, own_next = {0}, other_next = {0};
        V square = dot(b->edge, b->edge);
        for (int q = 0; q <= POINTS; q++) {
            V fraction = all(q * ((T)1 / POINTS));
            V together = (q ? a->radius : a->first_radius) + b->radius;
            V3 r = with(way, fraction, a->edge), u = with(speed, fraction, a->change);
            V t = clip(dot(r, b->edge) / square);
            V3 at = with(r, -t, b->edge);
            V near = (1 + (T)0.25 * law->onset) * together;
            if (SKIP && largest_of(near * near - dot(at, at)) <= 0) continue;
            V3 on = pressed(at, with(u, -t, b->change), together, length[q], law);
            V3 off = pressed(minus(r, b->edge), minus(u, b->change), together,
                             -b->follows * length[q], law);
            other_next = plus(with(other_next, t, on), off);
            on = plus(on, off), sum = plus(sum, on), own_next = with(own_next, fraction, on);
        }
        V3 own_first = minus(sum, own_next), other_first = minus(sum, other_next);
        for (int l = 0; l < W && begin + l < count; l++) {
            int i = list->own[kept[begin + l]], j = list->other[kept[begin + l]];
            T *at = force[rod_of(i)][0] + i - rod_of(i) * N;
            more(at, l, own_first, 1), more(at + 1, l, own_next, 1);
            at = force[rod_of(j)][0] + j - rod_of(j) * N;
            more(at, l, other_first, -1), more(at + 1, l, other_next, -1);
        }
    }
    return count;
}

#include "contact_steps.h"
