"""Flags of compilers, and the interpreters that a wheel carries.

The build hook (`hatch_build.py`) loads this file alone: it imports nothing of robins.
"""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Sequence
from pathlib import Path

# No passes that look for repeated computations: there are none left, and the passes take half of
# the compile time. Compilers that do not know these flags ignore them.
FASTER = ("-fno-gcse", "-fno-tree-pre")
# In addition for gcc, as other compilers may reject them: no search for redundant or adjacent
# stores, and a limit on the stores examined for each load. They save half of the remaining compile
# time; the code is as fast.
FASTER_IN_GCC = (
    *("-fno-code-hoisting", "-fno-tree-slp-vectorize", "-fno-tree-dse", "-fno-dse"),
    "--param=sccvn-max-alias-queries-per-access=30",
    "--param=max-cselib-memory-locations=30",
)
# Contraction would join a product and a sum into one rounding: other bits on other machines.
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fno-math-errno", *FASTER)
# Lanes use the full vector width of the processor that compiles them.
LANE_FLAGS = ("-std=gnu++17", "-march=native", "-Wno-psabi", *FLAGS[1:])
# In the interpreter `and`, `or` and `not` are parts of names, and a register holds all kinds.
INTERPRETER_FLAGS = (
    *("-std=gnu++17", "-Wno-psabi", "-fno-operator-names", "-fno-strict-aliasing"),
    *FLAGS[1:],
)
SHARED = ("-shared", "-fPIC")
ONE = "one"  # for one run at a time
# Flags for many runs by `robins_generation`: level 1, 3 or 4 of x86-64, 0 for other processors.
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
        subprocess.CalledProcessError: it rejects the interpreter; `stderr` has its message.
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
