"""Detection of rest by blocks of samples: from spread and constancy, not from the mean rate.

A gyro of a cheap unit reads some degrees a second at rest, and a slow turn reads the same. The
difference: at rest the rate is constant, the specific force keeps its direction in the unit,
and so does the magnetic field. So the mean rate counts from a bias that rest has shown before, and
a rest that shows a new one must last longer, unless the log begins with it.
"""

from __future__ import annotations

import numpy as np

from robins.systems.marg.parameters import Rest

_SHORT = 3  # blocks, below which there is no decision


class RestDetector:
    """Detector of rest, block by block.

    A quiet spell is one in which rate and specific force stay near their means over the last
    `rest.after`, and the field near the one the spell began with. It is rest once it has lasted
    `rest.after`, if its mean rate is within `rest.most_rate` of the bias that rest has shown last;
    otherwise, up to `rest.most_bias`, once it has lasted `rest.new_bias`, and then shows a new
    bias. The spell that the log begins with shows one at once.

    Attributes:
        first: (3,) rad/s, mean rate of the rest that the log begins with; None where there is none,
            or not yet.
        first_sigma: rad/s, of that mean.
    """

    def __init__(self, usual_s: float, rest: Rest):
        """Begin.

        Args:
            usual_s: s, usual length of a block.
            rest: thresholds.
        """
        self._usual_s, self._rest = usual_s, rest
        self._width = round(rest.after / usual_s) if usual_s > 0.0 else 0
        self._able = rest.detect and self._width >= _SHORT
        self._rate, self._force = np.zeros((0, 3)), np.zeros((0, 3))  # of the spell, the last width
        self._bias, self._held = np.zeros(3), np.full(3, np.nan)
        self._clock_s, self._began_s, self._unbroken = 0.0, 0.0, True
        self.first: np.ndarray | None = None
        self.first_sigma = rest.rate

    @property
    def settled(self) -> bool:
        """True if it is known how the log begins: at rest, which lasts `rest.after`, or not."""
        return not (self._able and self._unbroken) or self.first is not None

    def look(
        self, dt_s: float, rate: np.ndarray, force: np.ndarray, field: np.ndarray
    ) -> tuple[bool, float]:
        """Decide whether the unit lies still in the next block, with the spread of its rate
        [rad/s].

        Args:
            dt_s: s, length of the block.
            rate: (3,) rad/s, mean over it.
            force: (3,) m/s^2, mean specific force.
            field: (3,) T in body axes; NaN where there is none.
        """
        rest = self._rest
        self._clock_s += dt_s
        if not self._able:
            return False, rest.rate
        # one block is too little for a decision; a pair that differs breaks the spell
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
