"""Transfer alignment: a slave inertial unit on a flexing mount aligns itself to a master INS.

- study "attitude-matching": nine states in a bank turn, after Gu & Qin (2005).
- study "velocity-attitude": twelve states in an S-turn, after the patent of Southeast University.
- study "product": total state with mounting and flexure, closed loop; also for recorded pairs.
"""

from robins.systems.study import System
from robins.systems.transfer_alignment.attitude_matching.study import STUDY as MATCHING
from robins.systems.transfer_alignment.product.log import ALIGNMENT, orientation
from robins.systems.transfer_alignment.product.study import STUDY as PRODUCT
from robins.systems.transfer_alignment.velocity_attitude.study import STUDY as VELOCITY_ATTITUDE

SYSTEM = System(
    name="transfer-alignment",
    studies={
        "attitude-matching": MATCHING,
        "velocity-attitude": VELOCITY_ATTITUDE,
        "product": PRODUCT,
    },
    orientation=orientation,
    alignment=ALIGNMENT,
)

__all__ = ["SYSTEM"]
