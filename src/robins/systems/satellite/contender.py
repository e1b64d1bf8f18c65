"""Each filter with the model it believes in, in the loop."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array

from robins.errors import require_known
from robins.filters import Loop
from robins.filters.rules import with_gains
from robins.filters.synthesis import MissingExtra
from robins.systems.recipes import recipe
from robins.systems.satellite import design, model
from robins.systems.satellite.course import Course
from robins.systems.satellite.driven import Lens
from robins.systems.satellite.filters import KINDS, Build, Kind, make_filter
from robins.systems.satellite.nodes import STAR, Given, Row, Vehicle, begin, react
from robins.systems.satellite.parameters import AttitudeLoop
from robins.systems.satellite.world import World
from robins.systems.study import Case, Contender

_DIMS = {STAR: 3}


class Numbers(NamedTuple):
    """Data of a contender, so that contenders that differ in these alone compile once."""

    course: Any  # `Step` with leading axis E
    due: Array  # (E,) bool
    craft: Any
    control: Any
    pinv: Array
    step_s: Array
    quantum_rad: Array
    attitude_rad: Array  # believed at the start
    bias_rad_s: Array
    gain: Array  # (6, 3); zeros where there is none
    lens: Lens | None


def surroundings(n: Numbers, world: World) -> tuple[Given, Row, Vehicle]:
    """The loop around a filter: its numbers, what drives it (E steps), and how it begins."""
    given = Given(
        n.craft,
        n.control,
        n.pinv,
        n.step_s,
        n.quantum_rad,
        world.gyro_matrix,
        world.star_key,
        n.lens,
    )
    rows = Row(n.course, world.gyro_angle, world.gyro_bias, world.star_error)
    return given, rows, begin(given, world.craft)


def believed_walk(given: AttitudeLoop, kind: Kind) -> float:
    """Random walk of the gyro's rate that a filter believes in [rad/s/sqrt(s)]."""
    g = given.gyro
    true = model.equivalent_walk(g.rate_walk, g.markov, g.markov_time)
    if kind.drift is None:
        return true
    believed = true if given.believed.drift is None else given.believed.drift
    return math.sqrt(kind.drift) * believed


def as_case(additive: bool, build: Build, n: Numbers, world: World) -> Case:
    """What a filter takes of a run; pure."""
    reacts = partial(react, model.ADDITIVE if additive else model.MULTIPLICATIVE)
    given, rows, vehicle = surroundings(n, world)
    start: Any = model.start(world.start_q_ib, n.attitude_rad, n.bias_rad_s, additive)
    if build.startswith("fixed"):
        start = with_gains(make_filter(build).init(start, _DIMS), {STAR: n.gain})
    loop = Loop(Partial(reacts, given), vehicle, rows, {STAR: n.due})
    return Case(start=start, u=None, y={}, aux={}, truth=None, loop=loop)


def contender(given: AttitudeLoop, course: Course, name: str) -> Contender:
    """A filter with its model and its data.

    Raises:
        ValueError: there is no filter of this name, or its design needs a package that is not
            there.
    """
    require_known("filter", name, KINDS)
    kind = KINDS[name]
    walk = believed_walk(given, kind)
    noise = model.noise_of(given.gyro.random_walk, walk, given.step)
    believed = design.believed(given, walk)
    gain, facts = np.zeros((6, 3)), {}
    if kind.recipe is not None:
        try:
            facts = dict(design.facts(believed, kind.recipe))
        except MissingExtra as error:
            raise ValueError(f"filter '{name}': {error}; or choose others by --filters") from error
        if kind.build.startswith("fixed"):
            gain = design.gain(believed, kind.recipe)
        else:
            more = design.inflation(believed, kind.recipe) * math.sqrt(
                given.step / given.star.period
            )
            noise = noise._replace(factor=jnp.concatenate([noise.factor, more], axis=1))
    numbers = Numbers(
        course=course.steps,
        due=jnp.asarray(course.due),
        craft=course.craft,
        control=course.control,
        pinv=jnp.asarray(course.pinv),
        step_s=jnp.asarray(given.step),
        quantum_rad=jnp.asarray(given.gyro.quantum),
        attitude_rad=jnp.asarray(given.believed.attitude),
        bias_rad_s=jnp.asarray(given.believed.bias),
        gain=jnp.asarray(gain),
        lens=course.lens,
    )
    additive = kind.build == "quaternion"
    return Contender(
        filter=make_filter(kind.build),
        model=model.model(noise, given.star.noise, additive, given.star.camera is not None),
        case=recipe(as_case, additive, kind.build, numbers=numbers),
        facts=facts,
    )
