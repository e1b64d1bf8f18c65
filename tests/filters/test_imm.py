"""The interacting multiple model filter against one written down plainly in NumPy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import times
from in_lanes import each
from interpreted import run
from jax.tree_util import Partial
from scipy.spatial.transform import Rotation as Turn
from scipy.stats import multivariate_normal

from robins.filters import (
    Belief,
    Code,
    ModeFamily,
    Model,
    Motion,
    Rule,
    Sensor,
    StepWarning,
    kalman,
    unscented,
)
from robins.filters.composite.imm import imm, mode
from robins.filters.composite.mixture import log_normalised, matched, root
from robins.filters.rules import gate
from robins.filters.values import Numbers, value
from robins.manifold import Angle
from robins.rotation import Rotation

CHANGE = np.array([[0.95, 0.05, 0.0], [0.1, 0.85, 0.05], [0.0, 0.2, 0.8]])
FIRST = np.array([0.6, 0.3, 0.1])
F = [np.array([[1.0, 1.0], [0.0, f]]) for f in (1.0, 0.9, 0.5)]
G = [np.diag(g) for g in ([0.01, 0.01], [0.3, 0.4], [0.1, 0.9])]
H = np.array([[1.0, 0.0], [0.5, 0.5]])
W = [np.array([[1.0, 0.0], [0.4, 0.8]]), np.diag([0.5, 0.5]), np.diag([3.0, 1.0])]
M0, P0 = np.array([1.0, -0.5]), np.array([[4.0, 1.0], [1.0, 2.0]])
T = 25


def linear(i: int) -> tuple[Motion, Sensor]:
    motion = Motion(Partial(times, jnp.array(F[i])), jnp.array(G[i]))
    return motion, Sensor(Partial(times, jnp.array(H)), jnp.array(W[i]), 2)


# The first mode has its motion and sensor from the model; ways and forms do not matter if linear.
MODEL = Model(linear(0)[0], (linear(0)[1],))
MODES = [
    mode(kalman()),
    mode(kalman(unscented()), *[linear(1)[0], linear(1)[1:]]),
    mode(kalman(form="joseph"), *[linear(2)[0], linear(2)[1:]]),
]
IMM = imm(MODES, CHANGE, FIRST)
START = Belief.of(jnp.array(M0), P0)


def series(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    x, i, y = M0, 0, []
    for _ in range(T):
        i = rng.choice(3, p=CHANGE[i])
        x = F[i] @ x + G[i] @ rng.normal(size=2)
        y.append(H @ x + W[i] @ rng.normal(size=2))
    y = np.array(y)
    y[rng.random(y.shape) < 0.15] = np.nan
    return y


def moments(weights, means, covariances):
    mean = sum(w * m for w, m in zip(weights, means, strict=True))
    return mean, sum(
        w * (P + np.outer(m - mean, m - mean))
        for w, m, P in zip(weights, means, covariances, strict=True)
    )


def dense_imm(y, change, first):
    """Blom & Bar-Shalom's recursion with probabilities and covariances as they are printed."""
    mu, m, P = first, [M0] * 3, [P0] * 3
    out = {k: [] for k in ("mean", "covariance", "mu", "likelihood", "innovation", "S", "gain")}
    for row in y:
        c = change.T @ mu
        mix = [change[:, j] * mu / c[j] for j in range(3)]
        begun = [moments(mix[j], m, P) for j in range(3)]
        here = np.isfinite(row)
        h, likelihood, residual, S, K = H[here], np.ones(3), [], [], []
        for j, (a, A) in enumerate(begun):
            a, A = F[j] @ a, F[j] @ A @ F[j].T + G[j] @ G[j].T
            R = (W[j] @ W[j].T)[np.ix_(here, here)]
            S.append(h @ A @ h.T + R)
            residual.append(row[here] - h @ a)
            K.append(A @ h.T @ np.linalg.inv(S[j]))
            if here.any():
                likelihood[j] = multivariate_normal(cov=S[j]).pdf(residual[j])
            m[j], P[j] = a + K[j] @ residual[j], A - K[j] @ h @ A
        mu = c * likelihood
        out["likelihood"].append(mu.sum())
        mu = mu / mu.sum()
        mean, covariance = moments(mu, m, P)
        z, Z = moments(c, residual, S)
        for k, v in (("mean", mean), ("covariance", covariance), ("mu", mu), ("S", Z)):
            out[k].append(v)
        out["innovation"].append(z)
        out["gain"].append(sum(w * k for w, k in zip(mu, K, strict=True)))
    return out


@pytest.fixture(scope="module")
def solution():
    y = np.stack([*(series(seed) for seed in range(3)), np.full((T, 2), np.nan)])
    return y, each(lambda y: run(IMM, MODEL, START, y))(y)


@pytest.mark.parametrize("k", range(3))
def test_it_is_the_dense_recursion(solution, k):
    y, found = solution[0][k], jax.tree.map(lambda a: a[k], solution[1])
    want = dense_imm(y, CHANGE, FIRST)
    np.testing.assert_allclose(found.mean, want["mean"], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(found.covariance, want["covariance"], rtol=1e-9, atol=1e-12)
    info = found.steps.info["y"]
    np.testing.assert_allclose(info.notes["imm.probability"], want["mu"], rtol=1e-9)
    np.testing.assert_allclose(info.log_likelihood, np.log(want["likelihood"]), rtol=1e-9)
    assert float(found.log_likelihood) == pytest.approx(np.log(want["likelihood"]).sum(), rel=1e-11)
    assert np.ptp(info.notes["imm.probability"][:, 0]) > 0.4  # it does change its mind
    for t, row in enumerate(y):
        here = np.isfinite(row)
        z, Z = want["innovation"][t], want["S"][t]
        np.testing.assert_array_equal(np.isnan(info.innovation[t]), ~here)
        np.testing.assert_array_equal(info.used[t], here)
        np.testing.assert_allclose(info.innovation[t][here], z, rtol=1e-9, atol=1e-12)
        S = info.factor[t] @ info.factor[t].T
        np.testing.assert_allclose(S[np.ix_(here, here)], Z, rtol=1e-9)
        np.testing.assert_allclose(info.gain[t][:, here], want["gain"][t], rtol=1e-8, atol=1e-12)
        assert float(info.nis[t]) == pytest.approx(float(z @ np.linalg.solve(Z, z)), rel=1e-8)
        assert int(info.dof[t]) == here.sum()


def test_the_likeliest_mode_is_told_where_one_is_rare_and_wide():
    """A right narrow mode and a rare wide one: NIS is chi-square, the estimate is the same."""
    wide = Sensor(Partial(times, jnp.array(H)), jnp.array(100.0 * W[0]), 2)
    modes = [mode(kalman()), mode(kalman(), sensors=[wide])]
    change = np.array([[0.99, 0.01], [0.5, 0.5]])
    rng, x, y = np.random.default_rng(4), np.linalg.cholesky(P0) @ np.array([0.3, -0.8]) + M0, []
    for _ in range(400):
        x = F[0] @ x + G[0] @ rng.normal(size=2)
        y.append(H @ x + W[0] @ rng.normal(size=2))
    each = [run(imm(modes, change, likeliest=b), MODEL, START, np.array(y)) for b in (False, True)]
    np.testing.assert_array_equal(each[0].mean, each[1].mean)
    np.testing.assert_array_equal(each[0].log_likelihood, each[1].log_likelihood)
    mixture, one = (float(np.mean(s.steps.info["y"].nis)) / 2.0 for s in each)
    assert mixture < 0.1
    assert abs(one - 1.0) < 4.0 * np.sqrt(2.0 / 800.0)
    # and it is that mode's own: the innovation whitened by its factor
    last = jax.tree_util.tree_map(lambda a: np.asarray(a)[-1], each[1].steps.info["y"])
    white = np.linalg.solve(last.factor, last.innovation)
    np.testing.assert_allclose(last.nis, white @ white, rtol=1e-10)


def test_with_nothing_measured_probabilities_only_mix(solution):
    steps = jax.tree.map(lambda a: a[3], solution[1].steps)
    info = steps.info["y"]
    assert np.all(info.code == Code.MISSING)
    assert not np.any(info.log_likelihood[:3])
    np.testing.assert_allclose(info.log_likelihood, 0.0, atol=1e-15)  # of sums of probabilities
    want = [FIRST @ np.linalg.matrix_power(CHANGE, k + 1) for k in range(T)]
    np.testing.assert_allclose(info.notes["imm.probability"], want, rtol=1e-12)
    after, before = steps.posterior, steps.prediction.belief
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(before), strict=True):
        np.testing.assert_array_equal(a, b)


def test_one_mode_is_its_filter_and_modes_that_never_change_are_filters_of_their_own(solution):
    y = solution[0][0]
    alone = [kalman(), kalman(rules=[gate(0.9)])]
    each = [run(one, MODEL, START, y) for one in alone]
    single = run(imm([alone[1]], [[1.0]]), MODEL, START, y)
    same = (
        single.steps.posterior,
        single.log_likelihood,
        single.steps.info["y"]._replace(notes={}),
    )
    own = (
        each[1].steps.posterior,
        each[1].log_likelihood,
        each[1].steps.info["y"]._replace(notes={}),
    )
    for a, b in zip(jax.tree.leaves(same), jax.tree.leaves(own), strict=True):
        np.testing.assert_array_equal(a, b)
    notes = single.steps.info["y"].notes
    np.testing.assert_array_equal(
        notes["imm.0.gate.ratio"], each[1].steps.info["y"].notes["gate.ratio"]
    )

    bank = run(imm(alone, np.eye(2)), MODEL, START, y)
    for state, one in zip(bank.final.memory.states, each, strict=True):
        for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(one.final), strict=True):
            np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-15)
    # The gate refused what the other used: that says nothing about which of them is right.
    refused = each[1].steps.info["y"].code == Code.REFUSED
    mu = np.asarray(bank.steps.info["y"].notes["imm.probability"])
    assert refused.sum() >= 2
    before = np.concatenate([[[0.5, 0.5]], mu[:-1]])
    np.testing.assert_allclose(mu[refused], before[refused], rtol=1e-13)


def scaled(row):
    """A mode of a family: by numbers, its noise of motion, and of its sensor another factor."""
    drive, noise = row
    motion, sensor = linear(0)
    motion = dataclasses.replace(motion, noise=drive * jnp.asarray(motion.noise))
    sensor = dataclasses.replace(sensor, noise=noise * jnp.asarray(sensor.noise))
    return mode(kalman(rules=[gate(0.99)]), motion, [sensor])


def test_a_family_is_the_modes_one_by_one(solution):
    """Modes of a family with measurements missing and refused; from one mode none comes back."""
    y = solution[0][0]
    numbers = (np.array([1.0, 8.0]), np.array([1.0, 5.0]))
    rows = list(zip(*numbers, strict=True))
    change = np.array([[0.9, 0.1], [0.0, 1.0]])
    each = run(imm([scaled(row) for row in rows], change), MODEL, START, y)
    once = run(imm(ModeFamily(scaled, numbers), change), MODEL, START, y)
    for name in ("steps", "log_likelihood", "tally"):
        one, other = (getattr(x, name) for x in (once, each))
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)
    assert "imm.1.gate.ratio" in once.steps.info["y"].notes
    settled = imm(ModeFamily(scaled, numbers), change).reset(once.final, START)
    np.testing.assert_array_equal(settled.memory.states.belief.factor[1], START.factor)


HEARD = []


@value
class Told(Rule):
    """Adds a step at each prediction, and says what it became, also with steps of 100."""

    who: Numbers
    step: Numbers

    def init(self, belief, dims):
        return jnp.zeros(())

    def process(self, memory, transition):
        return memory + self.step, transition

    def report(self, start, final, again, time):
        more = None if again is None else float(again(dataclasses.replace(self, step=100.0)))
        HEARD.append((float(self.who), float(start), float(final), more, time))


def told(who):
    return kalman(rules=[Told(who, np.asarray(1.0))])


@pytest.mark.parametrize("family", [False, True], ids=["modes", "family"])
def test_every_mode_reports_a_run_with_its_own_rule_exchanged(family):
    who = np.array([7.0, 8.0])
    bank = imm(
        ModeFamily(told, who) if family else [told(w) for w in who], [[0.9, 0.1], [0.2, 0.8]]
    )
    start = bank.init(START, MODEL.dims)

    def ended(one):
        return one.predict(start, MODEL.motion)[0]

    HEARD.clear()
    bank.report(start, ended(bank), ended, None)
    bank.report(start, ended(bank), None, 5.0)
    rerun = [(7.0, 0.0, 1.0, 100.0, None), (8.0, 0.0, 1.0, 100.0, None)]
    assert rerun + [(w, 0.0, 1.0, None, 5.0) for w in who] == HEARD


def test_another_change_or_number_is_another_leaf_of_the_same_structure():
    def bank(scale, p):
        return imm(ModeFamily(scaled, (scale * np.ones(2), np.ones(2))), [[p, 1.0 - p], [0.2, 0.8]])

    one, other = (jax.tree_util.tree_flatten(bank(*a)) for a in ((1.0, 0.9), (3.0, 0.7)))
    assert one[1] == other[1]
    assert all(leaf.dtype == float for leaf in one[0])
    assert not all(np.array_equal(a, b) for a, b in zip(one[0], other[0], strict=True))


def test_the_likelihood_has_a_slope_by_the_chance_of_a_change(solution):
    """Also where another is zero."""
    y = solution[0][0][:4]

    def likelihood(p):
        modes = [kalman(), mode(kalman(), linear(1)[0])]
        bank = imm(modes, [[1.0 - p, p], [0.0, 1.0]], [1.0, 0.0])
        return run(bank, MODEL, START, y).log_likelihood

    value, slope = jax.jit(jax.vmap(jax.value_and_grad(likelihood)))(jnp.array([0.3, 0.301]))
    np.testing.assert_allclose(slope.mean(), (value[1] - value[0]) / 1e-3, rtol=1e-3)


def test_families_that_are_none_are_refused():
    with pytest.raises(ValueError, match="one row a mode; their shapes begin with"):
        imm(ModeFamily(scaled, (np.ones(2), np.ones(3))), np.eye(2))
    with pytest.raises(ValueError, match="one row a mode"):
        imm(ModeFamily(scaled, 1.0), np.eye(2))


def test_a_mode_that_fails_is_out_and_comes_back():
    # Its motion is not finite above one; then the other, which knows better, takes over.
    def fragile(x, u):
        return jnp.where(x[:1] > 1.0, jnp.nan, x) if u is None else x + u

    sound = Motion(lambda x, u: x if u is None else x + u, jnp.array([0.1]))
    sensor = Sensor(lambda x, aux: x, jnp.array([0.2]), 1)
    broken = mode(kalman(), Motion(fragile, jnp.array([0.1])))
    two = imm([kalman(), broken], [[0.9, 0.1], [0.1, 0.9]])
    y = np.array([[0.5], [1.9], [1.6], [0.4], [0.2], [0.1]])
    found = run(two, Model(sound, (sensor,)), Belief.of(jnp.zeros(1), np.eye(1)), y)
    mu = np.asarray(found.steps.info["y"].notes["imm.probability"])[:, 1]
    assert np.all(np.isfinite(found.mean))
    assert not np.any(found.steps.prediction.code)
    np.testing.assert_array_equal(mu[[2, 3]], 0.0)
    np.testing.assert_allclose(mu[[0, 1]], 0.5)
    assert 0.1 < mu[4] < mu[5]

    with pytest.warns(StepWarning, match="4 of 6 predictions are NOT_FINITE"):
        lost = run(imm([broken] * 2, np.eye(2)), Model(sound, (sensor,)), found.final.belief, y)
    assert lost.steps.prediction.code.tolist()[:4] == [0, 0, Code.NOT_FINITE, Code.NOT_FINITE]
    assert np.isneginf(lost.log_likelihood)
    assert np.all(np.isfinite(lost.mean))


def test_utterly_unlikely_measurements_leave_probabilities_and_slopes_finite():
    y = np.array([[0.0, 0.0], [1e8, -1e8], [np.nan, 1.0]])
    two = imm([kalman(), mode(kalman(), linear(1)[0])], [[0.9, 0.1], [0.0, 1.0]], [1.0, 0.0])

    def surprise(scale):
        motion = Motion(MODEL.motion.step, scale * MODEL.motion.noise)
        return run(two, Model(motion, MODEL.sensors), START, y).log_likelihood

    scale = jnp.array([1.0 - 1e-5, 1.0, 1.0 + 1e-5])
    slopes = jax.jit(jax.vmap(lambda s: jax.jvp(surprise, (s,), (jnp.ones(()),))))
    value, slope = slopes(scale)
    assert float(slope[1]) == pytest.approx(float(value[2] - value[0]) / 2e-5, rel=1e-4)


# ------------------------------------------------------------------------- moments on a manifold


def test_moments_of_rotations_are_those_of_scipy():
    rng = np.random.default_rng(2)
    turns = Turn.from_rotvec(rng.normal(size=(3, 3)) * 0.3)
    weight = np.array([0.5, 0.3, 0.2])
    S = 0.2 * np.tril(rng.normal(size=(3, 3, 3)))
    mean = turns[0]
    for _ in range(50):  # scipy's own mean minimises chords, not angles
        mean = Turn.from_rotvec(weight @ (turns * mean.inv()).as_rotvec()) * mean
    P, h = np.zeros((3, 3)), 1e-6
    for w, turn, s in zip(weight, turns, S, strict=True):
        d = (turn * mean.inv()).as_rotvec()
        ahead, back = (
            np.array([(Turn.from_rotvec(e) * turn * mean.inv()).as_rotvec() for e in way])
            for way in (h * np.eye(3), -h * np.eye(3))
        )
        J = (ahead - back).T / (2 * h)
        P += w * (J @ s @ s.T @ J.T + np.outer(d, d))
    wxyz = np.roll(turns.as_quat(), 1, axis=1)
    beliefs = Belief(Rotation(jnp.array(wxyz)), jnp.array(S))
    found = jax.jit(matched)(beliefs, jnp.array(weight), Rotation(jnp.array(wxyz[1])))
    np.testing.assert_allclose(found.mean.as_dcm(), mean.as_matrix(), atol=1e-10)
    np.testing.assert_allclose(found.covariance, P, atol=1e-9)


def test_moments_wrap_and_what_has_no_weight_does_not_count():
    beliefs = Belief(
        (Angle(jnp.array([3.1, -3.1, jnp.nan])), jnp.array([[1.0], [3.0], [jnp.inf]])),
        jnp.array([np.diag([0.1, 1.0]), np.diag([0.2, 2.0]), np.full((2, 2), np.nan)]),
    )
    weight = jnp.array([0.25, 0.75, 0.0])
    found = jax.jit(matched)(beliefs, weight, (Angle(jnp.array(3.0)), jnp.zeros(1)))
    gap = 2 * np.pi - 6.2
    assert float(found.mean[0].rad) == pytest.approx(-3.1 - 0.25 * gap, rel=1e-14)
    assert float(found.mean[1][0]) == pytest.approx(2.5)
    d = np.array([gap, 2.0])
    P = np.diag([0.25 * 0.01 + 0.75 * 0.04, 0.25 + 3.0]) + 0.25 * 0.75 * np.outer(d, d)
    np.testing.assert_allclose(found.covariance, P, rtol=1e-12)


def test_weights_that_are_lost_become_equal():
    for lost in ([-jnp.inf] * 4, [jnp.nan] * 4):
        log_weight, total = log_normalised(jnp.array(lost))
        np.testing.assert_allclose(jnp.exp(log_weight), 0.25)
        assert float(total) == -np.inf
    log_weight, total = log_normalised(jnp.array([-1e9, -1e9 - 1.0, jnp.nan, -jnp.inf]))
    assert float(total) == pytest.approx(-1e9)
    np.testing.assert_allclose(jnp.exp(log_weight), [0.731058578, 0.268941421, 0, 0], rtol=1e-6)
    assert np.all(np.isfinite(jax.jacfwd(root)(jnp.array([0.0, 4.0]))))


# -------------------------------------------------------------------------------- reset, reports


def test_a_reset_moves_all_modes_and_keeps_probabilities(solution):
    final = jax.tree.map(lambda a: a[0], solution[1].final)
    after = IMM.reset(final, START)
    for belief in (after.belief, *(s.belief for s in after.memory.states)):
        np.testing.assert_array_equal(belief.mean, M0)
    np.testing.assert_array_equal(after.memory.log_probability, final.memory.log_probability)


@pytest.mark.parametrize(
    ("transition", "start", "message"),
    [
        ([[1.0]], None, r"transition of imm has shape \(1, 1\), its modes need \(2, 2\)"),
        ([[0.5, 0.5], [0.5, 0.6]], None, "rows that sum to one"),
        ([[1.5, -0.5], [0.5, 0.5]], None, "transition of imm must hold probabilities"),
        ([[np.nan, 1.0], [0.5, 0.5]], None, "transition of imm must hold probabilities"),
        (np.eye(2), [0.5, 0.4], "start of imm must hold probabilities"),
        (np.eye(2), [1.0], "start of imm has shape"),
    ],
)
def test_bad_probabilities_are_refused(transition, start, message):
    with pytest.raises(ValueError, match=message):
        imm([kalman(), kalman()], transition, start)


def test_bad_modes_are_refused():
    with pytest.raises(ValueError, match="at least one mode"):
        imm([], np.zeros((0, 0)))
    stray = Sensor(lambda x, aux: x, jnp.ones(2), 2, "stray")
    with pytest.raises(ValueError, match=r"bring \['stray'\]; the model has \['y'\]"):
        run(imm([mode(kalman(), sensors=[stray])], [[1.0]]), MODEL, START, np.zeros((1, 2)))
