"""A span of time as a parameter."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import pydantic

from robins.scenario.parameters import Parameters, Quantity


class Span(Parameters):
    """A time from `begin` (included) to `end` (not)."""

    begin: Annotated[float, Quantity("time", least="0 s")]
    end: Annotated[float, Quantity("time", above="0 s")]

    @pydantic.model_validator(mode="after")
    def _in_order(self) -> Span:
        if self.end <= self.begin:
            raise ValueError(f"end ({self.end:g} s) must come after begin ({self.begin:g} s)")
        return self

    def holds(self, time_s: Any) -> np.ndarray:
        """Which times lie in it; those of a grid are rounded."""
        time = np.asarray(time_s, float)
        return (time >= self.begin - 1e-9) & (time < self.end - 1e-9)
