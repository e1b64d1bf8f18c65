"""Iterated filters, against the most probable state of a general optimiser and against filters."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import random_system, simulate
from interpreted import run
from scipy import optimize

from robins import manifold
from robins.filters import Belief, Sensor, cubature, kalman, unscented
from robins.filters.iterated import iterated
from robins.filters.rules import gate
from robins.manifold import Angle

MANY = kalman(iterated(iterations=30))
SIGMA = np.array([0.1, 0.02])  # m, rad


def radar(x, aux):
    return jnp.hypot(x[:1], x[1:2]), Angle(jnp.arctan2(x[1], x[0]))


SENSOR = Sensor(radar, jnp.array(SIGMA), 2)
MEAN, P = np.array([-3.0, 0.5]), np.array([[1.0, 0.3], [0.3, 2.0]])
START = Belief.of(MEAN, P)
CUBIC = Belief.of(np.array([2.0]), np.array([[2.0]]))
READ = (jnp.array([2.4]), Angle(jnp.array(-2.9)))  # across half a turn from the mean


@partial(jax.jit, static_argnums=0)
def posterior(one, y=READ, start=START, sensor=SENSOR):
    state, info = one.update(one.init(start, {"y": 2}), sensor, y)
    return state.belief, info


def most_probable(y=(2.4, -2.9)):
    """The minimum of the negative log-posterior, and the inverse of its Gauss-Newton Hessian."""
    root = np.linalg.cholesky(np.linalg.inv(P)).T

    def misfit(x):
        turn = (np.arctan2(x[1], x[0]) - y[1] + np.pi) % (2 * np.pi) - np.pi
        seen = np.array([np.hypot(*x) - y[0], turn]) / SIGMA
        return np.concatenate([root @ (x - MEAN), seen[np.isfinite(seen)]])

    found = optimize.least_squares(misfit, MEAN, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    r, phi = np.hypot(*found.x), np.arctan2(found.x[1], found.x[0])
    H = np.array([[np.cos(phi), np.sin(phi)], [-np.sin(phi) / r, np.cos(phi) / r]])
    here = np.isfinite(np.array(y))
    information = H[here].T @ np.diag(SIGMA[here] ** -2.0) @ H[here]
    return found.x, np.linalg.inv(np.linalg.inv(P) + information), 2 * found.cost


@pytest.mark.parametrize("one", [MANY, kalman(iterated(iterations=30), form="joseph")])
def test_the_fixed_point_is_the_most_probable_state(one):
    belief, info = posterior(one)
    mean, covariance, cost = most_probable()
    np.testing.assert_allclose(belief.mean, mean, rtol=1e-7)
    np.testing.assert_allclose(belief.covariance, covariance, rtol=1e-6)
    # the NIS of the effective residual is what the fit leaves: prior and measurement together
    assert float(info.nis) == pytest.approx(cost, rel=1e-6)


def test_a_few_iterations_come_near_it_and_one_is_the_extended_filter():
    few = {k: posterior(kalman(iterated(iterations=k)))[0] for k in (1, 4)}
    off = {k: np.linalg.norm(x.mean - most_probable()[0]) for k, x in few.items()}
    assert off[4] < 0.05 * off[1]
    for a, b in zip(jax.tree.leaves(few[1]), jax.tree.leaves(posterior(kalman())[0]), strict=True):
        np.testing.assert_array_equal(a, b)


def test_what_is_missing_is_left_out():
    y = (jnp.array([jnp.nan]), READ[1])
    belief, info = posterior(MANY, y)
    mean, covariance, _ = most_probable((np.nan, -2.9))
    np.testing.assert_allclose(belief.mean, mean, rtol=1e-6)
    np.testing.assert_allclose(belief.covariance, covariance, rtol=1e-5)
    assert info.used.tolist() == [False, True]
    gone = (jnp.array([jnp.nan]), Angle(jnp.array(jnp.nan)))
    for one in (MANY, kalman(iterated(cubature()))):
        belief, _ = posterior(one, gone)
        np.testing.assert_array_equal(belief.mean, START.mean)
        np.testing.assert_array_equal(belief.factor, START.factor)


def regression(m, C, y, h, r):
    """Posterior linearisation with cubature points of a scalar state, plainly, to its limit."""
    mean, var = m, C
    for _ in range(200):
        points = mean + np.array([-1.0, 1.0]) * np.sqrt(var)
        values = h(points)
        slope = (values[1] - values[0]) / (points[1] - points[0])
        offset = values.mean() - slope * mean
        left = values.var() - slope**2 * var
        S = slope**2 * C + left + r
        K = C * slope / S
        mean, var = m + K * (y - slope * m - offset), C - K**2 * S
    return mean, var


def test_points_are_drawn_from_the_posterior():
    h = lambda x: x**3 / 20 + x  # noqa: E731
    sensor = Sensor(lambda x, aux: h(x), jnp.array([0.3]), 1)
    for way in (cubature(), unscented(1.0, 0.0, 0.0)):
        belief, _ = posterior(kalman(iterated(way, 40)), jnp.array([9.0]), CUBIC, sensor)
        mean, variance = regression(2.0, 2.0, 9.0, h, 0.09)
        assert float(belief.mean[0]) == pytest.approx(mean, rel=1e-10)
        assert float(belief.covariance[0, 0]) == pytest.approx(variance, rel=1e-8)
    once, _ = posterior(kalman(cubature()), jnp.array([9.0]), CUBIC, sensor)
    assert abs(float(once.mean[0]) - mean) > 0.1


def test_an_exact_measurement_is_met():
    sensor = Sensor(lambda x, aux: jnp.hypot(x[:1], x[1:2]), jnp.zeros(1), 1)
    y = jnp.array([2.6])
    belief, _ = posterior(MANY, y, START, sensor)
    found = optimize.minimize(
        lambda x: (x - MEAN) @ np.linalg.inv(P) @ (x - MEAN),
        MEAN,
        method="SLSQP",
        constraints={"type": "eq", "fun": lambda x: np.hypot(*x) - 2.6},
        options={"ftol": 1e-15},
    ).x
    np.testing.assert_allclose(belief.mean, found, atol=1e-6)
    across = belief.mean / jnp.hypot(*belief.mean)
    assert float(jnp.max(jnp.abs(across @ belief.factor))) < 1e-12
    # Points cannot lie closer together than the prior's here: finite, though no tangent.
    several, info = posterior(kalman(iterated(cubature(), 6)), y, START, sensor)
    assert np.all(np.isfinite(several.factor))
    assert int(info.dof) == 1
    assert np.all(several.sigma < START.sigma)


def test_on_linear_models_nothing_changes():
    system = random_system(5)
    y = simulate(system, 1, 15, 0.2)[1]
    model, start = system.model(), system.start()
    plain = run(kalman(), model, start, y)
    solution = run(kalman(iterated(unscented(), 3), [gate()]), model, start, y)
    np.testing.assert_allclose(solution.mean, plain.mean, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(solution.covariance, plain.covariance, rtol=1e-8, atol=1e-10)
    innovation = np.asarray(solution.steps.info["y"].innovation)
    np.testing.assert_allclose(innovation, plain.steps.info["y"].innovation, atol=1e-9)


def test_a_curved_state_is_seen_from_its_prior():
    # The same problem in polar coordinates about another origin: an angle and a length.
    def read(x, aux):
        return x["length"] * jnp.stack([jnp.cos(x["angle"].rad), jnp.sin(x["angle"].rad)])

    sensor = Sensor(read, jnp.array([0.05, 0.05]), 2)
    mean = {"angle": Angle(jnp.array(3.1)), "length": jnp.array(2.0)}
    start, y = Belief.of(mean, np.diag([0.3, 0.5]) ** 2), jnp.array([-1.5, -0.4])

    def misfit(e):
        a, r = 3.1 + e[0], 2.0 + e[1]
        seen = (r * np.array([np.cos(a), np.sin(a)]) - np.asarray(y)) / 0.05
        return np.concatenate([e / np.array([0.3, 0.5]), seen])

    want = optimize.least_squares(misfit, np.zeros(2), xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    belief, _ = posterior(MANY, y, start, sensor)
    np.testing.assert_allclose(manifold.local(start.mean, belief.mean), want, rtol=1e-7)


def test_an_update_is_differentiable():
    one = kalman(iterated(iterations=3))
    y = (jnp.array([[2.4], [jnp.nan], [2.6]]), Angle(jnp.array([-2.9, 3.1, jnp.nan])))

    @jax.jit
    @jax.value_and_grad
    def total(scale):
        sensor = Sensor(radar, jnp.array(SIGMA) * scale, 2)
        belief, info = jax.vmap(lambda y: posterior.__wrapped__(one, y, START, sensor))(y)
        return jnp.sum(info.log_likelihood) + jnp.sum(belief.mean)

    step = 1e-6
    (low, _), (_, slope), (high, _) = (total(1.0 + k * step) for k in (-1, 0, 1))
    assert float(slope) == pytest.approx(float(high - low) / (2 * step), rel=1e-5)


def test_what_cannot_be_iterated():
    with pytest.raises(ValueError, match="iterations must be at least 1, got 0"):
        iterated(iterations=0)
    with pytest.raises(ValueError, match="redraw=True"):
        iterated(unscented(redraw=False))
