"""What a replay found: time series with units, figures of merit, sentences."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import xarray as xr

from robins.dataset import Dataset
from robins.filters import Code, Tally
from robins.results import array, variable
from robins.rotation import to_euler
from robins.systems.marg.accuracy import orientation_errors, rms_deg, truth_at
from robins.systems.marg.model import MAGNETOMETER, MargState
from robins.systems.marg.prepare import Prepared
from robins.systems.marg.setup import BLOCKS, SENSORS
from robins.systems.study import StateBlock
from robins.systems.tables import EULER, Update, block_array, innovation_tables, update_metrics


class Answer(NamedTuple):
    """What one filter says; B blocks, N samples."""

    mean: MargState  # leading axis B
    sigma: np.ndarray  # (B, n)
    q_nb: np.ndarray  # (N, 4) at every sample
    updates: dict[str, Update]  # empty for a smoother
    log_likelihood: float
    tally: Tally | None = None  # how the steps went; None for a smoother


def metrics(dataset: Dataset, log: Prepared, answer: Answer) -> dict[str, Any]:
    """Figures of merit of one filter; errors only where the log has a true attitude."""
    out: dict[str, Any] = {}
    if dataset.attitude is not None:
        q_true, counts = truth_at(dataset.attitude, log.time_ns)
        e = orientation_errors(answer.q_nb[counts], q_true[counts])
        out |= {
            "total_rmse_deg": rms_deg(e.total),
            "heading_rmse_deg": rms_deg(e.heading),
            "inclination_rmse_deg": rms_deg(e.inclination),
            "total_max_deg": float(np.degrees(np.max(e.total, initial=0.0))),
            "samples_compared": int(np.sum(counts)),
        }
        heading, _, moving = _errors_at_epochs(dataset, log, answer)
        ratio = heading[moving] / answer.sigma[moving, 2]
        # one where the stated spread of the heading is right
        out["heading_nees"] = float(np.mean(ratio**2)) if ratio.size else float("nan")
    out["rest_share"] = float(np.mean(log.still))
    out |= update_metrics(answer.updates)
    if answer.updates:
        out["log_likelihood"] = answer.log_likelihood
    return out


def _epoch_rows(log: Prepared) -> np.ndarray:
    """(B,) the sample at which each block ends."""
    n = log.samples.dt_s.shape[1]
    return np.minimum((np.arange(len(log.epoch_s)) + 1) * n, log.used)


def _errors_at_epochs(dataset: Dataset, log: Prepared, answer: Answer):
    """Heading and tilt [rad], true minus estimated, at the ends of blocks, and where they count."""
    assert dataset.attitude is not None
    rows = _epoch_rows(log)
    q_true, counts = truth_at(dataset.attitude, log.time_ns[rows])
    q = answer.q_nb[rows]
    heading = -orientation_errors(q, q_true).heading
    # How the true vertical leans against the estimated one, along estimated north and east.
    down = _down_in_body(q_true)
    lean = np.stack([np.sum(axis * down, axis=1) for axis in _level_axes(q)], axis=1)
    tilt = np.stack([lean[:, 1], -lean[:, 0]], axis=1)
    return heading, tilt, counts


def _down_in_body(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q.T
    return np.stack(
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)], axis=1
    )


def _level_axes(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """North and east in body axes."""
    w, x, y, z = q.T
    north = [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)]
    east = [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)]
    return np.stack(north, axis=1), np.stack(east, axis=1)


def solution(dataset: Dataset, log: Prepared, answers: dict[str, Answer]) -> xr.Dataset:
    """Time series of every filter, labelled as `robins.results` lists them."""
    data: dict[str, Any] = {
        "filter": ("filter", list(answers)),
        "time": variable("time", log.epoch_s, "s", "time since the first sample"),
    }
    still = log.still.astype(np.int8)
    data |= array("context", still, "rest", unit="1", long_name="unit lies still")
    for block in BLOCKS:
        sigma = np.stack([a.sigma[:, block.where] for a in answers.values()])
        data |= block_array("sigma", block, sigma)
        if block.name != "attitude":
            found = np.stack([_estimate(a, block.name) for a in answers.values()])
            data |= block_array("estimate", block, found)
    euler = [np.stack(to_euler(jnp.asarray(a.mean.q_nb.wxyz)), axis=-1) for a in answers.values()]
    turned = EULER._replace(frame="body to NED")
    data |= block_array("estimate", turned, np.stack(euler), "estimated roll, pitch, heading")
    if dataset.attitude is not None:
        data |= _error_tables(dataset, log, answers)
    data |= array(
        "context",
        np.stack([_disturbed(a, len(log.epoch_s)) for a in answers.values()]),
        "magnetic_disturbance",
        unit="1",
        long_name="magnetometer refused",
        dims="filter time",
    )
    seen = [answer.updates for answer in answers.values()]
    return xr.Dataset(data | innovation_tables(seen, SENSORS, log.epoch_s))


def _error_tables(dataset: Dataset, log: Prepared, answers: dict[str, Answer]) -> dict[str, Any]:
    found = [_errors_at_epochs(dataset, log, a) for a in answers.values()]
    heading = StateBlock("heading", slice(2, 3), "rad", "deg", "NED", ("heading",))
    inclination = StateBlock("inclination", slice(0, 2), "rad", "deg", "NED", ("north", "east"))
    out: dict[str, Any] = {}
    for block, values, words in (
        (heading, [h[:, None] for h, _, _ in found], "true minus estimated heading"),
        (inclination, [t for _, t, _ in found], "tilt of true against estimated"),
    ):
        out |= block_array("error", block, np.stack(values), words)
        sigma = np.stack([a.sigma[:, block.where] for a in answers.values()])
        out |= block_array("sigma", block, sigma)
    return out


def _estimate(answer: Answer, block: str) -> np.ndarray:
    value = np.asarray(getattr(answer.mean, {"velocity": "v_n"}.get(block, block)))
    return value.reshape(len(value), -1)


def _disturbed(answer: Answer, blocks: int) -> np.ndarray:
    if MAGNETOMETER not in answer.updates:
        return np.zeros(blocks, dtype=np.int8)
    return (answer.updates[MAGNETOMETER].code == int(Code.REFUSED)).astype(np.int8)


def sentences(log: Prepared, answers: dict[str, Answer]) -> list[str]:
    """What a reader of the report should know."""
    out = [log.look.sentence]
    c = log.counts
    out.append(
        f"At rest for {100.0 * float(np.mean(log.still)):.0f} % of the log; "
        f"{c['imu_missing']} inertial samples missing, {c['imu_saturated']} at the end of their "
        f"range, {c['imu_gaps']} gaps; {c['field_missing']} field readings missing, "
        f"{c['field_implausible']} no field of the Earth; {c['blocks_in_free_fall']} blocks in "
        f"free fall."
    )
    for name, answer in answers.items():
        update = answer.updates.get(MAGNETOMETER)
        if update is None or not np.any(update.dof + (update.code == int(Code.REFUSED))):
            continue
        asked = int(np.sum((update.dof > 0) | (update.code == int(Code.REFUSED))))
        refused = int(np.sum(update.code == int(Code.REFUSED)))
        out.append(
            f"{name}: the field was disturbed at {refused} of {asked} looks; heading then came "
            "from the gyros."
        )
    return out
