"""Constraints on beliefs: equalities, exact or noisy, and bounds."""

from robins.filters.limits.constrain import Constrained, constrain
from robins.filters.limits.interval import Bounded, clip, truncate

__all__ = ["Bounded", "Constrained", "clip", "constrain", "truncate"]
