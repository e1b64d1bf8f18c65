"""Rules that learn the size of the noise, against the papers' recursions written with inverses."""

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
    Rule,
    Sensor,
    kalman,
    run,
    unscented,
)
from robins.filters.observation import Observation
from robins.filters.rules.gate import gate
from robins.filters.rules.sage_husa import sage_husa
from robins.filters.rules.variational_bayes import variational_bayes
from robins.manifold import Angle

T = 30
SYSTEM = random_system(2)
MODEL, START = SYSTEM.model(), SYSTEM.start()
Y = simulate(SYSTEM, 2, T, 0.2)[1]
SPLIT = {"near": slice(0, 2), "far": slice(2, 3)}
# The nominal noise changes from step to step, and is not that of the data.
SWELL = 0.6 + 0.5 * np.random.default_rng(0).random(T)


def scaled_cov(nominal, scale):
    root = np.sqrt(scale)
    return nominal * root[:, None] * root[None, :]


# ------------------------------------------------------------------------------------- Sage-Husa


def two_sensors() -> tuple:
    """The system with its measurement split in two, with what each needs."""
    F, G, H, W = (jnp.array(a) for a in SYSTEM[:4])
    sensors = tuple(
        Sensor(Partial(times, H[part]), lambda x, aux: aux, len(H[part]), name)
        for name, part in SPLIT.items()
    )
    aux = {name: SWELL[:, None, None] * np.array(W[part]) for name, part in SPLIT.items()}
    return Model(Motion(Partial(times, F), G), sensors), {k: Y[:, p] for k, p in SPLIT.items()}, aux


def dense_sage_husa(adapt, b, low, high):
    """Means, covariances, and the scales of R by sensor and of Q after each step."""
    F, Q0, H = SYSTEM.F, SYSTEM.Q, SYSTEM.H
    m, P = SYSTEM.m0, SYSTEM.P0
    r, k_r = np.ones(3), np.zeros(3)
    q, k_q = np.ones(4), 0
    means, covariances, r_scales, q_scales = [], [], [], []
    share = lambda k: (1 - b) / (1 - b ** (k + 1))  # noqa: E731
    for k in range(T):
        m, moved = F @ m, F @ P @ F.T
        P, used = moved + scaled_cov(Q0, q), q.copy()
        correction = np.zeros(4)
        for part in SPLIT.values():
            here = np.flatnonzero(np.isfinite(Y[k, part])) + part.start
            if not len(here):
                continue
            C, e = H[here], Y[k, here] - H[here] @ m
            R0 = SWELL[k] ** 2 * SYSTEM.R[np.ix_(here, here)]
            if "R" in adapt:
                k_r[here] += 1
                d = share(k_r[here])
                sample = np.diag(np.outer(e, e) - C @ P @ C.T) / np.diag(R0)
                r[here] = np.clip((1 - d) * r[here] + d * sample, low, high)
            K = P @ C.T @ np.linalg.inv(C @ P @ C.T + scaled_cov(R0, r[here]))
            m, P = m + K @ e, (np.eye(4) - K @ C) @ P
            correction += K @ e
        if "Q" in adapt and np.any(np.isfinite(Y[k])):
            k_q += 1
            sample = np.diag(np.outer(correction, correction) + P - moved) / np.diag(Q0)
            q = np.clip((1 - share(k_q)) * q + share(k_q) * sample, low, high)
        means.append(m)
        covariances.append(P)
        r_scales.append(r.copy())
        q_scales.append(used)
    return np.array(means), np.array(covariances), np.array(r_scales), np.array(q_scales)


@pytest.mark.parametrize(("adapt", "form"), [("R", "sqrt"), ("Q", "joseph"), ("QR", "sqrt")])
def test_sage_husa_is_its_recursion(adapt, form):
    model, y, aux = two_sensors()
    rule = sage_husa(0.9, adapt, floor=0.3, ceiling=2.5)
    solution = run(kalman(rules=[rule], form=form), model, START, y, aux=aux)
    means, covariances, r, q = dense_sage_husa(adapt, 0.9, 0.3, 2.5)
    np.testing.assert_allclose(solution.mean, means, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(solution.covariance, covariances, rtol=1e-9, atol=1e-10)
    notes = {name: info.notes for name, info in solution.steps.info.items()}
    if "R" in adapt:
        got = [notes["near"][f"sage_husa.r_scale.{i}"] for i in (0, 1)]
        got = np.stack([*got, notes["far"]["sage_husa.r_scale.0"]], axis=1)
        np.testing.assert_allclose(got, r, rtol=1e-9)
        assert np.any((r > 0.3) & (r < 2.5) & (r != 1.0))
        assert {0.3, 2.5} <= set(r.ravel())  # the guard was at work on both sides
    if "Q" in adapt:
        for sensor in notes.values():
            got = np.stack([sensor[f"sage_husa.q_scale.{i}"] for i in range(4)], axis=1)
            np.testing.assert_allclose(got, q, rtol=1e-8)
        assert {0.3, 2.5} <= set(q.ravel())
    assert len(notes["far"]) == ("R" in adapt) + 4 * ("Q" in adapt)


def seen(residual, accepted=(True, True), deficit=None) -> Observation:
    """An observation of two components, with all kinds of covariance in it."""
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


def test_sage_husa_takes_all_of_the_prediction_from_the_innovation():
    # 5.25 and 2 are H P- H' + Omega, 4 and 2 the nominal variances; a deficit takes 1 of 5.25.
    rule = sage_husa(1.0, floor=1e-3, ceiling=1e3)
    memory = rule.init(START, {"y": 2})
    memory, prior, o = rule.before(memory, START, seen([5.0, 3.0]))
    assert prior is START
    scale = np.array([0.5 + 0.5 * (25 - 5.25) / 4, 0.5 + 0.5 * (9 - 2) / 2])
    np.testing.assert_allclose(memory[0]["y"].ratio, scale, rtol=1e-14)
    np.testing.assert_allclose(o.noise, seen([0, 0]).noise * np.sqrt(scale)[:, None], rtol=1e-14)
    less = rule.before(memory, START, seen([5.0, 3.0], deficit=jnp.array([1.0, 0.0])))[0]
    third = 2 / 3 * scale[0] + (25 - 4.25) / 4 / 3
    assert float(less[0]["y"].ratio[0]) == pytest.approx(third, rel=1e-14)
    # refused: nothing learnt, but the noise stays as known
    kept, _, o = rule.before(memory, START, seen([99.0, 3.0], accepted=(False, True)))
    assert float(kept[0]["y"].ratio[0]) == scale[0]
    assert kept[0]["y"].samples.tolist() == [1, 2]
    assert float(o.noise[0, 0]) == pytest.approx(2.0 * np.sqrt(scale[0]))


# ------------------------------------------------------------------------------ variational Bayes


def dense_variational_bayes(y, W, rho, iterations, dof, low, high):
    """The recursion of the paper: each iteration a whole update of the state."""
    F, Q, H, R0 = SYSTEM.F, SYSTEM.Q, SYSTEM.H, W @ W.T
    m, P = SYSTEM.m0, SYSTEM.P0
    a, b = np.full(3, dof / 2), np.full(3, dof / 2)
    means, covariances, scales = [], [], []
    scale = b / a
    for row in y:
        m, P = F @ m, F @ P @ F.T + Q
        here = np.flatnonzero(np.isfinite(row))
        scale = b / a
        if len(here):
            C, R = H[here], R0[np.ix_(here, here)]
            a[here] = rho * a[here] + 0.5
            first = rho * b[here]
            b[here], x, V = first, m, P
            for _ in range(iterations):
                scale[here] = np.clip(b[here] / a[here], low, high)
                S = C @ P @ C.T + scaled_cov(R, scale[here])
                K = P @ C.T @ np.linalg.inv(S)
                x, V = m + K @ (row[here] - C @ m), (np.eye(4) - K @ C) @ P
                left = (row[here] - C @ x) ** 2 + np.diag(C @ V @ C.T)
                b[here] = first + 0.5 * left / np.diag(R)
            b[here] = np.clip(b[here], low * a[here], high * a[here])
            m, P = x, V
        means.append(m)
        covariances.append(P)
        scales.append(scale)
    return np.array(means), np.array(covariances), np.array(scales)


@pytest.mark.parametrize(("form", "iterations"), [("sqrt", 3), ("joseph", 1)])
def test_variational_bayes_is_its_recursion(form, iterations):
    rule = variational_bayes(0.9, iterations, initial_dof=6.0, floor=0.8, ceiling=1.05)
    solution = run(kalman(rules=[rule], form=form), MODEL, START, Y)
    want = dense_variational_bayes(Y, SYSTEM.W, 0.9, iterations, 6.0, 0.8, 1.05)
    np.testing.assert_allclose(solution.mean, want[0], rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(solution.covariance, want[1], rtol=1e-9, atol=1e-10)
    notes = solution.steps.info["y"].notes
    got = np.stack([notes[f"variational_bayes.r_scale.{i}"] for i in range(3)], axis=1)
    np.testing.assert_allclose(got, want[2], rtol=1e-9)
    assert {0.8, 1.05} <= set(want[2].ravel())


def test_variational_bayes_takes_later_weights_for_the_nominal_noise():
    def double(memory, prior, o):
        return memory, prior, o._replace(noise=2.0 * o.noise)

    def first(rules, sensor):
        one = kalman(rules=rules)
        state, _ = jax.jit(one.update)(one.init(START, MODEL.dims), sensor, jnp.array(Y[1]))
        return state.memory[0]["y"]

    rule = variational_bayes(iterations=1)
    twice = SYSTEM._replace(W=2.0 * SYSTEM.W).model()
    got = first([rule, Rule(before=double)], MODEL.sensors[0])
    want = first([rule], twice.sensors[0])
    for a, b in zip(got, want, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)
    assert np.all(np.abs(want.rate - want.shape) > 1e-3)


# ------------------------------------------------------------------------------------------ laws

EVERYTHING = [sage_husa(adapt="QR"), variational_bayes()]


def test_a_band_of_nothing_is_the_kalman_filter():
    fixed = [sage_husa(0.9, "QR", 1.0, 1.0), variational_bayes(0.9, 2, 5.0, 1.0, 1.0)]
    got, want = (run(kalman(rules=r), MODEL, START, Y) for r in (fixed, []))
    np.testing.assert_array_equal(got.mean, want.mean)
    np.testing.assert_array_equal(got.covariance, want.covariance)
    np.testing.assert_allclose(got.mean, kalman_filter(SYSTEM, Y)[0], rtol=1e-9, atol=1e-10)


def learnt(state) -> list:
    """What each rule of EVERYTHING knows of the components of the sensor."""
    (sensors, _), gammas, *_ = state.memory
    return [*sensors["y"], *gammas["y"]]


def test_nothing_measured_or_refused_teaches_nothing():
    one = kalman(rules=[gate(0.99), *EVERYTHING])
    update = jax.jit(one.update)
    known = lambda state: learnt(state._replace(memory=state.memory[1:]))  # noqa: E731
    state, _ = update(one.init(START, MODEL.dims), MODEL.sensors[0], jnp.array(Y[1]))
    gone, info = update(state, MODEL.sensors[0], jnp.full(3, jnp.nan))
    assert int(info.code) == Code.MISSING
    for a, b in zip(jax.tree.leaves(gone), jax.tree.leaves(state), strict=True):
        np.testing.assert_array_equal(a, b)
    refused, info = update(state, MODEL.sensors[0], jnp.full(3, 1e4))
    assert int(info.code) == Code.REFUSED
    for a, b in zip(known(refused), known(state), strict=True):
        np.testing.assert_array_equal(a, b)
    in_part, info = update(state, MODEL.sensors[0], jnp.array([np.nan, 1.0, np.nan]))
    assert int(info.code) == Code.PARTLY_MISSING
    for a, b in zip(known(in_part), known(state), strict=True):
        assert (a == b).tolist() == [True, False, True]


def test_what_a_later_gate_refuses_does_not_reach_variational_bayes():
    one = kalman(rules=[variational_bayes(ceiling=2.0), gate(0.99)])
    state = one.init(START, MODEL.dims)
    after, info = jax.jit(one.update)(state, MODEL.sensors[0], jnp.full(3, 1e4))
    assert int(info.code) == Code.REFUSED
    for a, b in zip(after.memory[0]["y"], state.memory[0]["y"], strict=True):
        np.testing.assert_array_equal(a, b)


def test_forms_and_ways_agree_and_stream():
    base = run(kalman(rules=EVERYTHING), MODEL, START, Y)
    sigma = kalman(unscented(), EVERYTHING, form="joseph")
    other = run(sigma, MODEL, START, Y)
    np.testing.assert_allclose(other.mean, base.mean, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(other.covariance, base.covariance, rtol=1e-8, atol=1e-9)
    live = OnlineFilter(sigma, MODEL, START)
    for row in Y:
        live.predict()
        live.update(row)
    for a, b in zip(jax.tree.leaves(live.state), jax.tree.leaves(other.final), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)


def turning(start_rad):
    """A heading that is measured while it turns; noise of another size than is said."""
    step = lambda x, u: {"heading": x["heading"].retract(0.2 * x["rate"]), "rate": x["rate"]}  # noqa: E731
    sensor = Sensor(lambda x, aux: x["heading"], jnp.array([0.05]), 1)
    model = Model(Motion(step, jnp.array([0.01, 0.01])), (sensor,))
    mean = {"heading": Angle(jnp.array(start_rad)), "rate": jnp.array([1.0])}
    t = 0.2 * np.arange(1, 41)
    noise = 0.15 * np.random.default_rng(1).normal(size=40)
    return model, Belief.of(mean, np.diag([0.01, 0.04])), t + noise


def test_an_angle_that_wraps_teaches_what_one_that_does_not_would():
    one = kalman(rules=[sage_husa(adapt="Q"), variational_bayes()])
    scales = []
    for start_rad in (0.0, 3.0):  # crossing pi after 16 steps and after 1
        model, start, seen_rad = turning(start_rad)
        y = Angle(np.angle(np.exp(1j * (seen_rad + start_rad))))
        solution = run(one, model, start, y)
        scales.append(solution.steps.info["y"].notes)
    for name, values in scales[0].items():
        np.testing.assert_allclose(values, scales[1][name], rtol=1e-9)
    assert float(scales[0]["variational_bayes.r_scale.0"][-1]) > 3.0


def test_gradients_are_right_with_components_missing():
    rules = [sage_husa(0.9, "QR", 0.01, 100.0), variational_bayes(0.9)]
    one = kalman(rules=rules, form="joseph")
    y = np.array([[0.5, 1.0], [np.nan, 2.0], [np.nan, np.nan], [3.0, 2.5]])

    @jax.jit
    def surprise(size):
        motion = Motion(lambda x, u: jnp.stack([x[0] + x[1], x[1]]), size * jnp.array([0.1, 0.2]))
        model = Model(motion, (Sensor(lambda x, aux: x, size * jnp.array([1.0, 0.5]), 2),))
        return run(one, model, Belief(jnp.zeros(2), jnp.eye(2)), y).log_likelihood

    at, h = jnp.array(1.3), 1e-5
    by_difference = (surprise(at + h) - surprise(at - h)) / (2 * h)
    assert float(jax.jit(jax.grad(surprise))(at)) == pytest.approx(float(by_difference), rel=1e-6)
