/* The scalars of a program: one number each. */
#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

typedef double real;
typedef int flag; /* 0 or 1 */
typedef int64_t whole;
typedef uint32_t word;
typedef uint64_t word64;

#define REAL(x) ((real)(x))
#define WHOLE(x) ((whole)(x))
#define FLAG(x) (x)
#define WORD(x) ((word)(x))
#define WORD64(x) ((word64)(x))
#define ANY(c) (c)

#define COMPARED(kind)                                                              \
    static inline flag kind##_eq(kind a, kind b) { return a == b; }                 \
    static inline flag kind##_ne(kind a, kind b) { return a != b; }                 \
    static inline flag kind##_lt(kind a, kind b) { return a < b; }                  \
    static inline flag kind##_le(kind a, kind b) { return a <= b; }                 \
    static inline kind kind##_select(flag c, kind a, kind b) { return c ? a : b; }  \
    static inline kind kind##_pick(const kind *a, whole k) { return a[k]; }
COMPARED(real)
COMPARED(flag)
COMPARED(whole)
COMPARED(word)
COMPARED(word64)
#undef COMPARED

#define BITWISE(kind)                                                                            \
    static inline kind kind##_not(kind a) { return (kind)~a; }                                   \
    static inline kind kind##_shift_left(kind a, kind n) { return (kind)(a << n); }              \
    static inline kind kind##_shift_right(kind a, kind n) { return (kind)(a >> n); }             \
    static inline kind kind##_div(kind a, kind b) { return b != 0 ? (kind)(a / b) : (kind)~0; }  \
    static inline kind kind##_rem(kind a, kind b) { return b != 0 ? (kind)(a % b) : a; }         \
    static inline kind kind##_max(kind a, kind b) { return a > b ? a : b; }                      \
    static inline kind kind##_min(kind a, kind b) { return a < b ? a : b; }
BITWISE(whole)
BITWISE(word)
BITWISE(word64)
#undef BITWISE

static inline flag flag_not(flag a) { return !a; }
static inline flag flag_max(flag a, flag b) { return a | b; }
static inline flag flag_min(flag a, flag b) { return a & b; }

#define CONVERTED(to, from) static inline to to##_of_##from(from a) { return (to)a; }
CONVERTED(real, whole)
CONVERTED(real, flag)
CONVERTED(real, word)
CONVERTED(real, word64)
CONVERTED(whole, flag)
CONVERTED(whole, word)
CONVERTED(whole, word64)
CONVERTED(word, whole)
CONVERTED(word, flag)
CONVERTED(word, word64)
CONVERTED(word64, whole)
CONVERTED(word64, flag)
CONVERTED(word64, word)
#undef CONVERTED

/* Towards zero; what is beyond all whole numbers is the last of them, and NaN is 0. */
static inline whole whole_of_real(real a)
{
    if (a >= 9223372036854775808.0) { return INT64_MAX; }
    if (a <= -9223372036854775808.0) { return INT64_MIN; }
    return a == a ? (whole)a : 0;
}

/* The bits are those of double precision, whatever a real is. */
static inline real real_bits_word64(word64 a)
{
    double x;
    memcpy(&x, &a, sizeof x);
    return (real)x;
}

static inline word64 word64_bits_real(real a)
{
    const double given = (double)a;
    word64 x;
    memcpy(&x, &given, sizeof x);
    return x;
}

#define FROM_C(name, function) static inline real real_##name(real a) { return function(a); }
FROM_C(abs, fabs)
FROM_C(sqrt, sqrt)
FROM_C(cbrt, cbrt)
FROM_C(floor, floor)
FROM_C(ceil, ceil)
FROM_C(round_even, rint)
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
#undef FROM_C

#define FROM_C2(name, function) \
    static inline real real_##name(real a, real b) { return function(a, b); }
FROM_C2(atan2, atan2)
FROM_C2(pow, pow)
FROM_C2(rem, fmod)
FROM_C2(nextafter, nextafter)
#undef FROM_C2
