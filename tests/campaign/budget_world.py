"""Two instruments that read zero with noise, and a filter that takes each for a constant.

Errors are linear in the noise, so their mean squares add and all of it has a closed form.
"""

from functools import partial
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from robins.filters import Belief, Model, Motion, Sensor, kalman
from robins.scenario import Parameters, Quantity, default
from robins.sim.random import Component, stream
from robins.systems import Case, Contender, Scenario, SensorAxes, StateBlock, Study, View

Metres = Annotated[float, Quantity("length", least="0 m")]
COUNT, BELIEVED, START = 20, 1.0, 2.0


class Instruments(Parameters):
    left: Metres = default("1 m")
    right: Metres = default("1 m")
    both: Annotated[tuple[float, float], Quantity("length", least="0 m")] = default("1 m")


class Pair(Scenario):
    noise: Instruments = Instruments()
    unused: Metres = default("1 m")
    begin: Metres = default("2 m")  # the world brings it along as what the filter believes
    step: Annotated[float, Quantity("time", above="0 s")] = default("1 s")
    shape: Annotated[float, Quantity("length")] = default("5 m")  # decides a number of samples
    kind: Literal["one", "two"] = "one"
    explode: Metres = default("0 m")


class Course(NamedTuple):
    epoch_s: np.ndarray


def lay_out(given: Any) -> Course:
    return Course(given.step * np.arange(1, COUNT + 1))


def simulate(given: Any, course: Course, seed: int, run: Any) -> Case:
    np.zeros(int(given.shape))
    key = stream(seed, run, Component.BAROMETER)
    sigma = jnp.stack([jnp.asarray(x, float) for x in (given.noise.left, given.noise.right)])
    sigma = sigma * jnp.stack([jnp.asarray(x, float) for x in given.noise.both])
    z = sigma[None] * jax.random.normal(key, (COUNT, 2))
    truth = jnp.broadcast_to(jnp.where(given.explode > 0.5, jnp.nan, 0.0), (COUNT, 2))
    start = Belief(jnp.zeros(2), jnp.eye(2) * given.begin)
    return Case(start, None, {"pair": z}, {}, truth)


def contender(given: Any, course: Course, name: str) -> Contender:
    motion = Motion(lambda x, u: x, jnp.zeros(2))
    sensor = Sensor(lambda x, aux: x, jnp.full(2, BELIEVED), name="pair")
    return Contender(kalman(), Model(motion, (sensor,)))


def view(given: Any, course: Course) -> View:
    block = partial(StateBlock, units="m", display_unit="cm", frame="none")
    blocks = (
        block(name="left", where=slice(0, 1), axes=("left",)),
        block(name="right", where=slice(1, 2), axes=("right",)),
    )
    both = block(name="both", where=slice(0, 2), axes=("left", "right"))
    axes = {"pair": SensorAxes("m", "none", ("left", "right"))}
    return View(course.epoch_s, (*blocks, both), axes, count_from=3)


study = Study(
    parameters=Pair,
    filters=("kf",),
    simulate=simulate,
    contender=contender,
    view=view,
    lay_out=lay_out,
)
