"""Simulated inertial sensors: each error against its closed form, alone and by its statistics."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn import assert_variance
from scipy.linalg import expm

from robins.dataset import ImuTable
from robins.ins.allan import deviation
from robins.ins.imu_errors import ImuErrorModel, TriadErrors, allan_deviation, mean_sigma
from robins.sim.imu_sensor import (
    _less_tanh,
    begin,
    corrupt,
    corrupt_table,
    markov_step,
    sample,
    walk_step,
)
from robins.sim.random import Component, stream

N = 40
RNG = np.random.default_rng(0)
DT = RNG.uniform(0.005, 0.02, N)
THETA = RNG.normal(size=(N, 3)) * 0.01
DV = RNG.normal(size=(N, 3)) * 0.1
DV[3, 1] = -0.0  # whose sign a mere addition of zero would lose
KEY = stream(77, 5, Component.IMU)

corrupt_jit = jax.jit(corrupt)


def bits(x):
    return np.asarray(x).view(np.int64)


def gyro(**errors):
    return ImuErrorModel(gyro=TriadErrors(**errors))


def test_a_unit_without_errors_reports_the_truth_bit_for_bit():
    theta, dv, truth = corrupt_jit(DT, THETA, DV, ImuErrorModel(), KEY)
    np.testing.assert_array_equal(bits(theta), bits(THETA))
    np.testing.assert_array_equal(bits(dv), bits(DV))
    for triad in truth:
        assert not np.any(triad.clipped)
        for x in (triad.bias, triad.matrix, triad.g_sensitivity):
            assert not np.any(x)
        assert triad.bias.shape == (N, 3)


GIVEN = np.array([[0.0, 1e-3, -2e-3], [3e-3, 0.0, 4e-3], [-5e-3, 6e-3, 0.0]])
ELAPSED = np.concatenate([[0.0], np.cumsum(DT)])
NONE = {  # present, of no effect: one structure, one compilation for all that follow
    "bias": 0.0,
    "scale": 0.0,
    "misalignment": 0.0,
    "ramp": 0.0,
    "full_scale": 1e9,
    "quantum": 0.0,
}
PLAIN = NONE | {"g_sensitivity": 0.0}
FIXED = {  # error -> what it makes of the ideal increments x of samples with velocity increments f
    "bias": ([1.0, -2.0, 3.0], lambda x, f, e: x + DT[:, None] * e),
    "scale": ([1e-3, 0.0, -2e-3], lambda x, f, e: x * (1.0 + np.array(e))),
    "misalignment": (GIVEN, lambda x, f, e: x @ (np.eye(3) + e).T),
    "ramp": ([0.1, 0.2, -0.3], lambda x, f, e: x + np.diff(ELAPSED**2)[:, None] / 2.0 * e),
    "full_scale": ([0.5, 1.0, 2.0], lambda x, f, e: np.clip(x, -DT[:, None] * e, DT[:, None] * e)),
    "g_sensitivity": (GIVEN, lambda x, f, e: x + f @ e.T),
}


@pytest.mark.parametrize(
    ("sensor", "name"),
    [("gyro", name) for name in FIXED]
    + [("accel", name) for name in FIXED if name != "g_sensitivity"],
)
def test_a_given_error_alone_changes_what_it_must_and_nothing_else(sensor, name):
    error, wanted = FIXED[name]
    none = PLAIN if sensor == "gyro" else NONE
    model = ImuErrorModel(**{sensor: TriadErrors(**(none | {name: error}))})
    theta, dv, truth = corrupt_jit(DT, THETA, DV, model, KEY)
    reported, ideal = (theta, THETA) if sensor == "gyro" else (dv, DV)
    np.testing.assert_allclose(reported, wanted(ideal, DV, error), rtol=1e-13, atol=1e-17)
    untouched, kept = (dv, DV) if sensor == "gyro" else (theta, THETA)
    np.testing.assert_array_equal(bits(untouched), bits(kept))

    got, nothing = getattr(truth, sensor), np.zeros((3, 3))
    grown = {"bias": np.ones(N), "ramp": ELAPSED[1:]}.get(name, np.zeros(N))
    np.testing.assert_allclose(got.bias, grown[:, None] * np.ravel(error)[:3], rtol=1e-13)
    matrix = {"scale": np.diag(np.ravel(error)[:3]), "misalignment": GIVEN}
    np.testing.assert_array_equal(got.matrix, matrix.get(name, nothing))
    np.testing.assert_array_equal(got.g_sensitivity, GIVEN if name == "g_sensitivity" else nothing)
    beyond = np.abs(ideal) / DT[:, None] > (error if name == "full_scale" else np.inf)
    np.testing.assert_array_equal(got.clipped, beyond)
    assert beyond.any() == (name == "full_scale")


def test_quantised_increments_are_counts_and_lose_nothing_in_sum():
    quantum = np.array([1e-3, 2e-3, 0.0])
    theta, _, _ = corrupt_jit(DT, THETA, DV, gyro(**(PLAIN | {"quantum": quantum})), KEY)
    counts = np.asarray(theta)[:, :2] / quantum[:2]
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
    assert np.unique(np.rint(counts)).size > 5
    left = np.cumsum(THETA - theta, axis=0)
    assert np.all(np.abs(left[:, :2]) <= quantum[:2] / 2.0 * (1.0 + 1e-9))
    assert np.abs(left[:, :2]).max() > 0.3 * quantum[1]  # the residue is really there
    np.testing.assert_allclose(left[:, 2], 0.0, atol=1e-16)  # quantum 0: not quantised


def test_clipping_comes_before_quantising():
    quantum, limit = 1e-3, 0.3
    model = gyro(**(PLAIN | {"quantum": quantum, "full_scale": limit}))
    theta, _, truth = corrupt_jit(DT, THETA, DV, model, KEY)
    clipped = np.clip(THETA, -limit * DT[:, None], limit * DT[:, None])
    assert np.any(truth.gyro.clipped)
    assert np.all(np.abs(np.cumsum(theta - clipped, axis=0)) <= quantum / 2.0 * (1.0 + 1e-9))


@pytest.mark.parametrize("ratio", [1e-4, 1e-2, 0.15, 0.25, 1.0, 3.0])
def test_markov_step_has_the_covariance_of_van_loan(ratio):
    sigma, tau = 3.0, 20.0
    dt = ratio * tau
    # State: bias and its integral (Van Loan 1978).
    drift = np.array([[-1.0 / tau, 0.0], [1.0, 0.0]])
    noise = np.diag([2.0 * sigma**2 / tau, 0.0])
    big = expm(np.block([[-drift, noise], [np.zeros((2, 2)), drift.T]]) * dt)
    phi = big[2:, 2:].T
    wanted = phi @ big[:2, 2:]
    start = markov_step(jnp.ones(1), sigma, tau, dt, jnp.zeros(1))
    np.testing.assert_allclose(np.ravel(start[:2]), phi[:, 0], rtol=1e-12)
    gain, mean, rest = markov_step(jnp.zeros(1), sigma, tau, dt, jnp.ones(1))
    got = np.array([[gain**2, gain * mean], [gain * mean, mean**2 + rest]])[..., 0]
    # What rounding leaves of the matrix exponential, whose entries are of the size of one.
    np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-13)


def test_what_the_ends_leave_open_is_computed_without_cancellation():
    u = np.geomspace(1e-6, 5.0, 300).astype(np.longdouble)
    # Eighteen digits leave thirteen at the switch; there the series is exact to fifteen.
    wanted = np.where(u > 0.005, u - np.tanh(u), u**3 / 3 - 2 * u**5 / 15 + 17 * u**7 / 315)
    got = _less_tanh(jnp.asarray(u.astype(float)))
    np.testing.assert_allclose(got, wanted.astype(float), rtol=2e-12)


@pytest.mark.parametrize("step", ["markov", "walk"])
def test_steps_of_any_length_give_the_same_process(step):
    def joint(dt, count):
        """Covariance of (end, integral) after a start of variance 4."""
        covariance = np.diag([4.0, 0.0])
        for _ in range(count):
            one, zero = jnp.ones(1), jnp.zeros(1)
            if step == "markov":
                parts = [markov_step(b, 3.0, 20.0, dt, n) for b, n in ((one, zero), (zero, one))]
            else:
                parts = [walk_step(b, 3.0, dt, n) for b, n in ((one, zero), (zero, one))]
            (end, integral, rest), (gain, mean, _) = ([float(jnp.sum(x)) for x in p] for p in parts)
            move = np.array([[end, 0.0], [integral, 1.0]])
            drive = np.array([gain, mean])
            covariance = move @ covariance @ move.T + np.outer(drive, drive)
            covariance[1, 1] += rest
        return covariance

    np.testing.assert_allclose(joint(0.5, 40), joint(20.0, 1), rtol=1e-10)


def test_walk_step_has_the_moments_of_brownian_motion():
    gain, mean, rest = (np.asarray(x) for x in walk_step(jnp.zeros(2), 3.0, 4.0, jnp.ones(2)))
    np.testing.assert_allclose(gain**2, 9.0 * 4.0)
    np.testing.assert_allclose(gain * mean, 9.0 * 4.0**2 / 2.0)
    np.testing.assert_allclose(mean**2 + rest, 9.0 * 4.0**3 / 3.0)


STEPS, RUNS = 400, 1000
ALL = ImuErrorModel(
    gyro=TriadErrors(
        bias=0.5,
        bias_sigma=[1.0, 2.0, 3.0],
        scale_sigma=0.2,
        misalignment_sigma=0.3,
        g_sensitivity_sigma=0.4,
        markov_sigma=[1.0, 2.0, 0.5],
        markov_tau_s=[1.0, 0.5, 2.0],
    ),
    accel=TriadErrors(walk=[1.0, 2.0, 0.5], white=[0.3, 0.2, 0.1]),
)


@pytest.fixture(scope="module")
def batch():
    """A unit at rest: RUNS runs of STEPS samples, 4 s, in steps of two lengths."""
    dt = np.tile([0.005, 0.015], STEPS // 2)
    zero = jnp.zeros((STEPS, 3))

    def one(run):
        return corrupt(dt, zero, zero, ALL, stream(3, run, Component.IMU))

    return dt, jax.jit(jax.vmap(one))(jnp.arange(RUNS))


def test_what_is_drawn_once_has_its_sigma(batch):
    truth = batch[1][2].gyro
    matrix = np.asarray(truth.matrix)
    assert_variance(np.diagonal(matrix, axis1=1, axis2=2), 0.2**2)
    off = ~np.eye(3, dtype=bool)
    assert_variance(matrix[:, off], 0.3**2)
    assert_variance(np.reshape(truth.g_sensitivity, (RUNS, 9)), 0.4**2)
    numbers = np.column_stack([matrix.reshape(RUNS, 9), np.reshape(truth.g_sensitivity, (RUNS, 9))])
    correlation = np.corrcoef(numbers.T)[~np.eye(18, dtype=bool)]
    assert np.abs(correlation).max() < 5.0 / np.sqrt(RUNS)


def test_the_markov_bias_is_stationary_with_its_correlation_time(batch):
    dt, (_, _, truth) = batch
    sigma, tau = ALL.gyro.markov_sigma, ALL.gyro.markov_tau_s
    bias = np.asarray(truth.gyro.bias) - 0.5
    constant = ALL.gyro.bias_sigma**2
    for k in (0, STEPS // 2, STEPS - 1):
        assert_variance(bias[:, k], constant + sigma**2)
    first, last, between = 9, 59, np.sum(dt[10:60])
    change = bias[:, last] - bias[:, first]
    assert_variance(change, 2.0 * sigma**2 * -np.expm1(-between / tau))


def test_the_reported_increment_holds_the_integral_of_the_bias(batch):
    dt, (theta, _, truth) = batch
    sigma, tau = ALL.gyro.markov_sigma, ALL.gyro.markov_tau_s
    # Closed form of the integrated Gauss-Markov process plus constant, over all of the run.
    time = dt.sum()
    x = time / tau
    wanted = 2.0 * (sigma * tau) ** 2 * (x + np.expm1(-x)) + (ALL.gyro.bias_sigma * time) ** 2
    assert_variance(np.asarray(theta).sum(1) - 0.5 * time, wanted)
    # Within each sample it lies near the mean of the true bias at the two ends.
    bias = np.asarray(truth.gyro.bias)
    middle = 0.5 * (bias[:, 1:] + bias[:, :-1]) * dt[1:, None]
    rest = 2.0 * sigma**2 / tau * dt[1:, None] ** 3 / 12.0
    gap = (np.asarray(theta)[:, 1:] - middle) / np.sqrt(rest)
    assert_variance(gap.reshape(-1, 3), 1.0 + 0.0 * sigma)


def test_white_noise_and_random_walk_grow_as_they_must(batch):
    dt, (_, dv, truth) = batch
    white, walk = ALL.accel.white, ALL.accel.walk
    bias = np.asarray(truth.accel.bias)
    time = np.cumsum(dt)
    for k in (0, 99, STEPS - 1):
        assert_variance(bias[:, k], walk**2 * time[k])
    assert_variance((bias[:, 300] - bias[:, 100]), walk**2 * (time[300] - time[100]))
    total = np.asarray(dv).sum(1)
    assert_variance(total, white**2 * time[-1] + walk**2 * time[-1] ** 3 / 3.0)
    # Joint with the bias at the end: what the bias does not explain of the total.
    explained = bias[:, -1] * time[-1] / 2.0
    assert_variance(total - explained, white**2 * time[-1] + walk**2 * time[-1] ** 3 / 12.0)
    first = np.asarray(dv)[:, 0]
    assert_variance(first, white**2 * dt[0] + walk**2 * dt[0] ** 3 / 3.0)


def test_mean_sigma_is_that_of_the_simulated_means(batch):
    dt, (theta, dv, _) = batch
    time = dt.sum()
    assert_variance(np.asarray(theta).sum(1) / time - 0.5, mean_sigma(ALL.gyro, time) ** 2)
    assert_variance(np.asarray(dv).sum(1) / time, mean_sigma(ALL.accel, time) ** 2)


def test_runs_axes_and_triads_are_independent(batch):
    _, (theta, dv, _) = batch
    # Normalised changes from sample to sample are nearly white in time.
    series = np.concatenate([np.asarray(theta)[:6, :, :], np.asarray(dv)[:6, :, :]], axis=2)
    steps = np.diff(series[:, ::2], axis=1)
    columns = np.moveaxis(steps, 1, 0).reshape(steps.shape[1], -1)
    correlation = np.corrcoef(columns.T)[~np.eye(columns.shape[1], dtype=bool)]
    assert np.abs(correlation).max() < 5.0 * np.sqrt(1.5 / len(columns))


def test_a_run_alone_and_sample_by_sample_is_that_of_the_batch(batch):
    dt, (theta, dv, truth) = batch
    imu, state = begin(ALL, stream(3, 7, Component.IMU))
    online = jax.jit(sample)
    rows = []
    for k in range(5):
        state, row = online(imu, state, jnp.asarray(dt[k]), jnp.zeros(3), jnp.zeros(3))
        rows.append(row)
    for name, whole, stepped in (
        ("theta", theta[7], [r[0] for r in rows]),
        ("dv", dv[7], [r[1] for r in rows]),
        ("bias", truth.gyro.bias[7], [r[2].gyro.bias for r in rows]),
        ("matrix", truth.gyro.matrix[None, 7].repeat(5, 0), [r[2].gyro.matrix for r in rows]),
    ):
        # The numbers drawn are the same bits; their sums differ by how the compiler orders them.
        np.testing.assert_allclose(stepped, whole[:5], rtol=1e-12, atol=1e-15, err_msg=name)
    assert int(state.number) == 5
    np.testing.assert_allclose(state.elapsed_s, dt[:5].sum())


MIXED = ImuErrorModel(
    TriadErrors(white=0.01, markov_sigma=0.1, markov_tau_s=3.0, bias_sigma=0.5, scale_sigma=0.01),
    TriadErrors(bias=0.1, ramp=0.2, misalignment=0.01),
)


def test_an_error_more_leaves_the_noise_of_the_others():
    theta, _, truth = corrupt_jit(DT, THETA, DV, MIXED, KEY)
    more = ImuErrorModel(
        dataclasses.replace(MIXED.gyro, walk=0.0, misalignment_sigma=0.0, g_sensitivity_sigma=0.0),
        TriadErrors(white=1.0, walk=1.0),
    )
    theta_more, dv_more, truth_more = corrupt_jit(DT, THETA, DV, more, KEY)
    assert np.all(theta != THETA)
    np.testing.assert_allclose(theta_more, theta, rtol=1e-12, atol=1e-17)
    np.testing.assert_allclose(truth_more.gyro.bias, truth.gyro.bias, rtol=1e-12)
    # The accelerometers draw numbers of their own.
    correlation = np.corrcoef(np.ravel(dv_more - DV), np.ravel(theta_more - THETA))[0, 1]
    assert abs(correlation) < 5.0 / np.sqrt(3 * N)


def test_the_allan_curve_is_the_one_the_model_predicts():
    dt, n, runs = 0.1, 3000, 60
    errors = TriadErrors(
        white=[1.0, 0.2, 0.2],
        markov_sigma=[0.0, 1.0, 1.0],
        markov_tau_s=3.0,
        walk=[0.05, 0.0, 0.05],
        quantum=[0.5, 0.1, 0.0],  # below the white noise of a sample, so roundings are independent
        ramp=[0.0, 0.0, 0.01],
    )
    zero = jnp.zeros((n, 3))

    def one(run):
        model = ImuErrorModel(gyro=errors)
        return corrupt(jnp.full(n, dt), zero, zero, model, stream(9, run, Component.IMU))[0]

    theta = np.asarray(jax.jit(jax.vmap(one))(jnp.arange(runs)))
    rate = np.moveaxis(theta, 1, 0).reshape(n, 3 * runs) / dt
    curve = deviation(rate, dt_s=dt, clusters=[1, 3, 10, 30, 100, 300])
    wanted = allan_deviation(errors, curve.tau_s)
    # The mean of the variances of many runs, whose spread the runs themselves show.
    variance = np.square(curve.deviation).reshape(-1, runs, 3)
    error = variance.mean(1) / wanted**2 - 1.0
    spread = variance.std(1) / wanted**2 / np.sqrt(runs)
    assert np.all(np.abs(error) < 4.0 * spread), error / spread
    assert np.all(spread < 0.1)


def test_models_of_one_structure_map():
    models = [gyro(**(PLAIN | {"bias": b, "scale": 0.1 * b})) for b in (1.0, 2.0)]
    stacked = jax.tree.map(lambda *x: np.stack(x), *models)
    sweep = jax.jit(jax.vmap(lambda m: corrupt(DT, THETA, DV, m, KEY)[0]))(stacked)
    for row, model in zip(sweep, models, strict=True):
        np.testing.assert_allclose(row, corrupt_jit(DT, THETA, DV, model, KEY)[0], rtol=1e-12)


def test_gradients_are_finite_and_right():
    def cost(model):
        theta, dv, _ = corrupt_jit(DT, THETA, DV, model, KEY)
        return jnp.sum(theta**2) + jnp.sum(dv**2)

    slopes = jax.grad(cost)(MIXED)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slopes))
    leaves, tree = jax.tree.flatten(MIXED)
    for i, slope in enumerate(jax.tree.leaves(slopes)):
        step = 1e-6 * np.maximum(np.abs(leaves[i]), 1e-3)
        up, down = (
            cost(jax.tree.unflatten(tree, [*leaves[:i], leaves[i] + s * step, *leaves[i + 1 :]]))
            for s in (1.0, -1.0)
        )
        np.testing.assert_allclose(np.sum(slope * step), (up - down) / 2.0, rtol=1e-5, atol=1e-12)


def test_tables_of_rates_and_of_increments():
    time_ns = np.rint(1e9 * np.cumsum(DT)).astype(np.int64)
    dt = np.diff(time_ns, prepend=2 * time_ns[0] - time_ns[1]) * 1e-9
    model = gyro(**(PLAIN | {"bias": 2.0, "scale": 0.1}))
    table = ImuTable(time_ns, THETA, DV, "increment", body="RFU", source="here")
    got, truth = corrupt_table(table, model, KEY)
    np.testing.assert_allclose(got.gyro, 1.1 * THETA + 2.0 * dt[:, None], rtol=1e-12, atol=1e-17)
    np.testing.assert_array_equal(bits(got.accel), bits(DV))
    np.testing.assert_array_equal(truth.gyro.bias, np.full((N, 3), 2.0))
    assert (got.kind, got.body, got.source) == ("increment", "RFU", "here")
    rates = ImuTable(time_ns, THETA, DV, "rate")
    got, _ = corrupt_table(rates, model, KEY)
    np.testing.assert_allclose(got.gyro, 1.1 * THETA + 2.0, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(got.accel, DV, rtol=1e-15)
    for bad in (time_ns[:1], time_ns[[0, 2, 1]], time_ns[[0, 0]]):
        rows = slice(len(bad))
        with pytest.raises(ValueError, match="two rows and time that increases"):
            corrupt_table(ImuTable(bad, THETA[rows], DV[rows], "rate"), model, KEY)


@pytest.mark.parametrize(
    ("dt", "theta", "dv"),
    [(DT[:-1], THETA, DV), (DT, THETA[:, :2], DV), (DT, THETA, DV[1:]), (0.01, THETA, DV)],
)
def test_shapes_that_do_not_fit_are_refused(dt, theta, dv):
    with pytest.raises(ValueError, match=r"must have shapes \(n,\), \(n, 3\), \(n, 3\)"):
        corrupt(dt, theta, dv, ImuErrorModel(), KEY)
