"""Attitude matching in a bank turn, nine states, after Gu & Qin (2005)."""

from robins.systems.transfer_alignment.attitude_matching.study import STUDY

__all__ = ["STUDY"]
