"""The bank over the process noise against one written down plainly in NumPy, and what it is for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from interpreted import run
from scipy.stats import multivariate_normal

from robins.filters import Belief, Model, Motion, Sensor, adaptive, kalman
from robins.filters.composite.adaptive import excited, scale_changes
from robins.filters.composite.bank import EVERY, stationary, transitions
from robins.filters.linearise import Transition
from robins.filters.rules import huber

F = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])  # the third is held constant
G = np.array([[0.1, 0.0], [0.2, 0.1], [0.0, 0.0]])
H = np.array([[1.0, 0.0, 0.0]])
P0 = np.array([[4.0, 0.5, 0.0], [0.5, 1.0, 0.1], [0.0, 0.1, 0.04]])
MODEL = Model(
    Motion(lambda x, u: jnp.asarray(F) @ x, G), (Sensor(lambda x, aux: x[:1], np.ones(1), 1),)
)
START = Belief.of(jnp.zeros(3), P0)
PROBABILITY = "imm.probability"


def dense(y, scales, up, back):
    """Mean, covariance and probabilities of Blom & Bar-Shalom's recursion, as they are printed."""
    count = len(scales)
    change = np.array([[up if j > i else back for j in range(count)] for i in range(count)])
    for i in range(count):
        change[i, i] = 1.0 - sum(change[i, j] for j in range(count) if j != i)
    mu = np.linalg.matrix_power(change, 100000)[0]
    m, P, out = [np.zeros(3)] * count, [P0] * count, []
    for row in y:
        c = change.T @ mu
        begun, likelihood = [], np.ones(count)
        for j in range(count):
            w = change[:, j] * mu / c[j]
            a = sum(w[i] * m[i] for i in range(count))
            spread = [P[i] + np.outer(m[i] - a, m[i] - a) for i in range(count)]
            begun.append((a, sum(w[i] * spread[i] for i in range(count))))
        for j, (a, A) in enumerate(begun):
            Q = scales[j] ** 2 * G @ G.T
            a, A = F @ a, F @ A @ F.T + Q
            S = H @ A @ H.T + 1.0
            likelihood[j] = multivariate_normal(cov=S).pdf(row - H @ a)
            K = A @ H.T / S
            m[j], P[j] = a + K @ (row - H @ a), A - K @ H @ A
        mu = c * likelihood / (c @ likelihood)
        mean = sum(p * x for p, x in zip(mu, m, strict=True))
        parts = [V + np.outer(x - mean, x - mean) for x, V in zip(m, P, strict=True)]
        out.append((mean, sum(p * V for p, V in zip(mu, parts, strict=True)), mu))
    return [np.array(x) for x in zip(*out, strict=True)]


def track(rng, steps=60):
    """Positions with noise, of a motion that is pushed away in its middle."""
    x, y = np.array([0.0, 0.5, 0.0]), []
    for k in range(steps):
        x = F @ x + G @ rng.normal(size=2) + (np.array([0.0, 4.0, 0.0]) if 20 <= k < 24 else 0.0)
        y.append(x[:1] + rng.normal(size=1))
    return np.array(y)


def test_it_is_the_dense_recursion():
    scales, up, back = (1.0, 5.0, 40.0), 0.02, 0.1
    y = track(np.random.default_rng(3))
    found = run(adaptive(scales, 1.0, up, back), MODEL, START, y)
    mean, covariance, mu = dense(y, scales, up, back)
    np.testing.assert_allclose(found.mean, mean, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(found.steps.info["y"].notes[PROBABILITY], mu, rtol=1e-7, atol=1e-12)
    assert np.max(mu[20:26, 1:].sum(axis=1)) > 0.9  # the push is seen
    assert np.max(mu[:15, 1:].sum(axis=1)) < 0.5


def test_one_scale_is_a_filter_with_hubers_rule():
    y = track(np.random.default_rng(4))
    bank = run(adaptive((1.0,), 0.99), MODEL, START, y)
    alone = run(kalman(rules=[huber(0.99)]), MODEL, START, y)
    np.testing.assert_allclose(bank.mean, alone.mean, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("scales", "up", "back"),
    [((1, 8), 0.1, 0.3), ((1, 8, 64), 1e-4, 1e-2), ((1, 8, 64, 8, 64), 0.1, 0.01)],
)
def test_scales_change_as_stated_and_begin_where_they_last(scales, up, back):
    change = scale_changes(scales, up, back)
    np.testing.assert_allclose(change.sum(axis=1), 1.0, rtol=1e-14)
    assert change[0, -1] == up
    assert change[-1, 0] == back
    if len(scales) == 5:
        assert change[2, 4] == up  # as loud, of the other part
        assert change[4, 1] == back
    far = np.linalg.matrix_power(change, 10**6)
    np.testing.assert_allclose(stationary(change), far[0], rtol=1e-6)


def test_edges_are_probabilities_and_what_is_left_goes_where_it_is_told():
    edges = [(EVERY, 1, 0.2), (slice(2), 2, [0.1, 0.3]), (2, 0, 0.5), (2, 0, 0.4)]
    stays = transitions(3, edges)
    np.testing.assert_allclose(stays, [[0.7, 0.2, 0.1], [0.0, 0.7, 0.3], [0.4, 0.2, 0.4]])
    moves = transitions(3, edges, rest=[0, 0, 1])
    np.testing.assert_allclose(moves, [[0.7, 0.2, 0.1], [0.5, 0.2, 0.3], [0.4, 0.6, 0.0]])


def test_it_follows_what_lasts_and_ignores_what_does_not():
    """A wild record among right ones, then a push that no noise of the model explains."""
    rng = np.random.default_rng(5)
    clean, y = track(rng), None
    y = clean.copy()
    y[10] += 1e4
    error = {}
    for name, one in {"bank": adaptive(), "huber": kalman(rules=[huber(0.99)])}.items():
        found = run(one, MODEL, START, y)
        error[name] = np.abs(found.mean[:, 0] - clean[:, 0])
        if name == "bank":
            assert one.suspects == ("motion",)
            moved = found.steps.info["y"].notes["imm.wrong"][:, 0]
            assert np.max(moved[:19]) < 0.5 < np.max(moved[20:26])
    assert error["bank"][10] < 5.0  # the wild record
    assert np.max(error["bank"][26:]) < 6.0  # four sigma of a record, of six times the noise
    assert np.max(error["huber"][26:]) > 4.0 * np.max(error["bank"][26:])


def test_a_part_has_its_own_noise():
    rng = np.random.default_rng(8)
    N, none = rng.normal(size=(4, 2)), np.zeros((4, 0))
    t = Transition(jnp.zeros(4), jnp.eye(4), jnp.asarray(none), jnp.asarray(N))
    _, found = excited([[0], slice(1, 3)], np.array([5.0, 2.0])).process((), t)
    np.testing.assert_allclose(found.noise, np.diag([5.0, 2.0, 2.0, 1.0]) @ N, rtol=1e-15)


@pytest.mark.parametrize("off", [(), ("y",)], ids=["right", "off"])
def test_a_bank_made_again_with_other_numbers_has_the_same_structure(off):
    def leaves_and_structure(scales, up, robust):
        parts = {"gyro": [0], "accelerometer": slice(1, 3)}
        return jax.tree_util.tree_flatten(adaptive(scales, robust, up, 0.1, parts, off=off))

    one, structure = leaves_and_structure((1.0, 8.0), 0.01, 0.99)
    other, same = leaves_and_structure((2.0, 9.0), 0.02, 0.95)
    assert structure == same
    assert hash(structure) == hash(same)
    assert {x.dtype for x in one} == {np.dtype(float)}
    found = [x for x in one if np.shape(x) == (3 + 2 * len(off), 2)]  # the scales of the parts
    np.testing.assert_array_equal(found[0][:3], [[1.0, 1.0], [8.0, 1.0], [1.0, 8.0]])
    differ = [i for i, (a, b) in enumerate(zip(one, other, strict=True)) if np.any(a != b)]
    assert len(differ) == 4  # scales, Huber's limits, changes, the start


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="rise"):
        adaptive((1.0, 1.0))
    with pytest.raises(ValueError, match="named"):
        adaptive(parts={})
    with pytest.raises(ValueError, match="rise"):
        adaptive((0.0, 8.0))
    with pytest.raises(ValueError, match="chance to stay"):
        adaptive(back=0.6)
