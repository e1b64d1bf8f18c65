"""Strong tracking against the recursion written down with inverses, and what limits it promises."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import System, kalman_filter, random_system, simulate
from interpreted import run
from test_cases import cases, check, given, linear

from robins.filters import Model, Rule, Sensor, kalman, taylor
from robins.filters.kalman import Form
from robins.filters.rules.strong_tracking import strong_tracking

T = 30
SYSTEM = random_system(5)
MODEL, START = SYSTEM.model(), SYSTEM.start()
WEIGHTS = np.array([2.0, 1.0, 1.6, 0.5])
LAMBDA = "strong_tracking.lambda"


def jumping(seed: int, missing: float, size: float) -> np.ndarray:
    """Measurements of the system, thrown off so that fading has something to do."""
    rng = np.random.default_rng(seed)
    y = simulate(SYSTEM, seed, T, missing)[1]
    return y + size * (np.arange(T) > 12)[:, None] * rng.normal(size=3)


Y = jumping(5, 0.25, 2.0)


class Fading(NamedTuple):
    """Parameters of the textbook recursion; `keep` and `gain` are the weights of V and r r'."""

    form: str
    keep: float
    gain: float
    starts_at_R: bool = False
    beta: float = 1.0
    sigmas: float = -np.inf
    limit: float = 1e3
    weights: np.ndarray = np.ones(4)


def book(s: System, y: np.ndarray, fading: Fading) -> tuple:
    """Zhou & Frank's filter and its kin by covariances and inverses; V is kept whole, whitened.

    A component that is missing leaves its row of V alone. All of y's rows are whitened by one
    root of R, so R must be diagonal where components are missing.
    """
    m, P = s.m0, s.P0
    root = np.linalg.inv(np.linalg.cholesky(s.R))
    size = len(s.H)
    V = np.eye(size) if fading.starts_at_R else np.full((size, size), np.nan)
    means, covariances, factors = [], [], []
    for row in y:
        m, P_moved = s.F @ m, s.F @ P @ s.F.T
        P = P_moved + s.Q
        here = np.isfinite(row)
        lam = 1.0
        if here.any():
            H_white = root[np.ix_(here, here)] @ s.H[here]
            r = root[np.ix_(here, here)] @ (row[here] - s.H[here] @ m)
            block = np.ix_(here, here)
            new = fading.keep * V[block] + fading.gain * np.outer(r, r)
            V[block] = np.where(np.isnan(V[block]), np.outer(r, r), new)
            trace_V, dof = np.trace(V[block]), here.sum()
            N = trace_V - fading.beta * dof
            keep = fading.keep / (fading.keep + fading.gain)
            deviation = np.sqrt(2 * (1 - keep) / ((1 + keep) * dof))
            expected = np.trace(H_white @ P @ H_white.T) + dof
            if fading.form == "outside":
                N -= np.trace(H_white @ s.Q @ H_white.T)
                M = np.trace(H_white @ P_moved @ H_white.T)
            else:
                M = fading.weights @ np.diag(P @ H_white.T @ H_white)
            if trace_V > (1 + fading.sigmas * deviation) * expected:
                lam = min(max(1.0, N / M), fading.limit)
        if fading.form == "outside":
            P = lam * P_moved + s.Q
        elif fading.form == "projected":
            H = s.H[here]
            seen = P @ H.T @ np.linalg.pinv(H @ P @ H.T) @ H @ P if here.any() else 0.0
            P = P + (lam - 1.0) * seen
        else:
            root_lam = np.diag(np.sqrt(np.maximum(1.0, fading.weights * lam)))
            P = root_lam @ P @ root_lam
        step = s._replace(m0=m, P0=P, F=np.eye(4), G=np.zeros((4, 4)))
        after, spread, _, _ = kalman_filter(step, row[None]) if here.any() else ([m], [P], 0, 0)
        m, P = after[0], spread[0]
        means.append(m)
        covariances.append(P)
        factors.append(lam)
    return np.array(means), np.array(covariances), np.array(factors)


DIAGONAL = SYSTEM._replace(W=np.diag([0.5, 2.0, 1.3]))
KEEP, GAIN = 0.9 / 1.9, 1 / 1.9  # of the classic V at rho = .9
CASES: dict[str, tuple[Rule, Form, Fading]] = {
    "outside": (strong_tracking(0.9), "sqrt", Fading("outside", KEEP, GAIN)),
    "outside, Joseph": (
        strong_tracking(0.9, beta=2.0, limit=3.0),
        "joseph",
        Fading("outside", KEEP, GAIN, beta=2.0, limit=3.0),
    ),
    "projected": (strong_tracking(0.9, form="projected"), "sqrt", Fading("projected", KEEP, GAIN)),
    "multiple": (
        strong_tracking(0.9, form="multiple", weights=WEIGHTS),
        "sqrt",
        Fading("multiple", KEEP, GAIN, weights=WEIGHTS / 2.0),
    ),
    "lumped, average": (
        strong_tracking(0.9, form="lumped", power="ewma", threshold=1.0),
        "sqrt",
        Fading("lumped", 0.9, 0.1, starts_at_R=True, sigmas=1.0),
    ),
}
# One object a filter, so that all tests share its compilation.
FILTERS = {name: kalman(taylor(), [rule], form) for name, (rule, form, _) in CASES.items()}
OUTSIDE = FILTERS["outside"]


@pytest.mark.parametrize("name", CASES)
def test_each_form_is_the_recursion_of_the_book(name):
    means, covariances, factors = book(DIAGONAL, Y, CASES[name][2])
    solution = run(FILTERS[name], DIAGONAL.model(), START, Y)
    info = solution.steps.info["y"]
    np.testing.assert_allclose(info.notes[LAMBDA], factors, rtol=1e-9)
    np.testing.assert_allclose(solution.mean, means, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(solution.covariance, covariances, rtol=1e-9, atol=1e-10)
    assert 0.1 < np.mean(factors > 1.0) < 1.0  # both branches were taken


def test_correlated_noise_is_whitened():
    y = jumping(6, 0.0, 0.0)
    means, _, factors = book(SYSTEM, y, CASES["outside"][2])
    solution = run(OUTSIDE, MODEL, START, y)
    np.testing.assert_allclose(solution.steps.info["y"].notes[LAMBDA], factors, rtol=1e-9)
    np.testing.assert_allclose(solution.mean, means, rtol=1e-9, atol=1e-10)


def test_units_of_components_do_not_matter():
    # The noise as a square, not a triangular factor, takes another way to the same whitening.
    unit = np.diag([1e3, 1.0, 1e-4])
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    other = SYSTEM._replace(H=unit @ SYSTEM.H, W=unit @ SYSTEM.W @ turn)
    a, b = run(OUTSIDE, MODEL, START, Y), run(OUTSIDE, other.model(), START, Y * np.diag(unit))
    for got, want in [(a.mean, b.mean), (a.covariance, b.covariance)]:
        np.testing.assert_allclose(got, want, rtol=1e-8, atol=1e-9)


def test_reference_case(cases_dir):
    for case in cases(cases_dir, "strong_tracking"):
        model, start = linear(case)
        rule = strong_tracking(case["given"]["rho"], case["given"]["beta"])
        solution = run(kalman(taylor(), [rule]), model, start, given(case, "y")[0])
        factors = solution.steps.info["y"].notes[LAMBDA]
        check(case, series=True, m=solution.mean, P=solution.covariance, lam=factors)


# ------------------------------------------------------------------------------------- limits


def test_innovations_smaller_than_the_noise_fade_nothing():
    plain = run(kalman(), MODEL, START, Y)
    y = np.asarray(plain.mean[0]) @ SYSTEM.H.T
    still = np.vstack([y, np.full((T - 1, 3), np.nan)])
    still[1:] = np.asarray(run(kalman(), MODEL, START, still).mean[1:]) @ SYSTEM.H.T
    for one in (OUTSIDE, FILTERS["projected"]):
        solution = run(one, MODEL, START, still)
        np.testing.assert_array_equal(solution.mean, run(kalman(), MODEL, START, still).mean)


# ---------------------------------------------------------------------------- what is not seen


def test_projected_leaves_alone_what_the_sensor_does_not_see():
    # States 2, 3 walk on their own and are not measured, state 1 drives the one that is.
    F = np.eye(4)
    F[0, 1] = 1.0
    s = System(F, 0.01 * np.eye(4), np.eye(1, 4), np.eye(1), np.zeros(4), np.eye(4))
    y = np.cumsum(3.0 * np.random.default_rng(1).normal(size=(T, 1)), axis=0)
    y[12] = np.nan
    solution = run(FILTERS["projected"], s.model(), s.start(), y)
    hidden = np.asarray(solution.covariance)[:, 2:, :]
    walked = (1.0 + 1e-4 * np.arange(1, T + 1))[:, None, None] * np.eye(4)[2:]
    np.testing.assert_allclose(hidden, walked, rtol=1e-12, atol=1e-14)
    # and what is seen grows by lambda, no more and no less
    info = solution.steps.info["y"]
    lam = np.asarray(info.notes[LAMBDA])
    predicted = np.asarray(solution.steps.prediction.belief.covariance)[:, 0, 0]
    expected = np.where(np.isnan(y[:, 0]), 1.0, lam * predicted + 1.0)
    np.testing.assert_allclose(info.factor[:, 0, 0] ** 2, expected, rtol=1e-9)
    assert lam[12] == 1.0 < 5.0 < np.max(lam)


@pytest.mark.parametrize("name", ["outside", "multiple"])
def test_a_state_known_exactly_may_be_among_them(name):
    # Its rows of the covariance are zero, so that H cannot be had by an inverse.
    s = DIAGONAL._replace(
        F=np.vstack([np.eye(1, 4), SYSTEM.F[1:]]),
        G=np.diag([0.0, 0.3, 0.2, 0.1]),
        P0=np.diag([0.0, 1.0, 2.0, 1.0]),
    )
    means, _, factors = book(s, Y, CASES[name][2])
    solution = run(FILTERS[name], s.model(), s.start(), Y)
    early = slice(0, 15)  # later on a few hundredfold fadings have multiplied the rounding
    noted = solution.steps.info["y"].notes[LAMBDA]
    np.testing.assert_allclose(noted[early], factors[early], rtol=1e-8)
    np.testing.assert_allclose(solution.mean[early], means[early], rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(solution.mean[:, 0], SYSTEM.m0[0], rtol=1e-12)
    assert np.max(factors[early]) > 2.0


# --------------------------------------------------------------------------- missing, several


def test_only_the_first_sensor_of_a_step_knows_the_process_noise_apart():
    H, W = jnp.array(SYSTEM.H), jnp.array([0.5, 2.0, 1.3])
    parts = {"a": slice(0, 1), "b": slice(1, 3)}
    sensors = (
        Sensor(lambda x, aux: H[:1] @ x, W[:1], 1, "a"),
        Sensor(lambda x, aux: H[1:] @ x, W[1:], 2, "b"),
    )
    model = Model(MODEL.motion, sensors)
    y = {name: Y[:, part] for name, part in parts.items()}
    solution = run(kalman(rules=[strong_tracking()]), model, START, y)
    noted = {name: solution.steps.info[name].notes[LAMBDA] for name in parts}
    # The same by the book, sensor by sensor, each with a V of its own.
    m, P = SYSTEM.m0, SYSTEM.P0
    V = {name: np.full((3, 3), np.nan) for name in parts}
    for k in range(T):
        m, P_moved, Q = SYSTEM.F @ m, SYSTEM.F @ P @ SYSTEM.F.T, SYSTEM.Q
        for name, part in parts.items():
            here = np.flatnonzero(np.isfinite(Y[k]) & np.isin(np.arange(3), np.r_[part]))
            lam = 1.0
            if len(here):
                root = np.diag(1.0 / np.asarray(W)[here])
                A, r = root @ SYSTEM.H[here], root @ (Y[k, here] - SYSTEM.H[here] @ m)
                block = np.ix_(here, here)
                new = (0.95 * V[name][block] + np.outer(r, r)) / 1.95
                V[name][block] = np.where(np.isnan(V[name][block]), np.outer(r, r), new)
                N = np.trace(V[name][block] - np.eye(len(here)) - A @ Q @ A.T)
                lam = min(max(1.0, N / np.trace(A @ P_moved @ A.T)), 1e3)
                P = lam * P_moved + Q
                K = P @ A.T @ np.linalg.inv(A @ P @ A.T + np.eye(len(here)))
                m, P = m + K @ r, P - K @ A @ P
                P_moved, Q = P, 0.0 * Q
            assert float(noted[name][k]) == pytest.approx(lam, rel=1e-8)
        P = P_moved + Q
        np.testing.assert_allclose(solution.mean[k], m, rtol=1e-8, atol=1e-9)
    assert min(np.max(x) for x in noted.values()) > 1.5
