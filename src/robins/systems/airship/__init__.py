"""An airship in the wind: SINS, stars, radar and barometer, with the wind as a constraint.

After Zhao, Gao, Ding & Wei (2017), with their equations corrected; nine states as in the paper, and
a product model with states for the biases and for the error of the wind.
"""

from pathlib import Path

from robins.systems.airship.claims import CLAIMS
from robins.systems.airship.parameters import FILTERS, Airship
from robins.systems.airship.problem import airship_problem
from robins.systems.system import Study, System

_HERE = Path(__file__).parent / "scenarios"
_SCENARIOS = ("s0", "s1", "s1c", "s2", "s3", "s4", "sar-loss", "matched", "turbulence")

SYSTEM = System(
    name="airship",
    summary="a stratospheric airship in the wind: SINS, stars, radar, barometer and air data",
    studies={"navigation": Study(Airship, airship_problem, FILTERS, CLAIMS)},
    scenarios={name: _HERE / f"{name}.toml" for name in _SCENARIOS},
)

__all__ = ["SYSTEM"]
