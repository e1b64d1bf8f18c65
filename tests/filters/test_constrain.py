"""Equality constraints, against null spaces, normal equations and a general optimiser."""

import json
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import random_system, simulate
from interpreted import run
from scipy import optimize, stats
from scipy.linalg import null_space
from two_sensors import by_sensor, split

from robins import manifold
from robins.filters import Belief, Code, kalman, taylor, unscented
from robins.filters.limits.constrain import constrain
from robins.filters.rules.equality import equality
from robins.manifold import Angle
from robins.rotation import Rotation

N, C, DRAWS = 5, 2, 40
HOLD = jax.jit(constrain, static_argnames=("weight", "hard"))  # D and d are data


def draws(seed=0):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(DRAWS, N, N)) * 10.0 ** rng.uniform(-2, 2, size=(DRAWS, N, 1))
    B = rng.normal(size=(DRAWS, N, N))
    return {
        "m": rng.normal(size=(DRAWS, N)),
        "P": A @ np.swapaxes(A, 1, 2),
        "D": rng.normal(size=(DRAWS, C, N)),
        "d": rng.normal(size=(DRAWS, C)),
        "W": B @ np.swapaxes(B, 1, 2) + 0.1 * np.eye(N),
        "L": np.tril(rng.normal(size=(DRAWS, C, C))) + np.eye(C),
    }


DRAWN = draws()
FACTOR = np.stack([np.asarray(Belief.of(np.zeros(N), P).factor) for P in DRAWN["P"]])


@cache
def all_held(weight="covariance", noise=False, hard=False):
    """Every draw constrained, in one compilation."""

    def one(m, S, D, d, W, L):
        metric = W if weight == "matrix" else weight
        return constrain(Belief(m, S), D, d, metric, L if noise else None, hard)

    given = (DRAWN["m"], FACTOR, *(DRAWN[k] for k in ("D", "d", "W", "L")))
    return jax.tree_util.tree_map(np.asarray, jax.jit(jax.vmap(one))(*given))


def by_null_space(m, D, d, W):
    """Nearest state on the constraint and the map of errors: x = p + Z z with D p = d, D Z = 0."""
    Z, p = null_space(D), np.linalg.lstsq(D, d)[0]
    along = Z @ np.linalg.solve(Z.T @ W @ Z, Z.T @ W)  # I - J
    return p + along @ (m - p), along


def metric_of(weight, k):
    return {"covariance": np.linalg.inv(DRAWN["P"][k]), "identity": np.eye(N)}.get(
        weight, DRAWN["W"][k]
    )


@pytest.mark.parametrize("weight", ["covariance", "identity", "matrix"])
def test_an_exact_constraint_is_the_nearest_point_of_its_null_space(weight):
    held = all_held(weight)
    for k in range(DRAWS):
        m, P, D, d = (DRAWN[key][k] for key in "mPDd")
        mean, along = by_null_space(m, D, d, metric_of(weight, k))
        scale = np.sqrt(np.diag(P))
        np.testing.assert_allclose(held.belief.mean[k], mean, atol=1e-8 * np.max(scale))
        want = along @ P @ along.T
        np.testing.assert_allclose(
            held.belief.covariance[k], want, atol=1e-9 * np.max(P), rtol=1e-6
        )
        got = D @ np.asarray(held.belief.mean[k]) - d
        assert np.max(np.abs(got)) <= 1e-12 * np.max(np.abs(D) @ np.abs(mean) + np.abs(d))
        np.testing.assert_allclose(held.residual[k], d - D @ m, rtol=1e-10, atol=1e-12)
        square = held.residual[k] @ np.linalg.solve(D @ P @ D.T, held.residual[k])
        assert float(held.nis[k]) == pytest.approx(square, rel=1e-6)
        assert int(held.dof[k]) == C


def test_no_trace_grows():
    P = DRAWN["P"]
    least = {}
    for weight in ("covariance", "identity"):
        after = np.asarray(all_held(weight).belief.covariance)
        traces = np.trace(after, axis1=1, axis2=2), np.trace(P, axis1=1, axis2=2)
        assert np.all(traces[0] <= traces[1] * (1 + 1e-13))
        least[weight] = np.linalg.eigvalsh(P - after)[:, 0] / traces[1]
    assert np.all(least["covariance"] > -1e-12)  # no variance grows in any direction
    assert np.sum(least["identity"] < -1e-3) > DRAWS / 4  # some do, as the metric is not P's


def test_a_noisy_constraint_is_information_added():
    held = all_held(noise=True)
    for k in range(DRAWS):
        m, P, D, d, L = (DRAWN[key][k] for key in "mPDdL")
        before, of_it = np.linalg.inv(P), D.T @ np.linalg.inv(L @ L.T)
        want = np.linalg.inv(before + of_it @ D)
        mean = want @ (before @ m + of_it @ d)
        scale = np.sqrt(np.max(np.diag(P)))
        np.testing.assert_allclose(held.belief.mean[k], mean, rtol=1e-7, atol=1e-8 * scale)
        np.testing.assert_allclose(held.belief.covariance[k], want, atol=1e-8 * np.max(want))


@pytest.mark.parametrize("weight", ["covariance", "identity", "matrix"])
def test_hard_on_a_noisy_constraint_counts_its_noise(weight):
    held = all_held(weight, noise=True, hard=weight == "covariance")
    exact = all_held(weight)
    np.testing.assert_allclose(held.belief.mean, exact.belief.mean, rtol=1e-12)
    for k in range(DRAWS):
        m, P, D, d, L = (DRAWN[key][k] for key in "mPDdL")
        _, along = by_null_space(m, D, d, metric_of(weight, k))
        G = (np.eye(N) - along) @ np.linalg.pinv(D)  # J = G D, D pinv(D) = I
        want = along @ P @ along.T + G @ L @ L.T @ G.T
        np.testing.assert_allclose(held.belief.covariance[k], want, atol=1e-9 * np.max(want))


@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.0])
def test_hard_beats_nothing_only_below_the_uncertainty_it_meets(ratio):
    # With R_d = r D P D' the trace is linear in r for a hard constraint, and what is gained falls
    # by 1 + r for a weighed one: 73.9 -> 59.6, 73.9, 102.5 and 54.8, 59.6, 64.3 of the airship.
    P, D = DRAWN["P"][0], DRAWN["D"][0]
    belief = Belief(jnp.zeros(N), jnp.asarray(FACTOR[0]))
    root = np.linalg.cholesky(ratio * D @ P @ D.T)
    none = np.trace(P)
    exact = np.trace(HOLD(belief, D).belief.covariance)
    hard = np.trace(HOLD(belief, D, noise=root, hard=True).belief.covariance)
    soft = np.trace(HOLD(belief, D, noise=root).belief.covariance)
    assert hard == pytest.approx(exact + ratio * (none - exact), rel=1e-9)
    assert soft == pytest.approx(none - (none - exact) / (1 + ratio), rel=1e-9)
    assert (hard < none * (1 - 1e-9)) == (ratio < 1.0)


def test_reference_numbers(cases_dir):
    done = 0
    for path in sorted(cases_dir.glob("*.json")):
        case = json.loads(path.read_text("utf-8"))
        if case["kind"] != "constrain_equality":
            continue
        m, P, D, d = (np.array(case["given"][k], float) for k in "mPDd")
        held = HOLD(Belief.of(m, P), D, d).belief
        for got, name in ((held.mean, "m"), (held.covariance, "P")):
            want = np.array(case["expected"][name])
            allowed = case["atol"] + case["rtol"] * np.max(np.abs(want))
            assert np.max(np.abs(got - want)) <= allowed
        done += 1
    if not done:
        pytest.skip("no case of kind constrain_equality")


# ---------------------------------------------------------------------------- singular and curved


def test_what_is_held_already_is_left_alone():
    belief = Belief(jnp.asarray(DRAWN["m"][1]), jnp.asarray(FACTOR[1]))
    D, d = DRAWN["D"][1], DRAWN["d"][1]
    once = HOLD(belief, D, d).belief
    twice = HOLD(once, D, d)
    np.testing.assert_array_equal(twice.belief.mean, once.mean)
    np.testing.assert_array_equal(twice.belief.factor, once.factor)
    assert int(twice.dof) == 0
    near = HOLD(belief, D, d, weight="identity").belief
    again = HOLD(near, D, d, weight="identity").belief
    np.testing.assert_allclose(again.mean, near.mean, rtol=1e-13)
    np.testing.assert_allclose(
        again.covariance, near.covariance, atol=1e-13 * np.max(DRAWN["P"][1])
    )


@pytest.mark.parametrize("weight", ["covariance", "identity"])
def test_a_rank_that_is_lost_at_run_time_makes_no_nan(weight):
    # Row 1 repeats row 0, and the last state is known exactly: neither may divide by nothing.
    D = jnp.array([[1.0, 1.0, 0.0], [2.0, 2.0, 0.0], [0.0, 0.0, 1.0]])
    S = jnp.array([[1.0, 0.0, 0.0], [0.2, 0.5, 0.0], [0.0, 0.0, 0.0]])

    def total(m):
        held = constrain(Belief(m, S), D, jnp.array([3.0, 6.0, 5.0]), weight)
        return jnp.sum(held.belief.mean) + jnp.sum(held.belief.factor**2), held

    slope, held = jax.jit(jax.grad(total, has_aux=True))(jnp.array([1.0, 1.0, 5.0]))
    assert held.used.tolist() == [True, False, weight == "identity"]
    np.testing.assert_allclose(held.belief.mean[0] + held.belief.mean[1], 3.0, rtol=1e-14)
    assert np.all(np.isfinite(held.belief.factor))
    assert np.all(np.isfinite(slope))


def circle(x):
    return x[0] ** 2 + x[1] ** 2


def test_a_curved_constraint_is_met_at_the_most_probable_point():
    m = np.array([1.5, 0.4, 2.0])
    P = np.array([[0.5, 0.1, 0.2], [0.1, 0.3, -0.1], [0.2, -0.1, 1.0]])
    belief, W = Belief.of(m, P), np.linalg.inv(P)
    want = optimize.minimize(
        lambda x: (x - m) @ W @ (x - m),
        m,
        method="SLSQP",
        constraints={"type": "eq", "fun": lambda x: x[0] ** 2 + x[1] ** 2 - 4.0},
        options={"ftol": 1e-15},
    ).x

    @partial(jax.jit, static_argnums=(0, 1))
    def found(iterations, weight="covariance"):
        return constrain(belief, circle, jnp.array(4.0), weight, iterations=iterations).belief

    off = [abs(float(circle(found(k).mean)) - 4.0) for k in (1, 2, 30)]
    assert off[1] < 0.2 * off[0]
    assert off[2] < 1e-13
    held = found(30)
    np.testing.assert_allclose(held.mean, want, atol=1e-6)
    across = np.array([*held.mean[:2], 0.0])
    assert across @ held.covariance @ across < 1e-13
    near = found(30, "identity").mean
    np.testing.assert_allclose(near[:2], m[:2] * 2.0 / np.hypot(*m[:2]), rtol=1e-7)
    assert float(near[2]) == pytest.approx(2.0, abs=1e-12)


def test_a_curved_constraint_has_the_slope_of_finite_differences():
    def total(scale):
        belief = Belief(scale * jnp.array([0.9, 0.3]), jnp.array([[0.2, 0.0], [0.1 * scale, 0.3]]))
        held = constrain(belief, circle, jnp.array(1.0), iterations=2)
        return held.nis + jnp.sum(held.belief.mean**3) + jnp.sum(held.belief.covariance**2)

    step = 1e-6
    value, slope = jax.jit(jax.vmap(jax.value_and_grad(total)))(1.0 + step * jnp.arange(-1.0, 2.0))
    assert float(slope[1]) == pytest.approx(float(value[2] - value[0]) / (2 * step), rel=1e-5)


def test_a_heading_is_held_on_a_manifold():
    start = {"attitude": Rotation.from_euler(0.1, -0.2, 3.1), "bias": jnp.array([0.1, 0.2])}
    A = np.random.default_rng(1).normal(size=(5, 5)) * 0.1
    belief = Belief.of(start, A @ A.T)
    heading = lambda x: Angle(x["attitude"].as_euler()[2])  # noqa: E731
    # 0.083 rad away, across half a turn
    hold = jax.jit(lambda b: constrain(b, heading, Angle(-3.1), iterations=8).belief)
    held = hold(belief)
    got = held.mean["attitude"].as_euler()[2]
    assert float(jnp.abs(manifold.wrap(got + 3.1))) < 1e-12
    # nothing is uncertain across it, in the tangent space of the belief that was held
    move = manifold.local(start, held.mean)
    slope = jax.jit(jax.grad(lambda e: heading(manifold.retract(start, e)).rad))(move)
    assert np.max(np.abs(slope @ held.factor)) < 1e-12
    with pytest.raises(ValueError, match="rotations needs d"):
        constrain(belief, heading)
    with pytest.raises(ValueError, match="as a function of the state"):
        constrain(belief, np.eye(1, 5))


# --------------------------------------------------------------------------------------- the rule

SYSTEM = random_system(4, n=4, m=3)
D, d = np.array([[1.0, -1.0, 0.0, 2.0]]), np.array([0.3])
T = 12
Y = simulate(SYSTEM, 5, T, 0.25)[1]
Y[3] = np.nan
TWO = split(SYSTEM._replace(W=np.diag([0.5, 0.7, 0.9])))
DATA = by_sensor(Y)


def recursion(noise=None, weight="covariance", gate=np.inf):
    """Textbook recursion: predict, near, constrain, far, constrain again where that is exact."""
    m, P = SYSTEM.m0, SYSTEM.P0
    means, covariances = [], []

    def update(m, P, H, R, y):
        here = np.isfinite(y)
        H, R = H[here], R[np.ix_(here, here)]
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        return m + K @ (y[here] - H @ m), P - K @ H @ P

    def hold(m, P):
        if noise is not None:
            return update(m, P, D, np.diag(noise**2), d)
        V = P if weight == "covariance" else np.eye(4)
        G = V @ D.T @ np.linalg.pinv(D @ V @ D.T, rcond=1e-12)
        J = np.eye(4) - G @ D
        return m - G @ (D @ m - d), J @ P @ J.T

    for k in range(T):
        m, P = SYSTEM.F @ m, SYSTEM.F @ P @ SYSTEM.F.T + SYSTEM.Q
        m, P = update(m, P, SYSTEM.H[:2], np.diag([0.25, 0.49]), Y[k, :2])
        m, P = hold(m, P)
        m, P = update(m, P, SYSTEM.H[2:], np.diag([0.81]), Y[k, 2:])
        if noise is None:
            m, P = hold(m, P)
        means.append(m)
        covariances.append(P)
    return np.array(means), np.array(covariances)


@pytest.mark.parametrize(
    ("way", "weight"), [(taylor(), "identity"), (unscented(), "covariance")], ids=["taylor", "ukf"]
)
def test_an_exact_rule_holds_after_every_sensor(way, weight):
    one = kalman(way, [equality(D.tolist(), d.tolist(), weight)])
    solution = run(one, TWO, SYSTEM.start(), DATA)
    means, covariances = recursion(weight=weight)
    np.testing.assert_allclose(solution.mean, means, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(solution.covariance, covariances, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(solution.mean @ D[0], d[0], atol=1e-12)
    assert float(solution.steps.info["a"].notes["equality.residual"][3]) > 1e-6  # all missing


def test_a_noisy_rule_counts_once_a_step():
    noise = np.array([0.4])
    solution = run(kalman(rules=[equality(D, d, noise=noise)]), TWO, SYSTEM.start(), DATA)
    means, covariances = recursion(noise)
    np.testing.assert_allclose(solution.mean, means, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(solution.covariance, covariances, rtol=1e-8, atol=1e-9)


def test_a_gate_refuses_a_constraint_that_the_measurements_deny():
    model, start = SYSTEM.model(), SYSTEM.start()
    plain = run(kalman(), model, start, Y)
    P, m = np.asarray(plain.covariance), np.asarray(plain.mean)
    wrong = m[-1] @ D[0] + 100.0
    held = run(kalman(rules=[equality(D, np.array([wrong]), gate=0.999)]), model, start, Y)
    nis = np.asarray(held.steps.info["y"].notes["equality.nis"])
    refused = np.asarray(held.steps.info["y"].notes["equality.refused"])
    np.testing.assert_array_equal(refused, nis > stats.chi2.ppf(0.999, 1))
    assert np.all(refused[1:])  # the last ones from a start that knows nothing yet
    first = int(np.argmin(refused)) if not np.all(refused) else T
    want = (wrong - m[:first] @ D[0]) ** 2 / (P[:first] @ D[0] @ D[0])
    np.testing.assert_allclose(nis[:first], want, rtol=1e-6)
    if first == T:
        np.testing.assert_array_equal(held.mean, plain.mean)


# -------------------------------------------------------------------------------------- the edge


def test_noise_makes_repeated_rows_welcome():
    rule = equality([[1.0, 0.0], [1.0, 0.0]], [1.0, 1.2], noise=[0.1, 0.1])
    assert rule.name == "equality"


def test_joseph_refuses_a_singular_covariance_or_is_right_about_it():
    """It is rounding, other on each processor, that makes the last pivot negative or not."""
    one, rows = kalman(form="joseph"), np.random.default_rng(1).normal(size=(64, 1, 4))
    start = SYSTEM.start()

    def updated(row):
        held = HOLD(start, row, d).belief
        state, info = one.update(one.init(held, TWO.dims), TWO.sensors[1], jnp.ones(1))
        return held, state.belief, info.code

    held, after, code = jax.tree.map(np.asarray, jax.jit(jax.vmap(updated))(rows))
    refused, P, H = code == Code.INDEFINITE, np.asarray(held.covariance), SYSTEM.H[2:]
    assert np.any(refused)
    assert np.all(refused | (code == Code.DONE))
    np.testing.assert_array_equal(after.factor[refused], held.factor[refused])
    PHt, R = P @ H.T, np.sum(np.square(TWO.sensors[1].noise))
    dense = P - PHt @ np.swapaxes(PHt, 1, 2) / (H @ PHt + R)
    np.testing.assert_allclose(after.covariance[~refused], dense[~refused], atol=1e-12)
