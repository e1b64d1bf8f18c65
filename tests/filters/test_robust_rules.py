"""Robust rules against recursions written with inverses, their limits, and planted outliers."""

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import random_system, simulate
from in_lanes import each
from interpreted import run
from jax.tree_util import Partial
from scipy import optimize, stats

from robins.filters import Belief, Code, Model, Motion, Sensor, kalman
from robins.filters.rules import (
    correntropy,
    discriminator,
    equality,
    gate,
    huber,
    igg3,
    inequality,
    only,
    projection,
    student_t,
)
from robins.rotation import Rotation
from robins.systems.gnss.weights import by_component, huber_weight

T = 60
SYSTEM = random_system(2)
MODEL, START = SYSTEM.model(), SYSTEM.start()


def spoiled(seed: int) -> np.ndarray:
    """A run with gaps, outliers of all sizes in single components and in all, and a jump."""
    rng = np.random.default_rng(seed)
    y = simulate(SYSTEM, 2, T, 0.1)[1]
    y += np.where(rng.random(y.shape) < 0.1, 10.0 ** rng.uniform(0.5, 4.0, y.shape), 0.0)
    y[20] += 50.0 * rng.normal(size=3)
    y[40:] += 200.0
    y[30] = np.nan
    return y


Y = spoiled(1)

# ----------------------------------------------------------------------- by the book, with inverses


class Adapted(NamedTuple):
    """A prior and a noise covariance as a rule leaves them, the components kept, what it notes."""

    P: np.ndarray
    R: np.ndarray
    keep: np.ndarray
    notes: dict


def update(m, P, H, R, z):
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return m + K @ (z - H @ m), (np.eye(len(m)) - K @ H) @ P


def book_huber(m, P, H, R, z, memory, limit=None):
    r = z - H @ m
    k2 = stats.chi2.ppf(0.99, len(z)) if limit is None else limit**2

    def nis(s):
        return r @ np.linalg.solve(H @ P @ H.T + s * R, r)

    s = 1.0
    if nis(1.0) > k2:
        s = optimize.brentq(lambda s: nis(s) / k2 - 1.0, 1.0, 1e11, xtol=1e-12, rtol=1e-14)
    return Adapted(P, s * R, np.full(len(z), True), {"huber.weight": 1 / s}), memory


def book_igg3(m, P, H, R, z, memory, floor=0.01, patience=4):
    k0, k1 = 1.5, 4.0
    r = z - H @ m
    t = np.abs(r) / np.sqrt(np.diag(H @ P @ H.T + R))
    w = []
    for one in t:
        if one <= k0:
            w.append(1.0)
        elif one < k1:
            w.append(max(k0 / one * ((k1 - one) / (k1 - k0)) ** 2, floor))
        else:
            w.append(0.0 if floor * one > k0 else floor)
    w = np.array(w)
    recovered = np.all(w <= floor) and memory >= patience
    if recovered:
        G = P @ H.T @ np.linalg.inv(H @ P @ H.T)
        a = 1 / k0**2 - 1 / np.max(t) ** 2
        told = np.diag(G @ H @ P) / np.diag(P)
        more = np.max(r**2 / np.diag(H @ P @ H.T)) * np.sqrt(np.outer(told, told)) * (P - G @ H @ P)
        P, w = P + a * np.outer(G @ r, G @ r) + more, np.ones(len(z))
        assert np.max(np.abs(r) / np.sqrt(np.diag(H @ P @ H.T + R))) < k0 * (1 + 1e-9)
        memory = 0
    else:
        memory = memory + 1 if np.all(w <= floor) else 0
    keep = w > 0.0
    safe = np.where(keep, w, 1.0)
    notes = {"igg3.weight": np.min(w), "igg3.recovered": recovered}
    return Adapted(P, R / np.sqrt(np.outer(safe, safe)), keep, notes), memory


def book_student_t(m, P, H, R, z, memory, both=False):
    nu, b, c = 4.0, 1.0, 1.0
    for _ in range(3):
        m_, P_ = update(m, b * P, H, c * R, z)
        e, d = z - H @ m_, m_ - m
        D = e @ np.linalg.solve(R, e) + np.trace(np.linalg.solve(R, H @ P_ @ H.T))
        E = d @ np.linalg.solve(P, d) + np.trace(np.linalg.solve(P, P_))
        c = (nu + D) / (nu + len(z))
        b = (nu + E) / (nu + len(m)) if both else 1.0
    notes = {"student_t.weight": 1 / c, "student_t.prior": 1 / b}
    return Adapted(b * P, c * R, np.full(len(z), True), notes), memory


def book_correntropy(m, P, H, R, z, memory):
    sigma, w = 2.5, np.ones(len(z))
    for _ in range(4):
        m_, _ = update(m, P, H, R / np.sqrt(np.outer(w, w)), z)
        e = (z - H @ m_) / np.sqrt(np.diag(R))
        w = np.maximum(np.exp(-(e**2) / (2 * sigma**2)), 1e-3 / (1e5 + np.abs(e)))
    scaled = R / np.sqrt(np.outer(w, w))
    return Adapted(P, scaled, np.full(len(z), True), {"correntropy.weight": np.min(w)}), memory


def by_the_book(s, y, adapt):
    """Means, covariances and notes of a filter that adapts each update."""
    m, P, memory, out = s.m0, s.P0, 0, []
    for row in y:
        m, P = s.F @ m, s.F @ P @ s.F.T + s.Q
        here = np.isfinite(row)
        notes = None
        if np.any(here):
            H, R, z = s.H[here], s.R[np.ix_(here, here)], row[here]
            (P, R, keep, notes), memory = adapt(m, P, H, R, z, memory)
            if np.any(keep):
                m, P = update(m, P, H[keep], R[np.ix_(keep, keep)], z[keep])
        out.append((m, P, notes))
    means, covariances, notes = zip(*out, strict=True)
    return np.array(means), np.array(covariances), notes


PAIRS = {
    "huber": (huber(0.99), book_huber),
    "huber by threshold": (huber(threshold=2), lambda *a: book_huber(*a, limit=2.0)),
    "igg3": (igg3(floor=0.01, patience=4), book_igg3),
    "igg3 that refuses": (igg3(floor=0.0, patience=4), lambda *a: book_igg3(*a, floor=0.0)),
    "student_t": (student_t(4.0), book_student_t),
    "student_t of both": (student_t(4.0, whose="both"), lambda *a: book_student_t(*a, both=True)),
    "correntropy": (correntropy(2.5, 4), book_correntropy),
}


@pytest.mark.parametrize("name", PAIRS)
def test_a_rule_by_the_book(name):
    rule, adapt = PAIRS[name]
    solution = run(kalman(rules=[rule]), MODEL, START, Y)
    means, covariances, notes = by_the_book(SYSTEM, Y, adapt)
    np.testing.assert_allclose(solution.mean, means, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(solution.covariance, covariances, rtol=1e-7, atol=1e-7)
    info = solution.steps.info["y"]
    seen = [k for k in range(T) if notes[k] is not None]
    assert seen == [k for k in range(T) if info.code[k] != Code.MISSING]
    for note in notes[seen[0]]:
        want = np.array([notes[k][note] for k in seen], dtype=float)
        got = np.asarray(info.notes[note])
        np.testing.assert_allclose(got[seen], want, rtol=1e-6, atol=1e-12)
        others = np.delete(got, seen)
        assert np.all(others == (0.0 if note.endswith("recovered") else 1.0))
        assert note == "student_t.prior" or np.ptp(want) > 0.5
    if "igg3" in name:
        assert 0 < sum(n["igg3.recovered"] for n in notes if n) < 5


# Each rule with two numbers of each kind, whole ones too, and with `None` where that is a number.
NUMBERS = [
    (igg3, {"k0": 1, "k1": 4, "floor": 0, "patience": 3}, {"k0": 1.5, "floor": 1e-3}),
    (student_t, {"dof": 4, "patience": 2}, {"dof": 7.5, "patience": 30}),
    (correntropy, {"kernel": 2}, {"kernel": math.inf, "patience": 3}),
    (discriminator, {"patience": 2, "limit": 5, "threshold": 3}, {"rho": 0.5, "looks": 100}),
    (
        discriminator,
        {"fade": "multiple", "weights": [1, 2]},
        {"fade": "multiple", "weights": [3, 0.5], "robust": "huber"},
    ),
    (partial(projection, "y"), {"weight": np.eye(2, dtype=int)}, {"weight": 2.5 * np.eye(2)}),
    (
        partial(equality, [[1, 0]]),
        {"d": [2], "noise": [1], "gate": 0.9},
        {"d": np.array([0.5]), "noise": [0.1], "gate": 0.99},
    ),
    (partial(inequality, [[1, 0]]), {"lower": [1]}, {"lower": [-1.5], "upper": [3]}),
    (by_component, {"weight": huber_weight(1.0)}, {"weight": huber_weight(2.5)}),
    (partial(only, "y"), {"rule": gate(0.9, 2)}, {"rule": gate(0.99, 7)}),
]


@pytest.mark.parametrize(("rule", "given", "other"), NUMBERS)
def test_numbers_are_data_of_64_bits_and_choose_no_program(rule, given, other):
    (numbers, kinds), (others, same) = map(jax.tree.flatten, (rule(**given), rule(**other)))
    assert kinds == same
    assert {(type(x), x.dtype) for x in numbers} <= {
        (np.ndarray, np.dtype(float)),
        (np.float64, np.dtype(float)),
    }
    assert [x.shape for x in numbers] == [x.shape for x in others]
    assert any(np.any(x != y) for x, y in zip(numbers, others, strict=True))


@pytest.mark.parametrize(
    "rule",
    [
        lambda x: by_component(Partial(jnp.multiply, x)),
        lambda x: inequality(jnp.eye(4)[:1], -x[None] - 1.0),
        lambda x: equality(x * jnp.eye(4)[:1], x[None], noise=x[None]),
        lambda x: projection("y", x * jnp.eye(4) + 1.0),
    ],
)
def test_a_constructor_takes_a_stand_in_for_a_number(rule):
    made = jax.eval_shape(rule, jnp.asarray(1.5))
    assert jax.tree.structure(made) == jax.tree.structure(rule(jnp.asarray(1.5)))


# --------------------------------------------------------------------------------- planted outliers

RUNS, LONG = 48, 150
F = np.kron([[1.0, 1.0], [0.0, 1.0]], np.eye(2))  # 1 s steps of a point in a plane
G = 0.03 * np.kron([[0.5], [1.0]], np.eye(2))
PLANE = Model(
    Motion(lambda x, u: jnp.asarray(F) @ x, jnp.asarray(G)),
    (Sensor(lambda x, aux: x[:2], jnp.ones(2), 2),),
)
STILL = Belief.of(jnp.zeros(4), np.eye(4))


def outliers():
    """Truth, and measurements of it (case, run, step, 2) with faults as the fault list has them."""
    rng = np.random.default_rng(5)
    x = rng.normal(size=(RUNS, 4))
    truth = []
    for _ in range(LONG):
        x = x @ F.T + rng.normal(size=(RUNS, 2)) @ G.T
        truth.append(x[:, :2])
    truth = np.stack(truth, axis=1)
    clean = truth + rng.normal(size=truth.shape)

    def direction():
        d = rng.normal(size=truth.shape)
        return d / np.linalg.norm(d, axis=2, keepdims=True)

    def share(part, sigmas):
        return clean + np.where(rng.random((RUNS, LONG, 1)) < part, sigmas * direction(), 0.0)

    once = clean + 1e9 * direction() * (np.arange(LONG) == 75)[:, None]
    return truth, np.stack([clean, once, share(0.05, 10.0), share(0.3, 5.0)])


TRUTH, FAULTY = outliers()


def rmse(*rules):
    """Position error [m] of each case."""
    one = kalman(rules=rules)

    def means(y):
        return run(one, PLANE, STILL, y, keep=lambda step: step.posterior.mean[:2]).steps

    every = FAULTY.reshape(-1, LONG, 2)
    found = np.asarray(each(means)(every)).reshape(FAULTY.shape)
    return np.sqrt(np.mean(np.sum((found - TRUTH) ** 2, axis=-1)[:, :, 10:], axis=(1, 2)))


@pytest.fixture(scope="module")
def plain():
    return rmse()


def test_the_kalman_filter_fails_on_outliers(plain):
    assert plain[1] / plain[0] > 1e6
    assert plain[2] / plain[0] > 1.5
    assert plain[3] / plain[0] > 1.8


@pytest.mark.parametrize(
    ("rule", "bounds"),
    [
        (huber(), (1.01, 1.1, 1.3, 2.0)),
        (student_t(), (1.05, 1.1, 1.3, 2.0)),
        (correntropy(), (1.02, 1.1, 1.3, 2.0)),
        # What leaves out five sigma leaves out too much when a third is like that.
        (gate(0.99), (1.05, 1.1, 1.3, math.inf)),
        (igg3(floor=0.0), (1.12, 1.12, 1.3, math.inf)),
    ],
    ids=["huber", "student_t", "correntropy", "gate", "igg3"],
)
def test_outliers_cost_a_robust_filter_little(rule, bounds, plain):
    got = rmse(rule) / plain[0]
    assert np.all(got < bounds), got


# ---------------------------------------------------------------------------------------- manifold

STAR = Sensor(lambda x, aux: x["attitude"], jnp.full(3, 1e-4), 3)
TUMBLING = Model(
    Motion(
        lambda x, u: {
            **x,
            "attitude": x["attitude"].retract(0.1 * (jnp.array([0.3, 2.0, -1.0]) - x["bias"])),
        },
        jnp.concatenate([jnp.full(3, 1e-5), jnp.full(3, 1e-7)]),
    ),
    (STAR,),
)


@jax.jit
@jax.vmap
def tumbling(turned, fault):
    """An attitude, and a star frame of it with an error."""
    truth = Rotation.identity().retract(turned)
    return truth, truth.retract(fault)


apart = jax.jit(jax.vmap(lambda a, b: a.local(b)))


def test_star_frames_wrong_by_ten_degrees_do_not_turn_an_attitude():
    rng = np.random.default_rng(3)
    rate, bias, steps = np.array([0.3, 2.0, -1.0]), np.array([1e-4, -1e-4, 0.0]), 40
    turned = 0.1 * np.arange(1.0, steps + 1.0)[:, None] * (rate - bias)
    fault = 1e-4 * rng.normal(size=(steps, 3)) + 0.17 * (np.arange(steps) == 25)[:, None]
    truth, frames = tumbling(turned, fault)
    start = {"attitude": Rotation.identity(), "bias": jnp.zeros(3)}
    belief = Belief.of(start, np.diag([1e-4] * 3 + [1e-8] * 3))
    rules = (huber(), igg3(), student_t(), correntropy())
    robust, plain = (run(kalman(rules=r), TUMBLING, belief, frames) for r in (rules, ()))
    errors = [apart(s.mean["attitude"], truth) for s in (robust, plain)]
    worst = [float(np.max(np.linalg.norm(error, axis=1)[5:])) for error in errors]
    assert worst[0] < 3e-4
    assert worst[1] > 0.03  # contrast
    assert np.all(np.abs(robust.mean["bias"][-1] - bias) < 5 * robust.sigma[-1, 3:])
