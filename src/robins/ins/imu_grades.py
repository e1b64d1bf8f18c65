"""Error models of inertial measurement units by grade, for when there is no data sheet yet.

The grades are those of the field (Groves 2013, chapter 4; Titterton & Weston 2004, chapters 4
to 7). Figures are round ones from the middle of what such units are sold with, in the words of a
data sheet, so that a reader can compare them with one. Within a grade products differ by a factor
of three either way: take the figures of your sensor where you have them.
"""

from __future__ import annotations

import difflib
from types import MappingProxyType
from typing import Any

from robins.ins.imu_errors import ImuErrorModel

# navigation: ring laser gyros and force-feedback pendulums of an airliner's inertial reference,
# about one nautical mile per hour unaided, which is what 0.01 deg/h and 50 ug amount to. tactical:
# fibre-optic gyros and quartz accelerometers of guided munitions and survey systems. industrial
# MEMS: factory-calibrated modules, steady while on, a new bias at each switching on. consumer MEMS:
# one-chip sensors of telephones and drones, not calibrated one by one.
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
    if name not in FIGURES:
        near = difflib.get_close_matches(name, FIGURES, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise ValueError(f"no IMU grade {name!r}{hint} (known: {', '.join(FIGURES)})")
    return ImuErrorModel.from_datasheet(**FIGURES[name])
