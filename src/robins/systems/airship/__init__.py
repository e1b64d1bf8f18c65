"""An airship in the wind: SINS, stars, radar and barometer, with the wind as a constraint.

After Zhao, Gao, Ding & Wei (2017), with their equations corrected; nine states as in the paper, and
a product model with states for the biases and for the error of the wind.
"""

from robins.systems.airship.study import NAVIGATION
from robins.systems.study import System

SYSTEM = System(name="airship", studies={"navigation": NAVIGATION}, default="adaptive")

__all__ = ["SYSTEM"]
