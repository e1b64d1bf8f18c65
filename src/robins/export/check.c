#include "${name}.h"
#include <math.h>
#include <stdio.h>
#include <string.h>
#include "recorded.h"

static double worst = 0.0; /* difference, in parts of a field */
static int wrong = 0;      /* calls of which a code, a count or a flag differs */
static int beyond = 0;     /* reals that differ by more than they may */
static const char *where = ""; /* the first of these */
static uint64_t bits = 14695981039346656037u;

static void compare(const char *field, const ${name}_real *found, const double *expected, int n,
                    double size, double tolerance)
{
    for (int i = 0; i < n; ++i) {
        const double here = (double)found[i];
        const double off = fabs(here - expected[i]);
        const double part = size > 0.0 ? off / size : off;
        const int same = here == expected[i] || (isnan(here) && isnan(expected[i]));
        ${word} word = ${nan};
        if (!isnan(here)) { memcpy(&word, &found[i], sizeof word); }
        bits = (bits ^ word) * 1099511628211u;
#ifdef PRINT_BITS
        printf(${printed});
#endif
        if (!same && !(part <= worst)) { worst = isnan(part) ? (double)INFINITY : part; }
        if (!same && !(part <= tolerance) && !isinf(tolerance)) {
            ++beyond;
            where = *where ? where : field;
        }
    }
}

static int differ(const char *field, int yes)
{
    if (yes && CODES_OFF == 0 && !*where) { where = field; }
    return yes != 0;
}

$calls
    const int good = wrong <= CODES_OFF && beyond == 0;
    printf("%d steps: %d codes differ, numbers differ by %.1e of a field at most: %s\n",
           STEPS, wrong, worst, good ? "passed" : "FAILED");
    if (!good) {
        printf("first in %s\n", where);
    }
    printf("state: %lu bytes\n", (unsigned long)sizeof(${name}_state));
    printf("bits of all numbers: %08lx%08lx\n", (unsigned long)(bits >> 32),
           (unsigned long)(bits & 0xffffffffu));
    if (sizeof RUINED > 1) {
        printf("FAILED: %s\n", RUINED);
    }
    return good && sizeof RUINED == 1 ? 0 : 1;
}
