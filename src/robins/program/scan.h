/* Rounds of a program for some runs, RUNS of them at a time: a Real and a Whole are so many numbers,
   one of each run. */

typedef struct {
    char *data;      /* of the first run and round */
    int64_t runs;    /* how many are there: what others give is not kept */
    int64_t run;     /* bytes from one run to the next, 0 where all share one */
    int64_t round;   /* bytes from one round to the next */
    int64_t size;    /* numbers in a round */
    int64_t kind;    /* 0 double, 1 flag of a byte, 2 int32, 3 int64, 4 uint32, 5 uint64 */
} rows;

/* Rounds that are taken and given together: from the runs, which lie far from each other, into
   lanes, one array after the other, so that memory is read and written in its order. */
#define AHEAD 4096 /* numbers of a lane */

#define MOVED(type)                                                                    \
    for (int l = 0; l < RUNS; ++l) { /* lanes without a run repeat the last */        \
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

template <int RUNS, class Real, class Whole>
static void take(const rows *a, int64_t run, int active, span s, Real *x, int reals, Whole *k,
                 int others)
{
    const int64_t first = s.first, count = s.count, step = s.step;
    if (a->kind == 0) {
        Real *const to = x;
        const int width = reals;
        MOVED(double)
        return;
    }
    Whole *const to = k;
    const int width = others;
    switch (a->kind) {
    case 1: MOVED(uint8_t) break;
    case 2: MOVED(int32_t) break;
    case 3: MOVED(int64_t) break;
    case 4: MOVED(uint32_t) break;
    default: MOVED(int64_t) break;
    }
}

template <int RUNS, class Real, class Whole>
static void give(const rows *a, int64_t run, int active, span s, const Real *y, int reals,
                 const Whole *m, int others)
{
    const int64_t first = s.first, count = s.count, step = s.step;
    if (a->kind == 0) {
        const Real *const from = y;
        const int width = reals;
        GIVEN(double)
        return;
    }
    const Whole *const from = m;
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
#define EACH_ARRAY(what, count, arrays, span, x, reals, k, others)                         \
    for (int j = 0, r = 0, o = 0; j < (count); ++j) {                                      \
        what<RUNS>(&(arrays)[j], run, active, span, (x) + r, reals, (k) + o, others);               \
        if ((arrays)[j].kind == 0) { r += (int)(arrays)[j].size; } else { o += (int)(arrays)[j].size; } \
    }

static void counted(const rows *a, int64_t count, int *reals, int *others)
{
    *reals = *others = 0;
    for (int j = 0; j < count; ++j) { *(a[j].kind == 0 ? reals : others) += (int)a[j].size; }
}

/* A scan: arrays in and out (carried, fixed, taken; carried, given), and their counts. */
typedef struct {
    int64_t runs, rounds, backwards, carried, fixed, taken, given;
    const rows *in, *out;
} scan;

/* Step by step, `step(x, k, y, m)`: of reals and others in x and k those that are carried, those
   that stay and a row; in y and m what is carried on, and a row. Returns 0, or 1 where there is no
   memory. */
template <int RUNS, class Real, class Whole, class Step>
static int scanned(const scan *s, Step step, Real *x, Whole *k, Real *y, Whole *m)
{
    const rows *const in = s->in, *const out = s->out, *const row = in + s->carried + s->fixed;
    int cr, co, fr, fo, tr, to, gr, go;
    counted(in, s->carried, &cr, &co);
    counted(in + s->carried, s->fixed, &fr, &fo);
    counted(row, s->taken, &tr, &to);
    counted(out + s->carried, s->given, &gr, &go);
    const int widest = tr + to > gr + go ? tr + to : gr + go;
    const int64_t ahead = widest < AHEAD ? AHEAD / (widest > 0 ? widest : 1) : 1;
    const size_t total = (size_t)(ahead * (tr + to + gr + go) + 8) * sizeof(Real);
    char *const memory = (char *)malloc(total);
    if (memory == NULL) { return 1; }
    Real *const xs = (Real *)memory, *const ys = xs + ahead * tr;
    Whole *const ks = (Whole *)(ys + ahead * gr), *const ms = ks + ahead * to;
    const span once = {0, 1, 1};
    for (int64_t run = 0; run < s->runs; run += RUNS) {
        const int active = run + RUNS <= s->runs ? RUNS : (int)(s->runs - run);
        EACH_ARRAY(take, s->carried + s->fixed, in, once, x, 0, k, 0)
        for (int64_t begin = 0; begin < s->rounds; begin += ahead) {
            const int64_t left = s->rounds - begin, count = left < ahead ? left : ahead;
            const span now = {s->backwards ? s->rounds - 1 - begin : begin, count,
                              s->backwards ? -1 : 1};
            EACH_ARRAY(take, s->taken, row, now, xs, tr, ks, to)
            for (int64_t t = 0; t < count; ++t) {
                memcpy(x + cr + fr, xs + t * tr, (size_t)tr * sizeof(Real));
                memcpy(k + co + fo, ks + t * to, (size_t)to * sizeof(Whole));
                step(x, k, y, m);
                memcpy(x, y, (size_t)cr * sizeof(Real));
                memcpy(k, m, (size_t)co * sizeof(Whole));
                memcpy(ys + t * gr, y + cr, (size_t)gr * sizeof(Real));
                memcpy(ms + t * go, m + co, (size_t)go * sizeof(Whole));
            }
            EACH_ARRAY(give, s->given, out + s->carried, now, ys, gr, ms, go)
        }
        EACH_ARRAY(give, s->carried, out, once, x, 0, k, 0)
    }
    free(memory);
    return 0;
}
