"""Sensors of the master alone, against dense recursions and the centralised filter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import times
from interpreted import run
from jax.tree_util import Partial
from scipy import stats
from two_sensors import CHANNELS, ROWS, SYSTEMS, Y, added, by_sensor, corrected

from robins import linalg
from robins.filters import (
    Belief,
    Code,
    Model,
    Motion,
    Sensor,
    at_master,
    distributed,
    federated,
    guarded,
    kalman,
)
from robins.filters.rules import gate

S, STEPS = SYSTEMS[0], 40
D, SIGMA = np.array([[1.0, -1.0, 0.0, 2.0]]), 0.4
HELD = np.random.default_rng(8).normal(size=(STEPS, 1))
HELD[::4] = np.nan
START = Belief(jnp.array(S.m0), linalg.factor(S.P0))
FIRST = tuple(
    Sensor(Partial(times, jnp.array(S.H[r])), jnp.array(S.W[r, r]), r.stop - r.start, k)
    for k, r in ROWS.items()
)
JOINED = distributed(CHANNELS)
DATA_OF_LOCALS = by_sensor(Y[0, :STEPS])
DATA = DATA_OF_LOCALS | {"held": HELD}


def model(sigma=SIGMA, order=(0, 1, 2)):
    held = Sensor(Partial(times, jnp.array(D)), jnp.array([sigma]), 1, "held")
    every = (*FIRST, held)
    return Model(
        Motion(Partial(times, jnp.array(S.F)), jnp.array(S.G)), tuple(every[i] for i in order)
    )


def constrained(x, P, y, sigma):
    if np.isnan(y[0]):
        return x, P
    K = P @ D.T / (D @ P @ D.T + sigma**2)
    return x + K @ (y - D @ x), (np.eye(4) - K @ D) @ P


def by_the_book(feedback, sigma):
    """Information sums, what was fused constrained, and told back as the feedback says."""
    members, out = [(S.m0, S.P0)] * 2, []
    for row, y in zip(Y[0, :STEPS], HELD, strict=True):
        members = [(S.F @ x, S.F @ P @ S.F.T + S.Q) for x, P in members]
        pairs = zip(members, ROWS.values(), strict=True)
        members = [corrected(S, one, row, rows) for one, rows in pairs]
        out.append(constrained(*added(members), y, sigma))
        if feedback == "mean":
            members = [(out[-1][0], P) for _, P in members]
    return [np.array(series) for series in zip(*out, strict=True)]


@pytest.mark.parametrize(("feedback", "sigma"), [("own", 0.0), ("own", SIGMA), ("mean", SIGMA)])
def test_what_was_fused_is_constrained_and_told_as_the_feedback_says(feedback, sigma):
    got = run(at_master(distributed(CHANNELS, feedback), "held"), model(sigma), START, DATA)
    means, covariances = by_the_book(feedback, sigma)
    np.testing.assert_allclose(got.mean, means, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(got.covariance, covariances, rtol=1e-6, atol=1e-8)
    there = np.isfinite(HELD[:, 0])
    codes = np.asarray(got.steps.info["held"].code)
    np.testing.assert_array_equal(codes == Code.DONE, there)
    if sigma == 0.0:
        # In a local filter the same would leave nothing to invert.
        np.testing.assert_allclose(got.mean[there] @ D[0], HELD[there, 0], atol=1e-9)


def test_a_federated_filter_shares_out_what_its_master_measured():
    # As everything that was fused goes back, this is the filter that has all the sensors.
    got = run(at_master(federated(CHANNELS), "held"), model(), START, DATA)
    want = run(kalman(), model(), START, DATA)
    np.testing.assert_allclose(got.mean, want.mean, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(got.covariance, want.covariance, rtol=1e-9, atol=1e-11)


def test_without_its_sensor_it_is_the_joined_filter():
    silent = DATA | {"held": np.full_like(HELD, np.nan)}
    got = run(at_master(JOINED, ["held"]), model(), START, silent)
    want = run(JOINED, Model(model().motion, FIRST), START, DATA_OF_LOCALS)
    np.testing.assert_array_equal(got.mean, want.mean)
    np.testing.assert_array_equal(got.steps.posterior.factor, want.steps.posterior.factor)


def test_rules_of_the_master_judge_what_was_fused():
    one = at_master(JOINED, "held", kalman(rules=[gate(0.9, patience=STEPS)]))
    got = run(one, model(), START, DATA)
    fused = run(JOINED, Model(model().motion, FIRST), START, DATA_OF_LOCALS)
    expected = np.einsum("i,tij,j->t", D[0], fused.covariance, D[0]) + SIGMA**2
    far = (HELD[:, 0] - fused.mean @ D[0]) ** 2 > stats.chi2.ppf(0.9, 1) * expected
    assert 0 < np.sum(far) < np.sum(np.isfinite(HELD))
    codes = np.asarray(got.steps.info["held"].code)
    np.testing.assert_array_equal(codes == Code.REFUSED, far)
    np.testing.assert_array_equal(got.mean[far], fused.mean[far])
    last = one.reset(got.final, START)
    np.testing.assert_array_equal(last.memory.master.belief.mean, START.mean)
    assert jax.tree.structure(last) == jax.tree.structure(got.final)


def test_a_guard_takes_over_below_the_master():
    one = guarded(at_master(JOINED, "held"), JOINED, "held", ["a", "b"])
    wrong = {"a": DATA["a"], "held": HELD + 1e3}
    got = run(one, model(1e-3), START, wrong)
    watch = got.final.memory
    assert float(watch.weight) < 0.1
    for a, b in zip(
        watch.filter.memory.joined.memory.members, watch.reference.memory.members, strict=True
    ):
        np.testing.assert_allclose(a.belief.mean, b.belief.mean, rtol=1e-12)
        np.testing.assert_allclose(a.belief.factor, b.belief.factor, rtol=1e-12)


def test_bad_input():
    with pytest.raises(ValueError, match="name at least one"):
        at_master(JOINED, ())
    with pytest.raises(ValueError, match="no sensor 'wind'"):
        at_master(JOINED, "wind").init(START, model().dims)
    with pytest.raises(ValueError, match=r"sensor 'b' comes after .*put \['held'\] last"):
        at_master(JOINED, "held").init(START, model(order=(0, 2, 1)).dims)
    with pytest.raises(ValueError, match="without locals"):
        at_master(kalman(), "held").init(START, model().dims)
