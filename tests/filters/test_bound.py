"""The covariance bound and the Gramian against plain NumPy, and published figures of an airship."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import random_system, simulate
from interpreted import run

from robins.filters import Belief, Model, Motion, Sensor, kalman
from robins.filters.analysis.bound import covariance_bound, used_sensors
from robins.filters.analysis.observability import (
    NOTHING,
    bits,
    direction_in_words,
    gramian,
    observability,
    spectrum,
    unobservable,
)

T = 20
SYSTEM = random_system(5)
MODEL, START = SYSTEM.model(), SYSTEM.start()
TRUTH, Y = simulate(SYSTEM, 5, T, 0.2)
Y[7] = np.nan


# ------------------------------------------------------------------------------------- the bound


def test_of_a_linear_model_it_is_the_covariance_of_the_kalman_filter():
    done = run(kalman(), MODEL, START, Y)
    found = covariance_bound(MODEL, START, TRUTH, {"y": Y})
    np.testing.assert_allclose(found.covariance, done.covariance, rtol=1e-12, atol=1e-12)
    before = done.steps.prediction.belief.covariance
    predicted = found.predicted @ jnp.swapaxes(found.predicted, 1, 2)
    np.testing.assert_allclose(predicted, before, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found.sigma, done.sigma, rtol=1e-12)


def test_values_never_enter():
    other = np.where(np.isnan(Y), np.nan, 1e6)
    a, b = (covariance_bound(MODEL, START, TRUTH, {"y": y}).factor for y in (Y, other))
    assert np.array_equal(a, b)


DT = 0.5


def swing(x, u):
    """A pendulum of unit frequency, pushed; one Euler step."""
    return x + DT * jnp.stack([x[1], u[0] - jnp.sin(x[0])])


def reach(x, aux):
    return jnp.stack([jnp.sin(x[0] - aux[0])])


def pace(x, aux):
    return x[1:] ** 2


PENDULUM = Model(
    Motion(swing, np.array([0.02, 0.05])),
    (Sensor(reach, np.array([0.1]), 1, "reach"), Sensor(pace, np.array([0.3]), 1, "pace")),
)


@pytest.fixture(scope="module")
def swinging():
    rng = np.random.default_rng(2)
    push = 0.3 * rng.normal(size=(T, 1))
    x, truth = np.array([0.8, 0.1]), []
    for u in push:
        x = np.array([x[0] + DT * x[1], x[1] + DT * (u[0] - np.sin(x[0]))])
        truth.append(x)
        x = x + rng.normal(size=2) * [0.02, 0.05]
    y = {name: rng.normal(size=(T, 1)) for name in ("reach", "pace")}
    y["pace"][4:9] = np.nan
    start = Belief.of(np.array([0.7, 0.2]), np.diag([0.3, 0.4]) ** 2)
    return start, np.array(truth), y, push, {"reach": 0.2 * rng.normal(size=(T, 1))}


def dense_bound(start, truth, y, aux, use=(True, True)):
    """Fisher information forward in time, by inverses (Tichavsky et al. 1998, eq. 21)."""
    J, x, out = np.linalg.inv(start.covariance), np.asarray(start.mean), []
    Q = np.diag([0.02, 0.05]) ** 2
    for k, now in enumerate(truth):
        F = np.array([[1.0, DT], [-DT * np.cos(x[0]), 1.0]])
        J = np.linalg.inv(Q + F @ np.linalg.inv(J) @ F.T)
        if use[0]:
            h = np.array([np.cos(now[0] - aux["reach"][k, 0]), 0.0])
            J = J + np.outer(h, h) / 0.1**2
        if use[1] and np.isfinite(y["pace"][k, 0]):
            h = np.array([0.0, 2.0 * now[1]])
            J = J + np.outer(h, h) / 0.3**2
        x = now
        out.append(np.linalg.inv(J))
    return np.array(out)


def test_of_a_model_that_is_not_linear_it_is_the_recursion_of_the_information(swinging):
    start, truth, y, u, aux = swinging
    subsets = np.array([[True, True], [False, True], [True, False], [False, False]])

    def of(use):
        return covariance_bound(PENDULUM, start, truth, y, u, aux, use).covariance

    found = jax.vmap(of)(jnp.asarray(subsets))
    want = [dense_bound(start, truth, y, aux, use) for use in subsets]
    np.testing.assert_allclose(found, want, rtol=1e-10)


def test_what_is_known_tells_of_what_hangs_on_it(swinging):
    start, truth, y, u, aux = swinging
    found = covariance_bound(PENDULUM, start, truth, y, u, aux, known=(1,)).covariance
    assert np.all(np.asarray(found)[:, 1] == 0.0)
    # With the speed known the angle is a random walk from the first step on, seen by one sensor,
    # but for what the speed's own noise, which is then known, tells of the angle: -sin(angle).
    p, x, want = 0.3**2, np.asarray(start.mean), []
    for k, now in enumerate(truth):
        slope = -DT * np.cos(x[0])  # the change of speed reads the angle before it
        p = 1.0 / (1.0 / p + slope**2 / 0.05**2) + 0.02**2
        h = np.cos(now[0] - aux["reach"][k, 0])
        p = 1.0 / (1.0 / p + h**2 / 0.1**2)
        x = now
        want.append(p)
    np.testing.assert_allclose(found[:, 0, 0], want, rtol=1e-10)


# ------------------------------------------------------ published figures of an airship, one axis

VRW = 5e-4 * 9.8  # m/s/sqrt(s)
SAR = 25.0  # m, every second


def one_axis(bias):
    """Position, velocity and accelerometer bias with the attitude known, over 800 s."""
    F = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    noise = np.zeros((3, 2))
    noise[:2] = VRW * np.linalg.cholesky([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    model = Model(
        Motion(lambda x, u: jnp.asarray(F) @ x, noise), (Sensor(lambda x, a: x[:1], [SAR], 1),)
    )
    start = Belief.of(np.zeros(3), np.diag([31.0, 0.1, bias]) ** 2)
    return covariance_bound(model, start, np.zeros((800, 3)), {"y": np.zeros((800, 1))})


def test_the_airship_with_a_bias():
    sigma = one_axis(9.8e-3).sigma
    for at, figures in {200: (4.76, 0.097), 500: (3.78, 0.057), 800: (3.64, 0.053)}.items():
        off = np.abs(sigma[at - 1, :2] - np.array(figures))
        assert np.all(off < [0.006, 0.0006])  # what rounding of the figures leaves


def test_the_airship_without_a_bias():
    bound = one_axis(0.0)
    after = bound.sigma[-1]
    before = np.sqrt(np.diag(bound.predicted[-1] @ bound.predicted[-1].T))
    # Seen all the time, sqrt(sqrt(2) w) SAR with w^2 = VRW / SAR: the mean of before and after.
    continuous = np.sqrt(np.sqrt(2.0 * VRW / SAR) * SAR**2)
    assert continuous == pytest.approx(3.52, abs=0.005)
    assert np.sqrt(after[0] * before[0]) == pytest.approx(continuous, rel=1e-3)
    assert after[1] == pytest.approx(0.049, abs=6e-4)


# ------------------------------------------------------------------------------- observability


def dense_gramian(start, truth, y, aux, first=0):
    W, Phi, D = np.zeros((2, 2)), np.eye(2), np.diag(np.asarray(start.sigma))
    before = np.concatenate([np.asarray(start.mean)[None], truth[:-1]])
    out = []
    for k in range(first, len(truth)):
        Phi = np.array([[1.0, DT], [-DT * np.cos(before[k, 0]), 1.0]]) @ Phi
        h = np.array([np.cos(truth[k, 0] - aux["reach"][k, 0]), 0.0]) @ Phi @ D
        W = W + np.outer(h, h) / 0.1**2
        if np.isfinite(y["pace"][k, 0]):
            h = np.array([0.0, 2.0 * truth[k, 1]]) @ Phi @ D
            W = W + np.outer(h, h) / 0.3**2
        out.append(W)
    return np.array(out)


def test_the_gramian_is_the_sum_that_defines_it(swinging):
    start, truth, y, u, aux = swinging
    found = np.asarray(observability(PENDULUM, start, truth, y, u, aux))
    want = dense_gramian(start, truth, y, aux)
    np.testing.assert_allclose([gramian(L) for L in found], want, rtol=1e-9, atol=1e-11)
    left = np.diagonal(np.linalg.inv(np.eye(2) + want), axis1=1, axis2=2)
    np.testing.assert_allclose(bits(found), -0.5 * np.log2(left), rtol=1e-9)
    values, _ = spectrum(found[-1])
    np.testing.assert_allclose(values, np.linalg.eigvalsh(want[-1]), rtol=1e-9)


def test_a_window_begins_anew(swinging):
    start, truth, y, u, aux = swinging
    found = observability(PENDULUM, start, truth, y, u, aux, window=8)
    for first in (0, 8, 16):
        want = dense_gramian(start, truth[: first + 8], y, aux, first)
        np.testing.assert_allclose(gramian(found[first + len(want) - 1]), want[-1], rtol=1e-9)


def test_what_grows_without_bound_and_is_seen_does_not_overflow():
    model = Model(
        Motion(lambda x, u: jnp.stack([2.0 * x[0], x[1]]), np.zeros(2)),
        (Sensor(lambda x, a: x[:1] + x[1:], [1.0], 1),),
    )
    start = Belief.of(np.zeros(2), np.eye(2))
    L = observability(model, start, np.zeros((3000, 2)), {"y": np.zeros((3000, 1))})
    assert np.all(np.isfinite(L))  # 2^3000 is far beyond the largest number
    # The constant is what is left once the growing part is known: seen 3000 times.
    assert bits(L[-1])[1] == pytest.approx(0.5 * np.log2(3000.0), abs=0.05)
    assert bits(L[-1])[0] > 1000.0


def test_what_no_sensor_tells_apart_is_named():
    names = ["range", "bias", "clock", "drift"]
    model = Model(
        Motion(lambda x, u: x, np.zeros(4)),
        (
            Sensor(lambda x, a: x[:1] + 2.0 * x[1:2], [1.0], 1),
            Sensor(lambda x, a: x[3:], [1.0], 1, "z"),
        ),
    )
    start = Belief.of(np.zeros(4), np.diag([3.0, 2.0, 7.0, 1.0]) ** 2)
    y = {"y": np.zeros((5, 1)), "z": np.zeros((5, 1))}
    values, vectors = spectrum(observability(model, start, np.zeros((5, 4)), y)[-1])
    assert np.sum(values >= NOTHING) == 2
    basis = unobservable(values, vectors)
    # 3 a + 4 b = 0 of what is measured in units of the prior: a = 0.8, b = -0.6
    assert sorted(direction_in_words(v, names) for v in basis.T) == [
        "100 % clock",
        "64 % range against 36 % bias",
    ]


# ----------------------------------------------------------------------------------- bad input


def test_bad_input_is_named():
    with pytest.raises(KeyError, match=r"no sensor 'sonar'; this model has \['pace', 'reach'\]"):
        used_sensors(PENDULUM, ["sonar"])
    assert used_sensors(PENDULUM, ["reach"]).tolist() == [False, True]
    with pytest.raises(ValueError, match=r"one length, got \[19, 20\]"):
        covariance_bound(MODEL, START, TRUTH[1:], {"y": Y})
    with pytest.raises(ValueError, match=r"known components \[4\]: the state has 0 to 3"):
        covariance_bound(MODEL, START, TRUTH, {"y": Y}, known=[4])
    with pytest.raises(ValueError, match="a window of 0 steps"):
        observability(MODEL, START, TRUTH, {"y": Y}, window=0)
