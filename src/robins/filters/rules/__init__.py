"""Rules: one published adaptation a file; each composes with every way to linearise."""

from robins.filters.rules.gate import gate

__all__ = ["gate"]
