"""Compilation of pure JAX functions to programs of scalars: the step of a filter as C.

A filter, unchanged, is traced to its jaxpr and lowered to a graph of scalar operations. Moving data
leaves no code, equal scalars are computed once, constants are folded, and dead code is left out.
The rest is emitted as C99 and compiled, to be called from Python or flown.

    trace        function -> `Program`
    trace_step   the same for a step from state to state, whose lasting zeros are structural
    trace_steps  the same for several steps of one state
    to_c         `Program` -> text
    native       function -> the same function, compiled
    NativeState  a state that stays in the memory of C, and programs that step it

`stages` turns a function of one run into one of many runs, its loops in SIMD lanes. `robins.export`
writes C for a board.

The package is generic: no filter, rule or system is written for it.
"""

from robins.program.c import function, header, to_c
from robins.program.flags import FLAGS, LANE_FLAGS
from robins.program.interpreter import interpreted_step
from robins.program.memory import NativeState
from robins.program.native import CPP, Native, build, compiled_step, compiler, native
from robins.program.nodes import Graph
from robins.program.precision import DOUBLE, SINGLE, Precision
from robins.program.refusal import BuildError, ProgramError
from robins.program.trace import trace, trace_step, trace_steps
from robins.program.walk import Leaf, Program

__all__ = [
    "CPP",
    "DOUBLE",
    "FLAGS",
    "LANE_FLAGS",
    "SINGLE",
    "BuildError",
    "Graph",
    "Leaf",
    "Native",
    "NativeState",
    "Precision",
    "Program",
    "ProgramError",
    "build",
    "compiled_step",
    "compiler",
    "function",
    "header",
    "interpreted_step",
    "native",
    "to_c",
    "trace",
    "trace_step",
    "trace_steps",
]
