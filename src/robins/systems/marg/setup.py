"""From parameters to what a filter believes of sensors and motion."""

from __future__ import annotations

import jax.numpy as jnp

from robins.filters import Filter, Model
from robins.systems.marg.model import (
    MAGNETOMETER,
    REST_RATE,
    TRAVEL,
    Noise,
    Seen,
    marg_model,
)
from robins.systems.marg.parameters import Replay
from robins.systems.marg.rules import marg_filter
from robins.systems.study import SensorAxes, StateBlock

CAUSAL, SMOOTHED = "marg", "marg-smoothed"
FILTERS = (CAUSAL, SMOOTHED)
NED, XYZ = ("north", "east", "down"), ("x", "y", "z")


def model_of(parameters: Replay) -> Model:
    """The model a filter believes in."""
    g, a, m, p = (
        parameters.gyro,
        parameters.accelerometer,
        parameters.magnetometer,
        parameters,
    )
    noise = Noise(
        g.noise,
        g.turn_error,
        a.noise,
        g.bias_walk,
        g.bias_walk_moving,
        a.bias_walk,
        m.declination,
        m.declination_time,
        m.field_walk,
        a.gravity,
    )
    seen = Seen(p.travel.velocity, p.travel.place, p.rest.velocity, p.rest.rate, m.noise)
    return marg_model(
        Noise(*(jnp.asarray(x, float) for x in noise)),
        Seen(*(jnp.asarray(x, float) for x in seen)),
        p.use_magnetometer != "never",
    )


def filter_of(parameters: Replay) -> Filter:
    """The filter, with its rules."""
    m = parameters.magnetometer
    return marg_filter(
        gate=m.gate if parameters.use_magnetometer == "undisturbed" else None,
        patience=max(1, round(m.patience / parameters.travel.every)),
        weight=parameters.travel.weight,
        field_t=m.most,
    )


TRAVELLED = (("velocity", "m/s"), ("place", "m"))
SENSORS = {
    TRAVEL: SensorAxes("m/s, m", "NED", tuple(f"{w} {a} [{u}]" for w, u in TRAVELLED for a in NED)),
    REST_RATE: SensorAxes("rad/s", "body", XYZ),
    MAGNETOMETER: SensorAxes("rad, T", "NED", ("azimuth [rad]", "horizontal [T]", "down [T]")),
}

BLOCKS = (
    StateBlock("attitude", slice(0, 3), "rad", "deg", "NED", NED),
    StateBlock("velocity", slice(3, 6), "m/s", "m/s", "NED", NED),
    StateBlock("gyro_bias", slice(9, 12), "rad/s", "deg/s", "body", XYZ),
    StateBlock(
        "gyro_gain",
        slice(12, 21),
        "1",
        "%",
        "body",
        tuple(f"{a} from {b}" for a in XYZ for b in XYZ),
    ),
    StateBlock("accel_bias", slice(21, 24), "m/s^2", "mg", "body", XYZ),
    StateBlock("declination", slice(24, 25), "rad", "deg", "NED", ("here",)),
    StateBlock("field", slice(25, 27), "T", "uT", "NED", ("horizontal", "down")),
)
