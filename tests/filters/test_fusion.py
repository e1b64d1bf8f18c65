"""Beliefs fused, shared out and intersected, against dense sums of inverses."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from dense_kalman import times
from jax.tree_util import Partial
from scipy.optimize import minimize

from robins import manifold
from robins.filters import Belief, Model, Motion, Sensor
from robins.filters.composite.channels import channel
from robins.filters.composite.federated import (
    diagonal_shares,
    equal_shares,
    floored,
    observability_shares,
    trace_shares,
)
from robins.filters.composite.fusion import (
    covariance_intersection,
    fuse,
    intersection_weights,
    share,
)
from robins.manifold import Angle
from robins.rotation import Rotation

N = 5
ONES = np.ones(N)
UNITS = 10.0 ** np.array([-7.0, 0.0, 4.0, -2.0, 1.0])  # rad/s beside metres


def random_belief(seed: int, unit=ONES) -> Belief:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(N, N)) * unit[:, None]
    return Belief.of(jnp.array(unit * rng.normal(size=N)), A @ A.T)


def information(belief: Belief) -> np.ndarray:
    return np.linalg.inv(np.asarray(belief.covariance))


def close(got, want, sigma, tolerance=1e-12):
    """Two covariances alike, in units of standard deviations."""
    np.testing.assert_allclose(
        got / np.outer(sigma, sigma), want / np.outer(sigma, sigma), atol=tolerance
    )


SHARES = np.random.default_rng(1).dirichlet([2.0, 1.0, 1.0], size=N).T  # (3, N)


# ------------------------------------------------------------------------------------------- fuse


@pytest.mark.parametrize("unit", [ONES, UNITS], ids=["alike", "of many units"])
@pytest.mark.parametrize("count", [1, 2, 4])
def test_fusion_is_the_sum_of_information(unit, count):
    beliefs = [random_belief(seed, unit=unit) for seed in range(count)]
    plain = [np.asarray(b.covariance) / np.outer(unit, unit) for b in beliefs]
    Y = [np.linalg.inv(P) for P in plain]
    P = np.linalg.inv(sum(Y))
    mean = P @ sum(y @ (np.asarray(b.mean) / unit) for y, b in zip(Y, beliefs, strict=True))
    got = fuse(beliefs)
    np.testing.assert_allclose(got.mean / unit, mean, rtol=1e-10, atol=1e-11)
    close(got.covariance, P * np.outer(unit, unit), np.asarray(got.sigma), 1e-10)
    np.testing.assert_array_equal(np.triu(got.factor, 1), 0.0)


def test_fusion_of_very_unequal_beliefs_keeps_the_digits_of_the_better():
    # Summed as matrices, 1e24 would swallow 1: here the closed form of two scalars a direction.
    good, poor = np.array([1e-12, 1.0, 1e6]), np.array([1e12, 1e6, 1e-6])
    a = Belief(jnp.array([1.0, 2.0, 3.0]), jnp.diag(jnp.array(good)))
    b = Belief(jnp.array([5.0, 5.0, 5.0]), jnp.diag(jnp.array(poor)))
    got = fuse([a, b])
    variance = 1.0 / (good**-2 + poor**-2)
    np.testing.assert_allclose(got.sigma**2, variance, rtol=1e-13)
    want = variance * (np.array([1.0, 2.0, 3.0]) / good**2 + 5.0 / poor**2)
    np.testing.assert_allclose(got.mean, want, rtol=1e-13)


def test_angles_on_either_side_of_pi_meet_there():
    def at(rad, sigma):
        mean = {"a": Angle(jnp.array(rad)), "b": jnp.zeros(1)}
        return Belief(mean, jnp.diag(jnp.array([sigma, 1.0])))

    near = np.deg2rad(179.0)
    got = fuse([at(near, 0.1), at(-near, 0.1)])
    assert abs(float(got.mean["a"].rad)) == pytest.approx(np.pi, abs=1e-14)
    # The plain average of 170 and 590 / 3 degrees folded: 2/3 of the way by weights 1 : 2.
    uneven = fuse([at(np.deg2rad(170.0), 0.2), at(np.deg2rad(-178.0), 0.2 / np.sqrt(2.0))])
    assert float(uneven.mean["a"].rad) == pytest.approx(np.deg2rad(178.0), abs=1e-12)


def test_rotations_are_fused_in_the_tangent_space():
    turn = np.array([0.02, -0.01, 0.03])
    first = Rotation.from_rotvec(jnp.array([0.5, 3.0, -0.2]))
    second = first.retract(jnp.array(turn))
    P1, P2 = np.diag([0.01, 0.02, 0.03]), np.diag([0.03, 0.02, 0.01])
    got = fuse([Belief.of(first, P1), Belief.of(second, P2)])
    Y = np.linalg.inv(P1) + np.linalg.inv(P2)
    want = np.linalg.solve(Y, np.linalg.solve(P2, turn))
    np.testing.assert_allclose(manifold.local(first, got.mean), want, atol=1e-14)
    np.testing.assert_allclose(got.covariance, np.linalg.inv(Y), atol=1e-15)


@pytest.mark.parametrize("combine", [fuse, covariance_intersection])
def test_what_is_known_exactly_cannot_be_fused(combine):
    known = Belief(jnp.zeros(2), jnp.array([[1.0, 0.0], [2.0, 0.0]]))
    with pytest.raises(ValueError, match=r"belief 1: its covariance is singular.* give the constr"):
        combine([Belief(jnp.zeros(2), jnp.eye(2)), known])
    with pytest.raises(ValueError, match="nothing to"):
        combine([])
    assert not np.all(np.isfinite(jax.jit(lambda b: combine([b, b]).factor)(known)))


# ------------------------------------------------------------------------------------------ share


@pytest.mark.parametrize("unit", [ONES, UNITS], ids=["alike", "of many units"])
@pytest.mark.parametrize(
    ("sharing", "shares"),
    [("root", SHARES), ("root", [0.7, 0.2, 0.1]), ("scalar", [0.7, 0.2, 0.1])],
    ids=["root, vector", "root", "scalar"],
)
def test_shared_information_sums_to_what_there_was(sharing, shares, unit):
    whole = random_belief(3, unit=unit)
    parts = share(whole, shares, sharing)
    Y = np.outer(unit, unit) * information(whole)
    total = sum(np.outer(unit, unit) * information(p) for p in parts)
    np.testing.assert_allclose(total, Y, rtol=0.0, atol=1e-10 * np.max(np.abs(Y)))
    again = fuse(parts)
    np.testing.assert_allclose(again.mean, whole.mean, rtol=1e-14)
    close(again.covariance, whole.covariance, np.asarray(whole.sigma), 1e-13)
    for p in parts:  # and no part claims more than there was
        L = np.asarray(whole.factor)
        seen = scipy.linalg.solve_triangular(L, np.asarray(p.factor), lower=True)
        assert np.linalg.svd(seen, compute_uv=False)[-1] >= 1.0 - 1e-9


def test_root_sharing_is_by_the_symmetric_root_of_the_correlations():
    whole = random_belief(4, unit=UNITS)
    D = np.diag(whole.sigma)
    C = np.linalg.inv(D) @ np.asarray(whole.covariance) @ np.linalg.inv(D)
    root = scipy.linalg.sqrtm(C)
    for p, a in zip(share(whole, SHARES), SHARES, strict=True):
        close(p.covariance, D @ root @ np.diag(1 / a) @ root @ D, np.asarray(p.sigma), 1e-11)
    # so uncorrelated states get just what they were given
    for p, a in zip(share(Belief(whole.mean, jnp.array(D)), SHARES), SHARES, strict=True):
        np.testing.assert_allclose(p.factor, D @ np.diag(a**-0.5), rtol=1e-13, atol=1e-24)


def test_root_sharing_conserves_where_states_are_all_but_one():
    # Correlation 1 - 5e-15: a root from the eigenvalues of P would lose half the digits.
    L = np.array(random_belief(5).factor)
    L[4] = L[3] + np.array([0.0, 0.0, 0.0, 0.0, 1e-7])
    whole = Belief(jnp.zeros(N), jnp.array(L))
    again = fuse(share(whole, SHARES))
    seen = scipy.linalg.solve_triangular(L, np.asarray(again.factor), lower=True)
    np.testing.assert_allclose(np.linalg.svd(seen, compute_uv=False), 1.0, atol=1e-8)


def test_half_sharing_keeps_the_diagonal_only():
    whole = random_belief(6)
    with np.errstate(all="raise"):
        total = sum(information(p) for p in share(whole, SHARES, "half"))
    Y = information(whole)
    G = sum(np.sqrt(np.outer(a, a)) for a in SHARES)
    np.testing.assert_allclose(total, G * Y, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(np.diag(total), np.diag(Y), rtol=1e-9)
    # which is no lower bound of the information: in some direction there is more than there was
    assert scipy.linalg.eigh(total, Y, eigvals_only=True)[-1] > 1.01


def test_a_hundred_cycles_with_no_data():
    whole = random_belief(7)

    @jax.jit
    def cycles(belief):
        def cycle(both, _):
            return [fuse(share(b, SHARES, s)) for b, s in zip(both, WAYS, strict=True)], None

        return jax.lax.scan(cycle, [belief, belief], None, length=100)[0]

    WAYS = ("root", "half")
    root, half = cycles(whole)
    close(root.covariance, whole.covariance, np.asarray(whole.sigma), 1e-11)
    G = sum(np.sqrt(np.outer(a, a)) for a in SHARES)
    gained = G**100 * information(whole)  # entry by entry
    np.testing.assert_allclose(information(half), gained, rtol=1e-7, atol=1e-7)
    assert np.linalg.det(gained) > 3.0 * np.linalg.det(information(whole))


def test_sharing_and_fusing_have_the_derivatives_of_finite_differences():
    # At P = 1, where all eigenvalues are one and the derivative of an eigenvector is not there.
    slope = jnp.array(np.random.default_rng(8).normal(size=(N, N)))

    def first(t):
        parts = share(Belief(jnp.zeros(N), jnp.eye(N) + t * jnp.tril(slope)), SHARES)
        moved = Belief(parts[0].mean + 1.0, parts[0].factor)
        fused = fuse([moved, parts[1]])
        return jnp.sum(parts[0].covariance[2] ** 2) + jnp.sum(fused.mean**3)

    f = jax.jit(first)
    got = float(jax.jit(jax.grad(first))(0.0))
    assert got == pytest.approx(float((f(1e-5) - f(-1e-5)) / 2e-5), rel=1e-7)


def test_shares_that_are_none():
    whole = random_belief(9)
    for bad in ([0.5, 0.0], [0.5, -0.1], [0.5, np.nan], [np.inf, 1.0]):
        with pytest.raises(ValueError, match="shares must be positive"):
            share(whole, bad)
    with pytest.raises(ValueError, match=r"\(N,\) or \(N, 5\)"):
        share(whole, np.full((2, 3), 0.5))
    with pytest.raises(ValueError, match="use 'root' for one a state"):
        share(whole, SHARES, "scalar")
    plain = inspect.unwrap(share)
    with pytest.raises(ValueError, match="A_i\\^-1 P is asymmetric"):
        plain(whole, [0.5, 0.5], "naive")
    with pytest.raises(ValueError, match="sharing must be"):
        plain(whole, [0.5, 0.5], "some")


# -------------------------------------------------------------------------------- choice of shares


def test_shares_from_covariances():
    beliefs = [random_belief(seed, unit=UNITS) for seed in (0, 1, 2)]
    P = np.stack([np.diag(b.covariance) for b in beliefs])
    sigma = np.asarray(beliefs[0].sigma) * 1.5
    weight = 1.0 / np.sum(P / sigma**2, axis=1)
    assert np.min(weight / weight.sum()) > 0.05
    np.testing.assert_allclose(trace_shares(beliefs, jnp.array(sigma))[:, 0], weight / weight.sum())
    weight = 1.0 / P
    want = np.maximum(weight / weight.sum(0), 0.05)
    np.testing.assert_allclose(diagonal_shares(beliefs), want / want.sum(0))
    np.testing.assert_array_equal(equal_shares(4), np.full((4, 1), 0.25))


def test_shares_have_a_floor_and_nothing_is_shared_equally():
    got = np.asarray(floored(jnp.array([[1.0, 0.0, 0.9], [0.0, 0.0, 0.1]])))
    np.testing.assert_allclose(got, [[1 / 1.05, 0.5, 0.9], [0.05 / 1.05, 0.5, 0.1]])


def test_shares_by_observability():
    rng = np.random.default_rng(10)
    n = 3
    F = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.8]])
    H = {"a": rng.normal(size=(2, n)) * [1.0, 0.2, 0.0], "b": np.array([[0.3, 0.0, 0.0]])}
    W = {"a": np.array([[0.2, 0.0], [0.1, 0.4]]), "b": np.array([[0.7]])}
    sigma = np.array([2.0, 0.3, 5.0])
    sensors = (Sensor(Partial(times, jnp.array(H[k])), W[k], len(H[k]), k) for k in H)
    model = Model(Motion(Partial(times, jnp.array(F)), jnp.ones(n)), tuple(sensors))
    channels = [channel("a"), channel("b")]
    belief = Belief.of(jnp.zeros(n), np.diag(sigma**2))
    seen = []
    for k in ("a", "b"):
        blocks = [np.linalg.solve(W[k], H[k] @ np.linalg.matrix_power(F, j)) for j in range(n)]
        _, S, Vt = np.linalg.svd(np.concatenate(blocks) * sigma)
        seen.append(np.sqrt(sum(s**2 * v**2 for s, v in zip(S, Vt, strict=False))))
    seen = np.array(seen)
    assert np.all(seen[:, 2] == 0.0)  # nobody sees the third state
    want = seen[:, :2] / seen[:, :2].sum(0)
    got = observability_shares(model, belief, channels)
    assert np.min(want) > 0.05
    np.testing.assert_allclose(got, np.column_stack([want, [0.5, 0.5]]), rtol=1e-12)
    blind = observability_shares(model, belief, channels, steps=1)  # "b" sees no rate at once
    np.testing.assert_allclose(blind[:, 1], [1 / 1.05, 0.05 / 1.05])
    with pytest.raises(ValueError, match="at least one"):
        observability_shares(model, belief, channels, steps=0)
    exact = Model(model.motion, (Sensor(model.sensors[0].read, jnp.zeros(2), 2, "a"),))
    with pytest.raises(ValueError, match="'a' has components without noise"):
        observability_shares(exact, belief, channels[:1])


# -------------------------------------------------------------------------------------- intersect


@pytest.mark.parametrize("criterion", ["trace", "det"])
def test_weights_of_an_intersection_are_the_best_there_are(criterion):
    rng = np.random.default_rng(11)
    units = 10.0 ** rng.normal(size=(10, 3))
    factors = np.tril(rng.normal(size=(10, 3, 4, 4))) * units[:, :, None, None]
    weigh = jax.jit(
        jax.vmap(lambda f: intersection_weights([Belief(jnp.zeros(4), x) for x in f], criterion))
    )
    for f, w in zip(factors, np.asarray(weigh(jnp.array(factors))), strict=True):
        P = f @ np.swapaxes(f, 1, 2)
        unit = np.sqrt(np.min(np.diagonal(P, axis1=1, axis2=2), axis=0))
        Y = np.linalg.inv(P / np.outer(unit, unit))

        def size(w, Y=Y):
            whole = np.linalg.inv(np.einsum("i,ijk->jk", w, Y))
            return np.trace(whole) if criterion == "trace" else np.linalg.slogdet(whole)[1]

        total = {"type": "eq", "fun": lambda w: np.sum(w) - 1.0}
        best = minimize(size, np.full(3, 1 / 3), bounds=[(1e-12, 1)] * 3, constraints=total)
        assert np.all(w >= 0.0)
        assert np.sum(w) == pytest.approx(1.0, abs=1e-12)
        assert size(w) <= best.fun + 1e-7 * abs(best.fun)


@pytest.mark.parametrize("criterion", ["trace", "det"])
def test_an_intersection_with_a_worse_belief_is_the_better_one(criterion):
    good = random_belief(12)
    worse = Belief(good.mean + 3.0, 2.0 * good.factor)
    got = covariance_intersection([worse, good], criterion)
    np.testing.assert_allclose(got.mean, good.mean, atol=1e-8)
    np.testing.assert_allclose(got.covariance, good.covariance, rtol=1e-8, atol=1e-9)
    same = covariance_intersection([good, good, good], criterion)
    np.testing.assert_allclose(same.covariance, good.covariance, rtol=1e-9, atol=1e-10)


def test_given_weights():
    a, b = random_belief(13), random_belief(14)
    got = covariance_intersection([a, b], [0.3, 0.7])
    P = np.linalg.inv(0.3 * information(a) + 0.7 * information(b))
    mean = P @ (0.3 * information(a) @ a.mean + 0.7 * information(b) @ b.mean)
    np.testing.assert_allclose(got.covariance, P, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(got.mean, mean, rtol=1e-9, atol=1e-11)
    alone = covariance_intersection([a, b], [1.0, 0.0])
    np.testing.assert_allclose(alone.covariance, a.covariance, rtol=1e-11, atol=1e-12)
    wrong = {(0.5,): "one for each of 2", (0.5, 0.6): "sum to one", (1.5, -0.5): "sum"}
    for bad, why in wrong.items():
        with pytest.raises(ValueError, match=why):
            covariance_intersection([a, b], list(bad))
    with pytest.raises(ValueError, match="'trace', 'det' or weights"):
        inspect.unwrap(covariance_intersection)([a, b], "volume")


def test_an_intersection_is_never_overconfident():
    # Two estimates whose errors share a part that neither knows of.
    rng = np.random.default_rng(15)
    n, runs = 3, 4000
    L1, L2 = (np.tril(rng.normal(size=(n, n))) + 2 * np.eye(n) for _ in range(2))
    a, b = rng.normal(size=(2, runs, n))
    correlation = np.array([0.9, 0.0, -0.5])
    rho = correlation[:, None, None]
    e1, e2 = (0.0 * rho + a) @ L1.T, (rho * a + np.sqrt(1.0 - rho**2) * b) @ L2.T

    def both(a, b):
        two = [Belief(a, jnp.array(L1)), Belief(b, jnp.array(L2))]
        return [fuse(two), covariance_intersection(two)]

    nees = []
    for got in jax.jit(jax.vmap(jax.vmap(both)))(jnp.array(e1), jnp.array(e2)):
        error, Y = np.asarray(got.mean), np.linalg.inv(np.asarray(got.covariance)[0, 0])
        nees.append(np.mean(np.einsum("cri,ij,crj->cr", error, Y, error), axis=1) / n)
    summed, intersected = nees
    four_sigma = 4.0 * np.sqrt(2.0 / (n * runs))
    assert np.all(intersected < 1.0 + four_sigma)
    assert summed[0] > 1.5  # what it protects from
    assert abs(summed[1] - 1.0) < four_sigma
