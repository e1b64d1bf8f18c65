/* The scalars of a program: LANES numbers each, one of each run (C++, or a C that chooses between
   vectors by `?:`). A flag is a mask. */
#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

#ifndef LANES /* as many as the vectors of the processor hold */
#if defined(__AVX512F__)
#define LANES 8
#elif defined(__AVX__)
#define LANES 4
#elif defined(__SSE2__) || defined(__ARM_NEON)
#define LANES 2
#else
#define LANES 1
#endif
#endif

typedef double real __attribute__((vector_size(8 * LANES), aligned(8)));
typedef int64_t whole __attribute__((vector_size(8 * LANES), aligned(8)));
typedef int64_t flag __attribute__((vector_size(8 * LANES), aligned(8)));
typedef uint32_t word __attribute__((vector_size(4 * LANES), aligned(4)));
typedef uint64_t word64 __attribute__((vector_size(8 * LANES), aligned(8)));
typedef int32_t narrow __attribute__((vector_size(4 * LANES), aligned(4)));

static inline real real_all(double a) { return a - (real){}; }
static inline whole whole_all(int64_t a) { return a - (whole){}; }
static inline word word_all(uint32_t a) { return a - (word){}; }
static inline word64 word64_all(uint64_t a) { return a - (word64){}; }

#define REAL(x) real_all(x)
#define WHOLE(x) whole_all(x)
#define FLAG(x) whole_all((x) ? -1 : 0)
#define WORD(x) word_all(x)
#define WORD64(x) word64_all(x)

static inline int any(flag c)
{
    int64_t found = 0;
    for (int i = 0; i < LANES; ++i) { found |= c[i]; }
    return found != 0;
}
#define ANY(c) any(c)

#define COMPARED(kind)                                                                        \
    static inline flag kind##_eq(kind a, kind b) { return (flag)(a == b); }                   \
    static inline flag kind##_ne(kind a, kind b) { return (flag)(a != b); }                   \
    static inline flag kind##_lt(kind a, kind b) { return (flag)(a < b); }                    \
    static inline flag kind##_le(kind a, kind b) { return (flag)(a <= b); }                   \
    static inline kind kind##_select(flag c, kind a, kind b) { return c ? a : b; }
COMPARED(real)
COMPARED(whole)
COMPARED(word64)
#undef COMPARED
static inline flag flag_eq(flag a, flag b) { return ~(a ^ b); }
static inline flag flag_ne(flag a, flag b) { return a ^ b; }
static inline flag flag_lt(flag a, flag b) { return ~a & b; }
static inline flag flag_le(flag a, flag b) { return ~a | b; }
static inline flag flag_select(flag c, flag a, flag b) { return (c & a) | (~c & b); }
static inline flag wide(narrow c) { return __builtin_convertvector(c, flag); }
static inline flag word_eq(word a, word b) { return wide(a == b); }
static inline flag word_ne(word a, word b) { return wide(a != b); }
static inline flag word_lt(word a, word b) { return wide(a < b); }
static inline flag word_le(word a, word b) { return wide(a <= b); }
static inline word word_select(flag c, word a, word b)
{
    return __builtin_convertvector(c, narrow) ? a : b;
}

#define PICKED(kind)                                                  \
    static inline kind kind##_pick(const kind *a, whole k)            \
    {                                                                 \
        kind out = a[0];                                              \
        for (int i = 0; i < LANES; ++i) { out[i] = a[k[i]][i]; }      \
        return out;                                                   \
    }
PICKED(real)
PICKED(flag)
PICKED(whole)
PICKED(word)
PICKED(word64)
#undef PICKED

/* Divided one by one: processors have no such instruction for whole numbers. */
#define BITWISE(kind, one)                                                                  \
    static inline kind kind##_not(kind a) { return ~a; }                                    \
    static inline kind kind##_shift_left(kind a, kind n) { return a << n; }                 \
    static inline kind kind##_shift_right(kind a, kind n) { return a >> n; }                \
    static inline kind kind##_max(kind a, kind b) { return a > b ? a : b; }                 \
    static inline kind kind##_min(kind a, kind b) { return a < b ? a : b; }                 \
    static inline kind kind##_div(kind a, kind b)                                           \
    {                                                                                       \
        for (int i = 0; i < LANES; ++i) { a[i] = b[i] != 0 ? a[i] / b[i] : (one)~(one)0; }  \
        return a;                                                                           \
    }                                                                                       \
    static inline kind kind##_rem(kind a, kind b)                                           \
    {                                                                                       \
        for (int i = 0; i < LANES; ++i) { a[i] = b[i] != 0 ? a[i] % b[i] : a[i]; }          \
        return a;                                                                           \
    }
BITWISE(whole, int64_t)
BITWISE(word, uint32_t)
BITWISE(word64, uint64_t)
#undef BITWISE

static inline flag flag_not(flag a) { return ~a; }
static inline flag flag_max(flag a, flag b) { return a | b; }
static inline flag flag_min(flag a, flag b) { return a & b; }

#define CONVERTED(to, from) \
    static inline to to##_of_##from(from a) { return __builtin_convertvector(a, to); }
CONVERTED(real, whole)
CONVERTED(real, word)
CONVERTED(real, word64)
CONVERTED(whole, word)
CONVERTED(whole, word64)
CONVERTED(word, whole)
CONVERTED(word, word64)
CONVERTED(word64, whole)
CONVERTED(word64, word)
#undef CONVERTED
static inline whole whole_of_flag(flag a) { return -a; }
static inline real real_of_flag(flag a) { return real_select(a, REAL(1.0), REAL(0.0)); }
static inline word word_of_flag(flag a) { return word_of_whole(-a); }
static inline word64 word64_of_flag(flag a) { return (word64)-a; }

static inline whole whole_of_real(real a)
{
    const flag high = a >= 9223372036854775807.0, low = a <= -9223372036854775808.0;
    const flag inside = (flag)(a == a) & ~high & ~low;
    whole out = __builtin_convertvector(real_select(inside, a, REAL(0.0)), whole);
    out = whole_select(high, WHOLE(INT64_MAX), out);
    return whole_select(low, WHOLE(INT64_MIN), out);
}

static inline real real_bits_word64(word64 a) { return (real)a; }
static inline word64 word64_bits_real(real a) { return (word64)a; }
static inline real real_abs(real a) { return (real)((whole)a & INT64_MAX); }

#define FROM_C(name, function)                                            \
    static inline real real_##name(real a)                                \
    {                                                                     \
        for (int i = 0; i < LANES; ++i) { a[i] = function(a[i]); }        \
        return a;                                                         \
    }
FROM_C(cbrt, cbrt)
FROM_C(round_away, round)
FROM_C(tan, tan)
FROM_C(asin, asin)
FROM_C(acos, acos)
FROM_C(atan, atan)
FROM_C(sinh, sinh)
FROM_C(cosh, cosh)
FROM_C(tanh, tanh)
FROM_C(asinh, asinh)
FROM_C(acosh, acosh)
FROM_C(atanh, atanh)
FROM_C(exp, exp)
FROM_C(exp2, exp2)
FROM_C(expm1, expm1)
FROM_C(log, log)
FROM_C(log1p, log1p)
FROM_C(erf, erf)
FROM_C(erfc, erfc)
FROM_C(lgamma, lgamma)
FROM_C(far_sin, sin)
FROM_C(far_cos, cos)
#if defined(__AVX512F__) && LANES == 8
#include <immintrin.h>
static inline real real_sqrt(real a) { return (real)_mm512_sqrt_pd((__m512d)a); }
static inline real real_floor(real a) { return (real)_mm512_floor_pd((__m512d)a); }
static inline real real_ceil(real a) { return (real)_mm512_ceil_pd((__m512d)a); }
static inline real real_round_even(real a)
{
    return (real)_mm512_roundscale_pd((__m512d)a, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
}
#else
FROM_C(sqrt, sqrt)
FROM_C(floor, floor)
FROM_C(ceil, ceil)
FROM_C(round_even, rint)
#endif
#undef FROM_C

#define FROM_C2(name, function)                                              \
    static inline real real_##name(real a, real b)                           \
    {                                                                        \
        for (int i = 0; i < LANES; ++i) { a[i] = function(a[i], b[i]); }     \
        return a;                                                            \
    }
FROM_C2(atan2, atan2)
FROM_C2(pow, pow)
FROM_C2(rem, fmod)
FROM_C2(nextafter, nextafter)
#undef FROM_C2
