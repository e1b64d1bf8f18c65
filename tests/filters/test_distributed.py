"""Distributed filters and covariance intersection, against dense recursions."""

import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import System
from two_sensors import CHANNELS, ROWS, SYSTEMS, Y, added, centralised, corrected, one_run, split

from robins.filters import Belief, Code
from robins.filters.composite.channels import disagree
from robins.filters.composite.distributed import distributed, intersecting
from robins.filters.composite.fusion import common_information_sum, covariance_intersection
from robins.manifold import Angle

# Mean and standard deviation of a component of local filters; another one is known exactly.
DIFFERENT = ((0.0, 0.6), (4.9, 0.8), (-5.1, 0.8), (8.0, 0.8))

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


def test_local_filters_that_differ_are_reported():
    filter_, (a, b) = distributed(CHANNELS), split(SYSTEMS[0]).sensors
    dims = {sensor.name: sensor.dim for sensor in (a, b)}
    state, _ = filter_.update(filter_.init(SYSTEMS[0].start(), dims), a, jnp.zeros(2))
    reading, codes = b.read(state.belief.mean, None), []
    for off in (0.0, 1.0, 1e3, np.nan):
        codes.append(int(filter_.update(state, b, reading + off)[1].code))
    assert codes == [Code.DONE, Code.DONE, Code.APART, Code.MISSING]


def test_which_components_of_local_filters_are_compared():
    beliefs = [Belief(jnp.array([0.0, x]), jnp.diag(jnp.array([0.0, s]))) for x, s in DIFFERENT]
    apart = [bool(disagree([beliefs[0], other], 1, None)) for other in beliefs[1:]]
    assert apart == [False, True, True]  # of 4.9, 5.1 and 8 with a standard deviation of 0.6, 0.8
    assert not disagree(beliefs, 0, 1)


# ------------------------------------------------------------------------- states of one local


def dense_common(beliefs, common):
    """Marginals of all added up; the rest by the conditional distribution in the first."""
    c = slice(0, common)
    x, P = added([(x[c], P[c, c]) for x, P in beliefs])
    x1, P1 = beliefs[0]
    G = P1[common:, c] @ np.linalg.inv(P1[c, c])
    rest = P1[common:, common:] - G @ P1[c, common:]
    mean = np.concatenate([x, x1[common:] + G @ (x - x1[c])])
    return mean, np.block([[P, P @ G.T], [G @ P, G @ P @ G.T + rest]])


@pytest.mark.parametrize("feedback", ["own", "mean"])
def test_states_of_the_first_local_follow_what_is_common(feedback):
    s, members, out = SYSTEMS[0], [(SYSTEMS[0].m0, SYSTEMS[0].P0)] * 2, []
    for row in Y[0, :12]:
        members = [(s.F @ x, s.F @ P @ s.F.T + s.Q) for x, P in members]
        pairs = zip(members, ROWS.values(), strict=True)
        members = [corrected(s, one, row, rows) for one, rows in pairs]
        out.append(dense_common(members, 3))
        if feedback == "mean":
            members = [(out[-1][0], P) for _, P in members]
    got = one_run(distributed(CHANNELS, feedback, common=3), 12)
    for found, want in zip(got, zip(*out, strict=True), strict=True):
        np.testing.assert_allclose(found, np.array(want), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("common", [1, 2, 4])
def test_a_common_sum_on_a_manifold(common):
    # An attitude of the first local beside positions that all have; angles on both sides of +-pi.
    rng = np.random.default_rng(common)
    roots = [np.tril(rng.normal(size=(5, 5))) + 2.0 * np.eye(5) for _ in range(3)]
    x = [rng.normal(size=4) * 0.1 for _ in roots]
    means = [
        {"a": Angle(jnp.array(np.pi + a[0])), "b": jnp.array([*a[1:], 7.0 * i])}
        for i, a in enumerate(x)
    ]
    beliefs = [Belief(m, jnp.asarray(S)) for m, S in zip(means, roots, strict=True)]
    got = common_information_sum(beliefs, common)
    dense = [
        (np.array([*a, 7.0 * i]), S @ S.T) for i, (a, S) in enumerate(zip(x, roots, strict=True))
    ]
    mean, P = dense_common(dense, common)
    np.testing.assert_allclose(got.covariance, P, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(got.mean["b"], mean[1:], rtol=1e-10, atol=1e-12)
    assert float(got.mean["a"].local(Angle(jnp.array(np.pi + mean[0])))[0]) == pytest.approx(
        0.0, abs=1e-12
    )


def test_common_components_there_must_be():
    with pytest.raises(ValueError, match="at least one component"):
        distributed(CHANNELS, common=0)
    with pytest.raises(ValueError, match="5 components are common, the state has 4"):
        one_run(distributed(CHANNELS, common=5), 2)


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
