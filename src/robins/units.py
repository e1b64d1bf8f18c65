"""Units of navigation: text such as ``"0.1 deg/sqrt(h)"`` to SI numbers and back, by kind.

A quantity has a *kind*: angle rate, angle random walk, length. The reader of a number states the
kind, and a unit of another kind is refused, so deg/h never passes as Hz and deg/h never
as deg/sqrt(h). Kinds rather than dimensions decide: rad/s and Hz have the same dimension.

Noise is stated in one of two equivalent forms, since sqrt(Hz) = 1/sqrt(s):
a random walk (deg/sqrt(h), data sheets) and a density (deg/s/sqrt(Hz), Kalibr and most MEMS);
1 deg/s/sqrt(Hz) = 60 deg/sqrt(h). The density is that of the two-sided spectrum, as in IEEE Std
952 and in the discrete noise sigma = density/sqrt(dt).

Standard library only; robins computes in SI and converts units only at its interfaces.
"""

from __future__ import annotations

import difflib
import math
import re
import reprlib
from collections.abc import Iterable
from numbers import Real
from typing import NamedTuple

from robins.errors import RobinsError

_DEG = math.pi / 180.0
_ARCMIN = _DEG / 60.0
_ARCSEC = _DEG / 3600.0
_G = 9.80665  # m/s^2, standard gravity (CGPM 1901): the "g" of data sheets
_ROOT_H = 60.0  # sqrt(3600 s) in sqrt(s)

# Kind, unit, value in SI of one unit. The first unit of a kind is its SI unit.
_TABLE: dict[str, dict[str, float]] = {
    "angle": {
        "rad": 1.0,
        "mrad": 1e-3,
        "urad": 1e-6,
        "deg": _DEG,
        "arcmin": _ARCMIN,
        "arcsec": _ARCSEC,
    },
    "angle rate": {
        "rad/s": 1.0,
        "mrad/s": 1e-3,
        "deg/s": _DEG,
        "deg/min": _DEG / 60.0,
        "deg/h": _DEG / 3600.0,
        "arcsec/s": _ARCSEC,
        "rpm": math.pi / 30.0,
    },
    "angular acceleration": {"rad/s^2": 1.0, "deg/s^2": _DEG, "deg/h/s": _DEG / 3600.0},
    "angle random walk": {
        "rad/sqrt(s)": 1.0,
        "rad/s/sqrt(Hz)": 1.0,
        "rad/sqrt(h)": 1.0 / _ROOT_H,
        "deg/sqrt(s)": _DEG,
        "deg/sqrt(h)": _DEG / _ROOT_H,
        "deg/s/sqrt(Hz)": _DEG,
        "mdeg/s/sqrt(Hz)": 1e-3 * _DEG,
        "deg/h/sqrt(Hz)": _DEG / 3600.0,
        "arcsec/sqrt(s)": _ARCSEC,
        "arcsec/sqrt(h)": _ARCSEC / _ROOT_H,
    },
    "rate random walk": {
        "rad/s/sqrt(s)": 1.0,
        "rad/s^2/sqrt(Hz)": 1.0,
        "deg/s/sqrt(s)": _DEG,
        "deg/s/sqrt(h)": _DEG / _ROOT_H,
        "deg/s^2/sqrt(Hz)": _DEG,
        "deg/h/sqrt(s)": _DEG / 3600.0,
        "deg/h/sqrt(h)": _DEG / 3600.0 / _ROOT_H,
        "arcsec/s/sqrt(s)": _ARCSEC,
    },
    "acceleration": {
        "m/s^2": 1.0,
        "g": _G,
        "mg": 1e-3 * _G,
        "ug": 1e-6 * _G,
        "Gal": 1e-2,
        "mGal": 1e-5,
        "ft/s^2": 0.3048,
    },
    "velocity random walk": {
        "m/s/sqrt(s)": 1.0,
        "m/s^2/sqrt(Hz)": 1.0,
        "m/s/sqrt(h)": 1.0 / _ROOT_H,
        "g/sqrt(Hz)": _G,
        "mg/sqrt(Hz)": 1e-3 * _G,
        "ug/sqrt(Hz)": 1e-6 * _G,
        "mGal/sqrt(Hz)": 1e-5,
    },
    "acceleration random walk": {
        "m/s^2/sqrt(s)": 1.0,
        "m/s^3/sqrt(Hz)": 1.0,
        "m/s^2/sqrt(h)": 1.0 / _ROOT_H,
        "mg/sqrt(s)": 1e-3 * _G,
        "mg/sqrt(h)": 1e-3 * _G / _ROOT_H,
        "ug/sqrt(s)": 1e-6 * _G,
        "ug/sqrt(h)": 1e-6 * _G / _ROOT_H,
    },
    "g-sensitivity": {"rad/s/(m/s^2)": 1.0, "deg/s/g": _DEG / _G, "deg/h/g": _DEG / 3600.0 / _G},
    "length": {"m": 1.0, "um": 1e-6, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048, "NM": 1852.0},
    "area": {"m^2": 1.0, "cm^2": 1e-4, "km^2": 1e6},
    "speed": {
        "m/s": 1.0,
        "mm/s": 1e-3,
        "cm/s": 1e-2,
        "km/s": 1e3,
        "km/h": 1.0 / 3.6,
        "kn": 1852.0 / 3600.0,
        "ft/s": 0.3048,
    },
    "position random walk": {"m/sqrt(s)": 1.0, "m/s/sqrt(Hz)": 1.0, "m/sqrt(h)": 1.0 / _ROOT_H},
    "time": {"s": 1.0, "ns": 1e-9, "us": 1e-6, "ms": 1e-3, "min": 60.0, "h": 3600.0, "d": 86400.0},
    "frequency": {"Hz": 1.0, "mHz": 1e-3, "kHz": 1e3, "MHz": 1e6},
    "inverse time": {"1/s": 1.0, "1/min": 1.0 / 60.0, "1/h": 1.0 / 3600.0},
    "ratio": {"1": 1.0, "%": 1e-2, "ppm": 1e-6},
    "magnetic field": {"T": 1.0, "mT": 1e-3, "uT": 1e-6, "nT": 1e-9, "G": 1e-4, "mG": 1e-7},
    "magnetic noise": {"T/sqrt(Hz)": 1.0, "uT/sqrt(Hz)": 1e-6, "nT/sqrt(Hz)": 1e-9},
    "magnetic moment": {"A m^2": 1.0, "mA m^2": 1e-3},
    "mass": {"kg": 1.0, "t": 1e3},
    "moment of inertia": {"kg m^2": 1.0},
    "force": {"N": 1.0, "mN": 1e-3, "uN": 1e-6, "kN": 1e3},
    "torque": {"N m": 1.0, "mN m": 1e-3, "uN m": 1e-6},
    "angular momentum": {"N m s": 1.0, "mN m s": 1e-3},
    "density": {"kg/m^3": 1.0},
    "pressure": {"Pa": 1.0, "hPa": 1e2, "kPa": 1e3, "mbar": 1e2},
    "temperature": {"K": 1.0, "degC": 1.0},
}
# The same units under another name, so that messages name the expected quantity.
_TABLE["specific force"] = _TABLE["acceleration"]
_TABLE["scale factor"] = _TABLE["ratio"]
_OFFSETS = {"degC": 273.15}  # SI value of zero, where it is not zero
_BARE = ("ratio",)  # kinds whose numbers need no unit


class Unit(NamedTuple):
    """One unit: ``SI = value * scale + offset``."""

    symbol: str
    kinds: tuple[str, ...]
    scale: float
    offset: float = 0.0


def _units() -> dict[str, Unit]:
    out: dict[str, Unit] = {}
    for kind, scales in _TABLE.items():
        for symbol, scale in scales.items():
            kinds = (*out[symbol].kinds, kind) if symbol in out else (kind,)
            out[symbol] = Unit(symbol, kinds, scale, _OFFSETS.get(symbol, 0.0))
    return out


UNITS: dict[str, Unit] = _units()
"""Every unit by its symbol."""

KINDS: dict[str, tuple[str, ...]] = {kind: tuple(scales) for kind, scales in _TABLE.items()}
"""The units of every kind, that of the SI first."""


class UnitError(RobinsError, ValueError):
    """A quantity that cannot be read: unknown unit, unit of another kind, no unit, no number."""


# Equivalent spellings of symbols. For others the message makes a suggestion.
_CHARACTERS = str.maketrans({"µ": "u", "μ": "u", "²": "^2", "³": "^3", "·": " ", "*": " "})
_NUMBER = re.compile(r"\s*([+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)(.*)", re.DOTALL)


def _symbol(text: str) -> str:
    text = text.translate(_CHARACTERS).replace("°C", "degC").replace("°", "deg")
    text = re.sub(r"√\(?(\w+)\)?", r"sqrt(\1)", text)
    return re.sub(r"\s*/\s*", "/", " ".join(text.split()))


def _with_article(kind: str) -> str:
    return f"{'an' if kind[0] in 'aeio' else 'a'} {kind}"


def _nearest(symbol: str, among: Iterable[str]) -> str | None:
    # Difflib weighs case like any other difference, but a wrong case is the likeliest error.
    among = list(among)
    same = [s for s in among if s.lower() == symbol.lower()]
    near = difflib.get_close_matches(symbol, same or among, n=1, cutoff=0.0 if same else 0.6)
    return near[0] if near else None


def _likely(symbol: str, among: tuple[str, ...]) -> str:
    """Unit of a kind that was probably meant by a unit of another kind."""

    def rootless(s: str) -> str:
        return re.sub(r"sqrt\((\w+)\)", r"\1", s)

    # deg/h for deg/sqrt(h); then similar spellings; then ug for ug/sqrt(Hz), deg for deg/s.
    root = [s for s in among if rootless(s) == rootless(symbol)]
    near = _nearest(symbol, root or among)
    begun = [s for s in among if s.startswith(f"{symbol}/") or symbol.startswith(f"{s}/")]
    return near or (begun or list(among))[0]


def unit(symbol: str, kind: str | None = None) -> Unit:
    """Find a unit by its symbol, and check its kind.

    Raises:
        UnitError: unknown unit, or a unit of another kind.
        KeyError: unknown kind (a fault of the calling program, not of its input).
    """
    name = _symbol(symbol)
    allowed = tuple(UNITS) if kind is None else KINDS[kind]
    found = UNITS.get(name)
    if found is None:
        near = _nearest(name, allowed) or _nearest(name, UNITS)
        hint = f"; did you mean {near}?" if near else ""
        listed = "" if kind is None else f" (for {_with_article(kind)}: {', '.join(allowed)})"
        raise UnitError(f"unknown unit {symbol.strip()!r}{hint}{listed}")
    if kind is not None and kind not in found.kinds:
        likely = _likely(name, allowed)
        raise UnitError(
            f"{name} is {_with_article(found.kinds[0])}; {_with_article(kind)} in {likely} is "
            f"wanted here (allowed: {', '.join(allowed)})"
        )
    return found


def _finite(value: object) -> float:
    if isinstance(value, bool):
        raise UnitError(f"{value} is a truth value; a number is wanted here")
    if not isinstance(value, Real):
        raise UnitError(f"{reprlib.repr(value)} is not a number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise UnitError(f"{reprlib.repr(value)} is not a finite number")
    return number


def parse(quantity: object, kind: str) -> float:
    """Read a quantity such as ``"0.1 deg/sqrt(h)"`` and return its SI value.

    Args:
        quantity: text of a number and a unit; where the kind is "ratio", also a plain number.
        kind: one of `KINDS`.

    Raises:
        UnitError: no number, not finite, no unit, unknown unit, or a unit of another kind.
        KeyError: unknown kind.
    """
    allowed = KINDS[kind]
    if isinstance(quantity, str):
        match = _NUMBER.fullmatch(quantity)
        if match is None:
            example = "0.5" if kind in _BARE else f"1.5 {allowed[0]}"
            raise UnitError(f"{quantity!r} does not begin with a finite number, as in '{example}'")
        value, symbol = float(match[1]), match[2].strip()
        if symbol.startswith(","):
            raise UnitError(f"{quantity!r}: the decimal sign is a point")
    else:
        value, symbol = _finite(quantity), ""
    if symbol:
        value = to_si(value, unit(symbol, kind))
    elif kind not in _BARE:
        raise UnitError(
            f"{quantity!r} has no unit; {_with_article(kind)} is wanted here "
            f"(allowed: {', '.join(allowed)})"
        )
    if not math.isfinite(value):
        raise UnitError(f"{quantity!r} is beyond the range of numbers")
    return value


def to_si(value, unit_: str | Unit):
    """SI value of a number (or an array of them) in some unit."""
    u = unit(unit_) if isinstance(unit_, str) else unit_
    return value * u.scale + u.offset if u.offset else value * u.scale


def from_si(value_si, unit_: str | Unit):
    """Number (or array of them) in some unit of an SI value."""
    u = unit(unit_) if isinstance(unit_, str) else unit_
    return (value_si - u.offset) / u.scale if u.offset else value_si / u.scale


def convert(value, from_unit: str, into_unit: str):
    """A number (or an array of them) in another unit of the same kind.

    Raises:
        UnitError: unknown unit, or units of different kinds.
    """
    source = unit(from_unit)
    target = unit(into_unit)
    if not set(source.kinds) & set(target.kinds):
        target = unit(into_unit, source.kinds[0])
    return from_si(to_si(value, source), target)


def as_ending(unit_: str) -> str:
    """Suffix of a metric's name for a unit: "deg_per_sqrt_h" for "deg/sqrt(h)"."""
    plain = unit_.replace("sqrt(", "sqrt_").replace(")", "").replace("^", "").lower()
    return plain.replace("/", "_per_")


def show(value_si, unit_: str, digits: int = 6) -> str:
    """Text of an SI value in a unit, to `digits` significant digits: ``"0.1 deg/h"``."""
    u = unit(unit_)
    number = f"{from_si(value_si, u):.{digits}g}"
    return number if u.symbol == "1" else f"{number} {u.symbol}"
