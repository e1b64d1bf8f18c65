"""An inertial measurement unit: reports of its gyros and accelerometers along a true motion.

Input are the ideal increments, the angle and the change of velocity of each sampling interval;
output are those of a unit with the errors of an `ImuErrorModel`. Every process is discretised
exactly, for the sampling interval of each sample: the bias at the end of a sample and its integral
over the sample have their true covariance, so a sum of increments has the same statistics at 10 Hz
as at 1 kHz, and intervals may vary.

Normal numbers are drawn by sample number, and by error within a sample. So an error switched on or
off leaves the numbers of the others unchanged, and part of a run, a longer run and one sample at a
time (`begin`, `sample`) get the same noise as the whole run from `corrupt`.

All is pure JAX: map over ``key`` for a batch of runs, and over a stacked model for a sweep.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from robins import _float64  # noqa: F401
from robins.dataset import ImuTable
from robins.errors import require_kind
from robins.filters.belief import Number
from robins.ins.imu_errors import ImuErrorModel, TriadErrors

# The order of draws is part of the file format, as `robins.sim.random.Component` is: a table of
# normal numbers (rows, 2, 3) is drawn once and another at each sample; the second axis is gyros,
# accelerometers. A counter-based generator fills the rows in order, so none depends on later rows.
_ONCE, _SAMPLES = 0, 1  # streams folded into the key of the unit

# First row of each error among the numbers drawn at switch-on; the last two have three rows.
_MARKOV_START, _BIAS, _SCALE, _MISALIGNMENT, _G_SENSITIVITY = 0, 1, 2, 3, 6
# Fields of the errors that need a row of the numbers drawn at a sample, in their order. The first
# is also for the integrals of the processes given their values at both ends.
_WHITE, _MARKOV, _WALK = range(3)
_SAMPLED = ("white", "markov_sigma", "walk")


class TriadTruth(NamedTuple):
    """True errors of a triad. From `corrupt` the first two have a row for each sample."""

    bias: Any  # (3,) or (n, 3) rad/s or m/s^2 at the end of the sample, all parts of the bias
    clipped: Any  # (3,) or (n, 3) bool: the axis was beyond its full scale
    matrix: Any  # (3, 3) S + M: scale factor errors and misalignments
    g_sensitivity: Any  # (3, 3) rad/s per m/s^2


class ImuTruth(NamedTuple):
    """True errors of a unit."""

    gyro: TriadTruth
    accel: TriadTruth


class _Triad(NamedTuple):
    errors: TriadErrors
    bias: Any  # (3,) constant; None, here as below, where there is none
    matrix: Any  # (3, 3) S + M
    g_sensitivity: Any  # (3, 3)


class SimulatedImu(NamedTuple):
    """A unit after switch-on: its model and the errors that are constant until switch-off."""

    gyro: _Triad
    accel: _Triad
    key: Array  # key of the numbers drawn at each sample


class _TriadState(NamedTuple):
    markov: Any = None  # (3,) Gauss-Markov bias
    walk: Any = None  # (3,) random walk of the bias
    residue: Any = None  # (3,) part of the increments not yet reported by the quantiser


class ImuState(NamedTuple):
    """State of a unit from sample to sample."""

    number: Any  # () int, number of the next sample
    elapsed_s: Any  # () s since it was switched on
    gyro: _TriadState
    accel: _TriadState


def begin(model: ImuErrorModel, key: Array) -> tuple[SimulatedImu, ImuState]:
    """Switch a unit on: draw its constant errors and the initial values of its processes.

    The Gauss-Markov bias starts in its steady state, the random walk and the ramp at zero.

    Args:
        model: its error model.
        key: of the run and the unit, from `robins.sim.random.stream`.
    """
    numbers = jax.random.normal(jax.random.fold_in(key, _ONCE), (9, 2, 3))
    gyro, markov_of_gyro = _switch_on(model.gyro, numbers[:, 0])
    accel, markov_of_accel = _switch_on(model.accel, numbers[:, 1])
    state = ImuState(
        jnp.asarray(0),
        jnp.asarray(0.0),
        _start(model.gyro, markov_of_gyro),
        _start(model.accel, markov_of_accel),
    )
    return SimulatedImu(gyro, accel, jax.random.fold_in(key, _SAMPLES)), state


def sample(
    imu: SimulatedImu,
    state: ImuState,
    dt_s: Float[Array, ""],
    theta: Float[Array, "3"],
    dv: Float[Array, "3"],
) -> tuple[ImuState, tuple[Array, Array, ImuTruth]]:
    """Report one sample; the increments and `ImuTruth` are as in `corrupt`."""
    after, (turned, pushed, seen) = _sample(
        imu, state, _normals(imu, state.number), dt_s, theta, dv
    )
    return after, (turned, pushed, _truth(imu, seen))


def corrupt(
    dt_s: ArrayLike, theta: ArrayLike, dv: ArrayLike, model: ImuErrorModel, key: Array
) -> tuple[Array, Array, ImuTruth]:
    """Reported increments for n consecutive ideal samples, and the true errors of the unit.

    An error that is None in the model costs nothing and changes nothing: with none at all the
    increments come back bit for bit. Memory grows with n; for a long campaign use `begin` and
    `sample` in a scan.

    Args:
        dt_s: (n,) sampling intervals [s].
        theta: (n, 3) ideal angle increments [rad], integrals of omega_ib_b.
        dv: (n, 3) ideal velocity increments [m/s], integrals of the specific force f_ib_b.
        model: the error model.
        key: of the run and the unit, from `robins.sim.random.stream`.

    Returns:
        theta and dv as reported, and the `ImuTruth`.

    Raises:
        ValueError: shapes that do not fit together.
    """
    dt, turned, pushed = (jnp.asarray(x, float) for x in (dt_s, theta, dv))
    if dt.ndim != 1 or turned.shape != (*dt.shape, 3) or pushed.shape != turned.shape:
        raise ValueError(
            "dt_s, theta, dv must have shapes (n,), (n, 3), (n, 3), got "
            f"{dt.shape}, {turned.shape}, {pushed.shape}"
        )
    imu, state = begin(model, key)
    # All noise at once, then the recursions: many times faster than drawing inside the scan.
    normals = jax.vmap(lambda number: _normals(imu, number))(jnp.arange(len(dt)))
    _, (reported_theta, reported_dv, seen) = jax.lax.scan(
        lambda carry, x: _sample(imu, carry, *x), state, (normals, dt, turned, pushed)
    )
    return reported_theta, reported_dv, _truth(imu, seen)


_compiled = jax.jit(corrupt)


def corrupt_table(imu: ImuTable, model: ImuErrorModel, key: Array) -> tuple[ImuTable, ImuTruth]:
    """`corrupt` for a table of ideal samples, rates or increments; the errors have its body axes.

    A rate is taken as the mean over the interval that ends with it. The interval of the first row
    is not in the table; it is taken equal to that of the second.

    Raises:
        TypeError: it is not an `ImuTable`.
        ValueError: fewer than two rows, or time that does not increase.
    """
    require_kind(imu, ImuTable, "corrupt_table")
    dt = np.diff(imu.time_ns) * 1e-9
    if len(dt) == 0 or np.any(dt <= 0.0):
        raise ValueError(
            f"{imu.source or 'imu'}: {len(imu)} row(s) with sampling intervals from "
            f"{np.min(dt, initial=np.inf):g} s: two rows and time that increases are needed"
        )
    dt = np.concatenate([dt[:1], dt])
    per_row = dt[:, None] if imu.kind == "rate" else np.ones((len(dt), 1))
    theta, dv, truth = _compiled(dt, imu.gyro * per_row, imu.accel * per_row, model, key)
    gyro, accel = np.asarray(theta) / per_row, np.asarray(dv) / per_row
    return dataclasses.replace(imu, gyro=gyro, accel=accel), truth


def _switch_on(errors: TriadErrors, numbers: Array) -> tuple[_Triad, Number | None]:
    """A triad and the start of its Gauss-Markov bias, from normal numbers (9, 3)."""

    def drawn(row: int, given: Number | None, sigma: Number | None) -> Number | None:
        if sigma is None:
            return given
        normal = numbers[row] if jnp.ndim(sigma) == 1 else numbers[row : row + 3]
        return _sum(given, sigma * normal)

    bias = drawn(_BIAS, errors.bias, errors.bias_sigma)
    scale = drawn(_SCALE, errors.scale, errors.scale_sigma)
    sheared = drawn(_MISALIGNMENT, errors.misalignment, errors.misalignment_sigma)
    bent = drawn(_G_SENSITIVITY, errors.g_sensitivity, errors.g_sensitivity_sigma)
    matrix = _sum(None if scale is None else jnp.diag(scale), sheared)
    markov = drawn(_MARKOV_START, None, errors.markov_sigma)
    return _Triad(errors, bias, matrix, bent), markov


def _start(errors: TriadErrors, markov: Number | None) -> _TriadState:
    walk = None if errors.walk is None else jnp.zeros(3)
    residue = None if errors.quantum is None else jnp.zeros(3)
    return _TriadState(markov, walk, residue)


def _normals(imu: SimulatedImu, number: Array) -> Array:
    """Standard normal numbers (rows, 2, 3) of one sample, as many rows as the errors need."""
    both = imu.gyro.errors, imu.accel.errors
    there = [any(getattr(one, name) is not None for one in both) for name in _SAMPLED]
    rows = max((row + 1 for row, some in enumerate(there) if some), default=0)
    if rows == 0:
        return jnp.zeros((0, 2, 3))
    return jax.random.normal(jax.random.fold_in(imu.key, number), (rows, 2, 3))


def _sample(imu: SimulatedImu, state: ImuState, normals, dt, theta, dv):
    time = (state.elapsed_s, dt)
    gyro, turned, of_gyro = _report(imu.gyro, state.gyro, normals[:, 0], *time, theta, dv)
    accel, pushed, of_accel = _report(imu.accel, state.accel, normals[:, 1], *time, dv, dv)
    after = ImuState(state.number + 1, state.elapsed_s + dt, gyro, accel)
    return after, (turned, pushed, (of_gyro, of_accel))


def _report(triad: _Triad, state: _TriadState, normals, elapsed_s, dt, true, dv):
    """One sample of one triad: state, increment, (bias, clipped); dv is the true one."""
    errors = triad.errors
    now = triad.bias  # bias at the end of the sample
    added = None if now is None else now * dt  # its contribution to the increment
    markov, walk, residue = state
    spread_sq = None if errors.white is None else errors.white**2 * dt
    if markov is not None:
        markov, integral, rest = markov_step(
            markov, errors.markov_sigma, errors.markov_tau_s, dt, normals[_MARKOV]
        )
        now, added, spread_sq = _sum(now, markov), _sum(added, integral), _sum(spread_sq, rest)
    if walk is not None:
        walk, integral, rest = walk_step(walk, errors.walk, dt, normals[_WALK])
        now, added, spread_sq = _sum(now, walk), _sum(added, integral), _sum(spread_sq, rest)
    if spread_sq is not None:
        added = _sum(added, jnp.sqrt(spread_sq) * normals[_WHITE])
    if errors.ramp is not None:
        now = _sum(now, errors.ramp * (elapsed_s + dt))
        added = _sum(added, errors.ramp * (dt * (elapsed_s + 0.5 * dt)))
    if triad.matrix is not None:
        added = _sum(added, triad.matrix @ true)
    if triad.g_sensitivity is not None:
        added = _sum(added, triad.g_sensitivity @ dv)

    out = true if added is None else true + added
    clipped = jnp.zeros(3, bool)
    if errors.full_scale is not None:
        limit = errors.full_scale * dt
        clipped = jnp.abs(out) > limit
        out = jnp.clip(out, -limit, limit)
    if residue is not None:
        out, residue = quantise(out, residue, errors.quantum)
    bias = jnp.zeros(3) if now is None else now
    return _TriadState(markov, walk, residue), out, (bias, clipped)


def _truth(imu: SimulatedImu, seen) -> ImuTruth:
    none = jnp.zeros((3, 3))

    def of(triad: _Triad, bias: Array, clipped: Array) -> TriadTruth:
        matrix, bent = (none if m is None else m for m in (triad.matrix, triad.g_sensitivity))
        return TriadTruth(bias, clipped, matrix, bent)

    return ImuTruth(of(imu.gyro, *seen[0]), of(imu.accel, *seen[1]))


def markov_step(
    bias: Float[Array, "*b"],
    sigma: ArrayLike,
    tau_s: ArrayLike,
    dt_s: ArrayLike,
    normal: Float[Array, "*b"],
) -> tuple[Array, Array, Array]:
    """End value of a first-order Gauss-Markov process over dt; mean and variance of its integral.

    With x = dt/tau the end is ``e^-x bias + w`` with ``var w = sigma^2 (1 - e^-2x)``. Given both
    ends the integral has the mean ``tau tanh(x/2) (bias + end)`` and the variance
    ``4 sigma^2 tau^2 (x/2 - tanh(x/2))``: the joint covariance of the integrated Gauss-Markov
    model (Brown & Hwang 2012), conditioned.

    Args:
        bias: at the start of dt.
        sigma: of the stationary process.
        tau_s: correlation time [s].
        dt_s: interval [s].
        normal: standard normal numbers.
    """
    sigma, tau, dt = (jnp.asarray(x, float) for x in (sigma, tau_s, dt_s))
    half = 0.5 * dt / tau
    end = jnp.exp(-2.0 * half) * bias + sigma * jnp.sqrt(-jnp.expm1(-4.0 * half)) * normal
    mean = tau * jnp.tanh(half) * (bias + end)
    return end, mean, 4.0 * (sigma * tau) ** 2 * _less_tanh(half)


def walk_step(
    bias: Float[Array, "*b"], strength: ArrayLike, dt_s: ArrayLike, normal: Float[Array, "*b"]
) -> tuple[Array, Array, Array]:
    """End value of a random walk over dt; mean and variance of its integral.

    Given both ends the integral has the mean ``dt (bias + end) / 2`` and the variance of an
    integrated Brownian bridge, ``strength^2 dt^3 / 12``.

    Args:
        bias: at the start of dt.
        strength: K, root of the variance gained in a second.
        dt_s: interval [s].
        normal: standard normal numbers.
    """
    strength, dt = jnp.asarray(strength, float), jnp.asarray(dt_s, float)
    end = bias + strength * jnp.sqrt(dt) * normal
    return end, 0.5 * dt * (bias + end), strength**2 * dt**3 / 12.0


def quantise(
    increment: Float[Array, "*b"], residue: Float[Array, "*b"], quantum: ArrayLike
) -> tuple[Array, Array]:
    """Increment rounded to whole counts, and the remainder for the next one.

    Args:
        increment: increment of the interval.
        residue: remainder of the previous interval.
        quantum: size of a count; zero: not quantised.
    """
    size = jnp.asarray(quantum, float)
    due = increment + residue
    some = jnp.where(size > 0.0, size, 1.0)
    out = jnp.where(size > 0.0, jnp.round(due / some) * some, due)
    return out, due - out


def _less_tanh(u):
    """``u - tanh(u)`` for u >= 0 without cancellation."""
    small = u < 0.1
    x = jnp.where(small, u, 0.0) ** 2
    # Dropped: 21844/6081075 u^13, 1e-12 of the whole at the switch.
    series = x * (1 / 3 - x * (2 / 15 - x * (17 / 315 - x * (62 / 2835 - x * 1382 / 155925))))
    safe = jnp.where(small, 1.0, u)
    return jnp.where(small, u * series, safe - jnp.tanh(safe))


def _sum(a: Number | None, b: Number | None) -> Number | None:
    """Sum of two arrays, either of which may be None, which counts as zero."""
    return b if a is None else a if b is None else a + b
