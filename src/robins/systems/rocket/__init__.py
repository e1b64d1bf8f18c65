"""A spinning rocket's attitude from MEMS gyro and magnetometer.

After Zhao, Li & Wang (2016): their federated strong-tracking UKF with shares by state, what it
is compared with, and what should be used instead. Two studies: "magnetic-attitude" (test-beds A),
the paper's formulation, and "field-vector" (test-beds B), what a magnetometer can do.
"""

from robins.systems.rocket.claims import CLAIMS
from robins.systems.rocket.parameters import (
    ANGLE_FILTERS,
    FIELD_FILTERS,
    FieldVector,
    MagneticAttitude,
)
from robins.systems.rocket.problem import angle_problem, field_problem
from robins.systems.study import Study
from robins.systems.system import System

SYSTEM = System(
    name="rocket",
    studies={
        "magnetic-attitude": Study(MagneticAttitude, angle_problem, ANGLE_FILTERS, CLAIMS),
        "field-vector": Study(FieldVector, field_problem, FIELD_FILTERS, CLAIMS),
    },
)

__all__ = ["SYSTEM"]
