"""Transfer alignment: a slave inertial unit on a flexing mount aligns itself to a master INS.

- study "attitude-matching": nine states in a bank turn, after Gu & Qin (2005).
- study "velocity-attitude": twelve states in an S-turn, after the patent of Southeast University.
- study "product": total state with mounting and flexure, closed loop; also for recorded pairs.
"""

from robins.systems.study import Study
from robins.systems.system import System
from robins.systems.transfer_alignment import (
    matching_claims,
    matching_parameters,
    patent,
    patent_claims,
)
from robins.systems.transfer_alignment.matching import matching_problem
from robins.systems.transfer_alignment.matching_parameters import Matching
from robins.systems.transfer_alignment.product import study as product
from robins.systems.transfer_alignment.product.log import ALIGNMENT, orientation

SYSTEM = System(
    name="transfer-alignment",
    studies={
        "attitude-matching": Study(
            Matching, matching_problem, matching_parameters.FILTERS, matching_claims.CLAIMS
        ),
        "velocity-attitude": Study(
            patent.Patent, patent.patent_problem, patent.FILTERS, patent_claims.CLAIMS
        ),
        "product": product.STUDY,
    },
    orientation=orientation,
    alignment=ALIGNMENT,
)

__all__ = ["SYSTEM"]
