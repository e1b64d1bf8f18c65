"""Meter of a test run: processor seconds of each test, and its counts.

Counted are the programs that JAX is asked to compile, whether or not its cache has them; processes
started; texts given to a C compiler, whether or not the cache of compiled C has them; and runs that
campaigns simulate (`counting.py`).
"""

import hashlib
import json
import os
import resource
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
from counting import KINDS, Counts

HERE = Path(__file__).parent
# Processor seconds of `reference` on the machine on which the ceilings were set.
REFERENCE_S = 0.37


def reference() -> float:
    """Processor seconds of a fixed loop of Python and NumPy, by which machines are compared."""
    import numpy as np

    begin = time.process_time()
    total, matrix = 0.0, np.linspace(0.0, 1.0, 2500).reshape(50, 50)
    for k in range(500_000):
        total += len(str(k)) * hash((k, "x")) % 7
    for _ in range(50_000):
        total += float((matrix @ matrix)[0, 0])
    assert total > 0.0
    return time.process_time() - begin


def digest(file: str) -> str:
    """Digest of the text of a file of tests."""
    return hashlib.sha256((HERE / file).read_bytes()).hexdigest()[:12]


def sealed(row: dict) -> dict:
    """A row of `costs.json` with a checksum of its numbers, by which a typed one is found."""
    bare = {k: v for k, v in row.items() if k != "seal"}
    text = json.dumps(bare, sort_keys=True)
    return bare | {"seal": hashlib.sha256(text.encode()).hexdigest()[:12]}


class Meter:
    """Plugin that measures each test, and gathers the workers' rows in the controller.

    Attributes:
        rows: by file of tests and name of a test, its counts, with "seconds" of processor as on
            the machine of the ceilings.
        modules: imported when all tests are collected.
        spent_s: processor seconds of all workers, with what they did between tests.
        peak: most memory of a worker [MiB], and the test that reached it.
    """

    def __init__(self) -> None:
        self.rows: dict[str, dict[str, Counter]] = {}
        self.modules, self.spent_s, self.peak = 0, 0.0, (0, "")
        self.gathered = False  # from workers
        self.counts, self.loop_s = Counts(every=False), reference()

    def pytest_collection_finish(self) -> None:
        """Count modules; what is imported while tests run depends on their order."""
        self.counts.begin()
        self.modules = len(sys.modules)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        """Setup, call and teardown: the first user of a fixture pays for it."""
        before, spent = Counter(self.counts), processor_s()
        done = yield
        file, _, name = item.nodeid.removeprefix("tests/").partition("::")
        row = self.rows.setdefault(file, {}).setdefault(name.partition("[")[0], Counter())
        row.update({k: self.counts[k] - before[k] for k in KINDS})
        row["seconds"] += (processor_s() - spent) * REFERENCE_S / self.loop_s
        peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
        if peak_mib > self.peak[0]:
            self.peak = peak_mib, item.nodeid
        return done

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session):
        """Hand the rows of a worker to the controller."""
        if not self.gathered:
            self.spent_s = processor_s()
        if hasattr(session.config, "workeroutput"):
            rows = {f: {t: dict(c) for t, c in tests.items()} for f, tests in self.rows.items()}
            session.config.workeroutput["meter"] = rows
            session.config.workeroutput["totals"] = self.modules, self.spent_s, self.peak

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node, error):
        """Add the rows of a worker."""
        for file, tests in getattr(node, "workeroutput", {}).get("meter", {}).items():
            for name, counts in tests.items():
                self.rows.setdefault(file, {}).setdefault(name, Counter()).update(counts)
        modules, spent, peak = getattr(node, "workeroutput", {}).get("totals", (0, 0.0, (0, "")))
        self.gathered, self.modules = True, max(self.modules, modules)
        self.spent_s, self.peak = self.spent_s + spent, max(self.peak, tuple(peak))


def processor_s() -> float:
    """Processor seconds of this process and of those it started and has waited for."""
    return sum(os.times()[:4])
