"""Exported filters on two boards: size, stack, and whether their bits are those of this machine.

Each filter is exported, cross-compiled for a Cortex-M4F and a Cortex-M7, and its recorded steps are
run on QEMU's boards of these processors. The same is done by the compiler of this machine, and by
that of `ziglang` (clang) where it is named. QEMU computes as the processor does and says nothing of
its time.

    python benchmarks/boards.py [SCENARIO:FILTER | FOLDER ...] [--zig "PYTHON -m ziglang cc"]

A folder is one that `robins export` wrote.
Needs gcc-arm-none-eabi, libnewlib-arm-none-eabi, qemu-system-arm (Debian).
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

HERE = Path(__file__).parent / "boards"
GCC, QEMU = "arm-none-eabi-gcc", "qemu-system-arm"
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off")
CASES = (
    "transfer-alignment/s0:kf-flexure",
    "rocket/a1:ukf",
    "satellite/s1:adaptive",
    "ins-gnss/drive:ekf",
)


_WORD = re.compile(r"([0-9a-f]{8}|[0-9a-f]{16}) ([0-9.e+-]+)")


class Board(NamedTuple):
    """A processor, and a machine of QEMU that has it."""

    name: str
    cpu: str
    fpu: str
    machine: str

    @property
    def flags(self) -> list[str]:
        """For the compiler."""
        return [f"-mcpu={self.cpu}", "-mthumb", "-mfloat-abi=hard", f"-mfpu={self.fpu}", *FLAGS]


M4F = Board("Cortex-M4F", "cortex-m4", "fpv4-sp-d16", "mps2-an386")
M7 = Board("Cortex-M7", "cortex-m7", "fpv5-d16", "mps2-an500")


class Ran(NamedTuple):
    """Figures printed by the test of a library."""

    said: str  # its line on codes and numbers
    bits: str  # checksum of the bits of all reals
    reals: np.ndarray  # of all outputs, in the order of the calls
    sizes: np.ndarray  # the largest number in the field of each


class Built(NamedTuple):
    """Memory of a library on a board, in bytes."""

    flash: int  # code and constants of the library, without libm
    stack: int  # of its deepest entry point: sums of frames by -fstack-usage


def missing() -> str:
    """Missing tools, in words; empty if all are here."""
    absent = [name for name in (GCC, QEMU) if shutil.which(name) is None]
    if not absent:
        told = [GCC, "-mcpu=cortex-m4", "-mthumb", "-print-file-name=rdimon.specs"]
        specs = subprocess.run(told, capture_output=True, text=True).stdout.strip()
        absent = [] if os.path.isabs(specs) else ["newlib for arm-none-eabi"]
    return f"needs {' and '.join(absent)}" if absent else ""


def on_board(folder: Path, board: Board) -> Ran:
    """Compile an exported folder for a board, and run its recorded steps there."""
    with tempfile.TemporaryDirectory() as own:
        elf = str(Path(own) / "test.elf")
        sources = [HERE / "start.c", *sorted(folder.glob("*.c"))]
        script = ["--specs=rdimon.specs", "-T", HERE / "board.ld", "-DPRINT_BITS"]
        line = [GCC, *board.flags, *script, *sources, "-lm", "-o", elf]
        subprocess.run(list(map(str, line)), check=True)
        quiet = ["-nographic", "-monitor", "none", "-serial", "none"]
        host = ["-semihosting-config", "enable=on,target=native"]
        return _ran([QEMU, "-machine", board.machine, *quiet, *host, "-kernel", elf])


def on_host(folder: Path, compiler: str = "cc") -> Ran:
    """The same by a compiler of this machine."""
    with tempfile.TemporaryDirectory() as own:
        program = str(Path(own) / "test")
        line = [*shlex.split(compiler), *FLAGS, "-DPRINT_BITS"]
        sources = map(str, sorted(folder.glob("*.c")))
        subprocess.run([*line, *sources, "-lm", "-o", program], check=True)
        return _ran([program])


def _ran(command: list[str]) -> Ran:
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    lines = done.stdout.split("\n")
    words = [found.groups() for line in lines if (found := _WORD.fullmatch(line))]
    said = [line for line in lines if " steps: " in line]
    bits = [line.rpartition(" ")[2] for line in lines if line.startswith("bits of all")]
    if not said or not bits:
        raise RuntimeError(f"{command[0]} ended with {done.returncode}: {done.stdout[-300:]}")
    kinds = (np.uint32, np.float32) if len(words[0][0]) == 8 else (np.uint64, np.float64)
    reals = np.array([int(word, 16) for word, _ in words], kinds[0]).view(kinds[1])
    return Ran(said[0], bits[0], reals, np.array([float(size) or 1.0 for _, size in words]))


def apart(one: Ran, other: Ran) -> str:
    """Largest difference of the numbers of two runs, in parts of a field."""
    if one.bits == other.bits:
        return "to the bit"
    a, b = one.reals, other.reals
    off = np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, np.abs(a - b)) / one.sizes
    return f"within {np.max(off):.1e} of a field"


def built(folder: Path, board: Board) -> Built:
    """The size and the stack of a library on a board."""
    (source,) = (path for path in folder.glob("*.c") if path.name != "test.c")
    prefix = f"{source.stem}_"
    with tempfile.TemporaryDirectory() as own:
        made = ["-fstack-usage", "-c", str(source), "-o", "library.o"]
        subprocess.run([GCC, *board.flags, *made], check=True, cwd=own)
        told = subprocess.check_output(["arm-none-eabi-size", "library.o"], cwd=own, text=True)
        frames = {}
        for line in (Path(own) / "library.su").read_text().splitlines():
            where, size, _ = line.split("\t")
            frames[where.rpartition(":")[2].partition(".")[0]] = int(size)
    calls = {name: size for name, size in frames.items() if name.startswith(prefix)}
    inner = [size for name, size in frames.items() if not name.startswith((prefix, "of_"))]
    deepest = max(
        size + frames.get(f"of_{name.removeprefix(prefix)}", 0) for name, size in calls.items()
    )
    return Built(int(told.splitlines()[1].split()[0]), deepest + max(inner, default=0))


def row(folder: Path, case: str, real: str, board: Board, host: Ran) -> str:
    """A line of the table."""
    there, size = on_board(folder, board), built(folder, board)
    codes = there.said.partition(" steps: ")[2].partition(",")[0]
    return (
        f"| {case} | {board.name} | {real} | {size.flash / 1000:.1f} | {size.stack / 1000:.1f} "
        f"| {codes} | {apart(host, there)} |"
    )


def compared(folder: Path, label: str, real: str, zig: str) -> None:
    """Print the lines of an exported folder."""
    host = on_host(folder)
    for board in (M4F, M7):
        print(row(folder, label, real, board, host), flush=True)
    if zig:
        bits = apart(host, on_host(folder, zig))
        print(f"| {label} | this machine, clang | {real} | | | | {bits} |", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("cases", nargs="*", default=CASES)
    parser.add_argument("--zig", default="")
    told = parser.parse_args()
    if reason := missing():
        print(reason, file=sys.stderr)
        return 1
    from robins.workbench import export_filter

    print(
        "| filter | processor | reals | flash, kB | stack, kB | codes | bits beside this machine |"
    )
    print("|---|---|---|---|---|---|---|")
    for case in told.cases:
        if Path(case).is_dir():
            header = (Path(case) / "robins.h").read_text()
            real = "float" if "typedef float " in header else "double"
            compared(Path(case), case, real, told.zig)
            continue
        scenario, _, name = case.partition(":")
        for float32 in (False, True):
            with tempfile.TemporaryDirectory() as own:
                folder = Path(own) / "made"
                made = export_filter(scenario, folder, filter_name=name, float32=float32)
                compared(folder, f"`{scenario}` `{made.filter}`", made.real, told.zig)
    return 0


if __name__ == "__main__":
    sys.exit(main())
