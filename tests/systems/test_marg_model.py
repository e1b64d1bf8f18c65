"""The MARG model: Jacobians, integrals of blocks, and a filter that knows what it does not know."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from in_lanes import each
from scipy import stats
from scipy.spatial.transform import Rotation as SciRotation

from robins import manifold
from robins.filters import Belief, kalman, run
from robins.manifold import Angle
from robins.rotation import Rotation
from robins.systems.marg import Block, MargReplay, Samples, integrate, model_of
from robins.systems.marg.model import (
    DIM,
    MAGNETOMETER,
    REST,
    REVISIT,
    SITES,
    TRAVEL,
    MargState,
    causal_attitudes,
    persistence,
    smoothed_attitudes,
)

MODEL = model_of(MargReplay())


def some_state(seed=0) -> MargState:
    rng = np.random.default_rng(seed)
    draw = lambda *shape: jnp.asarray(rng.standard_normal(shape))  # noqa: E731
    return MargState(
        Rotation.from_rotvec(draw(3)),
        draw(3),
        draw(3),
        0.02 * draw(3),
        0.01 * draw(3, 3),
        0.05 * draw(3),
        0.1 * draw(),
        1e-5 * jnp.array([1.8, 4.4]),
        0.3 * draw(SITES),
        9.81 + 0.1 * draw(),
    )


def some_samples(seed=0, blocks=2, n=7) -> Samples:
    rng = np.random.default_rng(seed)
    return Samples(
        0.01 * rng.uniform(0.8, 1.2, (blocks, n)),
        0.1 * rng.standard_normal((blocks, n, 3)),
        0.1 * rng.standard_normal((blocks, n, 3)),
        2e-5 * rng.standard_normal((blocks, n, 3)),
    )


def some_block(seed=0, still=0.0) -> Block:
    first = jax.tree.map(lambda a: np.asarray(a)[0], integrate(some_samples(seed))[0])
    return Block(first, still=np.asarray(still), lost_turn=np.zeros(()), lost_dv=np.zeros(()))


def slope(function, x):
    """(., n) central differences between tangent spaces."""
    value = function(x)
    columns = []
    for i in range(DIM):
        # every component in units of its own, so that no difference drowns
        step = 1e-9 if i in (25, 26) else 1e-5
        ends = [function(manifold.retract(x, s * step * jnp.eye(DIM)[i])) for s in (1.0, -1.0)]
        up, down = (np.asarray(manifold.local(value, end)) for end in ends)
        columns.append((up - down) / (2.0 * step))
    return np.stack(columns, axis=1)


def test_jacobian_of_the_motion_is_that_of_differences():
    x, block = some_state(), some_block()
    new, F, _ = MODEL.motion.linear(x, block)
    step = jax.jit(MODEL.motion.step)
    np.testing.assert_allclose(np.asarray(F), slope(lambda s: step(s, block), x), atol=2e-5)
    np.testing.assert_array_equal(np.asarray(new.v_n), np.asarray(MODEL.motion.step(x, block).v_n))


@pytest.mark.parametrize(
    ("name", "aux"),
    [
        (TRAVEL, jnp.zeros(())),
        (REST, jnp.array([0.01, -0.02, 0.005, 0.001])),
        (MAGNETOMETER, jnp.array([1e-5, 2e-5, -3e-5])),
        (REVISIT, jnp.array([1e-5, 2e-5, -3e-5, 0.01, 0.0, 1.0, 0.0, 0.0])),
    ],
)
def test_jacobians_of_the_sensors_are_those_of_differences_but_for_tilt(name, aux):
    x, sensor = some_state(1), MODEL.sensor(name)
    read = jax.jit(sensor.read)
    z, H = sensor.linear(x, aux)
    numeric = slope(lambda s: read(s, aux), x)
    if name in (MAGNETOMETER, REVISIT):
        assert np.max(np.abs(numeric[:, :2])) > 0.1  # there is something left out
        numeric[:, :2] = 0.0
        assert isinstance(z[0] if name == MAGNETOMETER else z, Angle)
    np.testing.assert_allclose(np.asarray(H), numeric, atol=1e-8)


def test_integrals_of_a_block_are_those_of_a_loop_over_its_samples():
    samples = some_samples(3)
    found, field_b = integrate(samples)
    for k in range(2):
        R, dv, time, rates, field = SciRotation.identity(), 0.0, 0.0, np.zeros((3, 3, 3)), 0.0
        for dt, theta, push, b in zip(*(a[k] for a in samples), strict=True):
            half = (R * SciRotation.from_rotvec(0.5 * theta)).as_matrix()
            dv, time = dv + R.apply(push), time + half * dt
            rates = rates + np.multiply.outer(half, theta)
            R = R * SciRotation.from_rotvec(theta)
            field = field + R.apply(b) / 7.0
        q = np.roll(R.as_quat(), 1)
        turn = np.asarray(found.turn[k])
        np.testing.assert_allclose(turn * np.sign(turn @ q), q, atol=1e-14)
        np.testing.assert_allclose(found.dv[k], dv, atol=1e-14)
        np.testing.assert_allclose(found.turn_time[k], time, atol=1e-15)
        np.testing.assert_allclose(found.turn_rates[k], rates.reshape(3, 9), atol=1e-14)
        np.testing.assert_allclose(field_b[k], R.inv().apply(field), atol=1e-18)
    np.testing.assert_allclose(found.angle, np.linalg.norm(samples.theta, axis=2).sum(axis=1))


def test_a_block_turns_by_bias_and_gain_as_its_samples_do():
    full, samples = some_state(4), some_samples(4)
    samples = samples._replace(theta=samples.theta / 10.0)  # 280 Hz and a quick hand
    whole, _ = integrate(samples)
    none = np.zeros(())
    block = Block(jax.tree.map(lambda a: np.asarray(a)[0], whole), none, none, none)
    missed = []
    for share in (1.0, 0.1):
        x = full._replace(gyro_gain=share * full.gyro_gain, gyro_bias=share * full.gyro_bias)
        q = SciRotation.from_quat(np.roll(np.asarray(x.q_nb.wxyz), -1))
        gain, bias = np.asarray(x.gyro_gain), np.asarray(x.gyro_bias)
        for dt, theta in zip(samples.dt_s[0], samples.theta[0], strict=True):
            q = q * SciRotation.from_rotvec(theta + gain @ theta - bias * dt)
        after = MODEL.motion.step(x, block)
        there = Rotation(jnp.asarray(np.roll(q.as_quat(), 1)))
        missed.append(float(np.linalg.norm(there.local(after.q_nb))))
        posterior = jax.tree_util.tree_map(lambda a: jnp.stack([a, a]), after)
        inside = causal_attitudes(x, posterior, samples)
        np.testing.assert_array_equal(np.asarray(inside[0, -1]), np.asarray(after.q_nb.wxyz))
    # right to first order: what is left is a product of two small numbers
    assert missed[0] < 1e-4
    assert missed[1] < 0.02 * missed[0]


def test_smoothed_attitudes_meet_the_smoothed_states_and_follow_the_gyro():
    samples = some_samples(5, blocks=4)
    states = [some_state(i) for i in range(4)]
    smoothed = jax.tree_util.tree_map(lambda *a: jnp.stack(a), *states)
    q, first = smoothed_attitudes(smoothed, samples)
    met = Rotation(q[:, -1]).local(smoothed.q_nb)
    np.testing.assert_allclose(np.asarray(met), 0.0, atol=1e-12)
    at = SciRotation.from_quat(np.roll(np.asarray(first), -1))
    gain, bias = np.asarray(states[0].gyro_gain), np.asarray(states[0].gyro_bias)
    for k, (dt, theta) in enumerate(zip(samples.dt_s[0], samples.theta[0], strict=True)):
        at = at * SciRotation.from_rotvec(theta + gain @ theta - bias * dt)
        there = SciRotation.from_quat(np.roll(np.asarray(q[0, k]), -1))
        assert (at.inv() * there).magnitude() < 1e-12


def test_the_declination_fades_in_motion_and_stands_at_rest():
    noise = MODEL.motion.step.args[0]
    moving, still = some_block(), some_block(still=1.0)
    share = float(persistence(noise, moving))
    assert share == pytest.approx(np.exp(-float(moving.samples.dt_s) / 60.0))
    assert float(persistence(noise, still)) == 1.0
    factor = MODEL.motion.linear(some_state(), moving)[2]
    assert float(factor[24, 24]) == pytest.approx(
        MargReplay().magnetometer.declination * np.sqrt(1.0 - share**2)
    )
    assert float(MODEL.motion.linear(some_state(), still)[2][24, 24]) == 0.0


def test_what_a_gyro_did_not_sample_is_lost_about_its_own_axis():
    x, lost = some_state(3), np.array([0.2, 0.0, 0.0])
    bare, block = some_block(), some_block()._replace(lost_turn=lost)
    Q = [
        np.asarray(f) @ np.asarray(f).T
        for f in (MODEL.motion.linear(x, b)[2] for b in (bare, block))
    ]
    R = np.asarray(x.q_nb.as_dcm())
    np.testing.assert_allclose((Q[1] - Q[0])[:3, :3], R @ np.diag(lost**2) @ R.T, atol=1e-12)
    np.testing.assert_allclose((Q[1] - Q[0])[3:, :], 0.0, atol=1e-15)


def test_a_field_along_the_vertical_has_no_azimuth():
    x, sensor = some_state(2), MODEL.sensor(MAGNETOMETER)
    down_b = x.q_nb.inverse().apply(jnp.array([0.0, 0.0, 4e-5]))
    sigma = sensor.noise_factor(x, down_b)
    assert float(sigma[0, 0]) == pytest.approx(np.pi, rel=1e-6)
    for field in (down_b, jnp.zeros(3)):
        assert np.all(np.isfinite(np.asarray(manifold.leaves(sensor.read(x, field))[1])))
        assert np.all(np.isfinite(np.asarray(sensor.noise_factor(x, field))))


def test_errors_are_as_large_as_the_filter_says():
    """Truth drawn from the model, against a chi-square band; a field without a vertical part."""
    rng = np.random.default_rng(7)
    runs, steps = 40, 60
    samples = some_samples(8, blocks=steps, n=5)
    whole, _ = integrate(samples._replace(theta=samples.theta / 3.0))
    none = np.zeros(steps)
    u = Block(whole, none, none, none)
    parts = [
        (2, 0.01), (1, 0.02), (3, 0.1), (3, 0.1), (3, 0.01), (9, 0.005), (3, 0.05), (1, 0.005),
        (2, 1e-6), (SITES, 0.1), (1, 0.05),
    ]  # fmt: skip
    sigma = jnp.concatenate([jnp.full(n, s) for n, s in parts])
    mean = some_state()._replace(field=jnp.array([2e-5, 0.0]), declination=jnp.zeros(()))
    start = Belief(mean, jnp.diag(sigma))
    draw = lambda *shape: jnp.asarray(rng.standard_normal(shape))  # noqa: E731
    seen = np.arange(steps) % 10 == 9
    rows = draw(runs, DIM), draw(runs, steps, DIM), draw(runs, steps, 6), draw(runs, steps, 3)

    @each
    def nees(drawn):
        first, walk, travel_noise, field_noise = drawn
        x = manifold.retract(start.mean, sigma * first)

        def world(x, row):
            block, w, v, b = row
            new, _, q = MODEL.motion.linear(x, block)
            x = manifold.retract(new, q @ w)
            travel = MODEL.sensor(TRAVEL)
            y = travel.read(x, jnp.zeros(())) + travel.noise_factor(x, jnp.zeros(())) @ v
            strength = x.field + 2.5e-6 * b[:2]
            azimuth = x.declination + 2.5e-6 / strength[0] * b[2]
            m = jnp.stack([strength[0] * jnp.cos(azimuth), strength[0] * jnp.sin(azimuth)])
            field_b = x.q_nb.inverse().apply(jnp.append(m, strength[1]))
            return x, (x, y, field_b)

        _, (truth, y, field_b) = jax.lax.scan(world, x, (u, walk, travel_noise, field_noise))
        blank = jnp.where(seen, 0.0, jnp.nan)
        measured = {
            TRAVEL: jnp.where(seen[:, None], y, jnp.nan),
            MAGNETOMETER: (Angle(blank), blank[:, None] * jnp.ones((1, 2))),
        }
        aux = {TRAVEL: jnp.zeros(steps), MAGNETOMETER: field_b}
        end = run(kalman(), MODEL, start, measured, u, aux).final.belief
        error = manifold.local(end.mean, jax.tree_util.tree_map(lambda a: a[-1], truth))
        white = jax.scipy.linalg.solve_triangular(end.factor, error, lower=True)
        return white @ white

    total = float(jnp.sum(nees(rows)))
    low, high = stats.chi2.ppf([0.001, 0.999], runs * DIM)
    assert low < total < high
