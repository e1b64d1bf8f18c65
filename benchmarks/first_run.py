"""The time to the first answer: `robins demo` from an empty cache, then again.

Each is a whole process: wall time, time of all processors, the most memory, how many programs XLA
compiled and how many it found in the cache of the first one.

    python benchmarks/first_run.py [ARGUMENT ...]     # of robins, in place of `demo`
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROBINS = "from robins.cli import main; raise SystemExit(main())"
COMPILED, FOUND = "Finished XLA compilation of", "Persistent compilation cache hit"


class Spent(NamedTuple):
    """Time and memory of a process."""

    wall_s: float
    processor_s: float
    memory_mb: float
    compiled: int
    found: int  # programs that were compiled before


def spent(arguments: list[str], folder: Path) -> Spent:
    """Run robins with a cache in a folder.

    Raises:
        RuntimeError: it failed.
    """
    told = {"XDG_CACHE_HOME": str(folder / "cache"), "JAX_LOG_COMPILES": "1"}
    env = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    log, begin = folder / "log", time.monotonic()
    with log.open("w") as err, (folder / "out").open("w") as out:
        command = [sys.executable, "-c", ROBINS, *arguments]
        process = subprocess.Popen(command, cwd=folder, env=env | told, stdout=out, stderr=err)
        _, status, used = os.wait4(process.pid, 0)
    wall, text = time.monotonic() - begin, log.read_text("utf-8", "replace")
    if status:
        raise RuntimeError(text[-2000:])
    found = text.count(FOUND)
    per_mb = 1e6 if sys.platform == "darwin" else 1e3  # bytes there, kilobytes here
    processor = used.ru_utime + used.ru_stime
    return Spent(wall, processor, used.ru_maxrss / per_mb, text.count(COMPILED) - found, found)


def main() -> None:
    arguments = sys.argv[1:] or ["demo"]
    print(f"robins {' '.join(arguments)}, {os.cpu_count()} cores", flush=True)
    with tempfile.TemporaryDirectory(prefix="robins-first-") as name:
        for what in ("empty cache", "again"):
            s = spent(arguments, Path(name))
            print(
                f"{what:12} wall {s.wall_s:6.1f} s   processor {s.processor_s:6.1f} s   "
                f"memory {s.memory_mb:5.0f} MB   compiled {s.compiled:3}   found {s.found:3}",
                flush=True,
            )
        size = sum(path.stat().st_size for path in Path(name, "cache").rglob("*") if path.is_file())
        print(f"{'cache':12} {size / 1e6:.0f} MB")


if __name__ == "__main__":
    main()
