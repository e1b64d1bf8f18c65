"""gamma_min and the worst-case gain: what an H-infinity filter promises, without a Riccati."""

import inspect
from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest
from attitude_matching import in_unit, run_with
from dense_h_infinity import h_infinity_filter, least_gamma
from dense_kalman import SPLIT_W, random_system, simulate, split
from interpreted import run

from robins.filters import Belief, Model, Motion, Sensor, checks, kalman, unscented
from robins.filters.analysis.worst_case import (
    SensorChannel,
    error_operator,
    gamma_min,
    spectral_norm,
    steady_h_infinity,
    steady_kalman,
    worst_case_gain,
)
from robins.filters.rules.adaptive_h_infinity import adaptive_h_infinity
from robins.filters.rules.h_infinity import h_infinity, with_gamma
from robins.manifold import Angle

T = 20
SYSTEM = random_system(3)
MODEL, START = SYSTEM.model(), SYSTEM.start()
Y = simulate(SYSTEM, 3, T, 0.2)[1]
Y[6] = Y[13] = np.nan
L = np.array([[1.0, 0.5, 0.0, -0.3], [0.0, 2.0, 1.0, 0.0]])
HERE = np.isfinite(Y).any(axis=1)
KF = kalman()


@cache
def dense_least(estimate):
    """Least gamma of `Y`, from the dense recursion."""
    return least_gamma(SYSTEM, Y, L, estimate)


# --------------------------------------------------------------------------------- least gamma


@pytest.mark.parametrize("estimate", ["a-posteriori", "a-priori"])
def test_least_gamma_is_that_of_the_dense_recursion(estimate):
    found = gamma_min(MODEL, START, Y, L, rtol=1e-6, estimate=estimate)
    want = dense_least(estimate)
    assert want * (1.0 - 1e-8) <= found <= want * (1.0 + 1.1e-6)


def test_an_outage_raises_least_gamma_only_if_it_counts():
    y = Y.copy()
    y[8:16] = np.nan
    left_out = gamma_min(MODEL, START, y, L)
    counted = gamma_min(MODEL, START, y, L, count_missing=True)
    assert counted == pytest.approx(least_gamma(SYSTEM, y, L, count_missing=True), rel=1.1e-4)
    assert left_out == pytest.approx(least_gamma(SYSTEM, y, L), rel=1.1e-4)
    assert counted > 1.05 * left_out


def test_with_nothing_measured_any_gamma_will_do():
    assert gamma_min(MODEL, START, np.full((T, 3), np.nan), L) == 0.0


def test_a_kalman_filter_that_fails_is_not_searched():
    broken = Model(Motion(lambda x, u: x * jnp.nan, np.ones(4)), MODEL.sensors)
    with pytest.raises(ValueError, match="a step of the Kalman filter cannot be taken"):
        gamma_min(broken, START, Y, L)


# -------------------------------------------------------------------------------------- the gain

MEMBERS = {
    "a-posteriori": kalman(rules=[h_infinity(np.inf, L)]),
    "a-priori": kalman(rules=[h_infinity(np.inf, L, estimate="a-priori")]),
}


def gain(solution, estimate="a-posteriori", count_missing=False):
    return worst_case_gain(MODEL, START, solution, L, None, None, estimate, count_missing)


@pytest.mark.parametrize("estimate", MEMBERS)
def test_the_bound_holds_is_reached_and_the_kalman_filter_is_above_it(estimate):
    one = MEMBERS[estimate]
    least = dense_least(estimate)

    def of(gamma):
        return gain(run(with_gamma(one, gamma), MODEL, START, Y), estimate)

    for share in (1.0001, 1.05, 1.5, 4.0):
        assert of(share * least) < share * least
    assert least * (1.0 - 1e-6) < of(1.0001 * least) < 1.00001 * least
    assert gain(run(KF, MODEL, START, Y), estimate) >= least * (1.0 - 1e-8)
    assert of(np.inf) == pytest.approx(gain(run(KF, MODEL, START, Y), estimate), rel=1e-12)


def test_the_predictor_of_the_textbook_does_not_keep_its_bound():
    # Its test looks at P after the measurement, whose error it does not estimate.
    gamma = 1.05 * gamma_min(MODEL, START, Y, L, estimate="predictor")
    one = kalman(rules=[h_infinity(gamma, L, estimate="predictor")])
    assert gain(run(one, MODEL, START, Y), "predictor") > 1.1 * gamma


def operator(solution, scale=None):
    """The error operator of the standard problem, from plain arrays."""
    info = solution.steps.info["y"]

    def all_steps(a):
        return np.tile(a, (T, 1, 1))

    channel = SensorChannel(np.asarray(info.gain), all_steps(SYSTEM.H), all_steps(SYSTEM.W))
    weight = np.where(HERE[:, None, None], L, 0.0)
    if scale is not None:
        weight = weight / np.asarray(scale)[:, None, None]
    F, G, S0 = all_steps(SYSTEM.F), all_steps(SYSTEM.G), np.linalg.cholesky(SYSTEM.P0)
    return error_operator(S0, F, G, [channel], weight)


def test_members_whose_bound_changes_keep_it_step_by_step():
    # With L / gamma_k for weights the bound is one.
    least = dense_least("a-posteriori")
    rules = {
        "h_infinity.gamma": h_infinity(0.7 * least, L, policy="raise_gamma"),
        "adaptive_h_infinity.xi": adaptive_h_infinity(L, window=3),
    }
    y = Y + 5.0 * (np.arange(T) % 7 == 3)[:, None]  # surprises
    for name, rule in rules.items():
        solution = run(kalman(rules=[rule]), MODEL, START, y)
        bounds = solution.steps.info["y"].notes[name]
        assert np.ptp(bounds[HERE]) > 0.05 * np.min(bounds[HERE])
        assert 0.5 < spectral_norm(operator(solution, bounds)) < 1.0


def test_the_operator_moves_errors_as_the_filter_does():
    # Run the filter on what disturbances make of the truth: its errors are the operator's.
    one = with_gamma(MEMBERS["a-posteriori"], 3.0 * dense_least("a-posteriori"))
    rng = np.random.default_rng(1)
    x0, w, v = rng.normal(size=4), rng.normal(size=(T, 4)), rng.normal(size=(T, 3))
    x, y, truth = SYSTEM.m0 + np.linalg.cholesky(SYSTEM.P0) @ x0, np.empty((T, 3)), []
    for k in range(T):
        x = SYSTEM.F @ x + SYSTEM.G @ w[k]
        y[k] = SYSTEM.H @ x + SYSTEM.W @ v[k]
        truth.append(x)
    solution = run(one, MODEL, START, np.where(np.isfinite(Y), y, np.nan))
    error = (np.array(truth) - np.asarray(solution.mean)) @ L.T
    disturbance = np.concatenate([x0, np.concatenate([w, v], axis=1).ravel()])
    moved = (operator(solution) @ disturbance).reshape(T, 2)
    np.testing.assert_allclose(moved[HERE], error[HERE], rtol=1e-9, atol=1e-10)
    assert gain(solution) == pytest.approx(np.linalg.norm(operator(solution), 2), rel=1e-12)


def test_sensors_in_sequence_are_one():
    two, one = split(SYSTEM), SYSTEM._replace(W=SPLIT_W).model()
    raising = h_infinity(1.0, L, policy="raise_gamma", estimate="predictor")  # gamma by sensor
    members = {"a-priori": MEMBERS["a-priori"], "predictor": kalman(rules=[raising])}
    for estimate, member in members.items():
        member = with_gamma(member, {"a-priori": 9.0, "predictor": 1.0}[estimate])
        parts = run(member, two, START, {"near": Y[:, :2], "far": Y[:, 2:]})
        whole = run(member, one, START, Y)
        got = worst_case_gain(two, START, parts, L, estimate=estimate)
        want = worst_case_gain(one, START, whole, L, estimate=estimate)
        assert got == pytest.approx(want, rel=1e-9)


def test_a_model_that_is_not_linear_is_taken_along_its_run():
    # A range and a bearing to a target: disturbances that are small enough move the error so.
    G, sigma = np.diag([1e-3, 2e-3]), np.array([0.01, 0.02])
    motion = Motion(lambda x, u: x + 0.05 * jnp.stack([x[1], -x[0]]) * u, G)
    sensor = Sensor(
        lambda x, aux: (jnp.hypot(x[:1], x[1:]), Angle(jnp.arctan2(x[1], x[0]))), sigma, 2
    )
    model, start = Model(motion, (sensor,)), Belief.of(jnp.array([-2.0, 0.1]), 1e-4 * np.eye(2))
    one, u = kalman(unscented(), [h_infinity(1.0, np.eye(2))]), 1.0 + np.arange(6) % 3
    x, clean = np.array(start.mean), []
    for k in range(6):
        x = np.array(motion.step(x, u[k]))
        clean.append([np.hypot(*x), np.arctan2(x[1], x[0])])
    clean = np.array(clean)
    quiet = run(one, model, start, (clean[:, :1], Angle(clean[:, 1])), u)
    h, columns = 1e-5, []
    for k in range(6):
        for i in range(2):
            moved = clean.copy()
            moved[k, i] += h * sigma[i]
            shifted = run(one, model, start, (moved[:, :1], Angle(moved[:, 1])), u)
            columns.append(np.asarray(shifted.mean - quiet.mean).ravel() / h)
    measured = np.linalg.norm(np.array(columns).T, 2)  # of the measurement noises alone
    silent = Model(Motion(motion.step, 0.0 * G), (sensor,))
    known = Belief(start.mean, 0.0 * start.factor)
    found = worst_case_gain(silent, known, quiet, np.eye(2), u)
    assert found == pytest.approx(measured, rel=2e-3)


def test_a_gain_wants_its_steps():
    kept = run(KF, MODEL, START, Y, keep=lambda step: step.posterior.mean)
    with pytest.raises(ValueError, match="kept its steps"):
        gain(kept)


def test_attitude_matching_has_the_published_worst_cases():
    # 80 updates in degrees, R = I, L = I: reference values of an independent prototype
    model, start, F, aux = run_with(in_unit("deg", 80))
    y, weight = np.zeros((80, 3)), np.eye(9)
    least = gamma_min(model, start, y, weight, F, aux, rtol=1e-7)
    assert least == pytest.approx(3.18570, abs=5e-6)
    one = kalman(rules=[h_infinity(np.inf, weight)])
    want = {1.0001: 1.0, np.inf: 1.0216}
    for share, ratio in want.items():
        solution = run(with_gamma(one, share * least), model, start, y, F, aux)
        found = worst_case_gain(model, start, solution, weight, F, aux) / least
        assert found == pytest.approx(ratio, abs=1e-6 if share == 1.0001 else 5e-5)


# ----------------------------------------------------------------------------------- steady state


def test_the_steady_filter_is_where_the_recursion_goes():
    y = np.zeros((2000, 3))
    for gamma in (1.05 * least_gamma(SYSTEM, np.zeros((60, 3)), L), 30.0, np.inf):
        done = h_infinity_filter(SYSTEM, y, L, gamma)
        steady = steady_h_infinity(SYSTEM.F, SYSTEM.Q, SYSTEM.H, SYSTEM.R, L, gamma)
        np.testing.assert_allclose(steady.P_pred, done.P_pred[-1], rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(steady.P, done.P[-1], rtol=1e-8, atol=1e-9)
        HR = SYSTEM.H.T @ np.linalg.inv(SYSTEM.R)
        np.testing.assert_allclose(steady.K, done.P[-1] @ HR, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(steady.K_a_priori, done.P_wide[-1] @ HR, rtol=1e-8, atol=1e-9)
    plain = steady_kalman(SYSTEM.F, SYSTEM.Q, SYSTEM.H, SYSTEM.R)  # done is the Kalman filter's
    for got, want in zip(plain, (done.P_pred[-1], done.P[-1], done.P[-1] @ HR), strict=False):
        np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-11)


def test_units_do_not_drown_the_steady_kalman_filter():
    """A drift of 1e-15 beside an attitude of 1e-8, in closed form for a walk that is measured."""
    q, r = np.array([1e-16, 1e2]), np.array([1e-8, 1e-3])
    found = steady_kalman(np.eye(2), np.diag(q), np.eye(2), np.diag(r))
    P_pred = q / 2 + np.sqrt(q**2 / 4 + q * r)
    np.testing.assert_allclose(np.diag(found.P_pred), P_pred, rtol=1e-9)
    np.testing.assert_allclose(np.diag(found.K), P_pred / (P_pred + r), rtol=1e-9)
    with pytest.raises(ValueError, match="not detectable"):
        steady_kalman(np.eye(2), np.diag(q), np.eye(1, 2), np.eye(1))


def test_the_scalar_of_the_textbook_in_closed_form():
    # F = H = Q = R = L = 1: Simon (2006) sect. 11.3, theta = gamma^-2
    one = np.eye(1)
    for theta in (0.1, 0.3, 0.5):
        P = ((1 - theta) + np.sqrt((1 - theta) * (5 - theta))) / (2 * (1 - theta))
        steady = steady_h_infinity(one, one, one, one, one, theta**-0.5)
        assert steady.P_pred[0, 0] == pytest.approx(P, rel=1e-12)
        assert steady.K_a_priori[0, 0] == pytest.approx(P / (1 + (1 - theta) * P), rel=1e-12)
    with pytest.raises(ValueError, match=r"no steady H-infinity filter with gamma = 0\.9 exists"):
        steady_h_infinity(one, one, one, one, one, 0.9)
    with pytest.raises(ValueError, match="gamma must be positive"):
        steady_h_infinity(one, one, one, one, one, np.nan)


@pytest.mark.parametrize(
    ("wrong", "words", "error"),
    [
        ({"R": np.zeros((1, 1))}, "R is singular", ValueError),
        (
            {"R": -np.eye(1)},
            r"its variance at \(0, 0\), .* is -1",
            ValueError,
        ),
        ({"R": np.eye(2)}, r"R is \(2, 2\), must be \(1, 1\)", ValueError),
        ({"R": 1.0}, r"R has shape \(\), a matrix", ValueError),
        ({"F": np.ones((2, 3))}, r"F is \(2, 3\), must be \(2, 2\)", ValueError),
        ({"F": np.diag([1.0, np.inf])}, r"F\[1, 1\] is inf", ValueError),
        ({"H": np.ones((1, 3))}, r"H is \(1, 3\), must be \(1, 2\)", ValueError),
        ({"Q": np.ones((2, 2)) * 1j}, "Q holds complex128", TypeError),
        ({"weight": np.ones(2)}, "weight has shape", ValueError),
        ({"gamma": 1e-320}, "no steady H-infinity filter with gamma", ValueError),
    ],
)
def test_matrices_of_which_there_is_no_steady_filter(wrong, words, error):
    given = {"F": 0.9 * np.eye(2), "Q": np.eye(2), "H": np.eye(1, 2), "R": np.eye(1)}
    with pytest.raises(error, match=words) as told:
        inspect.unwrap(steady_h_infinity)(**given | {"weight": np.eye(2), "gamma": 9.0} | wrong)
    assert type(told.value) is error  # none of NumPy's own


def test_rows_that_differ_are_no_matrix():
    with pytest.raises(ValueError, match="F is no matrix: its rows differ"):
        inspect.unwrap(checks.matrix)("F", [[1.0, 2.0], [3.0]])


def test_an_unseen_drift_has_no_steady_filter():
    eye, unseen = np.eye(2), np.array([[1.0, 0.0]])
    with pytest.raises(ValueError, match="no steady H-infinity filter"):
        steady_h_infinity(eye, eye, unseen, np.eye(1), eye, 10.0)
