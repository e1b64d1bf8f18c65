"""A program as CUDA: a kernel that steps many runs, one thread a run, the loop over time inside.

The text is that of C, `scalars.h`, `routines.h` and the function of the program, as functions of
the device. The kernel holds the state of its run in registers, as far as they go, from the first
step to the last. The run is the fastest index of all arrays, so that neighbouring threads read
neighbouring numbers.

The text also compiles as C++ where the words that CUDA adds are defined, and is tested so on a CPU:
``__global__``, ``__device__``, ``__forceinline__``, ``__noinline__``, ``__launch_bounds__``,
``threadIdx``, ``blockIdx`` and ``blockDim``.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

from robins.program.c import function, header
from robins.program.refusal import ProgramError
from robins.program.trace import Leaf, Program

BLOCK = 64  # threads of a block: few, because each of them takes most registers it can get

# NVRTC has no headers of the C library, and knows the mathematics without.
ENVIRONMENT = """\
#ifdef __CUDACC_RTC__
typedef long long int64_t;
typedef unsigned int uint32_t;
typedef unsigned long long uint64_t;
#define INT64_MAX 9223372036854775807LL
#define INT64_MIN (-INT64_MAX - 1)
#define DBL_MAX 1.7976931348623157e+308
#undef NAN
#undef INFINITY
#define NAN __longlong_as_double(0x7ff8000000000000LL)
#define INFINITY __longlong_as_double(0x7ff0000000000000LL)
#else
#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>
#endif
"""

# Sine and cosine beyond a million radians are calls. Written out at each sine of a UKF of nine
# states they leave 32 registers for the rest (NVRTC 12.9), which then spills three times as much.
FAR = r"static __device__ __noinline__ real real_far_\1(real a) { return \1(a); }"

KERNEL = """
/* Steps runs from state to state, each in a thread of its own.
     state, counts:     (numbers, runs), reals and all else; read, and written in the end
     rows, row_counts:  (steps, numbers, width), what each step is given; width is 1 where all runs
                        are given the same, else runs
     kept, kept_counts: (steps / every, numbers, runs), what each step number every, 2 every, ...
                        gives beside the state; nothing where every is 0 */
extern "C" __global__ void __launch_bounds__(BLOCK) robins_steps(
    int runs, int steps, int every, int width, real *state, whole *counts, const real *rows,
    const whole *row_counts, real *kept, whole *kept_counts)
{
    const int run = (int)(blockIdx.x * blockDim.x + threadIdx.x);
    if (run >= runs) { return; }
    const size_t n = (size_t)runs, at = (size_t)run;
    const size_t wide = (size_t)width, column = width == 1 ? 0 : at;
    real x[GIVEN + 1], y[MADE + 1];
    whole k[GIVEN_COUNTS + 1], m[MADE_COUNTS + 1];
#pragma unroll
    for (int j = 0; j < STATE; ++j) { x[j] = state[(size_t)j * n + at]; }
#pragma unroll
    for (int j = 0; j < STATE_COUNTS; ++j) { k[j] = counts[(size_t)j * n + at]; }
    for (int s = 0; s < steps; ++s) {
        const real *row = rows + (size_t)s * (GIVEN - STATE) * wide + column;
        const whole *row_count =
            row_counts + (size_t)s * (GIVEN_COUNTS - STATE_COUNTS) * wide + column;
#pragma unroll
        for (int j = STATE; j < GIVEN; ++j) { x[j] = row[(size_t)(j - STATE) * wide]; }
#pragma unroll
        for (int j = STATE_COUNTS; j < GIVEN_COUNTS; ++j) {
            k[j] = row_count[(size_t)(j - STATE_COUNTS) * wide];
        }
        robins_step(x, k, y, m);
#pragma unroll
        for (int j = 0; j < STATE; ++j) { x[j] = y[j]; }
#pragma unroll
        for (int j = 0; j < STATE_COUNTS; ++j) { k[j] = m[j]; }
        if (every > 0 && (s + 1) % every == 0) {
            const size_t line = (size_t)(s / every);
            real *to = kept + line * (MADE - STATE) * n + at;
            whole *count_to = kept_counts + line * (MADE_COUNTS - STATE_COUNTS) * n + at;
#pragma unroll
            for (int j = STATE; j < MADE; ++j) { to[(size_t)(j - STATE) * n] = y[j]; }
#pragma unroll
            for (int j = STATE_COUNTS; j < MADE_COUNTS; ++j) {
                count_to[(size_t)(j - STATE_COUNTS) * n] = m[j];
            }
        }
    }
#pragma unroll
    for (int j = 0; j < STATE; ++j) { state[(size_t)j * n + at] = x[j]; }
#pragma unroll
    for (int j = 0; j < STATE_COUNTS; ++j) { counts[(size_t)j * n + at] = k[j]; }
}
"""


class Stepped(NamedTuple):
    """Arguments and results of a step, apart: the state, and what comes and goes with each step."""

    state: list[Leaf]
    rows: list[Leaf]
    kept: list[Leaf]


def stepped(program: Program) -> Stepped:
    """The parts of a program that gives its first argument back as the first of two results.

    Raises:
        ProgramError: it does not.
    """
    given, made = (tree.children() for tree in program.structure)
    if len(made) != 2 or not given or given[0] != made[0]:
        raise ProgramError(
            "what the function gives first is not a state as it takes first",
            fix="trace `step(state, ...) -> (state, kept)`",
        )
    n = given[0].num_leaves
    before, after = program.inputs[:n], program.results[:n]
    for a, b in zip(before, after, strict=True):
        if (a.shape, a.kind) != (b.shape, b.kind):
            raise ProgramError(f"the step makes {b.shape} of {a.shape} in its state", a.path)
    return Stepped(after, program.inputs[n:], program.results[n:])


def sizes(leaves: list[Leaf]) -> tuple[int, int]:
    """How many reals, and how many numbers of other kinds, some leaves have."""
    count = [0, 0]
    for leaf in leaves:
        count[leaf.kind != "real"] += int(np.prod(leaf.shape))
    return count[0], count[1]


def to_cuda(program: Program, block: int = BLOCK) -> str:
    """The text of a kernel ``robins_steps`` of a step, which `trace` or `trace_step` made.

    The step is ``step(state, ...) -> (state, kept)``; block is how many threads a block has.

    Raises:
        ProgramError: the program is not such a step.
    """
    parts = stepped(program)
    (state, counts), (rows, row_counts), (kept, kept_counts) = map(sizes, parts)
    numbers = {
        "BLOCK": block,
        "STATE": state,
        "GIVEN": state + rows,
        "MADE": state + kept,
        "STATE_COUNTS": counts,
        "GIVEN_COUNTS": counts + row_counts,
        "MADE_COUNTS": counts + kept_counts,
    }
    defined = "".join(f"#define {name} {number}\n" for name, number in numbers.items())
    c = header() + "\n" + function(program, linkage="static inline ")
    c = re.sub(r"^#include .*\n", "", c, flags=re.MULTILINE)
    c = c.replace("static inline ", "static __device__ __forceinline__ ")
    c = re.sub(r"FROM_C\(far_(sin|cos), \1\)", FAR, c)
    return ENVIRONMENT + c + "\n" + defined + KERNEL
