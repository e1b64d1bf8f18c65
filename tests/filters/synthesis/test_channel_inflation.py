"""Process noise by a channel: the steady state of the filter is the Riccati design."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from robins import manifold
from robins.filters import Belief, Model, Motion, Sensor, kalman, run, taylor, unscented
from robins.filters.rules import channel_inflation
from robins.filters.synthesis import current_form, kalman_gain, riccati
from robins.rotation import Rotation

A = np.array([[0.9, 0.2], [-0.1, 0.8]])
BW = np.array([[0.3, 0.0], [0.1, 0.2]])
BN = np.array([[0.0], [0.4]])
C = np.array([[1.0, 0.0]])
DV = np.array([[0.5]])
MODEL = Model(
    Motion(lambda x, u: jnp.asarray(A) @ x, jnp.asarray(BW)),
    (Sensor(lambda x, aux: x[:1], jnp.asarray(DV), 1),),
)
START = Belief.of(jnp.zeros(2), np.diag([4.0, 1.0]))
Y = jnp.asarray(np.random.default_rng(3).normal(size=(60, 1)))


def last_gain(rules, way=None):
    return np.asarray(run(kalman(way, rules), MODEL, START, Y).steps.info["y"].gain[-1])


@pytest.mark.parametrize("gamma", [1.1, 0.8])
def test_the_steady_gain_is_that_of_the_design(gamma):
    plant = current_form(A, BW, BN, C, DV)
    design = riccati(plant, gamma)
    assert design.lambda_ > 0.1
    assert design.hinf == pytest.approx(gamma, rel=1e-9)
    got = last_gain([channel_inflation(design.lambda_, BN)], taylor())
    np.testing.assert_allclose(got, design.gain, rtol=0, atol=1e-12)
    # and far from that of the filter without the rule, which is the Kalman filter's
    np.testing.assert_allclose(last_gain([]), kalman_gain(plant), rtol=0, atol=1e-12)
    assert np.linalg.norm(design.gain - kalman_gain(plant)) > 0.1


def test_one_prediction_by_hand_for_sigma_points_and_a_channel_that_turns_with_the_state():
    def channel(mean):
        return jnp.stack([mean, 2.0 * mean[::-1]], axis=1)

    start = Belief.of(jnp.array([1.0, -2.0]), np.diag([4.0, 1.0]))
    for way in (taylor(), unscented()):
        one = kalman(way, [channel_inflation(0.7, channel)])
        state, _ = one.predict(one.init(start, MODEL.dims), MODEL.motion, None)
        mean = A @ [1.0, -2.0]
        B = np.column_stack([mean, 2.0 * mean[::-1]])
        wanted = A @ np.diag([4.0, 1.0]) @ A.T + BW @ BW.T + 0.7 * B @ B.T
        np.testing.assert_allclose(state.belief.covariance, wanted, rtol=1e-13)


def test_an_attitude_whose_rate_is_in_doubt():
    rate = jnp.array([0.1, -0.2, 0.3])
    motion = Motion(lambda q, u: manifold.retract(q, rate), 1e-3 * jnp.eye(3))
    start = Belief.of(Rotation.identity(), 1e-4 * np.eye(3))
    one = kalman(rules=[channel_inflation(4.0, 0.01 * np.eye(3))])
    state, _ = one.predict(one.init(start, {}), motion, None)
    # all is isotropic, so turning changes nothing
    np.testing.assert_allclose(
        state.belief.covariance, (1e-4 + 1e-6 + 4e-4) * np.eye(3), rtol=0, atol=1e-17
    )


def test_the_likelihood_has_a_gradient_in_the_channel():
    def surprise(size):
        one = kalman(rules=[channel_inflation(2.0, lambda mean: size * jnp.asarray(BN))])
        return run(one, MODEL, START, Y).log_likelihood

    both = jax.jit(jax.value_and_grad(surprise))
    (value, slope), (above, _), (below, _) = (
        map(float, both(jnp.array(size))) for size in (1.3, 1.3001, 1.2999)
    )
    assert slope == pytest.approx((above - below) / 2e-4, rel=1e-6)
    # the likelihood itself, as one Gaussian over all of the data
    P, F = np.diag([4.0, 1.0]), A
    Q = BW @ BW.T + 2.0 * 1.69 * BN @ BN.T
    covariance = np.zeros((len(Y), len(Y)))
    for i in range(len(Y)):
        P = F @ P @ F.T + Q
        ahead = P
        for j in range(i, len(Y)):
            covariance[i, j] = covariance[j, i] = (C @ ahead @ C.T)[0, 0]
            ahead = F @ ahead
    covariance += DV[0, 0] ** 2 * np.eye(len(Y))
    y = np.asarray(Y)[:, 0]
    root = scipy.linalg.cholesky(covariance, lower=True)
    white = scipy.linalg.solve_triangular(root, y, lower=True)
    log_det = 2.0 * np.sum(np.log(np.diag(root)))
    assert value == pytest.approx(-0.5 * (white @ white + log_det + len(y) * np.log(2 * np.pi)))
