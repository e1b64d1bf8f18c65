"""The hypotheses of the adaptive product filter: what each makes of a transition."""

import jax
import jax.numpy as jnp
import numpy as np

from robins.earth import Geodetic
from robins.filters.linearise import Transition
from robins.ins.state import InsState
from robins.rotation import Rotation
from robins.systems.transfer_alignment.product.filters import (
    QUIET,
    NoiseHypothesis,
    hypothesis_bank,
    hypothesis_changes,
    under_hypothesis,
)
from robins.systems.transfer_alignment.product.model import ProductState

INS = InsState(
    Rotation.from_euler(0.1, -0.2, 1.5),
    jnp.array([100.0, 5.0, -1.0]),
    Geodetic(*(jnp.array(a) for a in (0.6, 2.0, 500.0))),
    jnp.full(3, 1e-5),
    jnp.full(3, 1e-2),
)
STATE = ProductState(INS, jnp.full(3, 1e-3), jnp.array([2e-3] * 3 + [4e-3] * 3))


def transition_of(x):
    """A transition as a filter sees it, with a spread and noise that are full."""
    rng = np.random.default_rng(1)
    noise = np.tril(rng.normal(size=(24, 24)))
    noise[:3, 3:] = 0.0  # what makes attitude noise is the gyros' alone
    noise[:3, :3] = 2.0 * np.eye(3)
    spread, none = rng.normal(size=(24, 24)), np.zeros((24, 0))
    return Transition(x, jnp.asarray(spread), jnp.asarray(none), jnp.asarray(noise))


def covariance(t):
    return np.asarray(t.noise @ t.noise.T)


def test_hypotheses_multiply_the_noise_they_are_about():
    plain = transition_of(STATE)
    N = np.asarray(plain.noise)
    _, quiet = under_hypothesis(QUIET, False).process((), plain)
    np.testing.assert_array_equal(covariance(quiet), covariance(plain))

    _, drifting = under_hypothesis(
        NoiseHypothesis(gyro=20.0, walk=5.0, flexure=3.0), False
    ).process((), plain)
    by_gyro, by_rest, by_flexure = N[:, :3], N[:, 3:18], N[:, 18:]
    expected = 400.0 * by_gyro @ by_gyro.T + by_rest @ by_rest.T + 9.0 * by_flexure @ by_flexure.T
    walk = np.zeros((24, 24))
    walk[9:12, 9:12] = (5.0 * 2.0) ** 2 * np.eye(3)  # gyro noise is 2 on each axis
    np.testing.assert_allclose(covariance(drifting), expected + walk, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(drifting.spread, plain.spread)


def test_a_stiff_structure_has_no_flexure():
    plain = transition_of(STATE)
    _, stiff = under_hypothesis(QUIET, True).process((), plain)
    assert not np.any(stiff.mean.flexure)
    for part in ("spread", "noise"):
        before, after = (np.asarray(getattr(t, part)) for t in (plain, stiff))
        np.testing.assert_array_equal(after[:18, :24], before[:18])
        assert np.max(np.abs(after[18:])) < 2e-3 * np.max(np.abs(before[18:]))


def test_changes_are_probabilities_that_hardly_cross():
    T = hypothesis_changes()
    assert T.shape == (7, 7)
    assert np.all(T >= 0.0)
    np.testing.assert_allclose(T.sum(axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(T[:3, 3:].sum(axis=1), 1e-5)
    np.testing.assert_allclose(T[3:, :3].sum(axis=1), 1e-5)


def test_the_bank_made_again_is_the_same_and_its_numbers_are_leaves():
    one, other = (jax.tree_util.tree_flatten(hypothesis_bank()) for _ in range(2))
    assert one[1] == other[1]
    assert {leaf.dtype for leaf in one[0]} == {np.dtype(float)}
    rows = [leaf.tolist() for leaf in one[0] if leaf.shape == (7,)]
    assert [1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0] in rows  # stiff
    assert [1.0, 15.0, 15.0, 1.0, 1.0, 15.0, 15.0] in rows  # noise of the gyros
