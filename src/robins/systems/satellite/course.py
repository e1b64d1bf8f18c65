"""What is the same in all runs: orbit, field, reference, when there are star frames."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from robins.earth.stars import hipparcos, synthetic
from robins.sim.attitude_control import Controller, allocation_matrix, controller
from robins.sim.attitude_reference import Reference, inertial, nadir, slews
from robins.sim.orbit import circular_orbit, field_along_orbit
from robins.sim.spacecraft import Spacecraft, spacecraft
from robins.sim.star_sensor import StarCamera, index_for
from robins.systems.satellite.driven import Lens, StarSays, Step
from robins.systems.satellite.parameters import AttitudeLoop, Craft, Star, Wheels


class Course(NamedTuple):
    """The same in all runs; E steps."""

    time_s: np.ndarray  # (E,) at the end of each step
    steps: Step
    due: np.ndarray  # (E,) bool, whether a step ends with a star frame
    craft: Spacecraft
    control: Controller
    lens: Lens | None
    pinv: np.ndarray  # (W, 3) from torques of the craft to those of the wheels


def inertia(craft: Craft) -> np.ndarray:
    """(3, 3) kg m^2."""
    xy, xz, yz = craft.products
    off = np.array([[0.0, xy, xz], [xy, 0.0, yz], [xz, yz, 0.0]])
    return np.diag(craft.moments) + off


def wheel_axes(wheels: Wheels) -> np.ndarray:
    """(3, W) unit columns."""
    axes = np.array(wheels.axes, float).T.reshape(3, len(wheels.axes))
    return axes / np.linalg.norm(axes, axis=0)


def lay_out(given: AttitudeLoop) -> Course:
    """Orbit, field and reference.

    Raises:
        ImportError: the Hipparcos catalogue without the extra "stars".
        ValueError: a craft that cannot be, wheels that do not turn it about three axes, or a date
            outside of the life of the magnetic model.
    """
    dt, o = given.step, given.orbit
    count = math.floor(given.duration / dt + 1e-9)
    edges = dt * np.arange(count + 1)
    where = o.altitude, o.inclination, o.node, o.latitude_argument
    middle = circular_orbit(*where, edges[:-1] + 0.5 * dt)
    field = field_along_orbit(middle, o.field, decimal_year=o.year)
    base = nadir(circular_orbit(*where, edges))
    if given.points == "inertial":
        base = inertial(base.q_ib[0], edges)
    wanted = _turned(given, base, edges)
    frame = round(given.star.period / dt)
    due = np.arange(1, count + 1) % frame == 0
    time = edges[1:]
    moments, wheels, axes = inertia(given.craft), given.wheels, wheel_axes(given.wheels)
    works = np.ones((count, len(wheels.axes)))
    left = np.array([float(i not in wheels.lost) for i in range(len(wheels.axes))])
    works[edges[:-1] > wheels.lost_at - 1e-9] = left
    return Course(
        time_s=time,
        steps=Step(
            wanted.q_ib[:-1],
            wanted.omega_b[:-1],
            wanted.alpha_b[:-1],
            wanted.q_ib[1:],
            middle.r_i_m,
            field,
            jnp.asarray(_disturbance(given, np.asarray(middle.time_s))),
            jnp.asarray(works),
            _star_says(given.star, due, time),
            jnp.arange(count),
        ),
        due=due,
        lens=_lens(given.star),
        craft=spacecraft(
            moments,
            axes,
            wheels.torque,
            wheels.momentum,
            given.control.dipole,
            given.craft.dipole,
        ),
        control=controller(
            moments, given.control.frequency, given.control.damping, given.control.unloading
        ),
        pinv=allocation_matrix(axes, left if wheels.loss_known else 1.0),
    )


def _turned(given: AttitudeLoop, base: Reference, time_s: np.ndarray) -> Reference:
    if (slew := given.slew) is None:
        return base
    return slews(base, slew.angle, slew.period, time_s, fade_in_s=slew.grows)


def _lens(star: Star) -> Lens | None:
    """The camera of a star sensor that has one, and the stars it may see."""
    if (given := star.camera) is None:
        return None
    camera = StarCamera(
        field_rad=given.field,
        magnitude_limit=given.magnitude,
        sigma_rad=given.noise,
        missed=given.missed,
        false_stars=given.false_stars,
    )
    stars = {"synthetic": synthetic, "hipparcos": hipparcos}[given.catalogue](given.magnitude)
    return Lens(camera, index_for(camera, stars), jnp.asarray(given.tolerance))


def _star_says(star: Star, due: np.ndarray, time_s: np.ndarray) -> StarSays:
    seen, stuck = due.copy(), np.zeros(len(due), dtype=bool)
    turn, factor = np.zeros((len(due), 3)), np.ones(len(due))
    for span in star.lost:
        seen &= ~span.holds(time_s)
    for fault in star.faults:
        here = fault.holds(time_s)
        if fault.kind == "stuck":
            stuck |= here
        elif fault.kind == "turned":
            turn[here, 2] += fault.angle
        elif fault.kind == "sign":
            factor[here & (np.floor(time_s + 1e-9) % 2 == 1)] *= -1.0
        else:
            factor[here] *= 0.99
    return StarSays(*(jnp.asarray(x) for x in (seen, stuck, turn, factor)))


def _disturbance(given: AttitudeLoop, time_s: np.ndarray) -> np.ndarray:
    """(E, 3) N m, a sine of the orbital period about each axis, a third of a turn apart."""
    turn = circular_orbit(given.orbit.altitude, 0.0, 0.0, 0.0, np.zeros(1))
    rate = np.linalg.norm(turn.v_i_m_s[0]) / np.linalg.norm(turn.r_i_m[0])
    phase = 2.0 * np.pi / 3.0 * np.arange(3.0)
    return given.craft.disturbance * np.sin(rate * time_s[:, None] + phase)
