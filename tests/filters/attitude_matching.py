"""Attitude matching as the filters' own tests want it: weights R = I, any unit, any length.

The system is that of the package (reference scenario of Gu & Qin 2005: nine states, 20 s, 400
updates); here are its start and inputs, ready to run.
"""

import numpy as np

from robins.systems.transfer_alignment.attitude_matching import (
    AttitudeMatching,
    Spread,
    attitude_matching,
)
from robins.systems.transfer_alignment.bank_turn import BankTurn

PERIOD_S = 0.05
STEPS = 400

DEG = np.pi / 180.0
TURN = BankTurn(240.0, 3.0 * 9.80665, 1.0, 11.0, 34.0 * DEG)
SPREAD = Spread(0.5 * DEG, DEG / 3600.0, 0.3 * DEG, 0.1 * DEG / 60.0)


def in_unit(unit: str = "deg", steps: int = STEPS, P0: str = "physical") -> AttitudeMatching:
    """The system in one unit of angle.

    Args:
        unit: "rad", "deg" or "arcmin".
        steps: updates, the first one filter period after the start.
        P0: "physical", (0.5 deg)^2, (1 deg/h)^2, (0.3 deg)^2; or "identity", in the unit.
    """
    system = attitude_matching(TURN, PERIOD_S, steps, SPREAD).in_unit(unit)
    return system._replace(sigma=np.ones(9)) if P0 == "identity" else system


def run_with(system: AttitudeMatching) -> tuple:
    """Model with R = I, start, inputs and extras of a run; sizes alone decide what is compiled."""
    return system.model(1.0), system.start(), *system.inputs()
