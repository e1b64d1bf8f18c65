"""The run of a bench inside one program, without any wire, as the reference for the bench."""

from __future__ import annotations

from functools import partial

import jax
import numpy as np

from robins.bench.parts.satellite.kit import Kit, as_numpy
from robins.bench.run.setup import Flight
from robins.bench.run.telemetry import Flown, padded
from robins.filters import Loop, run_closed
from robins.systems.satellite.nodes import STAR, react


def in_process(flight: Flight, kit: Kit) -> Flown:
    """The same run inside one program, by `run_closed`, as `robins run --runs 1` does it."""
    loop = Loop(
        jax.tree_util.Partial(partial(react, kit.form), kit.given),
        kit.vehicle,
        kit.rows,
        {STAR: kit.due},
    )
    done = run_closed(kit.filter, kit.model, kit.start, loop, keep=lambda step: step.posterior)
    mean, said = done.steps.mean, done.readings
    q_est = as_numpy(jax.jit(jax.vmap(kit.form.attitude))(mean))
    q = np.asarray(jax.tree_util.tree_leaves(said.truth)[0])  # first of the state of each kind
    steps = len(q)
    none = np.full((steps, 3), np.nan)
    return Flown(
        time_s=np.arange(1, steps + 1) * flight.loop.step,
        q_ib=np.asarray(q),
        omega_b=none,
        q_est_ib=np.asarray(q_est),
        bias=np.asarray(kit.form.bias(mean)),
        sigma=np.full((steps, 6), np.nan),
        flags=np.zeros(steps, np.int64),
        innovation=none,
        innovation_sigma=none,
        ratio=none[:, 0],
        wheel_h=padded(np.asarray(said.outputs["wheel_momentum"])),
    )
