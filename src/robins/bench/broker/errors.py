"""What ends a run on the bench."""

from __future__ import annotations

from robins.errors import RobinsError


class BenchError(RobinsError, RuntimeError):
    """A run on the bench that cannot go on; says which part, when and why."""

    bad_input = False


class LinkLost(BenchError):
    """A port whose far end is gone."""

    def __init__(self, part: str, why: OSError):
        super().__init__(f"the port of '{part}' is gone: {why}")
        self.part = part
