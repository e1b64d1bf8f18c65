"""The gate: what it refuses and how it recovers, against a recursion written with inverses."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import random_system, simulate
from interpreted import run
from scipy import stats
from two_sensors import by_sensor, split

from robins.filters import Belief, Code, Model, Motion, Sensor, kalman, taylor, unscented
from robins.filters.rules.gate import gate
from robins.manifold import Angle

T = 60
SYSTEM = random_system(2)
MODEL, START = SYSTEM.model(), SYSTEM.start()
P_GATE, PATIENCE = 0.999, 3


def troubled(seed: int) -> np.ndarray:
    """A run with gaps, single outliers, a jump that stays and a burst of nonsense."""
    rng = np.random.default_rng(seed)
    y = simulate(SYSTEM, 2, T, 0.1)[1]
    y[10, 0] += 60.0
    y[20:] += np.array([40.0, -30.0, 20.0])  # these agree with one another
    y[40:47] += 300.0 * rng.normal(size=(7, 3))  # and these do not
    y[50:] += np.array([0.0, 100.0, 0.0])
    return y


Y = troubled(0)


def open_prior(P, H, D, r):
    G = P @ H.T @ np.linalg.inv(H @ P @ H.T)
    told = np.diag(G @ H @ P) / np.diag(P)
    k = np.max(r**2 / np.diag(H @ P @ H.T))
    return P + G @ D @ G.T + k * np.sqrt(np.outer(told, told)) * (P - G @ H @ P)


def gated(s, y, recovery, scope):
    """The gate by the book: means, covariances, codes, which steps recovered."""
    m, P = s.m0, s.P0
    M = len(s.H)
    refused = np.zeros(M if scope == "component" else 1, int)
    series = [[] for _ in refused]  # innovations too large since the last that passed
    out = []
    for row in y:
        m, P = s.F @ m, s.F @ P @ s.F.T + s.Q
        r = row - s.H @ m
        here = np.isfinite(row)
        accepted, doubted, D = here.copy(), np.zeros(M, bool), np.zeros((M, M))
        S = s.H @ P @ s.H.T + s.R
        groups = [here] if scope == "joint" else [here & (np.arange(M) == i) for i in range(M)]
        for g, group in enumerate(groups):
            k = int(group.sum())
            if k == 0:
                continue
            at = np.ix_(group, group)
            q = stats.chi2.ppf(P_GATE, k)
            nis = r[group] @ np.linalg.inv(S[at]) @ r[group]
            if nis <= q:
                refused[g], series[g] = 0, []
                continue
            series[g].append(r)
            agree = refused[g] >= PATIENCE
            if agree and recovery == "reinitialise":
                last = np.array(series[g][-PATIENCE - 1 :])
                there = np.all(np.isfinite(last), axis=0) & (group | (scope == "joint"))
                d = last[:, there] - last[:, there].mean(axis=0)
                scatter = np.einsum("ki,ij,kj", d, np.linalg.inv(s.R[np.ix_(there, there)]), d)
                agree = scatter <= stats.chi2.ppf(P_GATE, PATIENCE * there.sum())
            if not agree:
                refused[g] += 1
                accepted &= ~group
                continue
            refused[g], series[g] = 0, []
            doubted |= group
            if recovery == "inflate":
                D[at] = (1 / q - 1 / nis) * np.outer(r[group], r[group])
            elif recovery == "reinitialise":
                D[at] = np.outer(r[group], r[group])
        if recovery == "reinitialise":
            D += 100.0 * s.R
        if np.any(doubted) and recovery != "accept":
            P = open_prior(P, s.H[doubted], D[np.ix_(doubted, doubted)], r[doubted])
        if np.any(accepted):
            H, R = s.H[accepted], s.R[np.ix_(accepted, accepted)]
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
            m, P = m + K @ r[accepted], P - K @ H @ P
        if not np.any(here):
            code = Code.MISSING
        elif not np.any(accepted):
            code = Code.REFUSED
        else:
            code = Code.DONE if np.all(accepted) else Code.PARTLY_MISSING
        out.append((m, P, code, np.any(doubted), refused.max()))
    return tuple(np.array(x) for x in zip(*out, strict=True))


RECOVERIES = ["accept", "inflate", "reinitialise"]
RUNS = list(itertools.product(RECOVERIES, ["joint", "component"]))
WAYS = [taylor(), taylor(), taylor(), unscented(), taylor(), taylor()]
FORMS = ["sqrt", "joseph", "joseph", "sqrt", "joseph", "sqrt"]


@pytest.mark.parametrize(
    ("recovery", "scope", "way", "form"),
    [(*told, way, form) for told, way, form in zip(RUNS, WAYS, FORMS, strict=True)],
)
def test_a_gate_by_the_book(recovery, scope, way, form):
    one = kalman(way, [gate(P_GATE, PATIENCE, recovery, scope)], form)
    solution = run(one, MODEL, START, Y)
    means, covariances, codes, recovered, refused = gated(SYSTEM, Y, recovery, scope)
    info = solution.steps.info["y"]
    np.testing.assert_array_equal(info.code, codes)
    np.testing.assert_array_equal(info.notes["gate.recovered"], recovered)
    np.testing.assert_array_equal(info.notes["gate.refused"], refused)
    np.testing.assert_allclose(solution.mean, means, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(solution.covariance, covariances, rtol=1e-8, atol=1e-8)
    assert np.sum(recovered) > 0
    assert np.sum(codes == Code.REFUSED) + np.sum(codes == Code.PARTLY_MISSING) > 10


def test_a_gate_that_never_refuses_is_the_kalman_filter_bit_for_bit():
    y = simulate(SYSTEM, 2, T, 0.1)[1]
    plain = run(kalman(), MODEL, START, y)
    got = run(kalman(rules=[gate(1 - 1e-12, 3, *told) for told in RUNS[1::2]]), MODEL, START, y)
    np.testing.assert_array_equal(got.mean, plain.mean)
    np.testing.assert_array_equal(got.steps.posterior.factor, plain.steps.posterior.factor)


# ------------------------------------------------------------------------ what is refused, and how

STRICT = kalman(rules=[gate(0.99, patience=3)])


def test_a_gate_lets_chance_pass_and_stops_what_is_not():
    runs, share = 80, []
    for seed in range(runs):
        info = run(STRICT, MODEL, START, simulate(SYSTEM, seed, T)[1]).steps.info["y"]
        refused = np.asarray(info.code) == Code.REFUSED
        ratio = np.asarray(info.notes["gate.ratio"])
        np.testing.assert_array_equal(ratio == 1.0, refused)
        assert np.all((ratio >= 0.0) & (ratio <= 1.0))
        share.append(np.mean(refused))
    # binomial, four standard deviations
    assert abs(np.mean(share) - 0.01) < 4 * np.sqrt(0.01 * 0.99 / (runs * T))


def test_the_ratio_of_a_gate_is_of_the_components_there():
    y = simulate(SYSTEM, 2, T, 0.2)[1]
    y[50] += 40.0
    plain = run(kalman(), MODEL, START, y).steps.info["y"]
    dof = np.isfinite(y).sum(axis=1)
    quantile = np.array([np.inf, *stats.chi2.ppf(0.99, [1, 2, 3])])[dof]
    raw = np.asarray(plain.nis) / quantile
    first = int(np.argmax(raw > 1.0))  # alike until one is refused
    assert 20 < first <= 50
    solution = run(STRICT, MODEL, START, y)
    ratio = np.asarray(solution.steps.info["y"].notes["gate.ratio"])
    gone = np.flatnonzero(dof[:first] == 0)  # there it is that of the last measurement
    raw[gone] = raw[gone - 1]
    assert len(gone) > 0
    np.testing.assert_allclose(ratio[:first], raw[:first], rtol=1e-9)
    assert ratio[first] == 1.0


@pytest.mark.parametrize("wild", [1e3, 1e155, 1e308])
def test_a_gate_equals_a_run_without_the_outlier(wild):
    y = simulate(SYSTEM, 2, T, 0.2)[1]
    without = y.copy()
    y[6], without[6] = wild, np.nan
    got, want = run(STRICT, MODEL, START, y), run(STRICT, MODEL, START, without)
    np.testing.assert_array_equal(got.mean, want.mean)
    np.testing.assert_array_equal(got.covariance, want.covariance)
    assert float(got.log_likelihood) == float(want.log_likelihood)
    assert int(got.steps.info["y"].code[6]) == Code.REFUSED


def test_what_is_missing_is_neither_refused_nor_agreed():
    y = simulate(SYSTEM, 2, T)[1] + 1e3 * (np.arange(T) >= 5)[:, None]
    y[7] = np.nan
    info = run(STRICT, MODEL, START, y).steps.info["y"]
    refused = np.flatnonzero(np.asarray(info.code) == Code.REFUSED)
    assert refused[:3].tolist() == [5, 6, 8]
    assert info.code[9] == Code.DONE
    assert info.notes["gate.refused"][4:10].tolist() == [0, 1, 2, 2, 3, 0]


# ------------------------------------------------------------------------------------- recovery


def turn(x, u):
    return {**x, "heading": Angle(x["heading"].rad + u)}


HEADING = Sensor(lambda x, aux: x["heading"], jnp.array([0.02]), 1)
COMPASS = Model(Motion(turn, jnp.array([1e-4, 1e-4])), (HEADING,))
# The offset does not show in the heading: it must stay as certain as it was.
KNOWN = Belief.of({"heading": Angle(jnp.array(3.1)), "offset": jnp.array(5.0)}, 1e-4 * np.eye(2))
RECOVERING = {name: kalman(rules=[gate(0.9999, 4, name)]) for name in RECOVERIES}


def turned(recovery, turn_rad, measured_rad, heading_rad):
    """Results of 60 steps: the run, its notes, and the error of its heading."""
    u, y = jnp.full(60, turn_rad), Angle(jnp.asarray(measured_rad))
    solution = run(RECOVERING[recovery], COMPASS, KNOWN, y, u)
    error = np.abs(np.asarray(Angle(heading_rad).local(solution.mean["heading"]))[:, 0])
    return solution, solution.steps.info["y"], error


@pytest.mark.parametrize("recovery", RECOVERIES)
def test_a_jump_across_the_seam_is_followed_where_samples_agree(recovery):
    rng = np.random.default_rng(1)
    heading_rad = np.where(np.arange(60) < 10, 3.1, -1.2)  # 1.98 rad on, through pi
    y = heading_rad + 0.02 * rng.normal(size=60)
    solution, info, error = turned(recovery, 0.0, y, heading_rad)
    recovered = np.flatnonzero(info.notes["gate.recovered"])
    assert recovered[0] == 14
    if recovery == "accept":
        assert error[14] > 1.0  # the prior was believed, so little was learnt
    else:
        assert recovered.tolist() == [14]
        assert np.all(error[14:] < 0.08)
        sigma = np.asarray(solution.sigma)
        assert 0.01 < sigma[14, 0] < 0.021
        np.testing.assert_allclose(sigma[:, 1], np.sqrt(1e-4 + 1e-8 * np.arange(1, 61)), rtol=1e-9)


def test_nonsense_and_a_stuck_sensor_are_refused_for_ever():
    rng = np.random.default_rng(2)
    truth = 3.1 + 0.1 * np.arange(1, 61)
    stuck = truth + 0.02 * rng.normal(size=60)
    stuck[20:50] = stuck[20]
    nonsense = truth + np.where(np.arange(60) < 20, 0.02, 2.0) * rng.normal(size=60)
    nonsense[50:] = stuck[50:]
    refused = {}
    for name in ("inflate", "reinitialise"):
        for kind, values in {"stuck": stuck, "nonsense": nonsense}.items():
            _, info, error = turned(name, 0.1, values, truth)
            refused[name, kind] = np.sum(np.asarray(info.code) == Code.REFUSED)
            worst = np.max(error[20:50])
            if name == "reinitialise":
                assert worst < 0.03
                assert not np.any(info.notes["gate.recovered"])
                assert np.max(error[50:]) < 0.03
            else:
                assert worst > 0.5  # contrast: recovery that does not ask for agreement is led away
    assert refused["reinitialise", "stuck"] == 29
    assert refused["reinitialise", "nonsense"] >= 25


def test_what_is_known_exactly_cannot_be_doubted():
    still = Motion(lambda x, u: x, jnp.zeros(2))
    model = Model(still, (Sensor(lambda x, aux: x, jnp.ones(2), 2),))
    start = Belief.of(jnp.zeros(2), np.diag([0.0, 1.0]))
    y = np.tile([50.0, 50.0], (8, 1))
    for recovery in ("inflate", "reinitialise"):
        solution = run(kalman(rules=[gate(0.999, 2, recovery)]), model, start, y)
        assert np.all(np.isfinite(solution.steps.posterior.factor))
        np.testing.assert_array_equal(solution.mean[:, 0], np.zeros(8))
        assert abs(float(solution.mean[-1, 1]) - 50.0) < 3.0


def test_each_sensor_has_a_count_of_its_own():
    y = simulate(SYSTEM, 2, 12)[1]
    y[4:, 2] += 1e3  # only the far one is off
    y[6] = np.nan
    two = split(SYSTEM._replace(W=np.diag([1.0, 1.0, 5.0])))
    one = kalman(rules=[gate(0.999, 2, "reinitialise")])
    info = run(one, two, START, by_sensor(y)).steps.info
    refused = {k: v.notes["gate.refused"].tolist() for k, v in info.items()}
    assert refused["b"][3:8] == [0, 1, 2, 2, 0]
    assert not any(refused["a"][:4])
