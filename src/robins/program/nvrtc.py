"""The compiler of CUDA texts: NVRTC, from the wheel that JAX's extra for GPUs installs.

It needs no GPU and no toolkit. What it compiled is kept by content, as libraries of C are.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from robins.program.native import cache_folder
from robins.program.refusal import BuildError

WHEELS = "install JAX for a GPU (`pip install 'jax[cuda12]'` or `'jax[cuda13]'`)"
# No contraction: a product and a sum are rounded each, so that the bits are those of the C.
EXACT = ("--fmad=false",)
# Say what registers and stack are used; that functions of `scalars.h` are not used is no news.
TOLD = ("--ptxas-options=-v", "--diag-suppress=177")


class Compiled(NamedTuple):
    """Machine code of a GPU, and what the compiler said: registers and spills among it."""

    code: bytes
    log: str


def found() -> Path | None:
    """The library of the newest wheel of NVRTC that is installed; None where none is."""
    spec = importlib.util.find_spec("nvidia")
    places = [] if spec is None else map(Path, spec.submodule_search_locations or ())
    libraries = [
        p
        for place in places
        for folder in ("cuda_nvrtc", "cu[0-9]*")
        for p in place.glob(f"{folder}/lib/libnvrtc.so.*")
    ]
    return max(libraries, key=lambda p: int(p.suffix[1:]), default=None)


@lru_cache
def _library(path: Path) -> ctypes.CDLL:
    for builtins in sorted(path.parent.glob("libnvrtc-builtins.so.*")):
        ctypes.CDLL(str(builtins), mode=ctypes.RTLD_GLOBAL)
    library = ctypes.CDLL(str(path))
    library.nvrtcGetErrorString.restype = ctypes.c_char_p
    return library


def compile_cuda(text: str, architecture: str, options: tuple[str, ...] = EXACT) -> Compiled:
    """Machine code of a text for an architecture such as ``sm_90``.

    Raises:
        BuildError: NVRTC is not installed, or refuses the text; it says what was said.
    """
    path = found()
    if path is None:
        raise BuildError("NVRTC, the compiler of CUDA, is not installed", "", WHEELS)
    library = _library(path)
    version = ctypes.c_int(), ctypes.c_int()
    library.nvrtcVersion(*map(ctypes.byref, version))
    told = (f"--gpu-architecture={architecture}", *TOLD, *options)
    key = "\0".join([text, *told, *(str(v.value) for v in version)])
    name = hashlib.sha256(key.encode()).hexdigest()[:24]
    kept, said = (cache_folder() / f"{name}{end}" for end in (".cubin", ".log"))
    if kept.exists() and said.exists():
        return Compiled(kept.read_bytes(), said.read_text("utf-8"))
    made = _compile(library, text, told)
    for file, content in ((said, made.log.encode()), (kept, made.code)):
        own = file.with_suffix(f"{file.suffix}.{id(made)}")
        own.write_bytes(content)
        own.replace(file)
    return made


def _compile(library: ctypes.CDLL, text: str, options: tuple[str, ...]) -> Compiled:
    program = ctypes.c_void_p()

    def do(name: str, *args: Any) -> None:
        if code := getattr(library, name)(*args):
            raise BuildError(f"{name}: {library.nvrtcGetErrorString(code).decode()}")

    def read(what: str) -> bytes:
        size = ctypes.c_size_t()
        do(f"nvrtcGet{what}Size", program, ctypes.byref(size))
        buffer = ctypes.create_string_buffer(size.value)
        do(f"nvrtcGet{what}", program, buffer)
        return buffer.raw

    source = text.encode()
    do("nvrtcCreateProgram", ctypes.byref(program), source, b"robins.cu", 0, None, None)
    try:
        words = [o.encode() for o in options]
        refused = library.nvrtcCompileProgram(
            program, len(words), (ctypes.c_char_p * len(words))(*words)
        )
        log = read("ProgramLog").rstrip(b"\0").decode()
        if refused:
            first = "\n".join(log.strip().splitlines()[:5])
            raise BuildError(f"NVRTC does not accept a program: {first}")
        return Compiled(read("CUBIN"), log)
    finally:
        library.nvrtcDestroyProgram(ctypes.byref(program))
