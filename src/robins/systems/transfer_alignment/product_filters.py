"""Filters of the product model, what they believe, and how they take a simulated pair."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Annotated, Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array

from robins.errors import require_known
from robins.filters import Belief, Filter, Model, kalman, taylor, unscented
from robins.filters.rules import huber
from robins.ins.frames import swap
from robins.ins.state import InsNoise, InsState
from robins.rotation import Rotation
from robins.scenario import Parameters, Quantity, default
from robins.sim.flexure import Flexure, transition
from robins.systems.study import Case, Contender
from robins.systems.transfer_alignment.pair import PairRun, start_estimate
from robins.systems.transfer_alignment.pair_parameters import PairParameters, Structure, Three
from robins.systems.transfer_alignment.product import (
    ATTITUDE,
    POSITION,
    VELOCITY,
    Installation,
    ProductState,
    Sigmas,
    lag_of,
    product_model,
)
from robins.systems.transfer_alignment.product_adaptive import adaptive

_BLOCKS = ("attitude", "velocity", "position", "gyro_bias", "accel_bias", "mounting")
_RIGID = 3 * len(_BLOCKS)  # components without flexure states
# Nothing is known better than this (rad, m/s, m, rad/s, m/s^2, rad), so that covariances that begin
# with zeros have full rank, as the Joseph form needs.
_LEAST = np.repeat([1e-9, 1e-6, 1e-3, 1e-12, 1e-8, 1e-9], 3)
OUTLIERS = 0.999  # share of right records that keep their weight


class Believed(Parameters):
    """What the filters are told; without a word the stated noise, start and mounting are true."""

    # one sigma of the mounting error
    mounting: Annotated[Three, Quantity("angle", least="0 deg", most="180 deg")] = default(
        "0.3 deg"
    )
    # flexure states are for what is given here; tails and bending are not modelled
    flexure: Structure | None = None
    gyro_bias_walk: Annotated[Three, Quantity("rate random walk", least="0 deg/h/sqrt(h)")] = (
        default("0 deg/h/sqrt(h)")
    )
    accel_bias_walk: Annotated[
        Three, Quantity("acceleration random walk", least="0 mg/sqrt(h)")
    ] = default("0 mg/sqrt(h)")
    position: bool = False  # match positions too


class _Kind(NamedTuple):
    flexure: Literal["never", "believed", "always"]
    filter: Any  # () -> Filter


_KINDS: Mapping[str, _Kind] = {
    "kf": _Kind("never", lambda: kalman(taylor())),
    "product": _Kind("believed", lambda: kalman(taylor(), (huber(OUTLIERS),))),
    "product-joseph": _Kind("believed", lambda: kalman(taylor(), (huber(OUTLIERS),), "joseph")),
    "product-flexure": _Kind("always", lambda: kalman(taylor(), (huber(OUTLIERS),))),
    "product-ukf": _Kind("believed", lambda: kalman(unscented(), (huber(OUTLIERS),))),
    "product-adaptive": _Kind("always", adaptive),
}
FILTERS = tuple(_KINDS)
# What a structure may do of which nothing is known. Too short a time is safe, too long is not.
_TEN_ARCMIN = math.radians(10.0 / 60.0)
UNKNOWN = Structure(sigma=(_TEN_ARCMIN, _TEN_ARCMIN, _TEN_ARCMIN), time=(3.0, 3.0, 3.0))


@cache
def make_filter(name: str) -> Filter:
    """The filter of a name; the same object each time, so that what was compiled serves again.

    Raises:
        ValueError: there is no filter of this name.
    """
    return _kind(name).filter()


def _kind(name: str) -> _Kind:
    require_known("filter", name, _KINDS)
    return _KINDS[name]


def flexure_of(name: str, believed: Believed) -> Flexure | None:
    """The flexure that the states of a filter stand for; None where it has none.

    "kf" has none, "product-flexure" always some, the others where one is believed in.
    """
    wanted = _kind(name).flexure
    structure = believed.flexure
    if wanted == "always" and structure is None:
        structure = UNKNOWN
    if wanted == "never" or structure is None:
        return None
    return Flexure(
        np.asarray(structure.sigma), np.asarray(structure.time), np.asarray(structure.damping)
    )


def model_of(pair: PairParameters, believed: Believed, flexure: Flexure | None) -> Model:
    """The product model as parameters tell it.

    Raises:
        ValueError: a noise of the master is zero, so that its records could not be weighed.
    """
    m, s = pair.master, pair.slave
    wanted = {"attitude_noise": m.attitude_noise, "velocity_noise": m.velocity_noise}
    if believed.position:
        wanted["position_noise"] = m.position_noise
    for name, sigma in wanted.items():
        if not all(x > 0.0 for x in sigma):
            raise ValueError(
                f"master.{name} is {sigma}: what filters match needs a sigma above zero on each "
                "axis"
            )
    noise = InsNoise(
        gyro_arw=np.asarray(s.gyro_noise),
        accel_vrw=np.asarray(s.accel_noise),
        gyro_bias_rw=np.asarray(believed.gyro_bias_walk),
        accel_bias_rw=np.asarray(believed.accel_bias_walk),
    )
    at = Installation(
        Rotation.from_euler(*pair.mounting.nominal), jnp.asarray(pair.lever_arm, float)
    )
    position = np.asarray(m.position_noise) if believed.position else None
    sigmas = Sigmas(np.asarray(m.attitude_noise), np.asarray(m.velocity_noise), position)
    return product_model(noise, at, sigmas, flexure)


def start_sigma(pair: PairParameters, believed: Believed, flexure: Flexure | None) -> np.ndarray:
    """(n,) standard deviations of the initial tangent components, uncorrelated."""
    parts = [
        pair.start.attitude,
        pair.start.velocity,
        pair.start.position,
        pair.slave.gyro_bias,
        pair.slave.accel_bias,
        believed.mounting,
    ]
    if flexure is not None:
        # of the steady state, the factor of whose covariance is that of a very long step
        three = zip(flexure.sigma_rad, flexure.tau_s, strict=True)
        steady = [transition(s, t, flexure.damping, 1e3 * t)[1] for s, t in three]
        parts += np.sqrt(np.sum(np.asarray(steady) ** 2, axis=2)).T.tolist()
    sigma = np.concatenate([np.asarray(p, dtype=float) for p in parts])
    sigma[:_RIGID] = np.maximum(sigma[:_RIGID], _LEAST)
    return sigma


def _case(sigma: Array, delay_s: Array, run: PairRun) -> Case:
    """What a filter of the product model is given of a pair, and what it should find."""
    zero, truth = jnp.zeros(3), run.truth
    flexes = len(sigma) > _RIGID
    mean = ProductState(
        InsState.start(start_estimate(run)), zero, *((zero, zero) if flexes else ())
    )
    lag = lag_of(run.increments, delay_s, run.master_omega_b)
    found = ProductState(
        InsState(Rotation(truth.q_nb), *truth[1:5]),
        truth.mounting_rad,
        *((truth.flexure_rad, truth.flexure_rate_rad_s) if flexes else ()),
    )
    return Case(
        start=Belief(mean, jnp.diag(sigma)),
        u=run.increments,
        y={ATTITUDE: Rotation(run.master_q_nb), VELOCITY: run.master_v_n},
        aux={ATTITUDE: lag, VELOCITY: lag},
        truth=found,
    )


def _case_with_position(sigma: Array, delay_s: Array, run: PairRun) -> Case:
    case = _case(sigma, delay_s, run)
    y = {**case.y, POSITION: run.master_position}
    return case._replace(y=y, aux={**case.aux, POSITION: case.aux[ATTITUDE]})


def reported(n: int, blocks: Sequence[str] = _BLOCKS, frame: str = "NED") -> np.ndarray:
    """Rows (3 len(blocks), n) that take some blocks of the tangent error, in the order given.

    Args:
        n: components of the filter's state, 18 or 24.
        blocks: of attitude, velocity, position, gyro_bias, accel_bias, mounting.
        frame: "NED", with body axes forward right down, or "ENU", with right forward up. The error
            is true minus estimated either way, for the attitude C_true = exp(e x) C_estimate.

    Raises:
        ValueError: a block or a frame that is not among these.
    """
    if frame not in ("NED", "ENU") or any(b not in _BLOCKS for b in blocks):
        raise ValueError(
            f"blocks are {', '.join(_BLOCKS)} in NED or ENU; got {', '.join(blocks)} in {frame}"
        )
    turn = np.eye(3) if frame == "NED" else swap(np.eye(3))
    rows = np.zeros((3 * len(blocks), n))
    for k, block in enumerate(blocks):
        at = 3 * _BLOCKS.index(block)
        rows[3 * k : 3 * k + 3, at : at + 3] = turn
    return rows


def product_contender(
    pair: PairParameters,
    name: str = "product",
    believed: Believed | None = None,
    blocks: Sequence[str] = _BLOCKS,
    frame: str = "NED",
) -> Contender:
    """A filter of the product model, for a problem that simulates a `PairRun`.

    Args:
        pair: what the filter is told of both units, the start and the seat. It knows nothing of
            `pair.disturbance`, `pair.flexure` and the true mounting error.
        name: one of `FILTERS`.
        believed: of mounting and flexure; by default 0.3 deg and none.
        blocks: what it reports, see `reported`.
        frame: "NED" or "ENU".

    Raises:
        ValueError: no such filter, block or frame; a noise of the master that is zero.
    """
    told = Believed() if believed is None else believed
    flexure = flexure_of(name, told)
    sigma = start_sigma(pair, told, flexure)
    case = _case_with_position if told.position else _case
    return Contender(
        filter=make_filter(name),
        model=model_of(pair, told, flexure),
        case=Partial(case, jnp.asarray(sigma), jnp.asarray(pair.master.delay)),
        reported=reported(len(sigma), blocks, frame),
    )
