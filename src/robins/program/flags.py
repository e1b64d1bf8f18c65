"""Flags of compilers, and the interpreters that a wheel carries.

The build hook (`hatch_build.py`) loads this file alone: it imports nothing of robins.
"""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Sequence
from pathlib import Path

# Passes that look for repeated computations: there is nothing left to find, and they take half of
# the time of the compiler. Compilers that do not know them ignore the flags.
FASTER = ("-fno-gcse", "-fno-tree-pre")
# In addition for gcc, which others may refuse: no search for double or adjacent stores, and a limit
# to how many writes it looks at behind a read. Half of the time that is left; the code
# is as fast.
FASTER_IN_GCC = (
    *("-fno-code-hoisting", "-fno-tree-slp-vectorize", "-fno-tree-dse", "-fno-dse"),
    "--param=sccvn-max-alias-queries-per-access=30",
    "--param=max-cselib-memory-locations=30",
)
# Contraction would join a product and a sum into one rounding: other bits on other machines.
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fno-math-errno", *FASTER)
# Lanes are as wide as the processor that compiles them.
LANE_FLAGS = ("-std=gnu++17", "-march=native", "-Wno-psabi", *FLAGS[1:])
# In the interpreter `and`, `or` and `not` are parts of names, and a register holds all kinds.
INTERPRETER_FLAGS = (
    *("-std=gnu++17", "-Wno-psabi", "-fno-operator-names", "-fno-strict-aliasing"),
    *FLAGS[1:],
)
SHARED = ("-shared", "-fPIC")
ONE = "one"  # for one run at a time
# Of many runs for processors, by `robins_generation`: of x86-64 1, 3 or 4, of others 0.
GENERATIONS = {
    "0": (),
    "1": ("-march=x86-64",),
    "3": ("-march=x86-64-v3",),
    "4": ("-march=x86-64-v4",),
}
OF_KIND = {ONE: ("-DONE_RUN",), **GENERATIONS}


def compile_interpreters(compiler: Sequence[str], into: Path) -> list[Path]:
    """Compile all interpreters for machines like this one into a folder, each named by its kind.

    Raises:
        OSError: there is no such compiler.
        subprocess.CalledProcessError: it refuses the interpreter; `stderr` has its words.
    """
    x86 = platform.machine().lower() in ("x86_64", "amd64")
    kinds = [kind for kind in OF_KIND if kind == ONE or (kind == "0") is not x86]
    source = Path(__file__).with_name("interpreter.cc")
    made = [into / f"{kind}.so" for kind in kinds]
    for kind, library in zip(kinds, made, strict=True):
        line = [*compiler, *INTERPRETER_FLAGS, *OF_KIND[kind], *SHARED, str(source)]
        subprocess.run(
            [*line, "-o", str(library), "-lm"], check=True, capture_output=True, text=True
        )
    return made
