"""The gate: what it refuses and how it recovers, against a recursion written with inverses."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import random_system, simulate
from jax.tree_util import Partial
from scipy import stats

from robins.filters import (
    Belief,
    Code,
    Model,
    Motion,
    OnlineFilter,
    Sensor,
    kalman,
    run,
    taylor,
    unscented,
)
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


def open_prior(P, H, D):
    G = P @ H.T @ np.linalg.inv(H @ P @ H.T)
    return P + G @ D @ G.T


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
            P = open_prior(P, s.H[doubted], D[np.ix_(doubted, doubted)])
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


RUNS = list(itertools.product(["accept", "inflate", "reinitialise"], ["joint", "component"]))


def check(solution, recovery, scope):
    means, covariances, codes, recovered, refused = gated(SYSTEM, Y, recovery, scope)
    info = solution.steps.info["y"]
    np.testing.assert_array_equal(info.code, codes)
    np.testing.assert_array_equal(info.notes["gate.recovered"], recovered)
    np.testing.assert_array_equal(info.notes["gate.refused"], refused)
    np.testing.assert_allclose(solution.mean, means, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(solution.covariance, covariances, rtol=1e-8, atol=1e-8)
    assert np.sum(recovered) > 0
    assert np.sum(codes == Code.REFUSED) + np.sum(codes == Code.PARTLY_MISSING) > 10


@pytest.mark.parametrize(("recovery", "scope"), RUNS)
def test_a_gate_by_the_book(recovery, scope):
    one = kalman(rules=[gate(P_GATE, PATIENCE, recovery, scope)])
    check(run(one, MODEL, START, Y), recovery, scope)


@pytest.mark.parametrize(
    ("one", "recovery", "scope"),
    [
        (kalman(unscented(), [gate(P_GATE, PATIENCE, *RUNS[3])]), *RUNS[3]),
        (kalman(taylor(), [gate(P_GATE, PATIENCE, *RUNS[4])], "joseph"), *RUNS[4]),
    ],
    ids=["unscented", "joseph"],
)
def test_a_gate_by_the_book_in_other_forms(one, recovery, scope):
    check(run(one, MODEL, START, Y), recovery, scope)


def test_without_recovery_nothing_is_reopened():
    # A gate that never refuses is the Kalman filter bit for bit, also where it could reopen.
    y = simulate(SYSTEM, 2, T, 0.1)[1]
    plain = run(kalman(), MODEL, START, y)
    for recovery, scope in RUNS[1::2]:
        gated_ = run(kalman(rules=[gate(1 - 1e-12, 3, recovery, scope)]), MODEL, START, y)
        np.testing.assert_array_equal(gated_.mean, plain.mean)
        np.testing.assert_array_equal(gated_.steps.posterior.factor, plain.steps.posterior.factor)


# ------------------------------------------------------------------------ what is refused, and how


def test_a_gate_lets_chance_pass_and_stops_what_is_not():
    long = simulate(SYSTEM, 3, 4000)[1]
    solution = run(kalman(rules=[gate(0.99)]), MODEL, START, long)
    info = solution.steps.info["y"]
    refused = np.asarray(info.code) == Code.REFUSED
    # binomial, four standard deviations
    assert abs(np.mean(refused) - 0.01) < 4 * np.sqrt(0.01 * 0.99 / 4000)
    ratio = np.asarray(info.notes["gate.ratio"])
    np.testing.assert_array_equal(ratio == 1.0, refused)
    assert np.all((ratio >= 0.0) & (ratio <= 1.0))


def test_the_ratio_of_a_gate_is_of_the_components_there():
    y = simulate(SYSTEM, 2, 20, 0.2)[1]
    plain = run(kalman(), MODEL, START, y).steps.info["y"]
    dof = np.isfinite(y).sum(axis=1)
    quantile = np.array([np.inf, *stats.chi2.ppf(0.95, [1, 2, 3])])[dof]
    raw = np.asarray(plain.nis) / quantile
    first = int(np.argmax(raw > 1.0)) or 20  # alike until one is refused
    solution = run(kalman(rules=[gate(0.95, patience=20)]), MODEL, START, y)
    ratio = np.asarray(solution.steps.info["y"].notes["gate.ratio"])
    np.testing.assert_allclose(ratio[:first], raw[:first], rtol=1e-9)
    assert first == 20 or ratio[first] == 1.0


STRICT = kalman(rules=[gate(1 - 1e-9)])


@pytest.mark.parametrize("wild", [1e3, 1e155, 1e308])
def test_a_gate_equals_a_run_without_the_outlier(wild):
    y = simulate(SYSTEM, 2, 20, 0.2)[1]
    without = y.copy()
    y[6], without[6] = wild, np.nan
    got, want = run(STRICT, MODEL, START, y), run(STRICT, MODEL, START, without)
    np.testing.assert_array_equal(got.mean, want.mean)
    np.testing.assert_array_equal(got.covariance, want.covariance)
    assert float(got.log_likelihood) == float(want.log_likelihood)
    assert int(got.steps.info["y"].code[6]) == Code.REFUSED


def test_what_is_missing_is_neither_refused_nor_agreed():
    y = simulate(SYSTEM, 2, 20)[1] + 1e3 * (np.arange(20) >= 5)[:, None]
    y[7] = np.nan
    solution = run(kalman(rules=[gate(0.9999, patience=3)]), MODEL, START, y)
    info = solution.steps.info["y"]
    refused = np.flatnonzero(np.asarray(info.code) == Code.REFUSED)
    assert refused[:3].tolist() == [5, 6, 8]
    assert info.code[9] == Code.DONE
    assert info.notes["gate.refused"][4:10].tolist() == [0, 1, 2, 2, 3, 0]


# ------------------------------------------------------------------------------------- recovery


def rest(x, u):
    return x


HEADING = Sensor(lambda x, aux: x["heading"], jnp.array([0.02]), 1)
COMPASS = Model(Motion(rest, jnp.array([1e-4, 1e-4])), (HEADING,))
# The offset does not show in the heading: it must stay as certain as it was.
KNOWN = Belief.of({"heading": Angle(jnp.array(3.1)), "offset": jnp.array(5.0)}, 1e-4 * np.eye(2))
RECOVERING = {
    name: kalman(rules=[gate(0.9999, 4, name)]) for name in ("accept", "inflate", "reinitialise")
}


def heading_error(solution, heading_rad):
    return np.abs(np.asarray(Angle(heading_rad).local(solution.mean["heading"]))[:, 0])


@pytest.mark.parametrize("recovery", RECOVERING)
def test_a_jump_across_the_seam_is_followed_where_samples_agree(recovery):
    rng = np.random.default_rng(1)
    heading_rad = np.where(np.arange(30) < 10, 3.1, -1.2)  # 1.98 rad on, through pi
    y = Angle(jnp.asarray(heading_rad + 0.02 * rng.normal(size=30)))
    solution = run(RECOVERING[recovery], COMPASS, KNOWN, y)
    error = heading_error(solution, heading_rad)
    recovered = np.flatnonzero(solution.steps.info["y"].notes["gate.recovered"])
    assert recovered[0] == 14
    if recovery == "accept":
        assert error[14] > 1.0  # the prior was believed, so little was learnt
    else:
        assert recovered.tolist() == [14]
        assert np.all(error[14:] < 0.08)
        sigma = np.asarray(solution.sigma)
        assert 0.01 < sigma[14, 0] < 0.021
        np.testing.assert_allclose(sigma[:, 1], np.sqrt(1e-4 + 1e-8 * np.arange(1, 31)), rtol=1e-9)


def test_nonsense_and_a_stuck_sensor_are_refused_for_ever():
    rng = np.random.default_rng(2)
    turning = Model(
        Motion(lambda x, u: {**x, "heading": Angle(x["heading"].rad + 0.1)}, COMPASS.motion.noise),
        COMPASS.sensors,
    )
    truth = 3.1 + 0.1 * np.arange(1, 61)
    stuck = truth + 0.02 * rng.normal(size=60)
    stuck[20:50] = stuck[20]
    nonsense = truth + np.where(np.arange(60) < 20, 0.02, 2.0) * rng.normal(size=60)
    nonsense[50:] = stuck[50:]
    refused = {}
    for name in ("inflate", "reinitialise"):
        for kind, values in {"stuck": stuck, "nonsense": nonsense}.items():
            solution = run(RECOVERING[name], turning, KNOWN, Angle(jnp.asarray(values)))
            code = np.asarray(solution.steps.info["y"].code)
            refused[name, kind] = np.sum(code == Code.REFUSED)
            error = heading_error(solution, truth)
            worst = np.max(error[20:50])
            if name == "reinitialise":
                assert worst < 0.03
                assert not np.any(solution.steps.info["y"].notes["gate.recovered"])
                assert np.max(error[50:]) < 0.03
            else:
                assert worst > 0.5  # contrast: recovery that does not ask for agreement is led away
    assert refused["reinitialise", "stuck"] == 29
    assert refused["reinitialise", "nonsense"] >= 25


def test_what_is_known_exactly_cannot_be_doubted():
    H = jnp.array([[1.0, 0.0], [0.0, 1.0]])
    model = Model(Motion(rest, jnp.zeros(2)), (Sensor(lambda x, aux: H @ x, jnp.ones(2), 2),))
    start = Belief.of(jnp.zeros(2), np.diag([0.0, 1.0]))
    y = np.tile([50.0, 50.0], (8, 1))
    for recovery in ("inflate", "reinitialise"):
        solution = run(kalman(rules=[gate(0.999, 2, recovery)]), model, start, y)
        assert np.all(np.isfinite(solution.steps.posterior.factor))
        np.testing.assert_array_equal(solution.mean[:, 0], np.zeros(8))
        assert abs(float(solution.mean[-1, 1]) - 50.0) < 3.0


# ----------------------------------------------------------------------------- memory, gradients


def position(H, x, aux):
    return H @ x


def test_each_sensor_has_a_count_of_its_own_and_streams_as_it_runs():
    H = jnp.array(SYSTEM.H)
    near = Sensor(Partial(position, H[:2]), jnp.ones(2), 2, "near")
    far = Sensor(Partial(position, H[2:]), 5.0 * jnp.ones(1), 1, "far")
    model = Model(MODEL.motion, (near, far))
    one = kalman(rules=[gate(0.999, 2, "reinitialise")])
    y = simulate(SYSTEM, 2, 12)[1]
    y[4:, 2] += 1e3  # only the far one is off
    y[6] = np.nan
    whole = run(one, model, START, {"near": y[:, :2], "far": y[:, 2:]})
    refused = {k: v.notes["gate.refused"].tolist() for k, v in whole.steps.info.items()}
    assert refused["far"][3:8] == [0, 1, 2, 2, 0]
    assert not any(refused["near"][:4])
    live = OnlineFilter(one, model, START)
    for row in y[:9]:
        live.predict()
        before = live.state.memory[0]
        live.update(row[:2], "near")
        live.update(row[2:], "far")
        if np.all(np.isnan(row)):
            jax.tree.map(np.testing.assert_array_equal, live.state.memory[0], before)
    np.testing.assert_allclose(live.belief.mean, whole.mean[8], rtol=1e-10)
    np.testing.assert_allclose(live.belief.covariance, whole.covariance[8], rtol=1e-9, atol=1e-12)
