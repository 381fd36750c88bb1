/* Steps of rods that touch, for a law that has

     FARTHEST      how much farther than its nodes a point of an axis can move
     BOTH_ORDERS   whether each pair of elements is listed in both orders
     chords        chords of all elements and their reaches, from positions
     may_touch     whether a first and a second element of one rod may touch
     prepare       whatever stays the same as long as a list does
     contact       total forces on nodes; returns the number of pairs not left out */

static void search(const States *s, const Law *law, const Chords *h, List *list,
                   States *record) {
    static int own[ROUND_UP(LOOKED_AT)], other[ROUND_UP(LOOKED_AT)];
    static Distances found;
    static T middle[3][ELEMENTS], far[ELEMENTS];
    for (int i = 0; i < ELEMENTS; i++) {
        T square = 0;
        for (int c = 0; c < 3; c++) {
            T e = h->edge[c][i];
            square += e * e;
            middle[c][i] = h->first[c][i] + (T)0.5 * e;
        }
        far[i] = (T)0.5 * (root(square) + law->skin) + h->reach[i];
    }
    int count = 0, taken = 0;
    for (int i = 0; i < N; i++) {
        unsigned char near[N];
        int start = RODS == 1 ? 0 : N;
        T x = middle[0][i], y = middle[1][i], z = middle[2][i], reach = far[i];
        for (int j = 0; j < N; j++) {
            T a = x - middle[0][start + j], b = y - middle[1][start + j];
            T c = z - middle[2][start + j], d = reach + far[start + j];
            near[j] = a * a + b * b + c * c <= d * d;
        }
        for (int j = RODS == 1 ? i + 1 : 0; j < N; j++)
            if (near[j] && count < LOOKED_AT) {
                own[count] = i, other[count] = start + j;
                count++;
            }
    }
    distances(h, own, other, count, law->skin, &found);
    for (int order = 0; order <= BOTH_ORDERS; order++)
        for (int p = 0; p < count; p++) {
            int i = order ? other[p] : own[p], j = order ? own[p] : other[p];
            if (found.beyond[p] > 0 || (RODS == 1 && !may_touch(law, i, j))) continue;
            if (taken < ROOM) list->own[taken] = i, list->other[taken] = j;
            taken++;
        }
    /* jaxrod has one list for each order of two rods. */
    T used = (T)taken / (RODS == 2 && BOTH_ORDERS ? 2 : 1);
    list->count = taken < ROOM ? taken : ROOM;
    record->missed = most(record->missed, most(taken - ROOM, count - LOOKED_AT));
    record->used = most(record->used, used);
    for (int p = list->count; p < ROUND_UP(ROOM); p++) list->own[p] = list->other[p] = 0;
    for (int k = 0; k < RODS; k++) memcpy(list->places[k], s->rods[k].x, sizeof s->rods[k].x);
    prepare(law, list);
}

/* Largest displacement of a node since the search, over half the skin. */
static T moved(const States *s, const Law *law, const List *list) {
    T worst = 0;
    for (int k = 0; k < RODS; k++)
        for (int i = 0; i <= N; i++) {
            T square = 0;
            for (int c = 0; c < 3; c++) {
                T way = s->rods[k].x[c][i] - list->places[k][c][i];
                square += way * way;
            }
            worst = most(worst, square);
        }
    return (T)FARTHEST * root(worst) / ((T)0.5 * law->skin);
}

static void kick_all(States *s, const Constants *k, List *list, int step) {
    static Chords h;
    static T force[RODS][3][N + 1];
    chords(s, &k->law, &h);
    if (step % EVERY == 0) search(s, &k->law, &h, list, s);
    s->moved = most(s->moved, moved(s, &k->law, list));
    int kept = contact(s, k, list, &h, force);
    s->kept += kept;
    for (int i = 0; i < RODS; i++)
        kick(&s->rods[i], &k->rods[i], kept ? force[i] : k->rods[i].force);
}

static void drift_all(States *s, const Constants *k, T dt) {
    for (int i = 0; i < RODS; i++) drift(&s->rods[i], &k->rods[i], dt);
}

void advance(States *s, const Constants *k, double dt, int steps) {
    unsigned mode = flush_small_numbers();
    static List list;
    drift_all(s, k, (T)(0.5 * dt));
    for (int step = 0; step < steps - 1; step++) {
        kick_all(s, k, &list, step);
        drift_all(s, k, (T)dt);
    }
    kick_all(s, k, &list, steps - 1);
    drift_all(s, k, (T)(0.5 * dt));
    restore(mode);
}
