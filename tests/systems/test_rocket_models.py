"""The rocket's two models against other computations: the simulation, differences, closed forms."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins import scenario
from robins.earth.magnetic import field_along, wmm_for
from robins.manifold import local, retract
from robins.rotation import (
    Rotation,
    conjugate,
    from_euler,
    from_rotvec,
    multiply,
    rotate,
    to_dcm,
    to_euler,
    to_rotvec,
)
from robins.sim.free_body import FreeBody, coning_start, free_body
from robins.systems.rocket import SYSTEM
from robins.systems.rocket.angles import AngleCoefficients, angle_state, dead_reckoned, step
from robins.systems.rocket.field import (
    FIELD,
    FieldState,
    GyroNoise,
    GyroTurn,
    bridged,
    observed,
    plausible,
    propagate,
    propagated,
    read_field,
    rows_of,
    sentence,
    unobserved,
)
from robins.systems.rocket.parameters import FieldVector
from robins.systems.rocket.world import lay_out, simulate

BODY = FreeBody(0.70, 1.0 / 3000.0, 1.0 / 400.0)
DT = 0.1
DEG = np.pi / 180.0


@pytest.fixture(scope="module")
def flight():
    """Ten seconds of the true motion without torque."""
    q0, omega0 = coning_start(60.0 * DEG, 10.0 * DEG, 60.0 * DEG, 20.0 * DEG, BODY)
    return free_body(jax.random.key(0), BODY, q0, omega0, DT, 100, 0.0)


def test_the_angles_move_as_the_body_does(flight):
    """Euler angles by Runge and Kutta against the closed form on quaternions."""
    q, omega = flight
    c = AngleCoefficients(*map(jnp.asarray, (*BODY, 1.0, DT)))
    found = jax.jit(jax.vmap(lambda q, w: step(c, angle_state(q, w), None)))(q[:-1], omega[:-1])
    gone = jax.vmap(local)(found, angle_state(q[1:], omega[1:]))
    # of the fourth order: (0.1 s x 1 rad/s)^5 / 120 and what a pitch near 70 deg makes of it
    assert np.max(np.abs(gone)) < 2e-5
    half = AngleCoefficients(*map(jnp.asarray, (*BODY, 1.0, DT / 2)))
    twice = jax.jit(jax.vmap(lambda q, w: step(half, step(half, angle_state(q, w), None), None)))(
        q[:-1], omega[:-1]
    )
    finer = jax.vmap(local)(twice, angle_state(q[1:], omega[1:]))
    order = np.log2(np.max(np.abs(gone)) / np.max(np.abs(finer)))
    assert 3.5 < order < 5.5


def test_a_wrong_kinematic_row_turns_the_roll_too_fast():
    c = AngleCoefficients(*map(jnp.asarray, (0.7, 0.0, 0.0, 1.02, DT)))
    still = angle_state(from_euler(0.1, 0.0, 0.3), jnp.array([60.0 * DEG, 0.0, 0.0]))
    turned = local(still, step(c, still, None))
    np.testing.assert_allclose(turned[0], 1.02 * 6.0 * DEG, rtol=1e-12)
    np.testing.assert_allclose(turned[1:], 0.0, atol=1e-14)


def test_dead_reckoning_follows_the_angles_of_a_perfect_gyro(flight):
    q, omega = flight
    theta = to_rotvec(multiply(conjugate(q[:-1]), q[1:]))
    start = angle_state(q[0], omega[0])

    def go(x, u):
        x = dead_reckoned(DT, x, u)
        return x, x

    end, _ = jax.lax.scan(go, start, theta)
    truth = angle_state(q[-1], theta[-1] / DT)
    np.testing.assert_allclose(local(end, truth), 0.0, atol=1e-12)


def a_state(scaled: bool):
    q = Rotation(from_euler(0.3, 1.0, -2.0))
    bias = jnp.array([0.01, -0.02, 0.015])
    return FieldState(q, bias, jnp.array([1e-2, -2e-2, 5e-3]) if scaled else None)


@pytest.mark.parametrize("scaled", [False, True])
@pytest.mark.parametrize("size", [1e-5, 0.3, 2.5])
def test_the_jacobian_of_the_motion_is_its_derivative(scaled, size):
    noise = GyroNoise(*map(jnp.asarray, (1e-3, 1e-6, DT)))
    theta = GyroTurn(size * jnp.array([0.8, -0.5, 0.33]))
    x = a_state(scaled)
    mean, F, _ = propagated(noise, x, theta)
    np.testing.assert_allclose(local(mean, propagate(noise, x, theta)), 0.0, atol=1e-15)
    n = F.shape[0]
    step_ = 1e-6
    found = np.zeros((n, n))
    for i in range(n):
        ends = [
            local(mean, propagate(noise, retract(x, s * step_ * jnp.eye(n)[i]), theta))
            for s in (1.0, -1.0)
        ]
        found[:, i] = (np.asarray(ends[0]) - np.asarray(ends[1])) / (2.0 * step_)
    np.testing.assert_allclose(F, found, atol=1e-9)


@pytest.mark.parametrize("scaled", [False, True])
def test_the_jacobian_of_the_field_is_its_derivative(scaled):
    x, field = a_state(scaled), jnp.array([21e-6, 2e-6, 41e-6])
    z, H = observed(x, field)
    np.testing.assert_allclose(z, read_field(x, field), rtol=1e-14)
    n = H.shape[1]
    slope = jax.jacfwd(lambda d: read_field(retract(x, d), field))(jnp.zeros(n))
    np.testing.assert_allclose(H, slope, atol=1e-18)
    # what a turn about the field does to the reading: nothing
    along = jnp.zeros(n).at[:3].set(field / jnp.linalg.norm(field))
    np.testing.assert_allclose(H @ along, 0.0, atol=1e-19)


def test_what_is_reported_is_the_error_in_body_and_field_axes():
    """A small turn about the field in n, and one about the body's x axis."""
    q = from_euler(0.3, 1.0, -2.0)[None]
    field = jnp.array([[21e-6, 2e-6, 41e-6]])
    rows = rows_of(q, field, 6)[0]
    b = field[0] / jnp.linalg.norm(field[0])
    about = rows @ jnp.concatenate([0.01 * b, jnp.zeros(3)])
    np.testing.assert_allclose(about[3:6], [0.01, 0.0, 0.0], atol=1e-15)
    x_n = to_dcm(q[0])[:, 0]
    spun = rows @ jnp.concatenate([0.01 * x_n, jnp.zeros(3)])
    np.testing.assert_allclose(spun[:3], [0.01, 0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(jnp.linalg.norm(spun[3:6]), 0.01, rtol=1e-12)
    np.testing.assert_allclose(
        rows @ jnp.arange(6.0) - rows[:, :3] @ jnp.arange(3.0),
        [0, 0, 0, 0, 0, 0, 3, 4, 5],
        atol=1e-15,
    )


def test_a_turn_of_the_body_shows_in_the_field_with_the_right_sign():
    """Yawed 90 deg to the east, a field to the north is read to the left."""
    east = FieldState(Rotation(from_euler(0.0, 0.0, 90.0 * DEG)), jnp.zeros(3))
    np.testing.assert_allclose(
        read_field(east, jnp.array([1.0, 0.0, 0.0])), [0.0, -1.0, 0.0], atol=1e-15
    )
    moved = propagate(
        GyroNoise(0.0, 0.0, 1.0),
        FieldState(Rotation.identity(), jnp.array([0.0, 0.0, 0.1])),
        GyroTurn(jnp.array([0.0, 0.0, 90.0 * DEG + 0.1])),
    )
    np.testing.assert_allclose(to_euler(moved.q_nb.wxyz)[2], 90.0 * DEG, atol=1e-14)


def test_a_lost_sample_of_the_gyro_is_held_and_doubted():
    theta = jnp.array([[jnp.nan] * 3, [0.1, 0.0, 0.02], [jnp.nan, 0.0, 0.0], [0.2, 0.0, 0.0]])
    found = bridged(theta)
    held = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.02], [0.1, 0.0, 0.02], [0.2, 0.0, 0.0]]
    np.testing.assert_allclose(found.theta_b, held)
    np.testing.assert_allclose(found.doubt, [1.0, 0.0, 0.1 * np.hypot(0.1, 0.02), 0.0])


def test_doubt_adds_to_the_noise_of_the_gyro():
    g = GyroNoise(*map(jnp.asarray, (3e-3, 1e-6, DT)))
    _, _, noise = propagated(g, a_state(False), GyroTurn(jnp.zeros(3), jnp.asarray(4e-3)))
    np.testing.assert_allclose(noise, [5e-3] * 3 + [1e-6] * 3, rtol=1e-12)


def test_an_axis_at_full_scale_has_no_direction():
    expected = jnp.tile(jnp.array([[20e-6, 0.0, 40e-6]]), (2, 1))
    read = jnp.array([[20e-6, 0.0, 40e-6], [30e-6, 0.0, 30e-6]])
    assert np.isfinite(np.asarray(plausible(read, expected))).all()
    kept = np.isfinite(np.asarray(plausible(read, expected, 40e-6))).all(axis=1)
    np.testing.assert_array_equal(kept, [False, True])


def test_a_flight_has_the_field_of_its_path_the_iron_and_the_limit_of_its_sensor():
    text = SYSTEM.scenarios["b4"].read_text()
    short = ('duration="4 s"', 'counted_from="1 s"')
    iron = ('magnetometer.hard_iron=["3 uT", "-2 uT", "1 uT"]', 'magnetometer.full_scale="36 uT"')
    plain, given = (
        scenario.parse(FieldVector, text, (*short, *more), source="b4") for more in ((), iron)
    )
    course = lay_out(given)
    start = field_along(wmm_for(2026.0), 40.0 * DEG, 10.0 * DEG, 0.0, 2026.0)
    # in 0.1 s and 264 m of height the field of the launch has hardly changed
    np.testing.assert_allclose(course.field_n[0], start, rtol=2e-3, atol=2e-8)
    assert course.alt_m[-1] > 10e3
    one, other = (jax.jit(partial(simulate, p, course, 0))(0) for p in (plain, given))
    shifted = np.asarray(one.readings[FIELD]) + np.array([3e-6, -2e-6, 1e-6])
    np.testing.assert_allclose(other.readings[FIELD], np.clip(shifted, -36e-6, 36e-6), atol=1e-18)
    assert np.any(np.abs(shifted) > 36e-6)


class TestUnobserved:
    def test_one_vector_leaves_the_turn_about_itself_open(self):
        b = np.array([0.3, -0.4, 0.8])
        found = unobserved(np.tile(b, (50, 1)), 1.0 * DEG)
        np.testing.assert_allclose(found.direction_n, b / np.linalg.norm(b), atol=1e-12)
        assert found.sigma_rad == np.inf
        np.testing.assert_allclose(found.across_rad, DEG / np.sqrt(50.0), rtol=1e-12)
        assert "nothing is known about it" in sentence(found)

    def test_two_directions_are_known_by_the_angle_between_them(self):
        """Half the vectors each: about the middle, information is K sin^2(half the angle)."""
        half = 6.7 * DEG
        pair = np.array([[np.cos(half), np.sin(half), 0.0], [np.cos(half), -np.sin(half), 0.0]])
        found = unobserved(np.repeat(pair, 300, axis=0), DEG)
        np.testing.assert_allclose(found.direction_n, [1.0, 0.0, 0.0], atol=1e-12)
        np.testing.assert_allclose(
            found.sigma_rad, DEG / (np.sqrt(600.0) * np.sin(half)), rtol=1e-12
        )
        np.testing.assert_allclose(found.field_turn_rad, 2.0 * half, rtol=1e-12)
        assert found.from_field_rad < 1e-12

    def test_missing_vectors_count_for_nothing_and_a_zero_is_refused(self):
        field = np.array([[0.0, 0.0, 1.0], [np.nan] * 3, [0.0, 1.0, 0.0]])
        assert np.isfinite(unobserved(field, DEG).sigma_rad)
        with pytest.raises(ValueError, match="without a direction"):
            unobserved(np.zeros((3, 3)), DEG)
        with pytest.raises(ValueError, match="without a direction"):
            unobserved(np.full((3, 3), np.nan), DEG)
        with pytest.raises(ValueError, match="sigma_rad"):
            unobserved(np.eye(3), 0.0)


def test_a_field_of_no_possible_size_is_left_out():
    expected = jnp.tile(jnp.array([[0.0, 0.0, 40e-6]]), (6, 1))
    q = from_rotvec(jnp.array([0.4, 0.2, -1.0]))
    size = jnp.array([1.0, 0.0, 0.29, 0.31, 2.9, 3.1])
    read = size[:, None] * rotate(conjugate(q)[None], expected)
    kept = np.isfinite(np.asarray(plausible(read, expected))).all(axis=1)
    np.testing.assert_array_equal(kept, [True, False, False, True, True, False])
    broken = read.at[0, 1].set(jnp.nan)
    assert not np.isfinite(np.asarray(plausible(broken, expected))[0]).any()
