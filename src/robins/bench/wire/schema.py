"""Every message of the wire in one table: what is encoded, checked, documented and put into C.

Numbers are part of the protocol. Add at the end, never renumber, never reuse; a change of the
fields of a message is a new version of the protocol. All numbers are little endian; lengths of
vectors are fixed, so that firmware needs no heap.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

VERSION = 1
WHEELS = 4

WireType = Literal["u8", "u16", "u32", "u64", "f64"]
SIZES: dict[WireType, int] = {"u8": 1, "u16": 2, "u32": 4, "u64": 8, "f64": 8}


class Field(NamedTuple):
    """Some numbers of one kind."""

    name: str
    kind: WireType
    length: int
    unit: str  # "1": a pure number
    text: str
    limits: tuple[float, float] | None = None  # least and most of a sound frame; None: of its type
    missing: bool = False  # whether NaN stands for a number that there is not

    @property
    def span(self) -> str:
        """The limits in words."""
        if self.limits is None:
            return ""
        return "{:g} to {:g}".format(*self.limits) + (" or NaN" if self.missing else "")


class Message(NamedTuple):
    """What one part of the bench tells another."""

    number: int
    name: str
    text: str
    fields: tuple[Field, ...]


def _f64(name: str, length: int, unit: str, text: str, most: float, missing: bool = False) -> Field:
    return Field(name, "f64", length, unit, text, (-most, most), missing)


def _size(name: str, length: int, unit: str, text: str, most: float) -> Field:
    """Floats that are never negative, NaN: not known."""
    return Field(name, "f64", length, unit, text, (0.0, most), True)


def _message(number: int, name: str, text: str, *fields: Field) -> Message:
    return Message(number, name, text, fields)


PARTS = ("bench", "plant", "table", "gyro", "star", "adm", "acm", "actuators")
"""Who talks; the place in this table is the number of a part."""

_QUATERNION = "body to inertial, scalar first"
# Limits are far beyond what a craft does and far from where squares and products overflow. They
# refuse what cannot be; whether a frame is plausible is for the filter to judge.
_UNIT, _TURN, _RATE, _SIGMA, _ACTS = 2.0, 10.0, 1e3, 1e6, 1e6
FLAGS = (
    "star used",
    "star refused",
    "gyro held",
    "safe: do not steer by this",
    "star silent",
    "star of a length other than one",
)
"""Bits of `estimate.flags`, from the lowest."""
USED, REFUSED, HELD, SAFE, SILENT, SHORT = (1 << k for k in range(len(FLAGS)))
_FLAGS = ", ".join(f"bit {k}: {text}" for k, text in enumerate(FLAGS))
_ACTUATORS = (
    _f64("wheel_torque", WHEELS, "N m", "on the body, along each wheel's axis", _ACTS),
    _f64("dipole_b", 3, "A m^2", "of the magnetorquers", _ACTS),
)

MESSAGES: tuple[Message, ...] = (
    _message(
        1,
        "hello",
        "A part is there; its first message.",
        Field("part", "u8", 1, "1", "number of the part"),
        Field("schema", "u32", 1, "1", "CRC-32C of this table, so that both mean the same"),
    ),
    _message(
        2,
        "tick",
        "The clock lets a step begin. The time in the header is that of its end.",
        Field("step", "u32", 1, "1", "number of the step, from 0"),
    ),
    _message(
        3,
        "done",
        "A part has sent all that it sends in a step.",
        Field("step", "u32", 1, "1", "number of the step"),
        Field("compute", "u32", 1, "ns", "time it took to compute"),
    ),
    _message(4, "stop", "The run is over."),
    _message(
        5,
        "begin",
        "The bench answers a hello. All that follow have the number of the run in this header.",
        Field("step", "u64", 1, "ns", "length of a step"),
    ),
    _message(
        16,
        "motion",
        "The craft as it truly is, from the plant to the rate table.",
        _f64("q_ib", 4, "1", _QUATERNION, _UNIT),
        _f64("omega_b", 3, "rad/s", "rate against inertial", _RATE),
    ),
    _message(
        17,
        "mounted",
        "Attitude of the rate table, which its sensors have.",
        _f64("q_ib", 4, "1", _QUATERNION, _UNIT),
    ),
    _message(
        18,
        "gyro",
        "A sample of the gyros.",
        _f64("theta_b", 3, "rad", "turn over the step, NaN: no sample of this axis", _TURN, True),
    ),
    _message(
        19,
        "star",
        "A frame of the star sensor.",
        _f64("q_ib", 4, "1", f"{_QUATERNION}; either sign; NaN: not solved", _UNIT, True),
        _f64(
            "factor",
            9,
            "rad",
            "L of its covariance L L', body axes, by rows; 0: unknown; NaN: not solved",
            _TURN,
            True,
        ),
        Field("stars", "u16", 1, "1", "used; 0: not told"),
    ),
    _message(
        20,
        "estimate",
        "Attitude as determined.",
        _f64("q_ib", 4, "1", _QUATERNION, _UNIT),
        _f64("gyro_bias", 3, "rad/s", "reported less true rate", _RATE),
        _size("sigma", 6, "rad, rad/s", "stated of attitude and bias, body axes", _SIGMA),
        Field("flags", "u8", 1, "1", _FLAGS, (0, 2 ** len(FLAGS) - 1)),
    ),
    _message(21, "command", "What control asks of the actuators.", *_ACTUATORS),
    _message(22, "actuation", "What the actuators give.", *_ACTUATORS),
    _message(
        23,
        "wheels",
        "Momenta of the wheels, from their speeds.",
        _f64("momentum", WHEELS, "N m s", "along each wheel's axis", _ACTS),
    ),
    _message(
        24,
        "innovation",
        "What the filter made of a frame of the star sensor, for who watches.",
        _f64("innovation", 3, "rad", "measured less expected, body axes", _TURN, True),
        _size("sigma", 3, "rad", "stated", _SIGMA),
        _size("ratio", 1, "1", "squared and normalised, over its limit; above 1: refused", 1e30),
    ),
)
"""All of them, by number."""

FIRST_DATA = 16
"""Messages of a lower number are of the protocol, the others carry data."""
NUMBERS = {m.name: m.number for m in MESSAGES}
NAMES = {m.number: m.name for m in MESSAGES}

_BY_NAME = {m.name: m for m in MESSAGES}
_BY_NUMBER = {m.number: m for m in MESSAGES}


def message(which: str | int) -> Message:
    """A message by its name or number.

    Raises:
        KeyError: there is none; the message of the error lists those there are.
    """
    known = _BY_NAME if isinstance(which, str) else _BY_NUMBER
    if which not in known:
        there = ", ".join(_BY_NAME)
        raise KeyError(f"no message {which!r} in version {VERSION}; there are {there}")
    return known[which]  # type: ignore[index]


def markdown() -> str:
    """The table as documentation."""
    lines = ["| number | message | field | type | unit | limits | meaning |"]
    lines.append("|---|---|---|---|---|---|---|")
    for m in MESSAGES:
        lines.append(f"| {m.number} | `{m.name}` | | | | | {m.text} |")
        for f in m.fields:
            kind = f.kind if f.length == 1 else f"{f.kind} x {f.length}"
            lines.append(f"| | | `{f.name}` | {kind} | {f.unit} | {f.span} | {f.text} |")
    return "\n".join(lines) + "\n"
