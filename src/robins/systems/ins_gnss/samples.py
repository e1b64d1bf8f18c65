"""Positions and attitudes at every inertial sample of a replay, on request.

Between two epochs the state is that of the earlier one, propagated by the samples since; at an
epoch it is that of the epoch. So a causal filter uses no future data, and a smoother no more than
its epochs do.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence

import jax
import numpy as np
from jaxtyping import Array

from robins.ins.increments import Increments
from robins.ins.mechanise import vector
from robins.ins.state import InsState, path
from robins.program.scanned import named_scan
from robins.systems.replaying import FilterEstimates, LogPiece


def at_samples(
    time_s: np.ndarray, pieces: Sequence[LogPiece], mean: InsState
) -> tuple[np.ndarray, np.ndarray]:
    """Times (K,) [s] and states (K, 10), as in `mechanise.vector`, at the samples of all pieces.

    Args:
        time_s: (N,) of the samples of the log [s].
        pieces: with worlds of type `Case`, whose inputs are blocks of increments.
        mean: at the epochs of all pieces, as joined by `replaying.end_to_end`.
    """
    times, rows, first = [], [], 0
    for piece in pieces:
        count = len(piece.epoch_s)
        own = jax.tree_util.tree_map(lambda x, a=first, n=count: np.asarray(x)[a : a + n], mean)
        first += count + 1
        before = jax.tree_util.tree_map(
            lambda start, x: np.concatenate([np.asarray(start)[None], x[:-1]]),
            piece.world.start.mean,
            own,
        )
        block = piece.world.u.increments
        dt = np.asarray(block.dt)
        found = named_scan(_navigate_block, np.zeros(1), (before, Increments(*block[:3])))[1]
        begins = np.append(piece.begin_s, piece.epoch_s[:-1])[:, None]
        ends = np.where(dt > 0.0, begins + np.cumsum(dt, axis=1), -np.inf)
        last = np.argmax(ends, axis=1)
        found[np.arange(count), last] = np.asarray(vector(own.nav))
        near = np.clip(np.searchsorted(time_s, ends - 1e-6), 0, len(time_s) - 1)
        real = np.abs(time_s[near] - ends) < 1e-6  # exclude parts of a sample split by an epoch
        times.append(time_s[near[real]])
        rows.append(found[real])
    return np.concatenate(times), np.concatenate(rows)


def _navigate_block(carry: Array, row: tuple[InsState, Increments]) -> tuple[Array, Array]:
    return carry, path(*row)


def as_files(
    time_s: np.ndarray,
    origin_ns: int,
    pieces: Sequence[LogPiece],
    answers: Mapping[str, FilterEstimates],
) -> dict[str, bytes]:
    """Files NAME-sample.npz of each filter, by path in the result.

    Each holds `time_ns` (K,) int64, the stamps of the log, and float64 arrays `q_nb` (K, 4), body
    FRD to NED, scalar first, `v_n` (K, 3) m/s, `lat_rad`, `lon_rad` and `alt_m` (K,) of the IMU.
    """
    files = {}
    for name, answer in answers.items():
        when_s, rows = at_samples(time_s, pieces, answer.mean)
        out = io.BytesIO()
        np.savez_compressed(
            out,
            time_ns=np.round(when_s * 1e9).astype(np.int64) + origin_ns,
            q_nb=rows[:, :4],
            v_n=rows[:, 4:7],
            lat_rad=rows[:, 7],
            lon_rad=rows[:, 8],
            alt_m=rows[:, 9],
        )
        files[f"exports/{name}-sample.npz"] = out.getvalue()
    return files
