"""Linearisations: sigma points against the textbook's sums, slopes against differences, rotations
against closed forms and quadrature."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from interpreted import run
from jax.tree_util import Partial

from robins import manifold
from robins.earth import Geodetic
from robins.filters import (
    Belief,
    Code,
    Model,
    Motion,
    Sensor,
    kalman,
    sigma_weights,
    taylor,
    unscented,
    unscented_transform,
)
from robins.filters.linearise import _regress
from robins.manifold import Angle
from robins.rotation import Rotation

EPS = np.finfo(float).eps
N = 3


def bent(x, sin=jnp.sin):
    """Curved in every direction."""
    return [x[0] * x[1] + sin(x[2]), x[1] ** 2 - 0.5 * x[0] * x[2], sin(x[0] + x[1] * x[2]), x[0]]


def bent_motion():
    return Motion(lambda x, u: jnp.stack(bent(x)[:N]), jnp.full(N, 0.1))


def draw(seed: int):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(N, N))
    return rng.normal(size=N), np.linalg.cholesky(0.3 * A @ A.T)


def textbook(m, L, weights, number=np.float64):
    """Mean, covariance and cross-covariance as weighted sums over the points (Julier & Uhlmann)."""
    alpha, beta, kappa = (number(w) for w in weights)
    lam = alpha**2 * (N + kappa) - N
    m, L = m.astype(number), L.astype(number)
    columns = np.sqrt(N + lam) * L.T
    points = np.concatenate([m[None], m + columns, m - columns])
    values = np.array([bent(p, np.sin)[:N] for p in points])
    wm = np.full(2 * N + 1, 1 / (2 * (N + lam)), dtype=number)
    wc = wm.copy()
    wm[0] = lam / (N + lam)
    wc[0] = wm[0] + 1 - alpha**2 + beta
    mean = wm @ values
    d = values - mean
    return mean, (d.T * wc) @ d, ((points - m).T * wc) @ d


def regressed(m, L, weights):
    """The same from the package."""
    t = unscented(*weights).transition(Belief(jnp.array(m), jnp.array(L)), bent_motion(), None)
    covariance = t.spread @ t.spread.T + t.excess @ t.excess.T
    if t.deficit is not None:
        covariance = covariance - jnp.outer(t.deficit, t.deficit)
    return np.asarray(t.mean), np.asarray(covariance), L @ np.asarray(t.spread).T


def off(got, want):
    return float(np.max(np.abs(got - want)) / np.max(np.abs(want)))


def test_sigma_points_give_the_weighted_sums_of_the_textbook():
    rng = np.random.default_rng(0)
    taken_away = 0
    for seed in range(60):
        weights = (rng.uniform(0.3, 1.5), rng.uniform(-1.0, 3.0), rng.uniform(-2.0, 3.0))
        m, L = draw(seed)
        for got, want in zip(regressed(m, L, weights), textbook(m, L, weights), strict=True):
            assert off(got, want) < 1e-12
        alpha, beta, kappa = weights
        taken_away += kappa * alpha**2 + N * beta < 0.0
    assert 5 < taken_away < 55  # both kinds were drawn


def test_nothing_is_taken_away_while_kappa_and_beta_are_not_negative():
    # The cubature points lie just on the border, whatever sqrt(n) rounds to.
    for n in range(1, 40):

        def deficit(*weights, n=n):
            shapes = jax.eval_shape(lambda x: _regress(x, n, *weights), jnp.ones((2 * n + 1, 1)))
            return shapes[3]

        assert all(deficit(*w) is None for w in ((1.0, 0.0, 0.0), (0.3, 0.0, 0.0), (1.0, 0.0, 2.0)))
        assert deficit(1.0, -1e-6, 0.0) is not None


def test_points_close_together_lose_no_more_than_the_values_do():
    # Values differ by alpha^2 of themselves, so EPS / alpha^2 is lost before any formula begins.
    weights = (1e-4, 2.0, 0.0)
    ours, sums = [], []
    for seed in range(20):
        m, L = draw(seed)
        exact = textbook(m, L, weights, np.longdouble)
        ours.append([off(a, b) for a, b in zip(regressed(m, L, weights), exact, strict=True)])
        sums.append([off(a, b) for a, b in zip(textbook(m, L, weights), exact, strict=True)])
    ours, sums = np.array(ours), np.array(sums)
    assert np.all(ours[:, :2] < 5 * EPS / weights[0] ** 2)
    assert np.all(ours[:, 2] < 50 * EPS / weights[0])
    assert np.all(np.mean(ours[:, :2], axis=0) < 0.5 * np.mean(sums[:, :2], axis=0))


@pytest.mark.parametrize(("alpha", "beta", "kappa"), [(1.0, 2.0, 0.0), (0.1, 0.0, 2.0)])
def test_weights_reproduce_the_moments_they_are_for(alpha, beta, kappa):
    w = sigma_weights(5, alpha, beta, kappa)
    assert float(jnp.sum(w.mean)) == pytest.approx(1.0, abs=1e-12)
    ring = w.reach**2 * 2 * float(w.mean[1])
    assert ring == pytest.approx(1.0, rel=1e-14)  # second moment
    assert float(w.covariance[0] - w.mean[0]) == pytest.approx(1 - alpha**2 + beta, rel=1e-12)


@pytest.mark.parametrize(("alpha", "kappa"), [(0.0, 0.0), (1.0, -3.0), (-1.0, 0.0), (1.0, -4.0)])
def test_weights_without_points_are_refused(alpha, kappa):
    with pytest.raises(ValueError, match=r"alpha > 0 and n \+ kappa > 0, got .* n = 3"):
        sigma_weights(3, alpha, 2.0, kappa)


def test_points_closer_together_than_rounding_allows_are_refused():
    n, eps = 9, np.finfo(float).eps
    border = np.sqrt(1e3 * eps)  # n + lambda = alpha^2 n is 1000 eps n
    assert sigma_weights(n, 1.01 * border, 2.0, 0.0).reach > 0.0
    for alpha in (0.99 * border, 1e-9, 1e-200):
        with pytest.raises(
            ValueError, match=r"too close together: n \+ lambda = .* n = 9 vanishes"
        ):
            sigma_weights(n, alpha, 2.0, 0.0)


def test_gaussian_moments_of_a_square():
    # x ~ N(m, s^2): x^2 has mean m^2 + s^2 and variance 4 m^2 s^2 + 2 s^4; beta = 2 finds both.
    m, s = 1.3, 0.4
    belief = Belief(jnp.array([m]), jnp.array([[s]]))
    for alpha in (1.0, 0.1, 1e-3):
        found = unscented_transform(belief, lambda x: x**2, alpha, 2.0, 0.0)
        tolerance = 1e-14 / alpha**2
        assert float(found.mean[0]) == pytest.approx(m**2 + s**2, rel=tolerance)
        want = 4 * m**2 * s**2 + 2 * s**4
        assert float(found.covariance[0, 0]) == pytest.approx(want, rel=10 * tolerance)


# -------------------------------------------------------------------------------------- slopes


def mixed_state():
    return {
        "attitude": Rotation.from_euler(0.4, -0.9, 2.5),
        "heading": Angle(jnp.array(3.1)),
        "place": Geodetic.from_degrees(47.0, 179.9999, 300.0),
        "v": jnp.array([3.0, -2.0, 0.5]),
    }


def mixed_step(x, u):
    """Everything moves everything."""
    turn = u * x["v"] + jnp.array([0.0, 0.0, 0.1]) * jnp.sin(x["heading"].rad)
    moved = x["attitude"].apply(x["v"]) * jnp.array([20.0, 300.0, 1.0])
    return {
        "attitude": Rotation.from_rotvec(turn) @ x["attitude"],
        "heading": Angle(manifold.wrap(x["heading"].rad + 0.3 * x["v"][0] + 1e-4 * x["place"].alt)),
        "place": x["place"].retract(moved),
        "v": x["v"] * jnp.cos(x["heading"].rad) + x["attitude"].apply(turn),
    }


def mixed_read(x, aux):
    north = x["attitude"].apply(aux)
    return x["place"].retract(north), Angle(x["heading"].rad + north[0]), north[1:]


def slopes(g, x, h=2e-3):
    """Jacobian of g between tangent spaces by central differences, Richardson's two steps."""
    value, n = g(x), manifold.dim(x)

    @jax.jit
    @jax.vmap
    def along(d):
        plus, minus = g(manifold.retract(x, d)), g(manifold.retract(x, -d))
        return manifold.local(value, plus) - manifold.local(value, minus)

    wide, narrow = along(h * jnp.eye(n)) / (2 * h), along(h / 2 * jnp.eye(n)) / h
    return np.asarray(4 * narrow - wide).T / 3


def test_slopes_of_a_motion_on_a_manifold():
    x, u = mixed_state(), jnp.array(0.2)
    n = manifold.dim(x)
    assert n == 10
    motion = Motion(mixed_step, jnp.ones(n))
    t = jax.jit(lambda x: taylor().transition(Belief(x, jnp.eye(n)), motion, u))(x)
    # a place is held to 1e-9 m
    want = slopes(lambda s: mixed_step(s, u), x)
    np.testing.assert_allclose(t.spread, want, rtol=1e-6, atol=1e-5)
    assert t.excess.shape == (n, 0)


def test_slopes_of_a_sensor_on_a_manifold():
    x, aux = mixed_state(), jnp.array([1.0, 2.0, -0.5])
    sensor = Sensor(mixed_read, jnp.ones(6), 6)
    S = jnp.diag(jnp.arange(1.0, 11.0))
    read = jax.jit(lambda x: mixed_read(x, aux))
    y = read(manifold.retract(x, jnp.full(10, 0.01)))
    o = jax.jit(lambda x: taylor().observation(Belief(x, S), sensor, y, aux)[2:])(x)
    np.testing.assert_allclose(o[3], slopes(read, x) @ np.asarray(S), rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(o[0], manifold.local(read(x), y), rtol=1e-12)


def test_an_analytic_slope_is_used_and_gives_the_same():
    used = []

    def linear_motion(x, u):
        used.append("motion")
        F = jnp.array([[1.0, 0.1], [-0.98 * jnp.cos(x[0]), 1.0]])
        return swing(x, u), F, jnp.array([0.01, 0.1])

    def linear_sensor(x, aux):
        used.append("sensor")
        return jnp.sin(x[:1]), jnp.array([[jnp.cos(x[0]), 0.0]])

    def swing(x, u):
        return x + jnp.stack([0.1 * x[1], -0.98 * jnp.sin(x[0])])

    noise, sigma = jnp.array([0.01, 0.1]), jnp.array([0.1])
    plain = Model(Motion(swing, noise), (Sensor(lambda x, aux: jnp.sin(x[:1]), sigma, 1),))
    analytic = Model(
        Motion(swing, noise, linear_motion),
        (Sensor(lambda x, aux: jnp.sin(x[:1]), sigma, 1, linear=linear_sensor),),
    )
    start = Belief.of(jnp.array([1.0, 0.0]), 0.1 * np.eye(2))
    y = np.sin(np.linspace(1.0, -1.0, 15))[:, None]
    ekf = kalman()
    one, other = run(ekf, plain, start, y), run(ekf, analytic, start, y)
    assert set(used) == {"motion", "sensor"}
    np.testing.assert_allclose(one.mean, other.mean, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-12, atol=1e-15)


# ----------------------------------------------------------------------------------- rotations


def test_mean_of_a_vector_seen_from_an_uncertain_attitude():
    # phi ~ N(0, s^2 I): E exp(phi x) = (1 + 2 (1 - s^2) exp(-s^2/2)) / 3. Third-degree points miss
    # it by s^4/6 and higher; a first-order expansion by all of s^2.
    attitude, v = Rotation.from_euler(0.3, 0.5, -2.0), jnp.array([1.0, -2.0, 0.5])
    read = Partial(lambda v, x: x.apply(v), v)

    @jax.jit
    def found(sigma):
        belief = Belief(attitude, sigma * jnp.eye(3))
        return unscented_transform(belief, read, 1.0, 0.0, 0.0).mean

    seen = np.asarray(attitude.apply(v))
    for sigma in (0.05, 0.2, 0.4):
        exact = (1 + 2 * (1 - sigma**2) * np.exp(-(sigma**2) / 2)) / 3 * seen
        miss = np.linalg.norm(found(sigma) - exact) / np.linalg.norm(v)
        assert 0.8 * sigma**4 / 6 < miss < 1.2 * sigma**4 / 6 + 1e-15
        assert np.linalg.norm(seen - exact) > 0.9 * sigma**2


def test_moments_of_an_uncertain_turn_against_quadrature():
    # A turn that depends on the attitude itself; the moments by Gauss-Hermite points of degree 19.
    shape = jnp.array(np.linalg.cholesky([[1.0, 0.3, -0.2], [0.3, 0.5, 0.1], [-0.2, 0.1, 0.8]]))
    mean = Rotation.from_euler(0.3, 1.4, -2.0)
    A = jnp.array([[0.5, 0.0, 0.2], [-0.3, 0.1, 0.0], [0.0, 0.4, -0.2]])
    v = jnp.array([1.0, -2.0, 0.5])

    def step(x, u):
        return Rotation.from_rotvec(A @ x.apply(v)) @ x

    point, weight = np.polynomial.hermite_e.hermegauss(10)
    grid = np.array(list(itertools.product(point, repeat=3)))
    share = np.prod(list(itertools.product(weight / weight.sum(), repeat=3)), axis=1)

    def misses(way, sigma):
        @jax.jit
        def both(L):
            t = way.transition(Belief(mean, L), Motion(step, jnp.zeros((3, 1))), None)
            move = jax.vmap(lambda e: manifold.local(t.mean, step(manifold.retract(mean, e), None)))
            return t.spread, t.excess, move(jnp.array(grid) @ L.T)

        L = sigma * shape
        spread, excess, d = (np.asarray(x) for x in both(L))
        centre = share @ d
        covariance = (d.T * share) @ d - np.outer(centre, centre)
        cross = ((grid @ np.asarray(L).T).T * share) @ d
        return (
            np.max(np.abs(centre)),
            np.max(np.abs(spread @ spread.T + excess @ excess.T - covariance)),
            np.max(np.abs(np.asarray(L) @ spread.T - cross)),
        )

    small, large = misses(unscented(), 0.05), misses(unscented(), 0.1)
    for one, two in zip(small, large, strict=True):
        assert 14 < two / one < 18  # all that is missed is of fourth order
    first, twice = misses(taylor(), 0.05), misses(taylor(), 0.1)
    assert 3.6 < twice[0] / first[0] < 4.4  # where a first-order expansion misses the second
    assert all(a < b for a, b in zip(small, first, strict=True))
    assert small[0] < 1e-3 * first[0]
    assert small[2] < 0.5 * first[2]  # deviations read off about the mean, not the centre point


def test_a_measured_attitude_is_a_measurement_on_the_manifold():
    # Star tracker: attitude error phi = measured - predicted, in the frame phi is seen in.
    truth = Rotation.from_euler(0.2, -0.4, 3.0)
    belief = Belief(truth.retract(jnp.array([0.01, -0.02, 0.015])), 0.05 * jnp.eye(3))
    sensor = Sensor(lambda x, aux: x, jnp.full(3, 1e-3), 3)
    one = kalman(unscented())
    start = one.init(belief, {"y": 3})
    state, info = one.update(start, sensor, truth)
    share = 1e-6 / (1e-6 + 0.05**2)
    left = manifold.local(state.belief.mean, truth)
    np.testing.assert_allclose(left, share * info.innovation, rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(info.innovation, [-0.01, 0.02, -0.015], rtol=1e-3)
    nothing = Rotation(np.full(4, np.nan))
    assert int(one.update(start, sensor, nothing)[1].dof) == 0


def test_an_attitude_that_the_model_cannot_tell_is_a_fault():
    belief = Belief(Rotation.identity(), 0.05 * jnp.eye(3))
    sensor = Sensor(lambda x, aux: Rotation(x.wxyz * aux), jnp.full(3, 1e-3), 3)
    one = kalman()
    state = one.init(belief, {"y": 3})
    nothing, seen = Rotation(np.full(4, np.nan)), Rotation.identity()
    codes = [int(one.update(state, sensor, y, jnp.nan)[1].code) for y in (seen, nothing)]
    assert codes == [Code.NOT_FINITE, Code.MISSING]


def test_a_place_whose_height_is_missing():
    here = Geodetic.from_degrees(47.0, 8.0, 400.0)
    belief = Belief(here, jnp.eye(3))
    sensor = Sensor(lambda x, aux: x, jnp.ones(3), 3)
    moved = here.retract(jnp.array([2.0, -4.0, 6.0]))
    flat = Geodetic(moved.lat, moved.lon, jnp.array(jnp.nan))
    one = kalman()
    state, info = jax.jit(one.update)(one.init(belief, {"y": 3}), sensor, flat)
    assert info.used.tolist() == [True, True, False]
    step = manifold.local(here, state.belief.mean)
    np.testing.assert_allclose(step, [1.0, -2.0, 0.0], atol=1e-8)
