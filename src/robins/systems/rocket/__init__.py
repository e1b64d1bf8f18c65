"""A spinning rocket's attitude from MEMS gyro and magnetometer.

After Zhao, Li & Wang (2016): their federated strong-tracking UKF with shares by state, the filters
it is compared with, and the recommended one. Two studies: "magnetic-attitude" (test-bed A), the
paper's formulation, and "field-vector" (test-bed B), the measurement a magnetometer can provide.
"""

from robins.systems.rocket.study import FIELD_VECTOR, MAGNETIC_ATTITUDE
from robins.systems.study import System

SYSTEM = System(
    name="rocket",
    studies={"magnetic-attitude": MAGNETIC_ATTITUDE, "field-vector": FIELD_VECTOR},
    default="adaptive",
)

__all__ = ["SYSTEM"]
