/* One clamped, damped rod under gravity. */
#include "rod.h"

void advance(State *s, const Rod *r, double dt, int steps) {
    unsigned mode = flush_small_numbers();
    drift(s, r, (T)(0.5 * dt));
    for (int k = 1; k < steps; k++) {
        kick(s, r, r->force);
        drift(s, r, (T)dt);
    }
    kick(s, r, r->force);
    drift(s, r, (T)(0.5 * dt));
    restore(mode);
}
