"""Sites where a unit has lain still, recognised by their field.

While a unit lies still its field does not change, so each rest is read once. Two rests with the
same strength and dip of the field are taken for the same site, where the field has the same
azimuth: the azimuth read at the later rest gives the drift of the heading since the earlier one.
Indoor fields differ by microtesla and degrees from place to place; a false match is rare, and the
heavy-tailed noise of the filter limits its effect.
"""

from __future__ import annotations

import numpy as np

_STRENGTH_T, _DIP_RAD = 0.5e-6, 0.01  # largest differences between two rests at one site
_FALLING = 1.0  # m/s^2; less specific force gives no vertical
_READ_S = 1.0  # s of rest over which a site is read
_APART_S = 5.0  # s of motion between two readings: after less the unit may not have moved


Look = tuple[int, np.ndarray, float]
"""A site read at the end of a block: its number, field (3,) [T] in body axes and dip [rad]."""

NONE: Look = (-1, np.array([1e-5, 0.0, 0.0]), 0.0)
"""Result if no site is read."""


class Sites:
    """Sites of a log, found block by block.

    Number 0 is the site where the log begins, if it begins with rest. The azimuth of its field is
    known from the start, so it is read from the second rest on. Others are numbered from 1 on in
    the order of their first readings; those beyond `count` are not read.
    """

    def __init__(self, count: int):
        """Begin without sites.

        Args:
            count: largest number of sites.
        """
        self._known = np.full((count, 2), np.nan)  # strength [T] and dip [rad] of each
        self._moved_s, self._rest_s, self._rests = np.inf, 0.0, False
        self._sums = np.zeros((2, 3))  # time integrals of field and specific force over this rest

    def process_block(
        self, dt_s: float, still: bool, starts_at_rest: bool, force: np.ndarray, field: np.ndarray
    ) -> Look:
        """Process a block; return the site read at its end, or `NONE`.

        Args:
            dt_s: s, its duration.
            still: the unit lies still in it.
            starts_at_rest: the log begins with rest.
            force: (3,) m/s^2, mean specific force.
            field: (3,) T in body axes; NaN if there is none.
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
            self._known[0] = seen if starts_at_rest else np.inf
            if starts_at_rest:
                return NONE
        site = self._number(seen)
        return (site, mean, dip) if site >= 0 else NONE

    def _number(self, seen: np.ndarray) -> int:
        """Number of the site with this strength and dip, added if new; -1 if all are in use."""
        off = np.max(np.abs(self._known - seen) / [_STRENGTH_T, _DIP_RAD], axis=1)
        if np.any(off < 1.0):
            return int(np.nanargmin(off))
        free = np.flatnonzero(np.isnan(off))
        if not len(free):
            return -1
        self._known[free[0]] = seen
        return int(free[0])
