"""Functions of JAX as programs of scalars: the step of a filter as C, without a change to it.

A filter is traced to its jaxpr and taken apart into the scalars that it computes with. Moving data
leaves no code, equal scalars are computed once, what is known is folded, and what no result needs
is left out. What remains is emitted as C99, compiled, and called from Python; or flown.

    trace        function -> `Program`
    trace_step   the same of a step from state to state, whose lasting zeros are structural
    trace_steps  the same of several steps of one state
    to_c         `Program` -> text
    native       function -> the same function, compiled
    NativeState  a state that stays in the memory of C, and programs that step it

`stages` makes of a function of one run one of many, its loops in lanes. `robins.export`
writes C for a board.

This room knows JAX and no filter: no filter, rule or system is written for it.
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
