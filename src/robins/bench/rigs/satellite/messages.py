"""Messages between the seven parts of the satellite, and from the operator to them."""

from __future__ import annotations

from robins.bench.wire.fields import Field, Message, f64, message, size
from robins.bench.wire.schema import Wire

WHEELS = 4
PARTS = ("plant", "table", "gyro", "star", "adm", "acm", "actuators")

_QUATERNION = "body to inertial, scalar first"
# Limits are far beyond the motion of any craft and far below overflow of squares and products. They
# refuse impossible values; the filter judges whether a frame is plausible.
_UNIT, _TURN, _RATE, _SIGMA, _ACTS = 2.0, 10.0, 1e3, 1e6, 1e6
FLAGS = (
    "star used",
    "star refused",
    "gyro held",
    "safe: do not steer by this",
    "star silent",
    "star of a length other than one",
    "last gain kept: no new one passed",
)
"""Bits of `estimate.flags`, from the lowest."""
USED, REFUSED, HELD, SAFE, SILENT, SHORT, KEPT = (1 << k for k in range(len(FLAGS)))
RUN, STAND_BY, AS_IT_IS = range(3)  # of `mode.mode`
_FLAGS = ", ".join(f"bit {k}: {text}" for k, text in enumerate(FLAGS))
_ACTUATORS = (
    f64("wheel_torque", WHEELS, "N m", "on the body, along each wheel's axis", _ACTS),
    f64("dipole_b", 3, "A m^2", "of the magnetorquers", _ACTS),
)

# fmt: off
MESSAGES: tuple[Message, ...] = (
    message(16, "motion", "The craft as it truly is, from the plant to the rate table.",
        f64("q_ib", 4, "1", _QUATERNION, _UNIT),
        f64("omega_b", 3, "rad/s", "rate against inertial", _RATE),
    ),
    message(17, "mounted", "Attitude of the rate table, which its sensors have.",
        f64("q_ib", 4, "1", _QUATERNION, _UNIT),
    ),
    message(18, "gyro", "A sample of the gyros.",
        f64("theta_b", 3, "rad", "turn over the step, NaN: no sample of this axis", _TURN, True),
    ),
    message(19, "star", "A frame of the star sensor.",
        f64("q_ib", 4, "1", f"{_QUATERNION}; either sign; NaN: not solved", _UNIT, True),
        f64(
            "factor",
            9,
            "rad",
            "L of its covariance L L', body axes, by rows; 0: unknown; NaN: not solved",
            _TURN,
            True,
        ),
        Field("stars", "u16", 1, "1", "used; 0: not told"),
    ),
    message(20, "estimate", "Attitude as determined.",
        f64("q_ib", 4, "1", _QUATERNION, _UNIT),
        f64("gyro_bias", 3, "rad/s", "reported less true rate", _RATE),
        size("sigma", 6, "rad, rad/s", "stated of attitude and bias, body axes", _SIGMA),
        Field("flags", "u8", 1, "1", _FLAGS, (0, 2 ** len(FLAGS) - 1)),
    ),
    message(21, "command", "What control asks of the actuators.", *_ACTUATORS),
    message(22, "actuation", "What the actuators give.", *_ACTUATORS),
    message(23, "wheels", "Momenta of the wheels, from their speeds.",
        f64("momentum", WHEELS, "N m s", "along each wheel's axis", _ACTS),
    ),
    message(24, "innovation",
        "What the filter made of a frame of the star sensor, for who watches.",
        f64("innovation", 3, "rad", "measured less expected, body axes", _TURN, True),
        size("sigma", 3, "rad", "stated", _SIGMA),
        size("ratio", 1, "1", "squared and normalised, over its limit; above 1: refused", 1e30),
    ),
)

_CONSOLE: tuple[Message, ...] = (
    message(25, "reference", "Where the craft is to point from now on, from the operator.",
        f64(
            "q_ib",
            4,
            "1",
            f"{_QUATERNION}; either sign; NaN: back to the course of the scenario",
            _UNIT,
            True,
        ),
        Field("rate", "f64", 1, "rad/s", "greatest of the slew; 0: as the craft can", (0.0, _RATE)),
    ),
    message(26, "mode", "What the computers on board are to do from now on, from the operator.",
        Field("mode", "u8", 1, "1", "0: run; 1: stand by: control rests; 2: as it is", (0, 2)),
        Field("reset", "u8", 1, "1", "1: the filter begins anew with the next star frame", (0, 1)),
    ),
)
# fmt: on

WIRE = Wire(PARTS, (*MESSAGES, *_CONSOLE))
CONSOLE = tuple(m.name for m in _CONSOLE)

SENDS: dict[str, tuple[str, ...]] = {
    "plant": ("motion",),
    "table": ("mounted",),
    "gyro": ("gyro",),
    "star": ("star",),
    "adm": ("estimate", "innovation"),
    "acm": ("command",),
    "actuators": ("actuation", "wheels"),
}
TAKES: dict[str, tuple[str, ...]] = {
    "plant": ("actuation",),
    "table": ("motion",),
    "gyro": ("mounted",),
    "star": ("motion", "gyro", "estimate"),
    "adm": ("gyro", "star", "mode"),
    "acm": ("estimate", "gyro", "wheels", *CONSOLE),
    "actuators": ("command",),
}
