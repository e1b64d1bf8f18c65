"""Gyros of a spacecraft: each process against its closed form, and angles that get lost nowhere."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn import assert_variance

from robins.ins.imu_errors import TriadErrors, allan_deviation, mean_sigma
from robins.sim.gyro import gyro_errors, read_gyro
from robins.sim.random import Component, stream

DT, COUNT, RUNS = 0.1, 400, 500
BENT = np.array([[0.0, 0.01, -0.02], [0.03, 0.0, 0.04], [-0.05, 0.06, 0.0]])
# One process on each axis, a constant on top of the third.
ERRORS = TriadErrors(
    white=[2.0, 0.0, 0.0],
    walk=[0.0, 0.5, 0.0],
    markov_sigma=[0.0, 0.0, 0.3],
    markov_tau_s=7.0,
    bias_sigma=[0.0, 0.0, 1.0],
    ramp=[0.0, 0.0, 0.02],
    scale=[1e-3, -2e-3, 3e-3],
    misalignment=BENT,
)
keys = jax.vmap(lambda run: stream(4, run, Component.IMU))
batch = jax.jit(jax.vmap(lambda key, model: gyro_errors(key, model, COUNT, DT), (0, None)))


@pytest.fixture(scope="module")
def drawn():
    return batch(keys(jnp.arange(RUNS)), ERRORS)


@pytest.mark.parametrize("first", [0, 150])
@pytest.mark.parametrize("length", [1, 40, 250])
def test_the_angle_grows_as_each_process_must(drawn, first, length):
    time, start = length * DT, first * DT
    angle = np.asarray(drawn.angle)[:, first : first + length].sum(1)
    assert_variance(angle[:, 0], 2.0**2 * time)
    assert_variance(angle[:, 1], 0.5**2 * (time**3 / 3.0 + start * time**2))
    x = time / 7.0
    markov = 2.0 * (0.3 * 7.0) ** 2 * (x + np.expm1(-x))
    ramp = 0.02 * (start * time + time**2 / 2.0)
    assert_variance(angle[:, 2] - ramp, markov + time**2)


def test_the_bias_is_the_mean_of_what_is_not_white(drawn):
    angle, bias = np.asarray(drawn.angle), np.asarray(drawn.bias)
    np.testing.assert_allclose(angle[..., 1:], bias[..., 1:] * DT, rtol=1e-13, atol=1e-17)
    np.testing.assert_array_equal(bias[..., 0], 0.0)
    white = (angle - bias * DT)[..., 0]
    assert_variance(white.ravel(), 2.0**2 * DT)
    # White in time too: what the bias has not, no later sample shows again.
    assert abs(np.corrcoef(white[:, :-1].ravel(), white[:, 1:].ravel())[0, 1]) < 4.0 / 2e5**0.5


def test_the_mean_over_the_run_is_that_of_the_closed_form(drawn):
    mean = np.asarray(drawn.angle).sum(1) / (COUNT * DT) - 0.02 * COUNT * DT / 2.0 * np.eye(3)[2]
    assert_variance(mean, mean_sigma(ERRORS, COUNT * DT) ** 2)


def test_the_allan_curve_is_the_one_the_model_predicts(drawn):
    for length in (4, 40):
        means = np.asarray(drawn.angle).reshape(RUNS, -1, length, 3).mean(2) / DT
        half = np.square(np.diff(means, axis=1)) / 2.0
        # Differences in one run depend on each other; those of one place in all runs do not.
        of_runs = half.mean(1)
        ratio = of_runs.mean(0) / allan_deviation(ERRORS, length * DT) ** 2
        spread = of_runs.std(0) / of_runs.mean(0) / RUNS**0.5
        assert np.all(np.abs(ratio - 1.0) < 4.0 * spread)


def test_scale_and_misalignment_are_those_of_the_model(drawn):
    wanted = np.diag([1e-3, -2e-3, 3e-3]) + BENT
    np.testing.assert_allclose(drawn.matrix, np.broadcast_to(wanted, (RUNS, 3, 3)), rtol=1e-14)


def test_the_same_numbers_are_drawn_whatever_the_sizes(drawn):
    twice = jax.tree.map(lambda x: 2.0 * x, ERRORS)
    twice = dataclasses.replace(twice, markov_tau_s=ERRORS.markov_tau_s)
    np.testing.assert_allclose(
        batch(keys(jnp.arange(RUNS)), twice).angle, 2.0 * drawn.angle, rtol=1e-12, atol=1e-15
    )
    # White noise of another size leaves all that is slow, and a shorter run is the longer's start.
    quieter = dataclasses.replace(ERRORS, white=[0.5, 0.0, 0.0])
    short = gyro_errors(stream(4, 3, Component.IMU), quieter, 50, DT)
    np.testing.assert_allclose(short.bias, drawn.bias[3, :50], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(4.0 * short.angle[:, 0], drawn.angle[3, :50, 0], rtol=1e-12)


def test_errors_that_are_not_there_are_zero():
    for x in gyro_errors(stream(4, 0, Component.IMU), TriadErrors(quantum=1e-3), 5, DT):
        np.testing.assert_array_equal(x, 0.0)


reading = jax.jit(
    lambda theta, errors, quantum: jax.lax.scan(
        lambda residue, row: read_gyro(*row, errors.matrix, residue, quantum)[::-1],
        jnp.zeros(3),
        (theta, errors.angle),
    )[1]
)


def test_what_is_reported_is_counts_of_an_angle_of_which_nothing_is_lost(drawn):
    errors = jax.tree.map(lambda x: x[0], drawn)
    theta = jnp.asarray(np.random.default_rng(5).normal(0.02, 0.01, (COUNT, 3)))
    exact = np.asarray(theta + theta @ errors.matrix.T + errors.angle)
    np.testing.assert_allclose(reading(theta, errors, 0.0), exact, rtol=1e-12, atol=1e-15)
    quantum = np.array([0.05, 0.3, 0.0])
    reported = np.asarray(reading(theta, errors, quantum))
    counts = reported[:, :2] / quantum[:2]
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
    assert np.unique(np.rint(counts)).size > 3
    left = np.cumsum(exact - reported, axis=0)
    assert np.all(np.abs(left) <= quantum / 2.0 + 1e-12)
    assert np.all(np.abs(left[:, :2]).max(0) > 0.4 * quantum[:2])  # and is as large as it may be
    # Quantised without carrying, the sum walks away from the truth.
    lost = np.cumsum(exact - np.rint(exact / 0.3) * 0.3, axis=0)
    assert np.abs(lost[:, 1]).max() > 2.0 * 0.3


@pytest.mark.parametrize(
    ("model", "count", "dt", "message"),
    [
        (ERRORS, 0, DT, "count is 0"),
        (ERRORS, 5, 0.0, "dt_s must be a finite number above 0"),
        (TriadErrors(full_scale=1.0), 5, DT, "simulates no full scale"),
    ],
)
def test_what_cannot_be_drawn_is_refused(model, count, dt, message):
    with pytest.raises(ValueError, match=message):
        gyro_errors(stream(4, 0, Component.IMU), model, count, dt)
