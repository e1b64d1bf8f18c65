"""A balloon that climbs, and a barometer that is grossly wrong now and then.

States: height h [m] and climb rate v [m/s]. The air pushes the balloon with white noise w of
density q [m/s/sqrt(s)]:

    h' = v ,   v' = w ,   z = h + noise

so over a step T

    F = [1 T]     Q = q^2 [T^3/3  T^2/2]     H = [1 0]
        [0 1]             [T^2/2      T]
"""

from functools import partial
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from robins.filters import Belief, Model, Motion, Sensor, kalman
from robins.filters.rules import gate
from robins.scenario import Quantity, Share, default
from robins.sim.random import Component, stream
from robins.systems import Case, Contender, Scenario, SensorAxes, StateBlock, Study, View
from robins.systems.judgement import Claim, ratio


class Balloon(Scenario):
    """Parameters of a scenario; everything has a unit and a default."""

    title: str = "A balloon climbs"
    duration: Annotated[float, Quantity("time", above="0 s")] = default("300 s")
    step: Annotated[float, Quantity("time", above="0 s")] = default("1 s")
    push: Annotated[float, Quantity("velocity random walk", above="0 m/s/sqrt(s)")] = default(
        "0.05 m/s/sqrt(s)"
    )
    barometer: Annotated[float, Quantity("length", above="0 m")] = default("3 m")
    outlier_share: Share = 0.05
    outlier_factor: float = 20.0


class Course(NamedTuple):
    """Data that all runs share."""

    epoch_s: np.ndarray  # (E,)
    F: np.ndarray  # (2, 2)
    L: np.ndarray  # (2, 2) factor of Q


START, SIGMA = np.array([100.0, 4.0]), np.array([5.0, 1.0])  # m, m/s: believed at first
READS = np.array([[1.0, 0.0]])  # H


def lay_out(given: Balloon) -> Course:
    T = given.step
    Q = given.push**2 * np.array([[T**3 / 3.0, T**2 / 2.0], [T**2 / 2.0, T]])
    F = np.array([[1.0, T], [0.0, 1.0]])
    return Course(T * np.arange(1, int(given.duration / T) + 1), F, np.linalg.cholesky(Q))


def simulate(given: Balloon, course: Course, seed: int, run) -> Case:
    """One run: the true climb, and what the barometer says of it."""
    key, count = partial(stream, seed, run), len(course.epoch_s)
    first = START + SIGMA * jax.random.normal(key(Component.INITIAL_STATE), (2,))
    pushed = jax.random.normal(key(Component.TRAJECTORY), (count, 2)) @ course.L.T

    def move(x, w):
        x = course.F @ x + w
        return x, x

    _, truth = jax.lax.scan(move, first, pushed)
    wrong = jax.random.bernoulli(key(Component.FAULT), given.outlier_share, (count, 1))
    sigma = given.barometer * jnp.where(wrong, given.outlier_factor, 1.0)
    z = truth @ READS.T + sigma * jax.random.normal(key(Component.BAROMETER), (count, 1))
    start = Belief(jnp.asarray(START), jnp.diag(jnp.asarray(SIGMA)))
    return Case(start, u=None, y={"barometer": z}, aux={}, truth=truth)


FILTERS = {"kf": [], "gated": [gate(0.999)]}


def climb(F, x, u):
    return F @ x


def read(x, aux):
    return READS @ x


def contender(given: Balloon, course: Course, name: str) -> Contender:
    """A filter with the model it believes in: it knows nothing of outliers."""
    # with its numbers as data a model with others is not compiled again
    moves = Motion(Partial(climb, course.F), jnp.asarray(course.L))
    barometer = Sensor(read, jnp.array([given.barometer]), name="barometer")
    return Contender(kalman(rules=FILTERS[name]), Model(moves, (barometer,)))


def view(given: Balloon, course: Course) -> View:
    """Report of every filter."""
    height = StateBlock("height", slice(0, 1), "m", "m", "up", ("height",))
    climb = StateBlock("climb", slice(1, 2), "m/s", "m/s", "up", ("climb rate",))
    return View(course.epoch_s, (height, climb), {"barometer": SensorAxes("m", "up", ("height",))})


CLAIMS = {
    "gate-helps": Claim(
        "A gate keeps outliers out of the height; value: RMS height error, gated over plain",
        ("gated", "kf"),
        ratio("gated", "kf", "height_rms_m"),
        (0.0, 0.5),
        (0.0, 1.0),
    )
}

study = Study(
    parameters=Balloon,
    filters=tuple(FILTERS),
    lay_out=lay_out,
    simulate=simulate,
    contender=contender,
    view=view,
    claims=CLAIMS,
)
