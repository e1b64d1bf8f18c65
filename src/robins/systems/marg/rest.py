"""Detection of rest by blocks of samples: from scatter and constancy, not from the mean rate.

A low-cost gyro reads several degrees per second at rest, and so does a slow turn. The difference:
at rest the rate is constant, and specific force and magnetic field keep their directions in body
axes. The mean rate is therefore compared with the last bias found at rest, and a rest with a new
bias must last longer, unless the log begins with it.
"""

from __future__ import annotations

import numpy as np

from robins.systems.marg.parameters import Rest

_SHORT = 3  # blocks; no detection over fewer


class RestDetector:
    """Detector of rest, block by block.

    A quiet spell is one in which rate and specific force stay near their means over the last
    `rest.after`, and the field near that at the start of the spell. It is rest once it has lasted
    `rest.after`, if its mean rate is within `rest.most_rate` of the last bias found at rest. A mean
    rate further off, up to `rest.most_bias`, is a new bias once the spell has lasted
    `rest.new_bias`, or `rest.after` if the log begins with it.

    Attributes:
        first: (3,) rad/s, mean rate of the rest that the log begins with; None if there is none,
            or it is not yet known.
        first_sigma: rad/s, sigma of that mean.
    """

    def __init__(self, usual_s: float, rest: Rest):
        """Create a detector at time zero.

        Args:
            usual_s: s, usual duration of a block.
            rest: thresholds.
        """
        self._usual_s, self._rest = usual_s, rest
        self._width = round(rest.after / usual_s) if usual_s > 0.0 else 0
        self._able = rest.detect and self._width >= _SHORT
        self._rate, self._force = np.zeros((0, 3)), np.zeros((0, 3))  # last blocks of the spell
        self._bias, self._held = np.zeros(3), np.full(3, np.nan)
        self._clock_s, self._began_s, self._unbroken = 0.0, 0.0, True
        self.first: np.ndarray | None = None
        self.first_sigma = rest.rate

    @property
    def settled(self) -> bool:
        """True once it is known whether the log begins with a rest of at least `rest.after`."""
        return not (self._able and self._unbroken) or self.first is not None

    def process_block(
        self, dt_s: float, rate: np.ndarray, force: np.ndarray, field: np.ndarray
    ) -> tuple[bool, float]:
        """Process a block: True if the unit is at rest in it, and sigma of its mean rate [rad/s].

        Args:
            dt_s: s, duration of the block.
            rate: (3,) rad/s, mean over it.
            force: (3,) m/s^2, mean specific force.
            field: (3,) T in body axes; NaN if there is none.
        """
        rest = self._rest
        self._clock_s += dt_s
        if not self._able:
            return False, rest.rate
        # one block does not suffice for a decision; two that differ end the spell
        self._rate = np.concatenate([self._rate, rate[None]])[-self._width :]
        self._force = np.concatenate([self._force, force[None]])[-self._width :]
        mean_rate, mean_force = self._rate.mean(axis=0), self._force.mean(axis=0)
        off_rate = np.max(np.linalg.norm(self._rate - mean_rate, axis=1))
        off_force = np.max(np.linalg.norm(self._force - mean_force, axis=1))
        quiet = 0.0 < dt_s < 3.0 * self._usual_s
        quiet &= bool(off_rate < rest.quiet_rate) and bool(off_force < rest.quiet_accel)
        if np.all(np.isfinite(field)):
            if np.any(np.isnan(self._held)):
                self._held = field
            turned = np.linalg.norm(field - self._held)
            quiet &= bool(turned < rest.quiet_field * np.linalg.norm(self._held))
        if not quiet:
            self._rate, self._force = self._rate[:0], self._force[:0]
            self._began_s, self._held = self._clock_s, np.full(3, np.nan)
            self._unbroken = False
            return False, rest.rate
        lasted = self._clock_s - self._began_s
        if lasted < rest.after * (1.0 - 1e-9):
            return False, rest.rate
        if not np.all(np.abs(mean_rate - self._bias) < rest.most_rate):
            new = self._unbroken or lasted >= rest.new_bias
            if not (new and np.all(np.abs(mean_rate) < rest.most_bias)):
                self._unbroken = False  # a turn: the log does not begin with rest
                return False, rest.rate
        self._bias = mean_rate
        spread = float(np.sqrt(np.mean((self._rate - mean_rate) ** 2)))
        sigma = max(rest.rate, spread)
        if self._unbroken and self.first is None:
            self.first, self.first_sigma = mean_rate, sigma
        return True, sigma
