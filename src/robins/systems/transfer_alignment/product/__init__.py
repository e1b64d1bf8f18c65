"""The product model: total state with mounting and flexure, closed loop; for recorded pairs too."""

from robins.systems.transfer_alignment.product.log import ALIGNMENT, orientation
from robins.systems.transfer_alignment.product.study import STUDY

__all__ = ["ALIGNMENT", "STUDY", "orientation"]
