"""Saving of compile time: faster compiler settings, and a cache kept between commands."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import importlib.util
import os
import platform
import subprocess
import sys
from pathlib import Path

# These halve the time to compile a campaign and leave the time to run it (`benchmarks/compile.py`).
# XLA aborts on an unknown setting.
_XLA_FLAGS = (
    "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1 "
    "--xla_backend_optimization_level=1"
)
_KNOWN = ("0.10.",)  # versions of jaxlib that accept them; others are tried once
_TRIAL = """
try:
    from jaxlib import xla_client
    xla_client.CompileOptions()  # reads them, a second before JAX is imported
except (ImportError, AttributeError):
    import jax
    jax.jit(abs)(1.0)
"""
_TRIAL_S = 60.0
_UNKNOWN = b"Unknown flag"  # message of XLA before it aborts
_REFUSED = (
    "robins: note: this jaxlib ({}) does not take the settings that halve the time to compile; "
    "it will take longer. Nothing else changes."
)
_MOST = 1 << 30  # bytes of compiled programs kept; the least recently used go first


def enable() -> None:
    """Set up JAX for a command, unless already imported; settings of the user stay."""
    if "jax" in sys.modules:
        return
    # XLA logs for its developers, such as on slow compilations; its errors come as exceptions.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    folder = _folder()
    if "XLA_FLAGS" not in os.environ and _on_processor():
        version = importlib.metadata.version("jaxlib")
        taken = version.startswith(_KNOWN) or _accepts_settings(version, folder)
        os.environ["XLA_FLAGS"] = _XLA_FLAGS if taken else ""
        if taken is False:
            with contextlib.suppress(OSError):
                print(_REFUSED.format(version), file=sys.stderr)
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ and folder is not None:
        _prune(folder)
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")


def _on_processor() -> bool:
    """True if XLA compiles for a processor, not a GPU."""
    accelerated = importlib.util.find_spec("jax_plugins") is not None
    return not accelerated or os.environ.get("JAX_PLATFORMS") == "cpu"


def _accepts_settings(version: str, folder: Path | None) -> bool | None:
    """True if a version of jaxlib accepts the settings; tried in another process, and stored.

    None if the trial itself failed; it is repeated next time.
    """
    digest = hashlib.sha256(f"{version} {_XLA_FLAGS}".encode()).hexdigest()[:12]
    memory = folder and folder.parent / f"settings-{digest}"
    with contextlib.suppress(OSError):
        if memory and (known := memory.read_text("utf-8")) in ("taken", "refused"):
            return known == "taken"
    try:
        settings = {"XLA_FLAGS": _XLA_FLAGS, "JAX_PLATFORMS": "cpu"}
        trial = [sys.executable, "-P", "-c", _TRIAL]
        done = subprocess.run(
            trial, env=os.environ | settings, capture_output=True, timeout=_TRIAL_S
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    if done.returncode and _UNKNOWN not in done.stderr:
        return None
    with contextlib.suppress(OSError):
        if memory:
            new = memory.with_suffix(f".{os.getpid()}")
            new.write_text("refused" if done.returncode else "taken", "utf-8")
            new.replace(memory)
    return done.returncode == 0


def _folder() -> Path | None:
    """The user's folder for compiled programs; None if it cannot be made."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "robins" / f"jax-{_machine()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None  # an unwritable home costs time, not the run
    return folder if os.access(folder, os.W_OK) else None


def _prune(folder: Path) -> None:
    """Remove the least recently used files of a folder that holds more than `_MOST` bytes."""
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        every = [(one.stat(), one.path) for one in entries if one.is_file()]
        left = sum(stat.st_size for stat, _ in every)
        for stat, path in sorted(every, key=lambda e: max(e[0].st_atime, e[0].st_mtime)):
            if left <= _MOST:
                break
            os.unlink(path)
            left -= stat.st_size


def _machine() -> str:
    """Digest of the processor: machines that share a home must not share compiled code."""
    settings = [platform.machine(), platform.processor()]
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").splitlines()
        settings += [
            line for line in lines if line.startswith(("model name", "flags", "Features"))
        ][:2]
    except OSError:
        pass
    return hashlib.sha256("\n".join(settings).encode()).hexdigest()[:12]
