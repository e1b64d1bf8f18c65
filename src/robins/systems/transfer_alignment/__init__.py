"""Transfer alignment: a slave inertial unit on a flexing mount aligns itself to a master INS.

- study "attitude-matching": nine states in a bank turn, after Gu & Qin (2005).
- study "velocity-attitude": twelve states in an S-turn, after the patent of Southeast University.
- study "product": total state with mounting and flexure, closed loop; also for recorded pairs.
"""

from robins.systems.study import System
from robins.systems.transfer_alignment import attitude_matching, product, velocity_attitude
from robins.systems.transfer_alignment.product.live import LiveAlignment, SlaveAlignment
from robins.systems.transfer_alignment.product.parameters import PairReplay

SYSTEM = System(
    name="transfer-alignment",
    studies={
        "attitude-matching": attitude_matching.STUDY,
        "velocity-attitude": velocity_attitude.STUDY,
        "product": product.STUDY,
    },
    default="adaptive",
    orientation=product.orientation,
    alignment=product.ALIGNMENT,
)

__all__ = ["SYSTEM", "LiveAlignment", "PairReplay", "SlaveAlignment"]
