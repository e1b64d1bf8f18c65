"""Runs of a chunk, and chunks computed at once, within a bound on memory.

A chunk is as wide as the histories of its runs allow, by what the stages of a run hold at once. The
width depends on the problem and not on the machine's cores: results that JAX sums in batches have
the same bits on any number of threads.
"""

from __future__ import annotations

import ctypes
import sys

LEAST = 8  # runs of a chunk: the lanes of a processor
CHUNK = 64  # runs of a chunk at most: they fill a core's vectors, and more would not fit its cache
SOME = 32  # runs of a chunk; a run takes the interpreter as long as with 48
CHUNK_BYTES = 192 << 20  # of a chunk in lanes, of which several are computed at once
MEMORY = 768 << 20  # bytes of all chunks at once


def filled(runs: int, most: int = CHUNK) -> int:
    """Number of runs in a chunk regardless of memory: all, up to half of `most`; else `most`.

    The last chunk is filled up, so that 50 and 1000 runs need one program.
    """
    return runs if runs <= most // 2 else most


def width_of(bytes_of_run: int, most: int) -> int:
    """Number of runs in a chunk of at most this many bytes.

    A multiple of `LEAST` up to `CHUNK`; `SOME` instead of a few more.
    """
    fitting = most // max(bytes_of_run, 1) // LEAST * LEAST
    width = min(max(fitting, LEAST), CHUNK)
    return SOME if SOME < width < CHUNK - LEAST else width


def concurrent_chunks(bytes_of_run: int, width: int, cores: int) -> int:
    """Number of chunks computed at once: one per core, as long as memory is left."""
    return max(1, min(cores, MEMORY // max(width * bytes_of_run, 1)))


def memory_note(bytes_of_run: int, width: int) -> list[str]:
    """A note where one chunk alone exceeds the bound."""
    needed = width * bytes_of_run
    if needed <= MEMORY:
        return []
    return [
        f"{width} runs at a time need about {needed / 1e6:.0f} MB of memory, more than the "
        f"{MEMORY / 1e6:.0f} MB that a campaign keeps to, since their histories are so long. "
        "Where that is too much, shorten the run or lengthen its step"
    ]


def release_memory() -> None:
    """Return free memory of the C library to Linux, between two chunks.

    Threads of lanes allocate in arenas of their own, which otherwise grow by 60 MB a chunk of the
    airship, to three times what a chunk needs.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc alone has it
        if trim is not None:
            trim(0)
