/* Two rods: the last node of the first and the first node of the second are one. */
#include "rod.h"

typedef struct {
    State one, two;
} States;
typedef struct {
    Rod one, two;
    T share; /* mass of the second rod's node over that of both */
} Rods;

static inline void together(T *a, T *b, T share) {
    for (int c = 0; c < 3; c++) {
        T *own = a + c * (N + 1) + N, *other = b + c * (N + 1);
        *own = *other = *own + share * (*other - *own);
    }
}

static inline void drift_both(States *s, const Rods *r, T dt) {
    drift(&s->one, &r->one, dt);
    drift(&s->two, &r->two, dt);
    together(s->one.x[0], s->two.x[0], r->share);
}

static inline void kick_both(States *s, const Rods *r) {
    kick(&s->one, &r->one, r->one.force);
    kick(&s->two, &r->two, r->two.force);
    together(s->one.v[0], s->two.v[0], r->share);
}

void advance(States *s, const Rods *r, double dt, int steps) {
    unsigned mode = flush_small_numbers();
    drift_both(s, r, (T)(0.5 * dt));
    for (int k = 1; k < steps; k++) {
        kick_both(s, r);
        drift_both(s, r, (T)dt);
    }
    kick_both(s, r);
    drift_both(s, r, (T)(0.5 * dt));
    restore(mode);
}
