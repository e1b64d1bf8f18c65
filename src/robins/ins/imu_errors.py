"""Error models of triads of gyros or accelerometers.

Each sample of a triad is modelled as (Groves 2013, section 4.4; Titterton & Weston 2004, chapters 4
and 6)::

    measured = (I + S + M) true + bias + G f + noise,        then clipped, then quantised

with scale factor errors S, misalignments M, and for gyros a sensitivity G to the specific force f.
The bias is the sum of a constant that changes from turn-on to turn-on, a first-order Gauss-Markov
process, a random walk and a ramp; the noise is white. This module defines models from SI numbers or
data sheets (by grade: `grade`; from an Allan fit: `robins.ins.allan.triad_errors`), and gives their
expected errors in closed form; `robins.sim.imu_sensor` simulates them.

Units are SI, per axis: [y] stands for rad/s of a gyro and m/s^2 of an accelerometer.

`grade` gives models by sensor grade, for use without a data sheet (Groves 2013, chapter 4;
Titterton & Weston 2004, chapters 4 to 7). Figures are round, typical of products, and given as in a
data sheet, so that they can be compared with one. Within a grade products differ by a factor of
three either way: use the figures of your sensor if you have them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import field
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from robins import _float64  # noqa: F401
from robins.errors import require, require_known
from robins.filters.values import value
from robins.units import UnitError, parse

MARKOV_PEAK = 0.6173642831
"""Largest Allan deviation of a Gauss-Markov process over its sigma, at 1.893 correlation times."""

FLICKER_FLAT = float(np.sqrt(2.0 * np.log(2.0) / np.pi))
"""Allan deviation of flicker noise over its coefficient B, 0.664 (IEEE Std 952)."""


@value
class TriadErrors:
    """Errors of three gyros or three accelerometers; None: the sensor has no such error.

    Sigmas are those of the values drawn in each run. A number stands for all three axes, or for all
    elements of a matrix that can differ from zero (for ``g_sensitivity``, the diagonal). A model is
    a pytree: the kinds of errors are its structure, their sizes its leaves, so models of one
    structure can be stacked, mapped over and traced. Known values are checked at construction, not
    inside compiled code.

    Raises:
        ValueError: a wrong shape, a value not finite, a negative sigma, a size not positive, a
            misalignment with a diagonal, a Markov process without sigma or correlation time.
    """

    bias: Any = None  # (3,) [y], the same in every run
    bias_sigma: Any = None  # (3,) [y], from turn-on to turn-on
    markov_sigma: Any = None  # (3,) [y], stationary sigma of the Gauss-Markov bias
    markov_tau_s: Any = None  # (3,) s, its correlation time
    walk: Any = None  # (3,) [y]/sqrt(s), random walk of the bias, K
    ramp: Any = None  # (3,) [y]/s, steady drift of the bias
    white: Any = None  # (3,) [y] sqrt(s), angle or velocity random walk, N
    scale: Any = None  # (3,) relative, the same in every run
    scale_sigma: Any = None  # (3,) relative
    misalignment: Any = None  # (3, 3) rad, zero diagonal: axis i measures M[i, j] of axis j
    misalignment_sigma: Any = None  # (3, 3) rad, zero diagonal
    g_sensitivity: Any = None  # (3, 3) [y]/(m/s^2), of gyros
    g_sensitivity_sigma: Any = None  # (3, 3) [y]/(m/s^2), of gyros
    full_scale: Any = None  # (3,) [y], larger magnitudes are clipped
    quantum: Any = None  # (3,) [y] s, one count of the increments; the remainder is carried over

    def __post_init__(self):
        for name in _FIELDS:
            object.__setattr__(self, name, _checked(name, getattr(self, name)))
        if (self.markov_sigma is None) != (self.markov_tau_s is None):
            raise ValueError("markov_sigma and markov_tau_s belong together: give both or neither")

    def size(self, name: str) -> np.ndarray:
        """Known value of a field; zeros of its shape where the sensor has no such error."""
        found = getattr(self, name)
        return np.zeros((3, 3) if name in _MATRICES else 3) if found is None else np.asarray(found)


@value
class ImuErrorModel:
    """Errors of the gyros and accelerometers of an inertial measurement unit.

    Raises:
        ValueError: accelerometers with a g-sensitivity (theirs is the scale factor).
    """

    gyro: TriadErrors = field(default_factory=TriadErrors)
    accel: TriadErrors = field(default_factory=TriadErrors)

    def __post_init__(self):
        if self.accel.g_sensitivity is not None or self.accel.g_sensitivity_sigma is not None:
            raise ValueError("g_sensitivity is an error of gyros; for accelerometers give a scale")

    @classmethod
    def from_datasheet(
        cls, gyro: Mapping[str, Any] | None = None, accel: Mapping[str, Any] | None = None
    ) -> ImuErrorModel:
        """Model from the figures of a data sheet, numbers with units.

        >>> model = ImuErrorModel.from_datasheet(
        ...     gyro={"noise": "0.1 deg/sqrt(h)", "bias": "10 deg/h"},
        ...     accel={"noise": "50 ug/sqrt(Hz)", "scale_factor": "300 ppm"},
        ... )

        Each figure is a text, or three of them for the three axes:

        - ``bias``: one sigma from turn-on to turn-on (repeatability);
        - ``bias_instability``, the lowest point of the Allan deviation, with ``correlation_time``:
          a Gauss-Markov process whose Allan deviation peaks at that figure;
        - ``noise``: angle or velocity random walk, or the density (``arw`` and ``vrw`` also do);
        - ``rate_random_walk``, ``drift_per_hour`` (of the bias), ``scale_factor``,
          ``misalignment``, ``g_sensitivity`` (gyros), ``quantisation`` (of increments),
          ``full_scale``.

        Raises:
            ValueError: an unknown or repeated figure; an instability without correlation time.
            robins.units.UnitError: a figure without unit or with one of another kind.
        """
        return cls(_from_figures("gyro", gyro or {}), _from_figures("accel", accel or {}))


_FIELDS = tuple(f.name for f in dataclasses.fields(TriadErrors))
_MATRICES = ("misalignment", "misalignment_sigma", "g_sensitivity", "g_sensitivity_sigma")
_SIGNED = ("bias", "ramp", "scale", "misalignment", "g_sensitivity")
_POSITIVE = ("markov_tau_s", "full_scale")


def _checked(name: str, value: Any) -> Any:
    if value is None:
        return None
    traced = isinstance(value, jax.Array)
    x = (jnp if traced else np).asarray(value, float)
    shape = (3, 3) if name in _MATRICES else (3,)
    if x.shape not in ((), shape):
        raise ValueError(f"{name} must be a number or of shape {shape}, got shape {x.shape}")
    if x.shape == ():
        x = (jnp if traced else np).broadcast_to(x, shape) * _pattern(name)
    if traced:
        return x
    if not np.all(np.isfinite(x)):
        raise ValueError(f"{name} must be finite, got {value}; None stands for no such error")
    require(name in _SIGNED or not np.any(x < 0.0), f"{name} must not be negative", value)
    if name in _POSITIVE and np.any(x == 0.0):
        raise ValueError(f"{name} must be positive, got {value}; None stands for no such error")
    if name.startswith("misalignment") and np.any(np.diag(x) != 0.0):
        raise ValueError(f"{name} has a diagonal, {np.diag(x)}: that part is a scale factor error")
    return x


def _pattern(name: str) -> Any:
    """Elements of a field that a single number sets."""
    if name.startswith("misalignment"):
        return np.ones((3, 3)) - np.eye(3)
    return np.eye(3) if name == "g_sensitivity" else 1.0


_FIGURES = {  # figure -> (field, kind for gyros, kind for accelerometers, factor into SI)
    "bias": ("bias_sigma", "angle rate", "specific force", 1.0),
    "bias_instability": ("markov_sigma", "angle rate", "specific force", 1.0 / MARKOV_PEAK),
    "correlation_time": ("markov_tau_s", "time", "time", 1.0),
    "noise": ("white", "angle random walk", "velocity random walk", 1.0),
    "arw": ("white", "angle random walk", None, 1.0),
    "vrw": ("white", None, "velocity random walk", 1.0),
    "rate_random_walk": ("walk", "rate random walk", "acceleration random walk", 1.0),
    "drift_per_hour": ("ramp", "angle rate", "specific force", 1.0 / 3600.0),
    "scale_factor": ("scale_sigma", "scale factor", "scale factor", 1.0),
    "misalignment": ("misalignment_sigma", "angle", "angle", 1.0),
    "g_sensitivity": ("g_sensitivity_sigma", "g-sensitivity", None, 1.0),
    "quantisation": ("quantum", "angle", "speed", 1.0),
    "full_scale": ("full_scale", "angle rate", "specific force", 1.0),
}


def _from_figures(sensor: str, figures: Mapping[str, Any]) -> TriadErrors:
    known = {
        figure: (name, kind, factor)
        for figure, (name, of_gyro, of_accel, factor) in _FIGURES.items()
        if (kind := of_gyro if sensor == "gyro" else of_accel) is not None
    }
    values: dict[str, Any] = {}
    for figure, text in figures.items():
        require_known("figure", figure, known, f"the {sensor}")
        name, kind, factor = known[figure]
        require(name not in values, f"{sensor}.{figure}: {name} is given twice, by two figures")
        try:
            if isinstance(text, list | tuple):
                values[name] = factor * np.array([parse(t, kind) for t in text])
            else:
                values[name] = factor * parse(text, kind)
        except UnitError as error:
            raise UnitError(f"{sensor}.{figure}: {error}") from None
    if ("bias_instability" in figures) != ("correlation_time" in figures):
        raise ValueError(f"{sensor}: bias_instability and correlation_time belong together")
    try:
        return TriadErrors(**values)
    except ValueError as error:
        raise ValueError(f"{sensor}: {error}") from None


def allan_deviation(errors: TriadErrors, tau_s: ArrayLike | float) -> np.ndarray:
    """Allan deviation (T, 3) that the model predicts for a sensor at rest, without clipping.

    The Markov term is IEEE Std 952-1997, Annex C; the others are the terms of
    `robins.ins.allan_noise`.
    """
    tau = np.asarray(tau_s, float)[..., None]
    quantum, white, walk, ramp = map(errors.size, ("quantum", "white", "walk", "ramp"))
    variance = quantum**2 / (4.0 * tau**2) + white**2 / tau
    if errors.markov_sigma is not None:
        x = tau / errors.markov_tau_s
        closed = (x + 2.0 * np.expm1(-x) - 0.5 * np.expm1(-2.0 * x)) / x**2
        series = x / 3.0 - x**2 / 4.0 + 7.0 * x**3 / 60.0  # the closed form cancels at small x
        variance = variance + 2.0 * errors.markov_sigma**2 * np.where(x < 1e-4, series, closed)
    return np.sqrt(variance + walk**2 * tau / 3.0 + ramp**2 * tau**2 / 2.0)


def mean_sigma(errors: TriadErrors, duration_s: float) -> np.ndarray:
    """One sigma (3,) of the error of a mean over a stated time at rest, over runs.

    It includes the turn-on bias, the averaged Gauss-Markov bias, the random walk (from zero at the
    start of the mean), the averaged white noise and one quantisation step at either end; the
    deterministic ``bias`` and ``ramp`` are not included.

    Raises:
        ValueError: a duration that is not positive.
    """
    if not (np.isfinite(duration_s) and duration_s > 0.0):
        raise ValueError(f"duration_s must be a positive number of seconds, got {duration_s}")
    walk, white, quantum = map(errors.size, ("walk", "white", "quantum"))
    variance = errors.size("bias_sigma") ** 2
    if errors.markov_sigma is not None:
        x = duration_s / errors.markov_tau_s
        variance = variance + 2.0 * (errors.markov_sigma / x) ** 2 * (x + np.expm1(-x))
    variance = variance + walk**2 * duration_s / 3.0 + white**2 / duration_s
    return np.sqrt(variance + quantum**2 / 6.0 / duration_s**2)


# navigation: ring laser gyros and force-feedback pendulums of an airliner's inertial reference,
# about one nautical mile per hour unaided, which is what 0.01 deg/h and 50 ug amount to. tactical:
# fibre-optic gyros and quartz accelerometers of guided munitions and survey systems. industrial
# MEMS: factory-calibrated modules, stable while on, with a new bias at each turn-on. consumer MEMS:
# single-chip sensors of telephones and drones, not individually calibrated.
_GRADES = ("navigation", "tactical", "industrial MEMS", "consumer MEMS")
_TABLE = {
    "gyro": {
        "bias": ("0.01 deg/h", "1 deg/h", "0.1 deg/s", "1 deg/s"),
        "bias_instability": ("0.003 deg/h", "0.3 deg/h", "6 deg/h", "20 deg/h"),
        "correlation_time": ("1 h", "300 s", "200 s", "100 s"),
        "noise": ("0.002 deg/sqrt(h)", "0.1 deg/sqrt(h)", "0.3 deg/sqrt(h)", "0.01 deg/s/sqrt(Hz)"),
        "scale_factor": ("5 ppm", "100 ppm", "0.3 %", "2 %"),
        "misalignment": ("5 arcsec", "0.1 mrad", "0.05 deg", "1 deg"),
        "g_sensitivity": (None, "0.1 deg/h/g", "0.01 deg/s/g", "0.1 deg/s/g"),
        "full_scale": ("400 deg/s", "1000 deg/s", "450 deg/s", "2000 deg/s"),
    },
    "accel": {
        "bias": ("50 ug", "1 mg", "5 mg", "40 mg"),
        "bias_instability": ("5 ug", "50 ug", "100 ug", "500 ug"),
        "correlation_time": ("1 h", "300 s", "200 s", "100 s"),
        "noise": ("10 ug/sqrt(Hz)", "50 ug/sqrt(Hz)", "50 ug/sqrt(Hz)", "250 ug/sqrt(Hz)"),
        "scale_factor": ("100 ppm", "300 ppm", "0.3 %", "2 %"),
        "misalignment": ("5 arcsec", "0.1 mrad", "0.05 deg", "1 deg"),
        "full_scale": ("20 g", "40 g", "18 g", "16 g"),
    },
}
FIGURES: MappingProxyType[str, dict[str, dict[str, Any]]] = MappingProxyType(
    {
        grade: {
            sensor: {figure: row[k] for figure, row in rows.items() if row[k] is not None}
            for sensor, rows in _TABLE.items()
        }
        for k, grade in enumerate(_GRADES)
    }
)
"""The figures of each grade, as `ImuErrorModel.from_datasheet` reads them."""


def grade(name: str) -> ImuErrorModel:
    """Error model of a grade: navigation, tactical, industrial MEMS or consumer MEMS.

    Raises:
        ValueError: no such grade.
    """
    require_known("IMU grade", name, FIGURES, "robins")
    return ImuErrorModel.from_datasheet(**FIGURES[name])
