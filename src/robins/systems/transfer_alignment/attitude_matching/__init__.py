"""Attitude matching in a bank turn, nine states, after Gu & Qin (2005)."""
