"""A short simulated drive through a city, and the same as text of libRSF."""

from functools import cache

import jax.numpy as jnp
import numpy as np

from robins import scenario
from robins.systems import SYSTEMS
from robins.systems.gnss import City, world
from robins.systems.gnss.model import RANGES

SETTINGS = ("rate=2 Hz", "satellites.count=10", "wheels.aligned_after=40 m")
LEGS = 4  # of the packaged drive: it stands, drives off and turns


@cache
def short_city():
    """Parameters of a drive of 48 s."""
    path = SYSTEMS["gnss"].scenarios["city"]
    city = scenario.parse(City, path.read_text(), SETTINGS)
    return city.model_copy(update={"legs": city.legs[:LEGS], "settle": 0.0})


@cache
def drive(seed=3):
    """Course and world of a run."""
    course = world.lay_out(short_city())
    return course, world.simulate(short_city(), course, seed, jnp.asarray(0))


def as_text(course, run):
    """The input of libRSF: each epoch's pseudoranges and the odometry at both ends of each step."""
    y, sky, u = np.asarray(run.y[RANGES]), run.sky, run.u
    cn0 = 45.0 - 40.0 * np.log10(np.asarray(sky.sigma) / short_city().satellites.noise)
    lines, truth = [], []
    for k, t in enumerate(course.epoch_s):
        # the wheels' mean over a step, as two samples within it
        for part in (0.01, 0.99):
            at = t - (1.0 - part) * course.dt[k]
            lines.append(
                f"odom3 {at:.6f} {float(u.speed[k])!r} 0 0 0 0 {-float(u.yaw_rate[k])!r} "
                "0.0025 0.0009 0.0009 4e-06 4e-06 4e-06"
            )
        for n in np.flatnonzero(np.isfinite(y[k])):
            x, yy, z = course.satellite_e[n].tolist()
            lines.append(
                f"pseudorange3 {t:.6f} {float(y[k, n])!r} {float(sky.sigma[k, n]) ** 2!r} "
                f"{x!r} {yy!r} {z!r} {n + 1 + 300 * (n % 2)} {1 + 3 * (n % 2)} "
                f"{float(np.degrees(course.elevation_rad[n]))!r} {float(cn0[k, n])!r}"
            )
        place = np.asarray(course.place.ecef(course.position[k])).tolist()
        truth.append(f"point3 {t:.6f} " + " ".join(map(repr, place)) + " 0" * 9)
    last = course.epoch_s[-1] + 0.01
    lines.append(f"odom3 {last:.6f} 0 0 0 0 0 0 0.0025 0.0009 0.0009 4e-06 4e-06 4e-06   ")
    return "\n".join(lines) + "\n", "\n".join(truth) + "\n"
