"""The bench: steps a second with seven processes in lock-step, and lateness in real time.

    python benchmarks/bench.py [--seconds 200] [--machine c]

The peer is the same loop inside one program, a compiled scan, so the ratio is what the wire costs:
seven processes, fourteen switches between them a step, frames made, checked and recorded.

For real time the machine is looked at first: a process on each core does nothing but read the
clock. What it loses there (other machines on the same host, the kernel) no program here can keep.
"""

import argparse
import multiprocessing
import os
import tempfile
import time
from pathlib import Path

from robins.bench.rigs.satellite.judging import inside
from robins.bench.run.session import Session
from robins.bench.run.setup import changed, read
from robins.bench.run.telemetry import difference

GAP_MS, LOOK_S = 1.0, 20.0


def gaps(core: int) -> list[float]:
    """For how long a core did not run a process that only reads the clock [ms], each time."""
    os.sched_setaffinity(0, {core})
    last, found = time.monotonic_ns(), []
    until = last + round(LOOK_S * 1e9)
    while last < until:
        now = time.monotonic_ns()
        if now - last > GAP_MS * 1e6:
            found.append((now - last) * 1e-6)
        last = now
    return found


def main() -> None:
    ask = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    ask.add_argument("--seconds", type=float, default=200.0)
    ask.add_argument("--machine", choices=("jax", "c"), default="jax", help="of the parts")
    asked = ask.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "bench.mcap"
        flight = changed(read("satellite/s1"), {"seconds": asked.seconds, "machine": asked.machine})
        ran = Session(flight, record).run()
        inside(ran.config)  # compiles
        began = time.perf_counter()
        alone = inside(ran.config)
        spent = (time.perf_counter() - began) / ran.steps
        steps = ran.steps / ran.seconds
        print(f"lock-step, seven processes   {steps:10.0f} steps/s")
        ratio = 1.0 / spent / steps
        print(f"one program                  {1.0 / spent:10.0f} steps/s, {ratio:.0f} times")
        print(f"difference                   {difference(ran.series, alone):10.3g}")
        print(f"record                       {record.stat().st_size / ran.steps:10.0f} bytes/step")
        print(ran.latencies.table())
        cores = sorted(os.sched_getaffinity(0))
        with multiprocessing.get_context("spawn").Pool(len(cores)) as pool:
            lost = sorted((gap for found in pool.map(gaps, cores) for gap in found), reverse=True)
        long = sum(gap > 3.0 for gap in lost)
        print(f"each core alone, {LOOK_S:g} s        {len(lost):6d} gaps above {GAP_MS:g} ms")
        print(f"above 3 ms, and the longest  {long:6d}, {max(lost, default=0.0):.1f} ms")
        real = changed(flight, {"clock": "realtime", "rate": 100.0})
        ran = Session(real, record, config=ran.config).run()
        late = ran.latencies.summary()
        print(f"real time, 100 Hz            {late['missed']:6d} of {ran.steps} deadlines missed")
        print(f"lateness p50, p99, max [us]  {late['cycle']['lateness_us']}")
        print(ran.latencies.table())


if __name__ == "__main__":
    main()
