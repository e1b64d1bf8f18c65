"""The adaptive H-infinity rule against a dense recursion, its limit and its memory."""

import numpy as np
from dense_h_infinity import compensated, greatest, h_infinity_filter
from dense_kalman import random_system, simulate
from interpreted import run
from two_sensors import by_sensor, split

from robins.filters import kalman
from robins.filters.rules.adaptive_h_infinity import adaptive_h_infinity

T = 30
SYSTEM = random_system(3)
MODEL, START = SYSTEM.model(), SYSTEM.start()
Y = simulate(SYSTEM, 3, T, 0.2)[1] + 20.0 * ((np.arange(T) // 3) % 4 == 2)[:, None]
Y[6] = Y[13] = np.nan
L = np.array([[1.0, 0.5, 0.0, -0.3], [0.0, 2.0, 1.0, 0.0]])
HERE = np.isfinite(Y).any(axis=1)
NAME = "adaptive_h_infinity"


class Chosen:
    """xi step by step, as the docstring of the rule has it."""

    def __init__(self, zeta=1.0, window=10, floor=1.05, ceiling=1e6, compensate=False):
        self.zeta, self.window, self.floor, self.ceiling = zeta, window, floor, ceiling
        self.compensate = compensate
        self.past, self.q, self.alpha, self.xi, self.events = [], [], [], np.inf, 0

    def __call__(self, k, P, weight, nis, dof):
        if dof:
            self.past.append((nis, dof))
        last = np.array(self.past[-self.window :])
        q = last[:, 0].sum() / last[:, 1].sum()
        alpha = 1.0 + 1.0 / (self.zeta * max(q - 1.0, 1e-6))
        self.q.append(q)
        self.alpha.append(min(max(alpha, self.floor), self.ceiling))
        before = self.xi
        if dof:
            if self.compensate and greatest(weight @ P @ weight.T) >= before:
                P = compensated(P, weight, before)
                self.events += 1
            self.xi = np.sqrt(self.alpha[-1]) * greatest(weight @ P @ weight.T)
        self.before = before
        return self.xi

    def mend(self, P, weight, xi):
        broken = self.compensate and greatest(weight @ P @ weight.T) >= self.before
        return compensated(P, weight, self.before) if broken else P


def agrees(solution, dense, chosen, last="y"):
    for got, want in (
        (solution.mean, dense.m),
        (solution.covariance, dense.P),
        (solution.steps.prediction.belief.covariance, dense.P_pred),
    ):
        np.testing.assert_allclose(got, want, rtol=1e-8, atol=1e-8 * np.max(np.abs(want)))
    notes = solution.steps.info[last].notes
    for name, want in (("q", chosen.q), ("alpha", chosen.alpha)):
        np.testing.assert_allclose(notes[f"{NAME}.{name}"][HERE], np.array(want)[HERE], rtol=1e-6)
    np.testing.assert_allclose(notes[f"{NAME}.bound"], dense.bound, rtol=1e-8)
    np.testing.assert_allclose(notes[f"{NAME}.xi"][HERE], dense.gamma[HERE], rtol=1e-7)
    assert not np.any(solution.steps.prediction.code)


def test_the_recursion_is_as_documented():
    rule = adaptive_h_infinity(L, zeta=0.3, window=4, floor=1.2, ceiling=50.0)
    chosen = Chosen(0.3, 4, 1.2, 50.0)
    solution = run(kalman(rules=[rule]), MODEL, START, Y)
    dense = h_infinity_filter(SYSTEM, Y, L, chosen)
    agrees(solution, dense, chosen)
    # the range of alpha is used, its ends included
    assert min(chosen.alpha) < 2.0
    assert max(chosen.alpha) == 50.0


def test_the_order_of_the_patent_compensates_first():
    chosen = Chosen(window=4, compensate=True)
    rule = adaptive_h_infinity(L, window=4, compensate_first=True)
    solution = run(kalman(rules=[rule]), MODEL, START, Y)
    dense = h_infinity_filter(SYSTEM, Y, L, chosen, mend=chosen.mend)
    agrees(solution, dense, chosen)
    acted = np.asarray(solution.steps.info["y"].notes[f"{NAME}.compensated"])
    assert 0 < chosen.events == acted.sum()


def test_sensors_add_up_to_one_step():
    system = SYSTEM._replace(W=np.diag([0.5, 0.7, 2.0]))
    one = kalman(rules=[adaptive_h_infinity(L, window=4)])
    solution = run(one, split(system), START, by_sensor(Y))
    chosen = Chosen(window=4)
    agrees(solution, h_infinity_filter(system, Y, L, chosen), chosen, "b")
