"""Counts of what a process asks for, the same on every machine but for roundings of order.

    python tests/counting.py COUNTS.json demo --runs 2

runs a command of robins in this process and writes its counts, and the modules it imported.
"""

import json
import os
import re
import sys
from collections import Counter
from functools import cache
from pathlib import Path

KINDS = ("programs", "processes", "builds", "runs")
COMPILER = re.compile(r"(.*-)?(cc|c\+\+|gcc|g\+\+|clang|clang\+\+|zig|ccache)(-[\d.]+)?(\.exe)?")


class Counts(Counter[str]):
    """Events of this process since `begin`.

    Args:
        every: count programs of one operation of JAX too. Which test of a worker is the first to
            need such an operation depends on the order, so the counts of tests leave them out.
    """

    def __init__(self, every: bool) -> None:
        super().__init__()
        self.every, self.joined = every, False
        self.libraries: set[str] = set()

    def begin(self) -> None:
        """Begin to count, programs as soon as JAX is imported."""
        sys.addaudithook(self._audit)
        self._join()

    def _join(self) -> None:
        register = "register_event_duration_secs_listener"
        monitoring = sys.modules.get("jax.monitoring")
        if not self.joined and hasattr(monitoring, register):
            self.joined = True
            getattr(monitoring, register)(self._compiled)

    def _compiled(self, event: str, duration: float, **about: object) -> None:
        if event.endswith("backend_compile_duration"):
            name = str(about.get("fun_name")).removeprefix("jit(").rstrip(")").strip("_")
            self["programs"] += self.every or name not in operations()

    def _audit(self, event: str, given: tuple) -> None:
        if event == "import":
            self._join()
        elif event == "subprocess.Popen":
            words = [given[1]] if isinstance(given[1], (str, bytes)) else list(given[1])
            name = Path(os.fsdecode(given[0] or words[0])).name
            built = COMPILER.fullmatch(name) or "ziglang" in words
            if not built:
                self["processes"] += 1
            elif not any(Path(os.fsdecode(word)).name in self.libraries for word in words):
                self["builds"] += 1
        elif event == "robins.build_once":  # on a machine; in a wheel not at all
            self.libraries.add(given[0])
        elif event == "robins.build":
            self["builds"] += given[0] not in self.libraries
            self.libraries.add(given[0])
        elif event == "robins.simulate":
            self["runs"] += given[0]


@cache
def operations() -> set[str]:
    """Names of what JAX compiles when it is called outside compiled code."""
    import jax.lax
    import jax.numpy

    return {*dir(jax.lax), *dir(jax.numpy)}


def command(page: str, *words: str) -> int:
    """Run a command of robins and write its counts, programs of one operation included."""
    from robins.cli import main

    counts = Counts(every=True)
    counts.begin()
    status = main(list(words))
    counts["modules"] = len(sys.modules)
    Path(page).write_text(json.dumps(counts), "utf-8")
    return status


if __name__ == "__main__":
    sys.exit(command(*sys.argv[1:]))
