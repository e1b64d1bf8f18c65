"""Ways that the three axes of a sensor point, such as FLU: forward, left, up."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_WAYS = {way: (k // 2, -1.0 if k % 2 else 1.0) for k, way in enumerate("FBRLDU")}


class Axes(NamedTuple):
    """For each axis x, y, z the component along forward, right, down that it is, and its sign."""

    component: tuple[int, ...]
    sign: tuple[float, ...]

    @classmethod
    def of(cls, ways: str) -> Axes:
        """Of three letters.

        Raises:
            ValueError: they are not three axes at right angles, or left-handed.
        """
        if len(ways) != 3 or not set(ways) <= set(_WAYS):
            raise ValueError("is not three of the ways F, B, R, L, D, U, such as FLU")
        index, sign = zip(*(_WAYS[way] for way in ways), strict=True)
        if len(set(index)) < 3:
            raise ValueError("names one axis twice; give three at right angles, such as FLU")
        even = index in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
        if (1 if even else -1) * sign[0] * sign[1] * sign[2] < 0:
            raise ValueError(
                "is left-handed; give a right-handed triad, and a scale of -1 where due"
            )
        return cls(index, sign)

    def to_frd(self, v: np.ndarray) -> np.ndarray:
        """Components (n, 3) along these axes as those along forward, right, down; exact."""
        out = np.empty_like(v)
        out[:, self.component] = v * self.sign
        return out

    def from_frd(self, v: np.ndarray) -> np.ndarray:
        """The inverse of `to_frd`."""
        return v[:, self.component] * self.sign
