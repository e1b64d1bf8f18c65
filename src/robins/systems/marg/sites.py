"""Sites where a unit has lain still, recognised by their field.

While a unit lies still its field does not change, so a rest is read once. Two rests with one
strength and dip of the field are taken for one site, where the field points the same way: the
azimuth that the later rest reads gives the drift of the heading since the earlier one. Fields of
rooms differ by microtesla and degrees from place to place; another site that looks alike is rare,
and the filter's noise of heavy tails answers it.
"""

from __future__ import annotations

import numpy as np

_STRENGTH_T, _DIP_RAD = 0.5e-6, 0.01  # that two rests at one site differ by at most
_FALLING = 1.0  # m/s^2 of specific force, below which there is no vertical
_READ_S = 1.0  # of rest, over which a site is read
_APART_S = 5.0  # of motion between two readings: after less the unit may lie as it lay


Look = tuple[int, np.ndarray, float]
"""A site read at the end of a block: its number, field (3,) [T] in body axes and dip [rad]."""

NONE: Look = (-1, np.array([1e-5, 0.0, 0.0]), 0.0)
"""None is read."""


class Sites:
    """Sites of a log, found block by block.

    Number 0 is the site where the log begins, if it begins with rest. Where its field points is
    known by the start, so it is read from the second rest on. Others are numbered from 1 on in the
    order of their first readings; those beyond `count` are not read.
    """

    def __init__(self, count: int):
        """Begin without sites.

        Args:
            count: the most that are kept.
        """
        self._known = np.full((count, 2), np.nan)  # strength [T] and dip [rad] of each
        self._moved_s, self._rest_s, self._rests = np.inf, 0.0, False
        self._sums = np.zeros((2, 3))  # of field and specific force over this rest, times time

    def look(
        self, dt_s: float, still: bool, at_home: bool, force: np.ndarray, field: np.ndarray
    ) -> Look:
        """Take a block.

        Args:
            dt_s: s, its length.
            still: the unit lies still in it.
            at_home: the first rest is that which the log begins with.
            force: (3,) m/s^2, mean specific force.
            field: (3,) T in body axes; NaN where there is none.
        """
        if not still:
            if self._rests and np.all(np.isnan(self._known)):
                self._known[0] = np.inf  # the first rest was too short to be read
            self._rests = False
            self._moved_s += dt_s
            self._rest_s, self._sums = 0.0, np.zeros((2, 3))
            return NONE
        self._rests = True
        if not np.all(np.isfinite(field)) or self._rest_s >= _READ_S * (1.0 - 1e-9):
            return NONE
        self._rest_s += dt_s
        self._sums += dt_s * np.stack([field, force])
        if self._rest_s < _READ_S * (1.0 - 1e-9) or self._moved_s < _APART_S:
            return NONE
        mean, up = self._sums / self._rest_s
        strength, weight = float(np.linalg.norm(mean)), float(np.linalg.norm(up))
        if strength == 0.0 or weight < _FALLING:
            return NONE
        self._moved_s = 0.0
        sine = -mean @ up / (strength * weight)
        dip = float(np.arcsin(np.clip(sine, -1.0, 1.0)))
        seen = np.array([strength, dip])
        if np.all(np.isnan(self._known)):
            self._known[0] = seen if at_home else np.inf
            if at_home:
                return NONE
        site = self._number(seen)
        return (site, mean, dip) if site >= 0 else NONE

    def _number(self, seen: np.ndarray) -> int:
        """Number of a site by its strength and dip; a new one is added; -1 where none is left."""
        off = np.max(np.abs(self._known - seen) / [_STRENGTH_T, _DIP_RAD], axis=1)
        if np.any(off < 1.0):
            return int(np.nanargmin(off))
        free = np.flatnonzero(np.isnan(off))
        if not len(free):
            return -1
        self._known[free[0]] = seen
        return int(free[0])
