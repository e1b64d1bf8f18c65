"""The satellite's filters: their motions by differences, their noise by simulation, their gains."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy.spatial.transform import Rotation as Scipy

from robins.filters.linearise import taylor
from robins.manifold import local, retract
from robins.rotation import BodyRotation, multiply
from robins.systems.satellite import design
from robins.systems.satellite.design import GainSpec, SensorNoise
from robins.systems.satellite.gyro import equivalent_walk, walk_covariance
from robins.systems.satellite.model import (
    AttitudeState,
    QuaternionState,
    model,
    noise_of,
    start,
    xi,
)

ARCSEC = math.pi / 648000.0
DT = 0.1
NOISE = noise_of(1.2 * ARCSEC, 0.025 * ARCSEC, DT)
STAR = np.array([10.0, 10.0, 40.0]) * ARCSEC
Q0 = jnp.asarray(Scipy.from_rotvec([0.7, -1.1, 0.4]).as_quat(scalar_first=True))
BIAS = jnp.array([1e-3, -2e-3, 5e-4])
THETA = jnp.array([0.02, -0.03, 0.015])


def test_the_transition_is_the_difference():
    motion = model(NOISE, STAR).motion
    x = AttitudeState(BodyRotation(Q0), BIAS)
    moved, F, _ = motion.linear(x, THETA)
    h, columns = 1e-5, []
    for e in jnp.eye(6):
        up, down = (local(moved, motion.step(retract(x, s * h * e), THETA)) for s in (1.0, -1.0))
        columns.append(np.asarray(up - down) / (2.0 * h))
    # the Jacobian of the exponential map to first order: 0.04^2/6 of T
    np.testing.assert_allclose(F, np.stack(columns, 1), atol=3e-4 * DT)
    np.testing.assert_allclose(F[:, :3], np.stack(columns, 1)[:, :3], atol=1e-9)


def test_the_motion_is_the_true_turn():
    x = model(NOISE, STAR).motion.step(AttitudeState(BodyRotation(Q0), BIAS), THETA)
    turned = Scipy.from_quat(Q0, scalar_first=True) * Scipy.from_rotvec(np.array(THETA - DT * BIAS))
    np.testing.assert_allclose(
        Scipy.from_quat(x.attitude.wxyz, scalar_first=True).as_matrix(),
        turned.as_matrix(),
        atol=1e-14,
    )


def test_noise_of_a_sample_is_that_of_many_short_ones():
    # white rate and a walk of it, integrated in a thousand steps each
    rng, n, parts, T = np.random.default_rng(0), 20000, 100, 0.5
    arw, rrw = 1.2, 0.8
    h = T / parts
    rate = np.cumsum(rrw * math.sqrt(h) * rng.normal(size=(n, parts)), axis=1)
    angle = -h * np.sum(rate, 1) + arw * math.sqrt(T) * rng.normal(size=n)
    found = np.cov(np.stack([angle, rate[:, -1]]))
    np.testing.assert_allclose(found, walk_covariance(arw, rrw, T), rtol=0.05, atol=0.003)


def test_samples_add_up_to_a_frame():
    # Q over a frame from five samples of A Q A' + Q
    a = np.array([[1.0, -DT], [0.0, 1.0]])
    Q = np.zeros((2, 2))
    for _ in range(5):
        Q = a @ Q @ a.T + walk_covariance(1.2, 0.025, DT)
    np.testing.assert_allclose(Q, walk_covariance(1.2, 0.025, 0.5), rtol=1e-12)


def test_additive_rows_are_the_attitude_error():
    q = np.asarray(Q0)
    np.testing.assert_allclose(xi(Q0).T @ xi(Q0), np.eye(3), atol=1e-15)
    np.testing.assert_allclose(xi(Q0) @ xi(Q0).T, np.eye(4) - np.outer(q, q), atol=1e-15)
    small = jnp.array([1e-6, -2e-6, 3e-6])
    turned = multiply(Q0, jnp.concatenate([jnp.ones(1), 0.5 * small]))
    np.testing.assert_allclose(2.0 * xi(Q0).T @ (turned - Q0), small, rtol=1e-9)
    belief = start(Q0, 60 * ARCSEC, 3 * ARCSEC, additive=True)
    P = np.asarray(belief.covariance)
    np.testing.assert_allclose(
        P[:4, :4], (30 * ARCSEC) ** 2 * (np.eye(4) - np.outer(q, q)), atol=1e-22
    )


def test_both_forms_of_the_state_predict_alike():
    one, other = model(NOISE, STAR), model(NOISE, STAR, additive=True)
    a = taylor().transition(start(Q0, 60 * ARCSEC, 3 * ARCSEC), one.motion, THETA)
    b = taylor().transition(start(Q0, 60 * ARCSEC, 3 * ARCSEC, True), other.motion, THETA)
    rows = np.zeros((6, 7))
    rows[:3, :4], rows[3:, 4:] = 2.0 * np.asarray(xi(b.mean.q_ib)).T, np.eye(3)
    P = np.asarray(a.spread @ a.spread.T + a.noise @ a.noise.T)
    other_P = rows @ np.asarray(b.spread @ b.spread.T + b.noise @ b.noise.T) @ rows.T
    np.testing.assert_allclose(P, other_P, atol=2e-3 * np.max(np.abs(P[:3, 3:])))
    assert isinstance(b.mean, QuaternionState)


# -------------------------------------------------------------------------------------- the gains

BELIEVED = SensorNoise(1.2 * ARCSEC, equivalent_walk(0.005, 0.3, 300.0) * ARCSEC, 0.5, tuple(STAR))


def test_markov_drift_as_a_walk():
    assert equivalent_walk(0.005, 0.3, 300.0) == pytest.approx(0.0250, abs=5e-5)


@pytest.mark.parametrize(
    ("share", "across", "about"),
    [
        (0.5, (0.09842, -0.003342), (0.03584, -0.000865)),
        (0.25, (0.11233, -0.006582), (0.04586, -0.001712)),
    ],
)
def test_gains_with_n_on_the_bias(share, across, about):
    K = design.gain(BELIEVED, GainSpec("riccati", share, "bias"))
    for i, wanted in ((0, across), (1, across), (2, about)):
        np.testing.assert_allclose(K[[i, 3 + i], i], wanted, rtol=2e-3)
    off = K.copy()
    off[[0, 1, 2, 3, 4, 5], [0, 1, 2, 0, 1, 2]] = 0.0
    assert np.max(np.abs(off)) == 0.0


def test_gains_against_the_riccati_equation_of_scipy():
    # the Kalman gain at frames, by the DARE of the frame-to-frame system
    A = np.array([[1.0, -0.5], [0.0, 1.0]])
    Q = walk_covariance(1.2, BELIEVED.rate_walk / ARCSEC, 0.5)
    P = scipy.linalg.solve_discrete_are(A.T, np.array([[1.0], [0.0]]), Q, np.array([[100.0]]))
    K = P[:, :1] / (P[0, 0] + 100.0)
    np.testing.assert_allclose(design.gain(BELIEVED, GainSpec("h2"))[[0, 3], 0], K[:, 0], rtol=1e-8)


def test_inflated_noise_makes_these_gains():
    # A Kalman filter with Q + (sqrt(lambda) Bn)(...)' settles on the gain of the design.
    recipe = GainSpec("riccati", 0.25, "bias")
    more = design.inflation(BELIEVED, recipe) / ARCSEC
    A = np.array([[1.0, -0.5], [0.0, 1.0]])
    for i, sigma in ((0, 10.0), (2, 40.0)):
        b = more[[i, 3 + i], i]
        Q = walk_covariance(1.2, BELIEVED.rate_walk / ARCSEC, 0.5) + np.outer(b, b)
        P = scipy.linalg.solve_discrete_are(A.T, np.eye(2)[:, :1], Q, np.array([[sigma**2]]))
        K = P[:, 0] / (P[0, 0] + sigma**2)
        np.testing.assert_allclose(design.gain(BELIEVED, recipe)[[i, 3 + i], i], K, rtol=1e-6)


def test_raw_takes_the_star_sensor_at_its_word():
    K = design.gain(BELIEVED, GainSpec("raw"))
    np.testing.assert_array_equal(K, np.concatenate([np.eye(3), np.zeros((3, 3))]))
    assert design.facts(BELIEVED, GainSpec("raw")) == {}


def test_facts_are_certified_norms():
    found = design.facts(BELIEVED, GainSpec("riccati", 0.5))
    assert found["worst_case_share"] == pytest.approx(0.5, rel=1e-6)
    # the covariance of the error at frames, by running its recursion
    total = 0.0
    K = design.gain(BELIEVED, GainSpec("riccati", 0.5))
    A = np.array([[1.0, -0.5], [0.0, 1.0]])
    Q, H = walk_covariance(1.2, BELIEVED.rate_walk / ARCSEC, 0.5), np.array([[1.0, 0.0]])
    for i, sigma in enumerate((10.0, 10.0, 40.0)):
        k = K[[i, 3 + i], i][:, None]
        P = np.eye(2)
        for _ in range(5000):
            P = A @ P @ A.T + Q
            P = (np.eye(2) - k @ H) @ P @ (np.eye(2) - k @ H).T + sigma**2 * k @ k.T
        total += P[0, 0]
    assert found["predicted_rms_arcsec"] == pytest.approx(math.sqrt(total), rel=1e-6)


def test_the_star_sensor_reads_either_sign():
    sensor = model(NOISE, STAR).sensors[0]
    seen = start(Q0, 60 * ARCSEC, 3 * ARCSEC)
    off = multiply(Q0, jnp.asarray(Scipy.from_rotvec([1e-4, 0, 0]).as_quat(scalar_first=True)))
    one, other = (
        taylor().observation(seen, sensor, BodyRotation(s * off), None).residual
        for s in (1.0, -1.0)
    )
    np.testing.assert_allclose(one, [1e-4, 0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(one, other, atol=1e-18)
    assert jax.tree.leaves(seen)[0].shape == (4,)
