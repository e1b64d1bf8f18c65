"""Rules that learn the size of the noise, against the papers' recursions written with inverses."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import random_system, simulate
from interpreted import run
from rule_table import START as PRIOR
from rule_table import seen
from two_sensors import ROWS, by_sensor, split

from robins.filters import Code, Model, Rule, kalman
from robins.filters.rules.gate import gate
from robins.filters.rules.sage_husa import sage_husa
from robins.filters.rules.variational_bayes import variational_bayes

T = 30
SYSTEM = random_system(2)
MODEL, START = SYSTEM.model(), SYSTEM.start()
Y = simulate(SYSTEM, 2, T, 0.2)[1]
# The nominal noise changes from step to step, and is not that of the data.
SWELL = 0.6 + 0.5 * np.random.default_rng(0).random(T)


def scaled_cov(nominal, scale):
    root = np.sqrt(scale)
    return nominal * root[:, None] * root[None, :]


# ------------------------------------------------------------------------------------- Sage-Husa


def swelling() -> tuple:
    """The system with its measurement split in two, with what each needs."""
    model = split(SYSTEM)
    sensors = tuple(replace(s, noise=lambda x, aux: aux) for s in model.sensors)
    aux = {name: SWELL[:, None, None] * SYSTEM.W[part] for name, part in ROWS.items()}
    return Model(model.motion, sensors), by_sensor(Y), aux


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
        for part in ROWS.values():
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


@pytest.mark.parametrize(("adapt", "form"), [("R", "joseph"), ("QR", "sqrt")])
def test_sage_husa_is_its_recursion(adapt, form):
    model, y, aux = swelling()
    rule = sage_husa(0.9, adapt, floor=0.3, ceiling=2.5)
    solution = run(kalman(rules=[rule], form=form), model, START, y, aux=aux)
    means, covariances, r, q = dense_sage_husa(adapt, 0.9, 0.3, 2.5)
    np.testing.assert_allclose(solution.mean, means, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(solution.covariance, covariances, rtol=1e-9, atol=1e-10)
    notes = {name: info.notes for name, info in solution.steps.info.items()}
    got = [notes["a"][f"sage_husa.r_scale.{i}"] for i in (0, 1)]
    got = np.stack([*got, notes["b"]["sage_husa.r_scale.0"]], axis=1)
    np.testing.assert_allclose(got, r, rtol=1e-9)
    assert np.any((r > 0.3) & (r < 2.5) & (r != 1.0))
    assert {0.3, 2.5} <= set(r.ravel())  # the guard was at work on both sides
    if "Q" in adapt:
        for sensor in notes.values():
            got = np.stack([sensor[f"sage_husa.q_scale.{i}"] for i in range(4)], axis=1)
            np.testing.assert_allclose(got, q, rtol=1e-8)
        assert {0.3, 2.5} <= set(q.ravel())
    assert len(notes["b"]) == 1 + 4 * ("Q" in adapt)


def test_sage_husa_takes_all_of_the_prediction_from_the_innovation():
    # 5.25 and 2 are H P- H' + Omega, 4 and 2 the nominal variances; a deficit takes 1 of 5.25.
    rule = sage_husa(1.0, floor=1e-3, ceiling=1e3)
    memory = rule.init(PRIOR, {"y": 2})
    memory, prior, o = rule.before(memory, PRIOR, seen([5.0, 3.0]))
    assert prior is PRIOR
    scale = np.array([0.5 + 0.5 * (25 - 5.25) / 4, 0.5 + 0.5 * (9 - 2) / 2])
    np.testing.assert_allclose(memory[0]["y"].ratio, scale, rtol=1e-14)
    np.testing.assert_allclose(o.noise, seen([0, 0]).noise * np.sqrt(scale)[:, None], rtol=1e-14)
    less = rule.before(memory, PRIOR, seen([5.0, 3.0], deficit=jnp.array([1.0, 0.0])))[0]
    third = 2 / 3 * scale[0] + (25 - 4.25) / 4 / 3
    assert float(less[0]["y"].ratio[0]) == pytest.approx(third, rel=1e-14)
    # refused: nothing learnt, but the noise stays as known
    kept, _, o = rule.before(memory, PRIOR, seen([99.0, 3.0], accepted=(False, True)))
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


def test_what_a_later_gate_refuses_does_not_reach_variational_bayes():
    one = kalman(rules=[variational_bayes(ceiling=2.0), gate(0.99)])
    state = one.init(START, MODEL.dims)
    after, info = jax.jit(one.update)(state, MODEL.sensors[0], jnp.full(3, 1e4))
    assert int(info.code) == Code.REFUSED
    for a, b in zip(after.memory[0]["y"], state.memory[0]["y"], strict=True):
        np.testing.assert_array_equal(a, b)
