r"""Scenarios: TOML text with units in strings, read into a checked parameter class.

A system declares its parameters as a class, each quantity with its kind; the text gives the unit:

    Axes = tuple[float, float, float]

    class Imu(Parameters):
        rate: Annotated[float, Quantity("frequency", above="0 Hz")]
        gyro_bias: Annotated[Axes, Quantity("angle rate")] = default("0 deg/h")

    class Drive(Parameters):
        imu: Imu

    drive = parse(Drive, '[imu]\nrate = "100 Hz"', settings=["imu.gyro_bias=2 deg/h"])
    drive.imu.gyro_bias  # three times 9.7e-6 rad/s: one text serves all axes

In a scenario a number without its unit is refused; in Python code a number is SI. All faults of a
scenario are raised as one `ScenarioError` with a line per fault: path, value, what is allowed.
"""

from robins.scenario.parameters import (
    Dof,
    Entry,
    Parameters,
    Positive,
    Quantity,
    Share,
    Span,
    default,
)
from robins.scenario.reading import load, parse, validate
from robins.scenario.scaling import scaled, setting, written
from robins.scenario.text import ScenarioError, mapping_of, override, read_text, text_of

__all__ = [
    "Dof",
    "Entry",
    "Parameters",
    "Positive",
    "Quantity",
    "ScenarioError",
    "Share",
    "Span",
    "default",
    "load",
    "mapping_of",
    "override",
    "parse",
    "read_text",
    "scaled",
    "setting",
    "text_of",
    "validate",
    "written",
]
