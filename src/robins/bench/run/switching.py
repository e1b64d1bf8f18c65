"""Faults of processes: parts that are killed, and parts whose power is switched off and on.

A killed part is brought back to its state, if the run restarts dead parts. A part without power
loses its state: it starts in the middle of the run as before the first step.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

from robins.bench.broker.broker import Broker
from robins.bench.broker.injector import Injector
from robins.bench.run.processes import PartProcesses

POWER_ON_HELLO_S = 60.0  # for the hello of a part that is switched on


def switch(
    injector: Injector,
    part_processes: PartProcesses,
    broker: Broker,
    time_ns: int,
    speaks: Mapping[str, str],
    reap: Callable[[str], None],
    event: Callable[[str, str], None],
) -> None:
    """Apply the faults of processes, before a step.

    The process of a part is started again as soon as the part is switched off, and waits to be
    switched on: so its start-up time does not prolong the fault. Boards are left alone.

    Args:
        injector: the faults of the run.
        part_processes: its processes.
        broker: its hub.
        time_ns: time of the run at the end of the step.
        speaks: the ports of the parts that are processes.
        reap: waits until a part has died, and applies the policy of the run.
        event: notes an event by its kind and text.

    Raises:
        BenchError: a part that was switched on sends no hello.
    """
    for part in injector.killed(time_ns):
        event("killed", f"'{part}' is killed, as a fault")
        part_processes.kill(part)
        reap(part)
    off = injector.off(time_ns) & speaks.keys()
    for part in sorted(off - broker.off):
        event("power", f"'{part}' is switched off, as a fault")
        injector.counts["power", part] += 1
        part_processes.kill(part)
        while not part_processes.deaths(part):
            time.sleep(0.001)
        broker.switch_off(part)
        part_processes.start(part, speaks[part])
    for part in sorted(broker.off - off):
        broker.switch_on(part, POWER_ON_HELLO_S)
        event("power", f"'{part}' is switched on, and begins anew")
