"""Reference numbers of H-infinity filters, computed in 60 digits, through the public interface."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from interpreted import run
from test_cases import cases, check, given

from robins import linalg
from robins.filters import Belief, Code, Model, Motion, Sensor, kalman
from robins.filters.analysis.worst_case import steady_h_infinity
from robins.filters.rules.h_infinity import Infeasible, h_infinity, with_gamma


def move(x, u):
    return u[0] @ x


def noise(x, u):
    return u[1]


def read(x, H):
    return H @ x


def problem(case: dict, rows: int) -> tuple:
    """Model, start, measurements, inputs and extras of a run over so many rows.

    The cases give the prior of the first measurement; a run predicts first, so its first
    prediction does nothing. Rows beyond the measurements are missing. Matrices are data, so that
    cases of one size share a compilation.
    """
    F, Q, H, R, m0, P0, y = given(case, "F", "Q", "H", "R", "m0", "P0", "y")
    if case["kind"] == "hinf_aposteriori":
        m0 = F @ m0
    n = len(F)
    still, moving = (np.eye(n), np.zeros((n, n))), (F, np.asarray(linalg.factor(Q)))
    u = tuple(np.stack([a, *([b] * (rows - 1))]) for a, b in zip(still, moving, strict=True))
    more = np.full((max(rows - len(y), 0), y.shape[1]), np.nan)
    model = Model(Motion(move, noise), (Sensor(read, linalg.factor(R), len(H)),))
    aux = {"y": np.tile(H, (rows, 1, 1))}
    return model, Belief.of(m0, P0), np.concatenate([y, more])[:rows], u, aux


@cache
def one_filter(L: tuple, estimate: str):
    return kalman(rules=[h_infinity(np.inf, np.array(L), estimate=estimate)])


def filtered(given: tuple, L: np.ndarray, estimate: str, gamma):
    one = one_filter(tuple(map(tuple, L)), estimate)
    model, start, *data = given
    return run(with_gamma(one, gamma), model, start, *data)


def weight_of(case: dict) -> tuple[np.ndarray, float]:
    """L and gamma, from L'L and theta = gamma^-2."""
    Sbar, theta = given(case, "Sbar", "theta")
    return np.asarray(linalg.factor(Sbar)).T, float(1.0 / np.sqrt(theta)) if theta else np.inf


def margins(posterior, L, gamma):
    """Least eigenvalue of P^-1 - gamma^-2 L'L: positive where the filter exists."""

    def least(belief):
        return jnp.linalg.eigvalsh(jnp.linalg.inv(belief.covariance) - L.T @ L / gamma**2)[0]

    return jax.vmap(least)(posterior)


def test_hinf_predictor(cases_dir):
    for case in cases(cases_dir, "hinf_predictor"):
        L, gamma = weight_of(case)
        T = len(case["given"]["y"])
        steps = filtered(problem(case, T + 1), L, "predictor", gamma).steps
        margin = margins(steps.posterior, L, gamma)[:T]
        predicted = steps.prediction.belief
        check(case, series=True, m_pred=predicted.mean, P_pred=predicted.covariance, margin=margin)


def test_hinf_infeasible(cases_dir):
    for case in cases(cases_dir, "hinf_infeasible"):
        L, gamma = weight_of(case)
        attempt = partial(filtered, problem(case, len(case["given"]["y"])), L, "a-posteriori")
        with pytest.raises(Infeasible) as caught:
            attempt(gamma)
        step = caught.value.step
        # In compiled code nothing is raised, so that the step can be looked at.
        steps = jax.jit(attempt)(gamma).steps
        margin = margins(steps.posterior, L, gamma)
        check(case, first_infeasible=step, margin_there=margin[step])
        code = np.asarray(steps.prediction.code)
        np.testing.assert_array_equal(code[: step + 1], Code.DONE)
        np.testing.assert_array_equal(code[step + 1 : step + 2], Code.INFEASIBLE)
        assert caught.value.gamma_min > gamma
        attempt(caught.value.gamma_min)


def test_hinf_steady(cases_dir):
    for case in cases(cases_dir, "hinf_steady"):
        F, Q, H, R = given(case, "F", "Q", "H", "R")
        steady = steady_h_infinity(F, Q, H, R, *weight_of(case))
        check(case, P=steady.P_pred, K=steady.K_a_priori)


def test_hinf_aposteriori(cases_dir):
    for case in cases(cases_dir, "hinf_aposteriori"):
        L, gamma = given(case, "L", "gamma")
        T = len(case["given"]["y"])
        rows = len(case["expected"]["P_pred"])  # one more where what follows the last is given
        steps = filtered(problem(case, rows), L, "a-posteriori", gamma).steps
        predicted, margin = steps.prediction.belief.covariance, margins(steps.posterior, L, gamma)
        check(case, series=True, m=steps.posterior.mean[:T], P_pred=predicted, margin=margin[:T])
