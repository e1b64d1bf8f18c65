"""The study "product": a slave on an aircraft, a ship or a vehicle, aligned closed loop.

The truth of a run is drawn from the assumptions of the filter "product": initial errors, biases,
noise, mounting error and flexure, from the sigmas of the scenario. So a right filter is consistent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array

from robins import units
from robins.errors import require_known
from robins.filters import Belief, Model
from robins.ins.frames import swap
from robins.ins.state import InsNoise, InsState
from robins.results import Probability, Variables
from robins.rotation import Rotation
from robins.sim.flexure import Flexure, stationary_sigma
from robins.systems.judgement import (
    Claim,
    Metric,
    consistency,
    consistency_claims,
    rms_by_axis,
)
from robins.systems.parts import FRD, NED, ImuBlock, during, refuse_unsettled
from robins.systems.study import Case, Contender, Limit, Recipe, StateBlock, Study, View
from robins.systems.tables import place_arrays, track_arrays
from robins.systems.transfer_alignment.product import model as pm
from robins.systems.transfer_alignment.product.filters import FILTERS, VARIANTS
from robins.systems.transfer_alignment.product.parameters import (
    PairAssumptions,
    PairParameters,
    Product,
)
from robins.systems.transfer_alignment.product.world import (
    PairCourse,
    PairRun,
    lay_out,
    simulate_pair,
    start_estimate,
)

_SLAVE, _MASTER = "FRD of the slave", "FRD of the master"
BLOCKS = (
    StateBlock("attitude", slice(0, 3), "rad", "arcmin", "NED", NED),
    StateBlock("velocity", slice(3, 6), "m/s", "m/s", "NED", NED),
    StateBlock("position", slice(6, 9), "m", "m", "NED", NED),
    StateBlock("gyro_bias", slice(9, 12), "rad/s", "deg/h", _SLAVE, FRD),
    StateBlock("accel_bias", slice(12, 15), "m/s^2", "mg", _SLAVE, FRD),
    StateBlock("mounting", slice(15, 18), "rad", "arcmin", _SLAVE, FRD),
    StateBlock("flexure", slice(18, 21), "rad", "arcmin", _MASTER, FRD),
)
SENSORS = {name: record.axes for name, record in pm.RECORDS.items()}
# by every filter, whether or not it has flexure states
_REPORTED = {block.name: block for block in BLOCKS if block.name != "flexure"}
_RIGID = 18  # components without flexure states
# Least initial sigmas (rad, m/s, m, rad/s, m/s^2, rad): zero ones would make the covariance
# singular, and the Joseph form needs full rank.
_LEAST = np.repeat([1e-9, 1e-6, 1e-3, 1e-12, 1e-8, 1e-9], 3)


# ----------------------------------------------------------------------- assumptions of a filter


def installation_of(pair: PairParameters) -> pm.Installation:
    """Nominal installation of the slave: mounting and lever arm."""
    q_ms = Rotation.from_euler(*pair.mounting.nominal)
    return pm.Installation(q_ms, jnp.asarray(pair.lever_arm, float))


def matched_records(believed: PairAssumptions) -> list[str]:
    """Names of the records of the master that a filter takes."""
    return [name for name in pm.RECORDS if name != pm.POSITION or believed.position]


def model_of(pair: PairParameters, believed: PairAssumptions, flexure: Flexure | None) -> Model:
    """The product model by its parameters.

    Raises:
        ValueError: a noise of the master is zero, so that its records cannot be weighted.
    """
    sigmas = {}
    for name in matched_records(believed):
        key = pm.RECORDS[name].sigma
        sigmas[name] = np.asarray(getattr(pair.master, key))
        if not np.all(sigmas[name] > 0.0):
            raise ValueError(
                f"master.{key} is {getattr(pair.master, key)}: what filters match needs a sigma "
                "above zero on each axis"
            )
    noise = InsNoise(
        gyro_arw=np.asarray(pair.slave.gyro_noise),
        accel_vrw=np.asarray(pair.slave.accel_noise),
        gyro_bias_rw=np.hypot(believed.gyro_bias_walk, pair.slave.gyro_walk),
        accel_bias_rw=np.asarray(believed.accel_bias_walk),
    )
    return pm.product_model(noise, installation_of(pair), sigmas, flexure)


def start_sigma(
    pair: PairParameters, believed: PairAssumptions, flexure: Flexure | None
) -> np.ndarray:
    """(n,) standard deviations of the initial tangent components, uncorrelated."""
    start, slave = pair.start, pair.slave
    parts = [start.attitude, start.velocity, start.position]
    parts += [slave.gyro_sigma, slave.accel_left, believed.mounting]
    sigma = np.maximum(np.concatenate([np.asarray(p, float) for p in parts]), _LEAST)
    return sigma if flexure is None else np.concatenate([sigma, stationary_sigma(flexure)])


def _case(matched: tuple[str, ...], start: tuple[Array, Array], run: PairRun) -> Case:
    """Case of a filter for a pair: its inputs and the truth.

    It uses the records of the master that are `matched`, and starts with a sigma (n,) and the delay
    [s] of the records.
    """
    sigma, delay_s = start
    flexure, truth = jnp.zeros(6), run.truth
    if len(sigma) == _RIGID:
        flexure, truth = None, truth and truth._replace(flexure=None)
    mean = pm.ProductState(InsState.start(start_estimate(run)), jnp.zeros(3), flexure)
    lag = run.lag
    if lag is None:
        lag = pm.lag_of(run.increments, delay_s, run.master_omega_b)
    return Case(
        start=Belief(mean, jnp.diag(sigma)),
        u=ImuBlock(run.increments, run.noise_scale),
        y={name: getattr(run.master, pm.RECORDS[name].field) for name in matched},
        aux=dict.fromkeys(matched, lag),
        truth=truth,
    )


def reported(n: int, blocks: Sequence[str] = tuple(_REPORTED), frame: str = "NED") -> np.ndarray:
    """Rows (3 len(blocks), n) that take some blocks of the tangent error, in the order given.

    Args:
        n: components of the filter's state, 18 or 24.
        blocks: of attitude, velocity, position, gyro_bias, accel_bias, mounting.
        frame: "NED", with body axes forward right down, or "ENU", with right forward up. The error
            is true minus estimated either way, for the attitude C_true = exp(e x) C_estimate.

    Raises:
        ValueError: a block or a frame that is not among these.
    """
    if frame not in ("NED", "ENU") or any(block not in _REPORTED for block in blocks):
        raise ValueError(
            f"blocks are {', '.join(_REPORTED)} in NED or ENU; got {', '.join(blocks)} in {frame}"
        )
    turn = np.eye(3) if frame == "NED" else swap(np.eye(3))
    return np.concatenate([turn @ np.eye(n)[_REPORTED[block].where] for block in blocks])


def product_contender(
    pair: PairParameters,
    name: str = "product",
    believed: PairAssumptions | None = None,
    blocks: Sequence[str] = tuple(_REPORTED),
    frame: str = "NED",
) -> Contender:
    """A filter of the product model, for a problem that simulates a `PairRun`.

    Args:
        pair: assumptions of the filter on both units, the start and the mounting. It does not use
            `pair.disturbance`, `pair.flexure` and the true mounting error.
        name: one of `FILTERS`.
        believed: assumed mounting and flexure; by default 0.3 deg and none.
        blocks: reported blocks, see `reported`.
        frame: "NED" or "ENU".

    Raises:
        ValueError: no such filter, block or frame; a noise of the master that is zero.
    """
    require_known("filter", name, FILTERS)
    assumed = PairAssumptions() if believed is None else believed
    flexure = VARIANTS[name].flexure(assumed.flexure)
    model, sigma = model_of(pair, assumed, flexure), start_sigma(pair, assumed, flexure)
    start = jnp.asarray(sigma), jnp.asarray(pair.master.delay)
    return Contender(
        filter=VARIANTS[name].make(),
        model=model,
        case=Recipe(_case, (tuple(model.dims),), start),
        reported=reported(len(sigma), blocks, frame),
    )


FIVE_ARCMIN = "5_arcmin"
JUDGED = "product"  # the filter whose consistency is claimed

CLAIMS = consistency_claims(
    {
        "sigma": "On no state the RMS error of the filter 'product' is proven, at 99 % confidence, "
        "to differ from its sigma by more than 5 %; value: the largest difference proven",
        "anees": "ANEES of all states of the filter 'product' is inside its 95 % band at 90 % of "
        "the epochs or more; value: the share",
        "nis": "The grand mean NIS of every sensor is inside its 99.9 % band for the filter "
        "'product'; value: the one farthest from 1",
    },
    JUDGED,
) | {
    "aligned": Claim(
        "Once it counts, the attitude RMS of the filter 'product' is at most 1.15 times what its "
        "covariance allows, pooled over the axes; value: the ratio",
        (JUDGED,),
        lambda metrics: metrics[JUDGED]["attitude_over_sigma"],
        (0.0, 1.15),
    )
}


def product_metrics(statistics: Any) -> dict[str, Metric]:
    """Metrics of one filter from its campaign statistics, over the epochs that count.

    Attitudes are listed east, north, up, as in the other studies; the rest as in its block. The
    last sigmas are those that the filter states at the end.
    """
    out = rms_by_axis(statistics, all_axes=("attitude",))
    for block in statistics.blocks:
        if (name := block.name) not in ("attitude", "mounting"):
            continue
        last = units.convert(statistics.sigma[-1][block.where], block.units, block.display_unit)
        out[f"{name}_last_sigma_arcmin"] = last.tolist()
        if name == "attitude":
            rms, sigma = statistics.pooled_rms, statistics.pooled_sigma
            error, stated = (np.linalg.norm(x[block.where]) for x in (rms, sigma))
            out["attitude_over_sigma"] = float(error / stated)
            for key in ("attitude_rms_arcmin", "attitude_last_sigma_arcmin"):
                north, east, down = np.asarray(out[key]).tolist()
                out[key] = [east, north, down]  # sizes, which have no sign
    settled = statistics.settled(FIVE_ARCMIN)
    out["share_below_5_arcmin"] = Probability.among(settled <= statistics.count_from)
    return out | consistency(statistics) | {"diverged_runs": statistics.diverged}


def _contender(given: Product, course: PairCourse, name: str) -> Contender:
    return product_contender(given, name, given.believed)


def tracks(means: Mapping[str, pm.ProductState]) -> Variables:
    """Estimated positions of the slave, by filter."""
    return track_arrays((mean.ins.position for mean in means.values()), "{} of the slave")


def faults(given: PairParameters, epoch_s: np.ndarray) -> dict[str, np.ndarray]:
    """Masks of the epochs at which gyros, flexure or mounting differ from their stated noise."""
    d = given.disturbance
    louder = d.gyro_noise_factor > 1.0
    gyros = during([d.gyro_noise_window] if louder else [], epoch_s)
    if d.drift_step_time is not None and any(d.drift_step):
        gyros |= epoch_s >= d.drift_step_time
    heavy = any(given.flexure.sigma) and given.flexure.tail_dof is not None
    askew = any(given.mounting.error)
    return {
        "gyros": gyros,
        "flexure": np.full(len(epoch_s), heavy),
        "mounting": np.full(len(epoch_s), askew),
    }


def _view(given: Product, course: PairCourse) -> View:
    refuse_unsettled("settle", given.settle, float(course.epoch_s[-1]))
    path = course.path.position
    return View(
        epoch_s=course.epoch_s,
        blocks=tuple(_REPORTED.values()),
        sensors={name: SENSORS[name] for name in matched_records(given.believed)},
        metrics=product_metrics,
        context=xr.Dataset(place_arrays("reference", (path.lat, path.lon, path.alt), "true {}")),
        shown=tracks,
        faults=faults(given, course.epoch_s),
        count_from=int(np.searchsorted(course.epoch_s, given.settle)),
        limits=(Limit(FIVE_ARCMIN, "attitude", units.parse("5 arcmin", "angle")),),
        notes=("The pair is simulated; --master and --slave align a recorded one.",),
    )


STUDY = Study(Product, FILTERS, simulate_pair, _contender, _view, lay_out, CLAIMS)
