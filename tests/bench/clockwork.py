"""A rig that imports no JAX, so its processes start at once: one part counts, the other adds up."""

import time
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar, NamedTuple

import numpy as np

from robins.bench import Part, Rig, Wire
from robins.bench.wire.fields import f64, message
from robins.scenario import Parameters, Quantity, default

CLOCKWORK = f"{Path(__file__)}:rig"


class Clockwork(Parameters):
    """A scenario: ``wait`` is the time that the adder takes to start."""

    duration: Annotated[float, Quantity("time", above="0 s")] = default("60 s")
    step: Annotated[float, Quantity("time", above="0 s")] = default("100 ms")
    wait: Annotated[float, Quantity("time", least="0 s")] = default("0 s")


class Kit(NamedTuple):
    """Numbers of a run."""

    step_ns: int
    wait_s: float
    frames: tuple[int, ...] = (0,)


def counter(config):
    """Say the number of the step."""
    return Part("counter", {}, lambda: None, lambda state, k, heard: (None, [("count", {"n": k})]))


def adder(config):
    """Say the sum of the numbers heard."""

    def act(total, k, heard):
        total += heard["count"]["n"] if heard["count"] else 0.0
        return total, [("sum", {"total": total})]

    wait = partial(time.sleep, config.wait_s)
    return Part("adder", {"count": 0}, lambda: 0.0, act, {"count": None}, wait)


class ClockworkRig(Rig):
    """The clockwork."""

    name = "clockwork"
    wire = Wire(
        ("counter", "adder"),
        (
            message(16, "count", "A number.", f64("n", 1, "1", "of the step", 1e9)),
            message(17, "sum", "Their sum.", f64("total", 1, "1", "so far", 1e18)),
        ),
    )
    sends: ClassVar = {"counter": ("count",), "adder": ("sum",)}
    takes: ClassVar = {"counter": (), "adder": ("count",)}
    parameters = Clockwork
    truth = "count"

    def prepare(self, setup, given):
        return Kit(round(1e9 * given.step), given.wait)

    def filters(self):
        return ("exact",)

    def inside(self, config, steps):
        """Numbers of a run, in closed form."""
        n = np.arange(float(steps))
        return {"count.n": n, "sum.total": n * (n + 1.0) / 2.0}


rig = ClockworkRig()
