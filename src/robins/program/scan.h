/* A scan over lanes: the rounds of a program, for so many runs, LANES of them at a time. It stands
   behind the program, whose counts of numbers are NX, NK (taken) and NY, NM (given). */

typedef struct {
    char *data;      /* of the first run and round */
    int64_t runs;    /* how many are there: what others give is not kept */
    int64_t run;     /* bytes from one run to the next, 0 where all share one */
    int64_t round;   /* bytes from one round to the next */
    int32_t size;    /* numbers in a round */
    int32_t kind;    /* 0 double, 1 flag of a byte, 2 int32, 3 int64, 4 uint32, 5 uint64 */
} rows;

/* Rounds that are taken and given together: from the runs, which lie far from each other, into
   lanes, one array after the other, so that memory is read and written in its order. */
#define AHEAD 4096 /* numbers of a lane */

#define MOVED(type)                                                                    \
    for (int l = 0; l < LANES; ++l) { /* lanes without a run repeat the last */        \
        const char *from = a->data + (run + (l < active ? l : active - 1)) * a->run;   \
        for (int64_t t = 0; t < count; ++t) {                                          \
            const type *at = (const type *)(from + (first + t * step) * a->round);     \
            for (int i = 0; i < a->size; ++i) { to[t * width + i][l] = at[i]; }        \
        }                                                                              \
    }
#define GIVEN(type)                                                                    \
    for (int l = 0; l < active && run + l < a->runs; ++l) {                            \
        char *into = a->data + (run + l) * a->run;                                     \
        for (int64_t t = 0; t < count; ++t) {                                          \
            type *at = (type *)(into + (first + t * step) * a->round);                 \
            for (int i = 0; i < a->size; ++i) { at[i] = (type)from[t * width + i][l]; } \
        }                                                                              \
    }

typedef struct {
    int64_t first, count, step; /* rounds */
} span;

static void take(const rows *a, int64_t run, int active, span s, real *x, int reals, whole *k,
                 int others)
{
    const int64_t first = s.first, count = s.count, step = s.step;
    if (a->kind == 0) {
        real *const to = x;
        const int width = reals;
        MOVED(double)
        return;
    }
    whole *const to = k;
    const int width = others;
    switch (a->kind) {
    case 1: MOVED(uint8_t) break;
    case 2: MOVED(int32_t) break;
    case 3: MOVED(int64_t) break;
    case 4: MOVED(uint32_t) break;
    default: MOVED(int64_t) break;
    }
}

static void give(const rows *a, int64_t run, int active, span s, const real *y, int reals,
                 const whole *m, int others)
{
    const int64_t first = s.first, count = s.count, step = s.step;
    if (a->kind == 0) {
        const real *const from = y;
        const int width = reals;
        GIVEN(double)
        return;
    }
    const whole *const from = m;
    const int width = others;
    switch (a->kind) {
    case 1: GIVEN(uint8_t) break;
    case 2: GIVEN(int32_t) break;
    case 3: GIVEN(int64_t) break;
    case 4: GIVEN(uint32_t) break;
    default: GIVEN(int64_t) break;
    }
}

/* All of some arrays: each takes its place behind those before it. */
#define EACH(what, count, arrays, s, x, reals, k, others)                                  \
    for (int j = 0, r = 0, o = 0; j < (count); ++j) {                                      \
        what(&(arrays)[j], run, active, s, (x) + r, reals, (k) + o, others);               \
        if ((arrays)[j].kind == 0) { r += (arrays)[j].size; } else { o += (arrays)[j].size; } \
    }

static void counted(const rows *a, int count, int *reals, int *others)
{
    *reals = *others = 0;
    for (int j = 0; j < count; ++j) { *(a[j].kind == 0 ? reals : others) += a[j].size; }
}

/* in: what is carried, what stays, the rows taken; out: what is carried, the rows given. Returns
   0, or 1 where there is no memory. */
extern "C" int robins_scan(int64_t runs, int64_t rounds, int32_t backwards, int32_t carried,
                           int32_t fixed, int32_t taken, int32_t given, const rows *in,
                           const rows *out)
{
    const rows *const row = in + carried + fixed;
    int cr, co, fr, fo, tr, to, gr, go;
    counted(in, carried, &cr, &co);
    counted(in + carried, fixed, &fr, &fo);
    counted(row, taken, &tr, &to);
    counted(out + carried, given, &gr, &go);
    const int widest = tr + to > gr + go ? tr + to : gr + go;
    const int64_t ahead = widest < AHEAD ? AHEAD / (widest > 0 ? widest : 1) : 1;
    const size_t total = (size_t)(ahead * (tr + to + gr + go) + 8) * sizeof(real);
    char *const memory = (char *)malloc(total);
    if (memory == NULL) { return 1; }
    real *const xs = (real *)memory, *const ys = xs + ahead * tr;
    whole *const ks = (whole *)(ys + ahead * gr), *const ms = ks + ahead * to;
    const span once = {0, 1, 1};
    for (int64_t run = 0; run < runs; run += LANES) {
        const int active = run + LANES <= runs ? LANES : (int)(runs - run);
        real x[NX], y[NY];
        whole k[NK], m[NM];
        EACH(take, carried + fixed, in, once, x, 0, k, 0)
        for (int64_t begin = 0; begin < rounds; begin += ahead) {
            const int64_t left = rounds - begin, count = left < ahead ? left : ahead;
            const span s = {backwards ? rounds - 1 - begin : begin, count, backwards ? -1 : 1};
            EACH(take, taken, row, s, xs, tr, ks, to)
            for (int64_t t = 0; t < count; ++t) {
                memcpy(x + cr + fr, xs + t * tr, (size_t)tr * sizeof(real));
                memcpy(k + co + fo, ks + t * to, (size_t)to * sizeof(whole));
                robins_step(x, k, y, m);
                memcpy(x, y, (size_t)cr * sizeof(real));
                memcpy(k, m, (size_t)co * sizeof(whole));
                memcpy(ys + t * gr, y + cr, (size_t)gr * sizeof(real));
                memcpy(ms + t * go, m + co, (size_t)go * sizeof(whole));
            }
            EACH(give, given, out + carried, s, ys, gr, ms, go)
        }
        EACH(give, carried, out, once, x, 0, k, 0)
    }
    free(memory);
    return 0;
}

extern "C" int robins_lanes(void) { return LANES; }
