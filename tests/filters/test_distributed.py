"""Distributed filters and covariance intersection, against dense recursions."""

import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import System
from two_sensors import CHANNELS, ROWS, SYSTEMS, Y, added, centralised, corrected, one_run

from robins.filters import Belief
from robins.filters.distributed import distributed, intersecting
from robins.filters.fusion import covariance_intersection

# -------------------------------------------------------------------------- distributed, intersect


def dense_distributed(s: System, y, feedback):
    members, out = [(s.m0, s.P0)] * 2, []
    for row in y:
        members = [(s.F @ x, s.F @ P @ s.F.T + s.Q) for x, P in members]
        members = [
            corrected(s, one, row, rows) for one, rows in zip(members, ROWS.values(), strict=True)
        ]
        fused = added(members)
        out.append(fused)
        if feedback == "mean":
            members = [(fused[0], P) for _, P in members]
        if feedback == "full":
            members = [fused, fused]
    return [np.array(series) for series in zip(*out, strict=True)]


@pytest.mark.parametrize("feedback", ["own", "mean", "full"])
@pytest.mark.filterwarnings("ignore:feedback='full' gives:UserWarning")
def test_distributed_fusion_is_a_sum_of_the_locals_information(feedback):
    steps = 12  # "full" doubles the information at each
    means, covariances = dense_distributed(SYSTEMS[0], Y[0, :steps], feedback)
    got = one_run(distributed(CHANNELS, feedback), steps)
    np.testing.assert_allclose(got[0], means, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(got[1], covariances, rtol=1e-7, atol=1e-10)
    central = np.linalg.det(centralised(SYSTEMS[0], Y[0, :steps])[1][-1])
    claimed = np.linalg.det(np.asarray(got[1][-1]))
    assert claimed < (0.3 if feedback == "full" else 1.0) * central


def test_intersecting_filters_are_the_intersection_of_each_alone():
    got = one_run(intersecting(CHANNELS, "det"), 12)
    alone = []
    for rows in ROWS.values():
        y = np.full((12, 3), np.nan)
        y[:, rows] = Y[0, :12, rows]
        alone.append(centralised(SYSTEMS[0], y))
    last = [Belief.of(jnp.array(m[-1]), P[-1]) for m, P in alone]
    want = covariance_intersection(last, "det")
    np.testing.assert_allclose(got[0][-1], want.mean, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(got[1][-1], want.covariance, rtol=1e-7, atol=1e-9)
    better = min(np.linalg.det(P[-1]) for _, P in alone)
    assert (
        np.linalg.det(centralised(SYSTEMS[0], Y[0, :12])[1][-1])
        < np.linalg.det(np.asarray(want.covariance))
        <= better * (1 + 1e-9)
    )
