"""Sigma points used again in the update, as many papers print the filter."""

import jax.numpy as jnp
import numpy as np
import pytest
from interpreted import run
from jax.tree_util import Partial

from robins import linalg
from robins.filters import Belief, Model, Motion, Sensor, kalman, unscented
from robins.manifold import Angle

N, M = 3, 2
Q, R = np.diag([0.1, 0.2, 0.05]), np.diag([0.3, 0.2])
P0 = np.array([[0.2, 0.05, 0.0], [0.05, 0.3, -0.02], [0.0, -0.02, 0.1]])
M0 = np.array([0.5, -0.2, 0.3])
Y = np.random.default_rng(0).normal(size=(6, M))


def f(x, u=None):
    return jnp.stack(
        [x[0] + 0.1 * x[1], x[1] + 0.1 * jnp.sin(x[0]), 0.9 * x[2] + 0.1 * x[0] * x[1]]
    )


def h(x, aux=None):
    return jnp.stack([x[0] ** 2 + x[2], jnp.sin(x[1])])


def as_printed(alpha, beta, kappa):
    """Means and covariances by the equations of the papers, in covariances."""
    lam = alpha**2 * (N + kappa) - N
    wm = np.full(2 * N + 1, 0.5 / (N + lam))
    wc = wm.copy()
    wm[0] = lam / (N + lam)
    wc[0] = wm[0] + 1.0 - alpha**2 + beta
    m, P = M0, P0
    for y in Y:
        L = np.linalg.cholesky(P) * np.sqrt(N + lam)
        points = np.concatenate([m[None], m + L.T, m - L.T])
        moved = np.array([f(x) for x in points])
        m = wm @ moved
        D = moved - m
        seen = np.array([h(x) for x in moved])
        E = seen - wm @ seen
        S = (wc[:, None] * E).T @ E + R
        K = (wc[:, None] * D).T @ E @ np.linalg.inv(S)
        m = m + K @ (y - wm @ seen)
        P = (wc[:, None] * D).T @ D + Q - K @ S @ K.T
        yield m, P


def model(noise=Q):
    sensor = Sensor(h, linalg.factor(R), M)
    return Model(Motion(f, linalg.factor(noise)), (sensor,))


@pytest.mark.parametrize(
    ("weights", "form"),
    [((1.0, 2.0, 0.0), "sqrt"), ((0.5, 2.0, 1.0), "joseph"), ((1.0, 0.5, 0.0), "sqrt")],
)
def test_the_filter_is_the_one_that_is_printed(weights, form):
    one = kalman(unscented(*weights, redraw=False), form=form)
    solution = run(one, model(), Belief.of(jnp.array(M0), P0), Y)
    means, covariances = (np.array(a) for a in zip(*as_printed(*weights), strict=True))
    np.testing.assert_allclose(solution.mean, means, atol=1e-13)
    np.testing.assert_allclose(solution.covariance, covariances, atol=1e-13)


def moving(share, x, u):
    return share * f(x) + (1.0 - share) * x


def test_points_that_stay_where_they_are_are_those_that_would_be_drawn():
    def both(share):
        motion = Motion(Partial(moving, jnp.array(share)), share * jnp.array(linalg.factor(Q)))
        given = Model(motion, model().sensors), Belief.of(jnp.array(M0), P0), Y[:1]
        return (run(kalman(unscented(redraw=redraw)), *given) for redraw in (False, True))

    again, drawn = both(0.0)
    np.testing.assert_allclose(again.mean, drawn.mean, atol=1e-14)
    np.testing.assert_allclose(again.covariance, drawn.covariance, atol=1e-14)
    again, drawn = both(1.0)
    assert np.max(np.abs(drawn.covariance - again.covariance)) > 1e-3  # it is another filter


def test_the_second_sensor_of_a_step_draws():
    bearing = Sensor(lambda x, aux: Angle(jnp.arctan2(x[1], x[0])), jnp.array([0.1]), 1, "bearing")
    both = Model(model().motion, (*model().sensors, bearing))
    y = {"y": jnp.array(Y), "bearing": Angle(jnp.linspace(-0.5, 3.5, len(Y)))}
    start = Belief.of(jnp.array(M0), P0)
    solution = run(kalman(unscented(redraw=False)), both, start, y)
    # By hand: reuse for the first, then an ordinary update for the second.
    again, plain = kalman(unscented(redraw=False)), kalman(unscented())
    state = again.init(start, both.dims)
    state, _ = again.predict(state, both.motion, None)
    state, _ = again.update(state, both.sensors[0], jnp.array(Y[0]))
    second = plain.init(state.belief, both.dims)
    second, _ = plain.update(second, bearing, Angle(y["bearing"].rad[0]))
    np.testing.assert_allclose(solution.mean[0], second.belief.mean, atol=1e-13)
    np.testing.assert_allclose(solution.steps.posterior.factor[0], second.belief.factor, atol=1e-13)


def test_it_skips_what_is_missing():
    y = Y.copy()
    y[2], y[4, 0] = np.nan, np.nan
    solution = run(kalman(unscented(redraw=False)), model(), Belief.of(jnp.array(M0), P0), y)
    np.testing.assert_array_equal(solution.mean[2], solution.steps.prediction.belief.mean[2])


def test_weights_that_would_take_covariance_away_are_refused():
    one = kalman(unscented(1.0, -1.0, 0.0, redraw=False))
    with pytest.raises(ValueError, match="used again only where kappa alpha"):
        run(one, model(), Belief.of(jnp.array(M0), P0), Y)
