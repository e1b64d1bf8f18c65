"""What each filter of "magnetic-attitude" believes, and what it is given of a run."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from robins.filters import Belief, Model, channel, kalman, observability_shares
from robins.manifold import Angle
from robins.sim.free_body import coning_start
from robins.systems.recipes import recipe
from robins.systems.rocket.angles import (
    GYRO,
    MAGNETIC,
    Coefficients,
    angle_sensor,
    angle_state,
    body_model,
    rate_sensor,
    reckoned_model,
    unmoved_model,
)
from robins.systems.rocket.field import bridged
from robins.systems.rocket.filters import BY_STATE, KINDS, Kind, Sight, make_filter
from robins.systems.rocket.parameters import MagneticAttitude
from robins.systems.rocket.world import World, body_of, wrong_by
from robins.systems.study import Case, Contender

FORGETS = (10.0, 10.0)  # rad, rad/s: noise of a step that leaves nothing of what was before


class Numbers(NamedTuple):
    """Data of a contender, so that contenders that differ in these alone compile once."""

    sigma: Array  # (6,) initial


def coefficients(given: MagneticAttitude) -> Coefficients:
    """Of the motion as the filters believe it."""
    wrong = 1.0 + given.believed.error
    kinematic = wrong if given.believed.wrong == "all" else 1.0
    e1, e2, e3 = (wrong * e for e in body_of(given))
    return Coefficients(*map(jnp.asarray, (e1, e2, e3, kinematic, given.step)))


def believed_model(given: MagneticAttitude, kind: Kind) -> Model:
    """Motion and sensors of a kind of filter."""
    b, step = given.believed, given.step
    of_gyro = rate_sensor(jnp.full(3, given.gyro.white))
    if given.gyro_reads == "attitude":
        of_gyro = angle_sensor(GYRO, jnp.full(3, given.gyro.attitude_noise))
    of_magnet = angle_sensor(MAGNETIC, jnp.full(3, given.magnetometer.noise))
    sensors = tuple(s for s in (of_gyro, of_magnet) if s.name in kind.sensors)
    if kind.motion == "reckoned" and given.gyro_reads == "rate":
        white = given.gyro.white
        return reckoned_model(jnp.asarray(step), jnp.repeat(jnp.array([step * white, white]), 3))
    if kind.motion != "body":
        sensor = of_gyro if kind.motion == "reckoned" else of_magnet
        return unmoved_model(jnp.asarray(step), jnp.repeat(jnp.array(FORGETS), 3), sensor)
    noise = np.array([b.attitude_noise, b.rate_noise]) * np.sqrt(step)
    return body_model(coefficients(given), jnp.repeat(jnp.asarray(noise), 3), sensors)


def sight_of(given: MagneticAttitude, filters: tuple[str, ...]) -> Sight:
    """What filters must know of their sensors.

    Shares are by how well each sees each state at the start; halves where no filter asks for them.
    """
    if not set(filters) & set(BY_STATE):
        return Sight(gyro_reads=given.gyro_reads)
    b = given.body
    q, omega = coning_start(b.spin, b.cone, b.elevation, b.azimuth, body_of(given))
    mean = angle_state(wrong_by(q, given.start.attitude_error), omega)
    belief = Belief(mean, jnp.diag(initial_sigma(given)))
    channels = [channel((name,), kalman()) for name in (GYRO, MAGNETIC)]
    found = observability_shares(believed_model(given, KINDS["ukf"]), belief, channels)
    return Sight(tuple(tuple(float(x) for x in row) for row in found), given.gyro_reads)


def initial_sigma(given: MagneticAttitude) -> Array:
    """(6,) of angles and rates."""
    return jnp.repeat(jnp.array([given.start.attitude, given.start.rate]), 3)


def as_case(reads: str, reckoned: bool, sensors: tuple[str, ...], n: Numbers, world: World) -> Case:
    """What a filter takes of a run; pure."""
    rows: dict[str, Any] = {
        GYRO: world.rate if reads == "rate" else _as_angles(world.integrated),
        MAGNETIC: _as_angles(world.angles),
    }
    if reckoned and reads == "attitude":
        sensors = (GYRO,)
    return Case(
        start=Belief(angle_state(world.start_q_nb, world.start_omega_b), jnp.diag(n.sigma)),
        u=bridged(world.theta).theta_b,
        y={name: rows[name] for name in sensors},
        aux={},
        truth=angle_state(world.q_nb, world.omega_b),
    )


def _as_angles(rows: Array) -> tuple[Angle, Angle, Angle]:
    roll, pitch, yaw = (Angle(rows[:, i]) for i in range(3))
    return roll, pitch, yaw


def angle_contender(given: MagneticAttitude, name: str, sight: Sight) -> Contender:
    """A filter with its model and its data.

    Raises:
        ValueError: there is no filter of this name.
    """
    filter_, kind = make_filter(name, sight), KINDS[name]
    return Contender(
        filter=filter_,
        model=believed_model(given, kind),
        case=recipe(
            as_case,
            given.gyro_reads,
            kind.motion == "reckoned",
            kind.sensors,
            numbers=Numbers(initial_sigma(given)),
        ),
    )
