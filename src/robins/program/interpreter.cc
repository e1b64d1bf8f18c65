/* The machine: an interpreter of programs of scalars, compiled once for all programs.

   An instruction is one operation on WIDTH runs; a register is a row of as many numbers, 8 bytes
   each. One text makes two machines: for one run, with the scalars of `scalars.h` (-DONE_RUN), and
   for FEW, SOME or MANY runs, with those of `lanes.h`. Operations and routines are the functions
   that compiled programs call, so that results have the same bits. */
#include "finite.h"
#ifdef ONE_RUN
#include "scalars.h"
#define FEW 1
#define SOME 1
#define MANY 1
#define LANES 1
#else
#include "lanes.h"
#define FEW 8
#define SOME 32
#define MANY 64
#endif
#include "sine.h"
#include "routines.h"
#include "operations.h"
#include <stdlib.h>
#include "scan.h"

/* Operators of C in a compiled program. */
#define OPERATOR(kind, name, sign) \
    static inline kind kind##_##name(kind a, kind b) { return (kind)(a sign b); }
#define ARITHMETIC(kind) OPERATOR(kind, add, +) OPERATOR(kind, sub, -) OPERATOR(kind, mul, *)
#define BITS(kind) OPERATOR(kind, and, &) OPERATOR(kind, or, |) OPERATOR(kind, xor, ^)
ARITHMETIC(real) ARITHMETIC(whole) ARITHMETIC(word) ARITHMETIC(word64)
BITS(flag) BITS(whole) BITS(word) BITS(word64)
static inline real real_neg(real a) { return -a; }
static inline whole whole_neg(whole a) { return -a; }

/* Beside operations: a product added to, taken from, or less a number; selects; moves; entries of
   an array by an index; routines on arrays; rounds of loops. */
#define FOR_EACH_KIND(DO) DO(real) DO(flag) DO(whole) DO(word) DO(word64)
#define FOR_EACH_CONTROL(DO) \
    DO(multiply_add) DO(multiply_subtract) DO(multiply_less) DO(move) \
    DO(real_select) DO(flag_select) DO(whole_select) DO(word_select) DO(word64_select) \
    DO(real_pick) DO(flag_pick) DO(whole_pick) DO(word_pick) DO(word64_pick) \
    DO(product) DO(cholesky) DO(solve_lower) DO(triangle) DO(householder) DO(eigh) DO(lu) \
    DO(begin) DO(round) DO(take) DO(keep) DO(again) DO(leave_unless)

#define CODE1(result, kind, function) CODE_##function,
#define CODE(name) CODE_##name,
enum { FOR_EACH_OPERATION(CODE1, CODE1) FOR_EACH_CONTROL(CODE) CODES };

#define NAME1(result, kind, function) #function ","
#define NAME(name) #name ","
extern "C" const char *robins_codes(void)
{
    return FOR_EACH_OPERATION(NAME1, NAME1) FOR_EACH_CONTROL(NAME);
}
extern "C" int robins_width(void) { return MANY; }

#ifdef ONE_RUN
/* The generation of this processor: of x86-64 1, 3 or 4, of others 0. */
extern "C" int robins_generation(void)
{
#ifdef __x86_64__
#define HAS(what) __builtin_cpu_supports(what)
    __builtin_cpu_init();
    if (!(HAS("avx2") && HAS("bmi") && HAS("bmi2") && HAS("fma"))) { return 1; }
    const int wide = HAS("avx512f") && HAS("avx512bw") && HAS("avx512cd");
    return wide && HAS("avx512dq") && HAS("avx512vl") ? 4 : 3;
#else
    return 0;
#endif
}
#endif

#define VECTORS (WIDTH / LANES)
#define ROW(kind, k) ((kind *)(registers + (size_t)(k) * WIDTH))
#define EACH for (int v = 0; v < VECTORS; ++v)

/* A call of a routine: its registers are gathered, vector by vector, and its results lie in
   registers one after the other. */
#define GATHERED(call)                                                           \
    {                                                                            \
        const int32_t *q = lists + p[2];                                         \
        const int m = q[0], n = q[1], width = q[2], taken = q[3], made = p[3];   \
        (void)m, (void)n, (void)width;                                           \
        real *const in = (real *)scratch, *const out = in + taken;               \
        q += 4;                                                                  \
        EACH {                                                                   \
            for (int i = 0; i < taken; ++i) { in[i] = ROW(real, q[i])[v]; }      \
            call;                                                                \
            for (int i = 0; i < made; ++i) { ROW(real, p[1] + i)[v] = out[i]; }  \
        }                                                                        \
    }                                                                            \
    break;

/* Instructions are five numbers: operation, result, and three arguments. */
template <int WIDTH>
static void execute(const int32_t *code, int64_t count, const int32_t *lists, int64_t *registers,
                    char *scratch)
{
    int32_t rounds[16];
    for (const int32_t *p = code, *const end = code + 5 * count; p < end; p += 5) {
        switch (p[0]) {
#define CASE1(result, kind, function)                                              \
    case CODE_##function: {                                                        \
        result *const d = ROW(result, p[1]);                                       \
        const kind *const a = ROW(kind, p[2]);                                     \
        EACH { d[v] = function(a[v]); }                                            \
    } break;
#define CASE2(result, kind, function)                                              \
    case CODE_##function: {                                                        \
        result *const d = ROW(result, p[1]);                                       \
        const kind *const a = ROW(kind, p[2]), *const b = ROW(kind, p[3]);         \
        EACH { d[v] = function(a[v], b[v]); }                                      \
    } break;
            FOR_EACH_OPERATION(CASE1, CASE2)
#define CASE3(code, expression)                                                    \
    case code: {                                                                   \
        real *const d = ROW(real, p[1]);                                           \
        const real *const a = ROW(real, p[2]), *const b = ROW(real, p[3]);         \
        const real *const c = ROW(real, p[4]);                                     \
        EACH { d[v] = expression; }                                                \
    } break;
            CASE3(CODE_multiply_add, c[v] + a[v] * b[v])
            CASE3(CODE_multiply_subtract, c[v] - a[v] * b[v])
            CASE3(CODE_multiply_less, a[v] * b[v] - c[v])
        case CODE_move: memmove(ROW(real, p[1]), ROW(real, p[2]), 8 * WIDTH); break;
#define SELECT(kind)                                                               \
    case CODE_##kind##_select: {                                                   \
        kind *const d = ROW(kind, p[1]);                                           \
        const flag *const c = ROW(flag, p[2]);                                     \
        const kind *const a = ROW(kind, p[3]), *const b = ROW(kind, p[4]);         \
        EACH { d[v] = kind##_select(c[v], a[v], b[v]); }                           \
    } break;
            FOR_EACH_KIND(SELECT)
#ifdef ONE_RUN
#define PICK(kind)                                                                 \
    case CODE_##kind##_pick:                                                       \
        *ROW(kind, p[1]) = *ROW(kind, lists[p[2] + *ROW(whole, p[3])]);            \
        break;
#else
#define PICK(kind)                                                                 \
    case CODE_##kind##_pick: {                                                     \
        const int32_t *const q = lists + p[2];                                     \
        EACH {                                                                     \
            const whole k = ROW(whole, p[3])[v];                                   \
            kind d = {};                                                           \
            for (int i = 0; i < LANES; ++i) { d[i] = ROW(kind, q[k[i]])[v][i]; }   \
            ROW(kind, p[1])[v] = d;                                                \
        }                                                                          \
    } break;
#endif
            FOR_EACH_KIND(PICK)
        case CODE_product: GATHERED(product(m, n, width, in, in + m * n, out))
        case CODE_cholesky: GATHERED(cholesky(m, in, out))
        case CODE_solve_lower: GATHERED(solve_lower(m, n, in, in + m * m, out))
        case CODE_triangle: GATHERED(triangle(m, n, width, in, out))
        case CODE_householder: GATHERED(householder(m, n, width, in, out))
        case CODE_eigh: GATHERED(eigh(m, in, out))
        case CODE_lu: GATHERED(lu(m, n, in, out))
        case CODE_begin: rounds[p[1]] = 0; break;
        case CODE_round: EACH { ROW(whole, p[1])[v] = WHOLE(rounds[p[2]]); } break;
        case CODE_take: /* the entry of an array for this round */
            memcpy(ROW(real, p[1]), ROW(real, lists[p[2] + rounds[p[3]]]), 8 * WIDTH);
            break;
        case CODE_keep:
            memcpy(ROW(real, p[1] + rounds[p[3]]), ROW(real, p[2]), 8 * WIDTH);
            break;
        case CODE_again: /* the next round, if there is one */
            if (++rounds[p[1]] < p[2]) { p = code + 5 * ((int64_t)p[3] - 1); }
            break;
        case CODE_leave_unless: { /* a loop, when its condition holds for no run */
            int some = 0;
            EACH { some |= ANY(ROW(flag, p[1])[v]); }
            if (!some) { p = code + 5 * ((int64_t)p[2] - 1); }
        } break;
        default: abort();
        }
    }
}

/* A program as the machine takes it. */
typedef struct {
    const int32_t *code;
    const int32_t *lists;       /* arguments of routines, entries of arrays */
    const int64_t *constants;   /* pairs: register, bits */
    const int32_t *results;     /* registers: NY reals, then NM others */
    int64_t codes, constant_count;
    int64_t registers, scratch; /* rows */
    int64_t nx, nk, ny, nm;     /* reals and others that are taken, and given */
} tape;

extern "C" int64_t robins_bytes(const tape *t)
{
    return (t->registers + t->scratch + 1) * (int64_t)(8 * MANY);
}

/* Registers with their constants, in memory of `robins_bytes`, aligned. */
template <int WIDTH> static void prepare(const tape *t, int64_t *registers)
{
    memset(registers, 0, (size_t)(t->registers + t->scratch + 1) * 8 * WIDTH);
    for (int64_t k = 0; k < t->constant_count; ++k) {
        int64_t *const row = ROW(int64_t, t->constants[2 * k]);
        for (int i = 0; i < WIDTH; ++i) { row[i] = t->constants[2 * k + 1]; }
    }
}

#ifdef ONE_RUN
extern "C" void robins_prepare(const tape *t, int64_t *registers) { prepare<1>(t, registers); }

/* A step in registers that are prepared. */
extern "C" void robins_step(const tape *t, int64_t *registers, const double *x, const int64_t *k,
                            double *y, int64_t *m)
{
    memcpy(registers, x, (size_t)t->nx * 8);
    memcpy(registers + t->nx, k, (size_t)t->nk * 8);
    execute<1>(t->code, t->codes, t->lists, registers, (char *)(registers + t->registers));
    const int32_t *from = t->results;
    for (int i = 0; i < t->ny; ++i) { y[i] = ((double *)registers)[*from++]; }
    for (int i = 0; i < t->nm; ++i) { m[i] = registers[*from++]; }
}
#endif

template <class Number, int WIDTH> struct row_of {
    Number at[WIDTH];
    Number &operator[](int i) { return at[i]; }
    Number operator[](int i) const { return at[i]; }
};

/* Rounds of a program; the carried arrays, those that stay and a row are its first registers. */
template <int WIDTH> static int rounds_of(const scan *s, const tape *t, int64_t *registers)
{
    typedef row_of<double, WIDTH> reals;
    typedef row_of<int64_t, WIDTH> wholes;
    int64_t *const found = (int64_t *)malloc((size_t)(t->ny + t->nm + 1) * 8 * WIDTH);
    if (found == NULL) { return 1; }
    prepare<WIDTH>(t, registers);
    const auto step = [t, registers](reals *, wholes *, reals *y, wholes *m) {
        execute<WIDTH>(t->code, t->codes, t->lists, registers,
                       (char *)(registers + t->registers * WIDTH));
        const int32_t *from = t->results;
        for (int i = 0; i < t->ny; ++i) { memcpy(y + i, ROW(double, *from++), sizeof *y); }
        for (int i = 0; i < t->nm; ++i) { memcpy(m + i, ROW(int64_t, *from++), sizeof *m); }
    };
    const int failed =
        scanned<WIDTH>(s, step, (reals *)registers, (wholes *)(registers + t->nx * WIDTH),
                       (reals *)found, (wholes *)(found + t->ny * WIDTH));
    free(found);
    return failed;
}

/* A pass of SOME takes about as long as two of FEW, one of MANY as three. */
extern "C" int robins_scan(const scan *s, const tape *t, int64_t *registers)
{
    if (s->runs <= 2 * FEW) { return rounds_of<FEW>(s, t, registers); }
    return (s->runs <= SOME ? rounds_of<SOME> : rounds_of<MANY>)(s, t, registers);
}
