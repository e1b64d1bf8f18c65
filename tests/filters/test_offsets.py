"""Sensors that may be off: the bank against one with augmented matrices, and what it is for."""

import jax.numpy as jnp
import numpy as np
import pytest
from interpreted import run
from jax.tree_util import Partial
from scipy.stats import multivariate_normal

from robins import linalg
from robins.filters import Belief, Model, Motion, Sensor, adaptive, imm, kalman
from robins.filters.composite import offsets
from robins.filters.composite.adaptive import scale_changes
from robins.filters.composite.bank import stationary
from robins.filters.composite.offsets import (
    marginal,
    offset_hypotheses,
    offset_transitions,
    under_hypothesis,
)
from robins.filters.rules import huber
from robins.manifold import Angle

F = np.array([[1.0, 0.1], [0.0, 1.0]])
G = np.array([[0.0], [0.05]])
R = np.array([[0.3, 0.1], [0.0, 0.4]])  # factor of the noise of "both"
P0 = np.diag([1.0, 0.25])
RATE, BOTH = "rate", "both"
START = Belief.of(jnp.zeros(2), P0)


def model(linear=None):
    motion = Motion(lambda x, u: jnp.asarray(F) @ x, G, linear)
    return Model(
        motion, (Sensor(lambda x, aux: x[1:], np.array([0.2]), 1, RATE), Sensor(_both, R, 2, BOTH))
    )


def _both(x, aux):
    return x


def data(rng, steps=80, off=0.0, since=30):
    """Records of both sensors; those of the rate are off from a step on."""
    x, rate, both = np.array([0.5, 1.0]), [], []
    for k in range(steps):
        x = F @ x + G @ rng.normal(size=1)
        rate.append(x[1:] + 0.2 * rng.normal(size=1) + off * (k >= since))
        both.append(x + R @ rng.normal(size=2))
    return {RATE: np.array(rate), BOTH: np.array(both)}


def dense(y, scale):
    """The recursion of Blom & Bar-Shalom on (x, b), b the offset of the rate in units of 0.2.

    Modes: right, right and `scale` times the process noise, begins, lasts.
    """
    A = [np.diag([0.0] * 3) + np.pad(F, (0, 1)) for _ in range(4)]
    A[3][2, 2] = 1.0
    Q = [np.pad(s**2 * G @ G.T, (0, 1)) for s in (1.0, scale, 1.0, 1.0)]
    for q, drawn in zip(Q, (offsets.BEGINS,) * 3 + (offsets.WANDERS,), strict=True):
        q[2, 2] = drawn**2
    off = 0.0, 0.0, 0.2, 0.2
    b, e = offsets.BEGIN, offsets.END
    up, back = 1e-5, 1e-2
    change = np.array(
        [
            [1 - up - b, up, b, 0.0],
            [back, 1 - back - b, b, 0.0],
            [e, 0.0, b, 1 - e - b],
            [e, 0.0, b, 1 - e - b],
        ]
    )
    mu = np.linalg.matrix_power(change, 10**6)[0]
    m, P, out = [np.zeros(3)] * 4, [np.diag([1.0, 0.25, offsets.BEGINS**2])] * 4, []
    for k in range(len(y[RATE])):
        c = change.T @ mu
        begun = []
        for j in range(4):
            w = change[:, j] * mu / c[j]
            a = w @ np.array(m)
            spread = [P[i] + np.outer(m[i] - a, m[i] - a) for i in range(4)]
            begun.append((a, sum(w[i] * spread[i] for i in range(4))))
        m = [A[j] @ a for j, (a, _) in enumerate(begun)]
        P = [A[j] @ V @ A[j].T + Q[j] for j, (_, V) in enumerate(begun)]
        mu = c
        for name, noise in ((RATE, np.array([[0.04]])), (BOTH, R @ R.T)):
            likelihood = np.ones(4)
            for j in range(4):
                H = np.array([[0.0, 1.0, off[j]]]) if name == RATE else np.eye(2, 3)
                S = H @ P[j] @ H.T + noise
                r = y[name][k] - H @ m[j]
                likelihood[j] = multivariate_normal(cov=S).pdf(r)
                K = P[j] @ H.T @ np.linalg.inv(S)
                m[j], P[j] = m[j] + K @ r, P[j] - K @ H @ P[j]
            mu = mu * likelihood / (mu @ likelihood)
        mean, V = mu @ np.array(m), np.zeros((3, 3))
        for p, x, own in zip(mu, m, P, strict=True):
            V += p * (own + np.outer(x - mean, x - mean))
        out.append((mean[:2], V[:2, :2], mu))
    return [np.array(x) for x in zip(*out, strict=True)]


def _linear(x, u):
    return jnp.asarray(F) @ x, jnp.asarray(F), jnp.asarray(G)


@pytest.mark.parametrize("linear", [None, _linear])
def test_it_is_the_dense_recursion(linear):
    y = data(np.random.default_rng(2), off=1.0)
    bank = adaptive((1.0, 8.0), 1.0, off=(RATE,))
    found = run(bank, model(linear), START, y)
    mean, covariance, mu = dense(y, 8.0)
    np.testing.assert_allclose(found.mean, mean, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-7, atol=1e-10)
    noted = found.steps.info[BOTH].notes["imm.probability"]
    np.testing.assert_allclose(noted, mu, rtol=1e-6, atol=1e-11)
    assert bank.suspects == ("motion", RATE)
    wrong = np.stack([mu[:, 1], mu[:, 2] + mu[:, 3]], axis=1)
    np.testing.assert_allclose(found.steps.info[BOTH].notes["imm.wrong"], wrong, rtol=1e-6)
    assert mu[25, 0] > 0.8  # all is right, then the offset is seen, and lasts
    assert np.all(mu[45:, 3] > 0.8)


def test_a_sensor_that_stays_off_still_tells_of_changes():
    """Huber's rule alone follows the rate that is off; the bank knows its motion without it."""
    rng, error = np.random.default_rng(3), {}
    y = data(rng, 400, off=1.0)
    right = {RATE: y[RATE] - 1.0 * (np.arange(400) >= 30)[:, None], BOTH: y[BOTH]}
    best = run(kalman(), model(), START, right).mean
    for name, one in {"off": adaptive(off=(RATE,)), "huber": kalman(rules=[huber()])}.items():
        error[name] = np.abs(run(one, model(), START, y).mean - best)[50:].mean(axis=0)
    assert np.all(error["off"] < 0.1)
    assert error["huber"][1] > 3.0 * error["off"][1]


def test_an_offset_turns_an_angle_about():
    """The sum of angle and offset is wrapped: 3.1 rad and an offset of 0.2 read -2.98 rad."""
    read = Sensor(lambda x, aux: Angle(x[0]), np.array([0.1]), 1, "heading")
    still = Model(Motion(lambda x, u: x, np.array([1e-4])), (read,))
    start = Belief.of(jnp.array([3.1]), np.array([[1e-6]]))
    y = Angle(np.full(20, 3.1 + 0.2 - 2.0 * np.pi))
    found = run(adaptive((1.0,), off=("heading",)), still, start, {"heading": y})
    np.testing.assert_allclose(found.mean[:, 0], 3.1, atol=2e-3)
    assert found.steps.info["heading"].notes["imm.probability"][-1, 2] > 0.9


def test_another_belief_leaves_what_is_known_of_offsets():
    change = offset_transitions(np.ones((1, 1)), 1)
    of = offset_hypotheses(1, 1)
    rows = [type(of)(*(jnp.asarray(a[i]) for a in of)) for i in range(3)]
    modes = [under_hypothesis(kalman(), (RATE,), row, Partial(lambda N: N)) for row in rows]
    bank = marginal(imm(modes, change, stationary(change)), (RATE,))
    m, y = model(), data(np.random.default_rng(4), 30, off=1.0, since=0)
    state = bank.init(START, m.dims)
    for k in range(30):
        state, _ = bank.predict(state, m.motion, None)
        for sensor in m.sensors:
            state, _ = bank.update(state, sensor, jnp.asarray(y[sensor.name][k]), None)
    assert abs(float(state.memory.belief.mean.offset[0][0]) - 5.0) < 1.0  # in units of 0.2
    other = Belief(jnp.array([9.0, 9.0]), linalg.factor(0.5 * np.eye(2)))
    after = bank.reset(state, other)
    np.testing.assert_array_equal(after.belief.mean, other.mean)
    np.testing.assert_allclose(after.belief.covariance, other.covariance, rtol=1e-14)
    was, now = state.memory.belief, after.memory.belief
    np.testing.assert_array_equal(now.mean.offset[0], was.mean.offset[0])
    np.testing.assert_allclose(now.covariance[2, 2], was.covariance[2, 2], rtol=1e-12)
    np.testing.assert_array_equal(now.covariance[2, :2], 0.0)


def test_each_sensor_begins_lasts_and_ends():
    plain = scale_changes((1, 8), 1e-5, 1e-2)
    p = offset_transitions(plain, 2)
    np.testing.assert_allclose(p.sum(axis=1), 1.0, rtol=1e-14)
    assert np.all(p >= 0.0)
    np.testing.assert_array_equal(p[:, [2, 4]], offsets.BEGIN)
    np.testing.assert_array_equal(p[2:, 0], offsets.END)
    assert p[2, 3] == p[3, 3] == 1.0 - offsets.END - 2.0 * offsets.BEGIN
    assert p[0, 3] == p[0, 5] == p[3, 5] == 0.0  # nothing lasts that has not begun
    of = offset_hypotheses(2, 2)
    np.testing.assert_array_equal(of.off, [[0, 0], [0, 0], [1, 0], [1, 0], [0, 1], [0, 1]])
    np.testing.assert_array_equal(of.lasts, [[0, 0], [0, 0], [0, 0], [1, 0], [0, 0], [0, 1]])


def test_a_sensor_that_is_not_there_is_named():
    with pytest.raises(ValueError, match=r"\['radar'\].*\['rate', 'both'\]"):
        run(adaptive(off=("radar",)), model(), START, data(np.random.default_rng(5)))
