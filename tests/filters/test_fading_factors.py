"""Fading by the innovations of a window, and by age, against recursions and least squares."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import kalman_filter, random_system, simulate, times
from jax.tree_util import Partial

from robins.filters import (
    Belief,
    Code,
    Model,
    Motion,
    OnlineFilter,
    Sensor,
    StepWarning,
    kalman,
    rts_smoother,
    run,
    unscented,
)
from robins.filters.observation import Observation
from robins.filters.rules.fading_memory import fading_memory, per_step
from robins.filters.rules.gate import gate
from robins.filters.rules.innovation_fading import innovation_fading
from robins.filters.rules.sage_husa import sage_husa
from robins.filters.rules.variational_bayes import variational_bayes
from robins.manifold import Angle

T = 30
SYSTEM = random_system(2)
MODEL, START = SYSTEM.model(), SYSTEM.start()
Y = 2.5 * simulate(SYSTEM, 2, T, 0.2)[1]  # larger than the filter is told
SPLIT = {"near": slice(0, 2), "far": slice(2, 3)}


# ----------------------------------------------------------------------------- innovation fading


def dense_innovation_fading(window, limit):
    """Means, covariances and the factor of each sensor, one step fading once at most."""
    m, P = SYSTEM.m0, SYSTEM.P0
    seen: list[list[float]] = [[], [], []]
    means, covariances, factors = [], [], []
    for k in range(T):
        m, P = SYSTEM.F @ m, SYSTEM.F @ P @ SYSTEM.F.T + SYSTEM.Q
        faded, row = False, []
        for part in SPLIT.values():
            here = np.flatnonzero(np.isfinite(Y[k, part])) + part.start
            if not len(here):
                row.append(1.0)
                continue
            H, e = SYSTEM.H[here], Y[k, here] - SYSTEM.H[here] @ m
            R = SYSTEM.R[np.ix_(here, here)]
            for i, one, r in zip(here, e, np.diag(R), strict=True):
                seen[i] = [*seen[i], one**2 / r][-window:]
            full = [len(seen[i]) == window for i in here]
            above = sum(np.mean(seen[i]) - 1 for i in here[full])
            explained = np.sum((np.diag(H @ P @ H.T) / np.diag(R))[full])
            factor = above / explained if any(full) else 1.0
            factor = 1.0 if faded else min(max(factor, 1.0), limit)
            faded = faded or factor > 1.0
            P = factor * P
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
            m, P = m + K @ e, (np.eye(4) - K @ H) @ P
            row.append(factor)
        means.append(m)
        covariances.append(P)
        factors.append(row)
    return np.array(means), np.array(covariances), np.array(factors)


@pytest.mark.parametrize("form", ["sqrt", "joseph"])
def test_innovation_fading_is_its_recursion(form):
    F, G, H, W = (jnp.array(a) for a in SYSTEM[:4])
    sensors = tuple(Sensor(Partial(times, H[p]), W[p], len(H[p]), k) for k, p in SPLIT.items())
    model = Model(Motion(Partial(times, F), G), sensors)
    one = kalman(rules=[innovation_fading(4, 3.0)], form=form)
    solution = run(one, model, START, {name: Y[:, part] for name, part in SPLIT.items()})
    means, covariances, factors = dense_innovation_fading(4, 3.0)
    np.testing.assert_allclose(solution.mean, means, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(solution.covariance, covariances, rtol=1e-8, atol=1e-9)
    for name, factor in zip(SPLIT, factors.T, strict=True):
        noted = solution.steps.info[name].notes["innovation_fading.lambda"]
        np.testing.assert_allclose(noted, factor, rtol=1e-8)
        assert {1.0, 3.0} <= set(factor)
        assert np.any((factor > 1.0) & (factor < 3.0))
    assert not np.any(np.all(factors > 1.0, axis=1))


def seen(residual, accepted=(True, True), deficit=None) -> Observation:
    """Two components: H P H' + Omega has diagonal 5.25 and 2, R 4 and 2."""
    return Observation(
        sensor="y",
        prior=START,
        residual=jnp.array(residual),
        present=jnp.array([True, True]),
        accepted=jnp.array(accepted),
        spread=jnp.array([[1.0, 0.0, 2.0, 0.0], [0.0, 1.0, 0.0, 0.0]]),
        excess=jnp.array([[0.5], [1.0]]),
        noise=jnp.array([[2.0, 0.0], [1.0, 1.0]]),
        size=jnp.ones(2),
        deficit=deficit,
    )


def test_the_factor_by_hand():
    rule = innovation_fading(2, 100.0)
    memory = rule.init(START, {"y": 2})

    def factor(memory, o):
        memory, prior, _ = rule.before(memory, START, o)
        times_ = np.asarray(prior.factor[0, 0] / START.factor[0, 0]) ** 2
        assert float(memory.factor) == pytest.approx(times_, rel=1e-14)
        return float(memory.factor), memory._replace(faded=jnp.array(False))

    # one sample does not fill a window of two
    first, memory = factor(memory, seen([6.0, 4.0]))
    assert first == 1.0
    # the second component is refused: only the first counts, over its two samples
    second, memory = factor(memory, seen([4.0, 1e6], accepted=(True, False)))
    assert second == pytest.approx(((36 + 16) / 2 / 4 - 1) / (5.25 / 4), rel=1e-14)
    assert memory.windows["y"].filled.tolist() == [2, 1]
    # the window of two has forgotten the 6, and what a deficit takes is not the state's
    third, memory = factor(memory, seen([4.0, 4.0], deficit=jnp.array([1.0, 0.0])))
    assert third == pytest.approx((16 / 4 - 1 + 16 / 2 - 1) / (4.25 / 4 + 2 / 2), rel=1e-14)
    # an outlier that a robust weight has made light does not fade
    light = seen([1e3, 0.0])._replace(noise=1e3 * seen([0.0, 0.0]).noise)
    _, memory = factor(memory, light)
    assert factor(memory, light)[0] == 1.0


def test_a_step_is_faded_once():
    rule = innovation_fading(1, 100.0)
    memory = rule.init(START, {"y": 2})
    memory, faded, _ = rule.before(memory, START, seen([9.0, 9.0]))
    assert float(memory.factor) > 1.0
    memory, again, _ = rule.before(memory, faded, seen([9.0, 9.0]))
    assert float(memory.factor) == 1.0
    np.testing.assert_array_equal(again.factor, faded.factor)


def test_nothing_measured_or_refused_moves_no_window():
    one = kalman(rules=[gate(0.99), innovation_fading()])
    update = jax.jit(one.update)
    state, _ = update(one.init(START, MODEL.dims), MODEL.sensors[0], jnp.ones(3))
    for y, code in ((jnp.nan, Code.MISSING), (1e4, Code.REFUSED)):
        after, info = update(state, MODEL.sensors[0], jnp.full(3, y))
        assert int(info.code) == code
        assert float(info.notes["innovation_fading.lambda"]) == 1.0
        for a, b in zip(after.memory[1].windows["y"], state.memory[1].windows["y"], strict=True):
            np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(after.belief.factor, state.belief.factor)


# --------------------------------------------------------------------------------- fading memory


def test_fading_memory_weighs_data_by_age():
    # Without process noise the filter solves one least-squares problem, here solved at a stroke.
    alpha, still = 1.1, SYSTEM._replace(G=np.zeros((4, 4)))
    solution = run(kalman(rules=[fading_memory(alpha)]), still.model(), START, Y)
    root = np.linalg.inv(np.linalg.cholesky(SYSTEM.P0))
    rows, right = [alpha**-T * root], [alpha**-T * root @ SYSTEM.m0]
    ahead = np.eye(4)
    for k in range(T):
        ahead = SYSTEM.F @ ahead
        here = np.isfinite(Y[k])
        if np.any(here):
            root = np.linalg.inv(np.linalg.cholesky(SYSTEM.R[np.ix_(here, here)]))
            weight = alpha ** -(T - 1 - k)
            rows.append(weight * root @ SYSTEM.H[here] @ ahead)
            right.append(weight * root @ Y[k, here])
    first = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    np.testing.assert_allclose(solution.mean[-1], ahead @ first, rtol=1e-8, atol=1e-10)
    # and what is smoothed lies on one trajectory, as it must without process noise
    smooth = rts_smoother(solution)
    for k in range(T - 1):
        moved = SYSTEM.F @ np.asarray(smooth.mean[k])
        np.testing.assert_allclose(moved, smooth.mean[k + 1], rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("form", ["sqrt", "joseph"])
def test_fading_memory_is_its_recursion(form):
    one = kalman(unscented(), [fading_memory(1.1)], form=form)
    solution = run(one, MODEL, START, Y)
    m, P = SYSTEM.m0, SYSTEM.P0
    for k in range(T):
        step = SYSTEM._replace(m0=m, P0=1.21 * P)
        (m,), (P,), _, _ = kalman_filter(step, Y[k : k + 1])
        np.testing.assert_allclose(solution.mean[k], m, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(solution.covariance[k], P, rtol=1e-8, atol=1e-9)
    np.testing.assert_array_equal(
        solution.steps.info["y"].notes["fading_memory.factor"], np.full(T, 1.1)
    )


def test_a_time_constant_is_what_it_says():
    assert per_step(20.0, 0.1) ** (-2 * 200) == pytest.approx(np.exp(-1.0), rel=1e-12)
    assert per_step(np.inf, 0.1) == 1.0


# ------------------------------------------------------------------------------------------ both

BOTH = [fading_memory(1.05), innovation_fading(5, 4.0)]


def test_limits_that_are_the_kalman_filter():
    one = kalman(rules=[fading_memory(1), innovation_fading(limit=1)])
    got, want = run(one, MODEL, START, Y), run(kalman(), MODEL, START, Y)
    np.testing.assert_array_equal(got.mean, want.mean)
    np.testing.assert_array_equal(got.covariance, want.covariance)


def test_fading_streams_as_it_runs():
    one = kalman(unscented(), BOTH)
    whole = run(one, MODEL, START, Y)
    live = OnlineFilter(one, MODEL, START)
    for row in Y:
        live.predict()
        live.update(row)
    for a, b in zip(jax.tree.leaves(live.state), jax.tree.leaves(whole.final), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)


def test_an_angle_that_wraps_fades_as_one_that_does_not():
    step = lambda x, u: {"heading": x["heading"].retract(0.2 * x["rate"]), "rate": x["rate"]}  # noqa: E731
    sensor = Sensor(lambda x, aux: x["heading"], jnp.array([0.05]), 1)
    model = Model(Motion(step, jnp.array([0.01, 0.01])), (sensor,))
    t = 0.2 * np.arange(1, 41)
    seen_rad = t + 0.3 * (t > 4.0) + 0.05 * np.random.default_rng(1).normal(size=40)
    one, found = kalman(rules=BOTH), []
    for start_rad in (0.0, 3.0):
        mean = {"heading": Angle(jnp.array(start_rad)), "rate": jnp.array([1.0])}
        start = Belief.of(mean, np.diag([0.01, 0.04]))
        y = Angle(np.angle(np.exp(1j * (seen_rad + start_rad))))
        solution = run(one, model, start, y)
        found.append(np.asarray(solution.steps.info["y"].notes["innovation_fading.lambda"]))
    np.testing.assert_allclose(found[0], found[1], rtol=1e-9)
    assert found[0].max() == 4.0


def test_gradients_are_right_with_components_missing():
    one = kalman(rules=[fading_memory(1.05), innovation_fading(2, 50.0)], form="joseph")
    y = np.array([[3.0, 1.0], [np.nan, 2.0], [np.nan, np.nan], [6.0, 2.5]])

    @jax.jit
    def surprise(size):
        motion = Motion(lambda x, u: jnp.stack([x[0] + x[1], x[1]]), size * jnp.array([0.1, 0.2]))
        model = Model(motion, (Sensor(lambda x, aux: x, size * jnp.array([1.0, 0.5]), 2),))
        return run(one, model, Belief(jnp.zeros(2), jnp.eye(2)), y).log_likelihood

    at, h = jnp.array(0.9), 1e-5
    by_difference = (surprise(at + h) - surprise(at - h)) / (2 * h)
    assert float(jax.jit(jax.grad(surprise))(at)) == pytest.approx(float(by_difference), rel=1e-6)


# ------------------------------------------------------------------- everything, against the worst


def test_all_that_adapts_survives_the_worst():
    # Nothing known at first, exact, repeated and missing readings, at times no process noise.
    rng = np.random.default_rng(3)
    steps, n, m = 2000, 4, 3
    F = np.linalg.qr(rng.normal(size=(n, n)))[0]
    A = rng.normal(size=(m, n))
    kinds = [A, np.zeros((m, n)), np.array([A[0], A[0], A[1]]), np.array([A[0], A[1], 0 * A[0]])]
    H = np.array(kinds)[rng.integers(4, size=steps)]
    W = np.array([0.0, 1e-6, 1.0, 1e3])[rng.integers(4, size=(steps, m))][:, :, None] * np.eye(m)
    G = rng.choice([0.0, 1.0], p=[0.9, 0.1], size=steps)[:, None, None] * np.eye(n)
    x, y = 1e6 * rng.normal(size=n), np.empty((steps, m))
    for k in range(steps):
        x = F @ x + G[k] @ rng.normal(size=n)
        y[k] = H[k] @ x + W[k] @ rng.normal(size=m)
    y[rng.random(y.shape) < 0.1] = np.nan
    y[[50, 700]] = [[1e9, 0.0, 1e9], [1e308, -1e308, np.inf]]
    sensor = Sensor(lambda x, aux: aux[0] @ x, lambda x, aux: aux[1], m)
    model = Model(Motion(Partial(times, jnp.array(F)), lambda x, u: u), (sensor,))
    rules = [sage_husa(adapt="QR"), variational_bayes(), innovation_fading(), fading_memory(1.001)]
    start = Belief.of(jnp.zeros(n), 1e12 * np.eye(n))
    with pytest.warns(StepWarning, match="1 of 2000 updates with 'y' are NOT_FINITE"):
        solution = run(kalman(rules=rules), model, start, y, G, {"y": (H, W)})
    P = np.asarray(solution.covariance)
    assert np.all(np.isfinite(solution.mean))
    assert np.all(np.isfinite(P))
    least, greatest = np.linalg.eigvalsh(P)[:, [0, -1]].T
    assert np.all(least >= -1e-15 * greatest)
    codes = np.asarray(solution.steps.info["y"].code)
    assert np.flatnonzero(codes == Code.NOT_FINITE).tolist() == [700]
    assert not np.any(codes == Code.INDEFINITE)


# ------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: innovation_fading(0), "innovation_fading window must be 1 sample or more, got 0"),
        (lambda: innovation_fading(limit=0.5), "innovation_fading limit must be finite and not"),
        (lambda: innovation_fading(limit=np.inf), "innovation_fading limit must"),
        (lambda: innovation_fading(limit=np.nan), "innovation_fading limit must"),
        (lambda: fading_memory(0.99), "fading_memory factor must be finite and not below 1"),
        (lambda: fading_memory(np.inf), "fading_memory factor must"),
        (lambda: fading_memory(np.nan), "fading_memory factor must"),
        (lambda: per_step(0.0, 1.0), "fading_memory memory_s must be positive"),
        (lambda: per_step(1.0, 0.0), "fading_memory step_s must be positive and finite"),
    ],
)
def test_parameters_that_make_no_sense(build, message):
    with pytest.raises(ValueError, match=message):
        build()
