"""When a unit lies still, by blocks of samples: from spread and constancy, not from the mean rate.

A gyro of a cheap unit reads some degrees a second at rest, and a slow turn reads the same. What
tells them apart: at rest the rate is constant, the specific force keeps its direction in the unit,
and so does the magnetic field. So the mean rate counts from a bias that rest has shown before, and
a rest that shows a new one must last longer, unless the log begins with it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from robins.systems.marg.parameters import Rest

_SHORT = 3  # blocks, below which nothing can be told


class RestFound(NamedTuple):
    """Of K blocks."""

    still: np.ndarray  # (K,) bool
    sigma: np.ndarray  # (K,) rad/s, of the mean rate of a block, from the spread of the blocks
    first: np.ndarray | None  # (3,) rad/s, mean rate of the rest that the log begins with
    first_sigma: float  # rad/s, of that mean


def at_rest(
    dt_s: np.ndarray, rate: np.ndarray, force: np.ndarray, field: np.ndarray, rest: Rest
) -> RestFound:
    """Which blocks lie still, told causally.

    A quiet spell is one in which rate and specific force stay near their means over the last
    `rest.after`, and the field near the one the spell began with. It is rest once it has lasted
    `rest.after`, if its mean rate is within `rest.most_rate` of the bias that rest has shown last;
    otherwise, up to `rest.most_bias`, once it has lasted `rest.new_bias`, and then shows a new
    bias. The spell that the log begins with shows one at once.

    Args:
        dt_s: (K,) s, lengths of the blocks.
        rate: (K, 3) rad/s, mean over each block.
        force: (K, 3) m/s^2, mean specific force over each block.
        field: (K, 3) T in body axes; NaN where there is none.
        rest: thresholds.
    """
    count = len(dt_s)
    still, sigma = np.zeros(count, dtype=bool), np.full(count, rest.rate)
    usual = float(np.median(dt_s[dt_s > 0.0])) if np.any(dt_s > 0.0) else 0.0
    first, first_sigma = None, rest.rate
    width = round(rest.after / usual) if usual > 0.0 else 0
    if not rest.detect or width < _SHORT:
        return RestFound(still, sigma, first, first_sigma)
    bias, began, held = np.zeros(3), 0, np.full(3, np.nan)
    clock = np.concatenate([[0.0], np.cumsum(dt_s)])
    for k in range(count):
        # one block is too little to tell from; a pair that differs breaks the spell
        window = slice(max(began, k - width + 1), k + 1)
        mean_rate, mean_force = rate[window].mean(axis=0), force[window].mean(axis=0)
        quiet = 0.0 < dt_s[k] < 3.0 * usual
        quiet &= bool(np.max(np.linalg.norm(rate[window] - mean_rate, axis=1)) < rest.quiet_rate)
        quiet &= bool(np.max(np.linalg.norm(force[window] - mean_force, axis=1)) < rest.quiet_accel)
        if np.all(np.isfinite(field[k])):
            if np.any(np.isnan(held)):
                held = field[k]
            turned = np.linalg.norm(field[k] - held)
            quiet &= bool(turned < rest.quiet_field * np.linalg.norm(held))
        if not quiet:
            began, held = k + 1, np.full(3, np.nan)
            continue
        lasted = clock[k + 1] - clock[began]
        if lasted < rest.after * (1.0 - 1e-9):
            continue
        known = bool(np.all(np.abs(mean_rate - bias) < rest.most_rate))
        if not known:
            new = began == 0 or lasted >= rest.new_bias
            if not (new and np.all(np.abs(mean_rate) < rest.most_bias)):
                continue
        bias = mean_rate
        still[k] = True
        spread = float(np.sqrt(np.mean((rate[window] - mean_rate) ** 2)))
        sigma[k] = max(rest.rate, spread)
        if began == 0 and first is None:
            first, first_sigma = mean_rate, max(rest.rate, spread)
    return RestFound(still, sigma, first, first_sigma)
