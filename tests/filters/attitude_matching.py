"""Attitude matching as the filters' own tests want it: weights R = I, any unit, any length.

The system is that of the package (reference scenario of Gu & Qin 2005: nine states, 20 s, 400
updates); here are its start and inputs, ready to run.
"""

from pathlib import Path

import numpy as np

from robins import scenario
from robins.systems import transfer_alignment
from robins.systems.transfer_alignment.attitude_matching.model import LinearSystem, linear_system
from robins.systems.transfer_alignment.attitude_matching.parameters import AttitudeMatching

PERIOD_S = 0.05
STEPS = 400
S0 = Path(transfer_alignment.__file__).parent / "scenarios" / "s0.toml"


def in_unit(unit: str = "deg", steps: int = STEPS, P0: str = "physical") -> LinearSystem:
    """The system in one unit of angle.

    Args:
        unit: "rad", "deg" or "arcmin".
        steps: updates, the first one filter period after the start.
        P0: "physical", (0.5 deg)^2, (1 deg/h)^2, (0.3 deg)^2; or "identity", in the unit.
    """
    system = linear_system(scenario.load(AttitudeMatching, S0), steps).in_unit(unit)
    return system._replace(sigma=np.ones(9)) if P0 == "identity" else system


def run_with(system: LinearSystem) -> tuple:
    """Model with R = I, start, inputs and extras of a run; sizes alone decide what is compiled."""
    return system.model(1.0), system.start(), *system.inputs()
