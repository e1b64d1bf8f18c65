"""When the unit lies still, from samples up to now."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from robins.systems.marg.parameters import Rest

_MEMORY_S = 0.5  # time constant of the running means
_FEWEST = 5  # samples in the memory, below which nothing can be told


def still_samples(
    dt_s: np.ndarray, rate_b: np.ndarray, force_b: np.ndarray, rest: Rest
) -> np.ndarray:
    """Whether the unit has lain still for a while, sample by sample, causal.

    Still means that rate and specific force stay near their running means, and the mean rate near
    zero, without a break for `Rest.after`.

    Args:
        dt_s: (N,) s.
        rate_b: (N, 3) rad/s.
        force_b: (N, 3) m/s^2.
        rest: thresholds.

    Returns:
        (N,) bool.
    """
    step = float(np.median(dt_s)) if len(dt_s) else 0.0
    if not rest.detect or step <= 0.0 or _FEWEST * step > _MEMORY_S:
        return np.zeros(len(dt_s), dtype=bool)
    mean_rate, mean_force = _running_mean(rate_b, step), _running_mean(force_b, step)
    quiet = np.linalg.norm(rate_b - mean_rate, axis=1) < rest.quiet_rate
    quiet &= np.linalg.norm(force_b - mean_force, axis=1) < rest.quiet_accel
    quiet &= np.all(np.abs(mean_rate) < rest.most_rate, axis=1)
    quiet &= dt_s < rest.after
    time = np.cumsum(dt_s)
    # time at which the quiet spell that holds now began
    began = np.maximum.accumulate(np.where(quiet, -np.inf, time))
    began = np.where(np.isfinite(began), began, 0.0)
    return quiet & (time - began >= rest.after)


def _running_mean(values: np.ndarray, step: float) -> np.ndarray:
    """First-order low-pass, begun at the first sample."""
    share = -np.expm1(-step / _MEMORY_S)
    return np.asarray(lfilter([share], [1.0, share - 1.0], values - values[0], axis=0)) + values[0]
