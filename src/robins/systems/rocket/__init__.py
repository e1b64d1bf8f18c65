"""A spinning rocket's attitude from MEMS gyro and magnetometer.

After Zhao, Li & Wang (2016): their federated strong-tracking UKF with shares by state, what it
is compared with, and what should be used instead. Two studies: "magnetic-attitude" (test-beds A),
the paper's formulation, and "field-vector" (test-beds B), what a magnetometer can do.
"""

from robins.systems.rocket.study import FIELD_VECTOR, MAGNETIC_ATTITUDE
from robins.systems.study import System

SYSTEM = System(
    name="rocket",
    studies={"magnetic-attitude": MAGNETIC_ATTITUDE, "field-vector": FIELD_VECTOR},
    default="adaptive",
)

__all__ = ["SYSTEM"]
