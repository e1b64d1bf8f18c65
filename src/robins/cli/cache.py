"""Saves compile time: faster compiler settings, and a cache that is kept between commands."""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
import os
import platform
import sys
from pathlib import Path

# These halve the time to compile a campaign and leave the time to run it (`benchmarks/compile.py`).
# XLA ends a process that gives it an unknown setting: only versions that were tried get them.
_XLA_FLAGS = (
    "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1 "
    "--xla_backend_optimization_level=1"
)
_TRIED = "0.10."


def enable() -> None:
    """Set up JAX for a command, unless it is imported already; what the user has set stays."""
    if "jax" in sys.modules:
        return
    if "XLA_FLAGS" not in os.environ and _is_for_them():
        os.environ["XLA_FLAGS"] = _XLA_FLAGS
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        _keep()


def _is_for_them() -> bool:
    """Whether the settings are known to XLA, and it compiles for a processor, not a GPU."""
    accelerated = importlib.util.find_spec("jax_plugins") is not None
    on_processor = not accelerated or os.environ.get("JAX_PLATFORMS") == "cpu"
    return on_processor and importlib.metadata.version("jaxlib").startswith(_TRIED)


def _keep() -> None:
    """Name a folder of the user's for what is compiled."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "robins" / f"jax-{_machine()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return  # a home that cannot be written costs time, not the run
    if os.access(folder, os.W_OK):
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")


def _machine() -> str:
    """A digest of the processor: machines that share a home must not share its instructions."""
    told = [platform.machine(), platform.processor()]
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").splitlines()
        told += [line for line in lines if line.startswith(("model name", "flags", "Features"))][:2]
    except OSError:
        pass
    return hashlib.sha256("\n".join(told).encode()).hexdigest()[:12]
