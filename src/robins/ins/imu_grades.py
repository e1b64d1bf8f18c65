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

FIGURES: MappingProxyType[str, dict[str, dict[str, Any]]] = MappingProxyType(
    {
        # Ring laser gyros and force-feedback pendulums of an airliner's inertial reference: about
        # one nautical mile per hour unaided, which is what 0.01 deg/h and 50 ug amount to.
        "navigation": {
            "gyro": {
                "bias": "0.01 deg/h",
                "bias_instability": "0.003 deg/h",
                "correlation_time": "1 h",
                "noise": "0.002 deg/sqrt(h)",
                "scale_factor": "5 ppm",
                "misalignment": "5 arcsec",
                "full_scale": "400 deg/s",
            },
            "accel": {
                "bias": "50 ug",
                "bias_instability": "5 ug",
                "correlation_time": "1 h",
                "noise": "10 ug/sqrt(Hz)",
                "scale_factor": "100 ppm",
                "misalignment": "5 arcsec",
                "full_scale": "20 g",
            },
        },
        # Fibre-optic gyros and quartz accelerometers of guided munitions and survey systems.
        "tactical": {
            "gyro": {
                "bias": "1 deg/h",
                "bias_instability": "0.3 deg/h",
                "correlation_time": "300 s",
                "noise": "0.1 deg/sqrt(h)",
                "scale_factor": "100 ppm",
                "misalignment": "0.1 mrad",
                "g_sensitivity": "0.1 deg/h/g",
                "full_scale": "1000 deg/s",
            },
            "accel": {
                "bias": "1 mg",
                "bias_instability": "50 ug",
                "correlation_time": "300 s",
                "noise": "50 ug/sqrt(Hz)",
                "scale_factor": "300 ppm",
                "misalignment": "0.1 mrad",
                "full_scale": "40 g",
            },
        },
        # Factory-calibrated MEMS modules: steady while on, a new bias at each switching on.
        "industrial MEMS": {
            "gyro": {
                "bias": "0.1 deg/s",
                "bias_instability": "6 deg/h",
                "correlation_time": "200 s",
                "noise": "0.3 deg/sqrt(h)",
                "scale_factor": "0.3 %",
                "misalignment": "0.05 deg",
                "g_sensitivity": "0.01 deg/s/g",
                "full_scale": "450 deg/s",
            },
            "accel": {
                "bias": "5 mg",
                "bias_instability": "100 ug",
                "correlation_time": "200 s",
                "noise": "50 ug/sqrt(Hz)",
                "scale_factor": "0.3 %",
                "misalignment": "0.05 deg",
                "full_scale": "18 g",
            },
        },
        # One-chip sensors of telephones and drones, not calibrated one by one.
        "consumer MEMS": {
            "gyro": {
                "bias": "1 deg/s",
                "bias_instability": "20 deg/h",
                "correlation_time": "100 s",
                "noise": "0.01 deg/s/sqrt(Hz)",
                "scale_factor": "2 %",
                "misalignment": "1 deg",
                "g_sensitivity": "0.1 deg/s/g",
                "full_scale": "2000 deg/s",
            },
            "accel": {
                "bias": "40 mg",
                "bias_instability": "500 ug",
                "correlation_time": "100 s",
                "noise": "250 ug/sqrt(Hz)",
                "scale_factor": "2 %",
                "misalignment": "1 deg",
                "full_scale": "16 g",
            },
        },
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
