"""A spinning body against an integration of its equations, conservation laws and Lyapunov's."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn import rotation
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from robins.rotation import from_rotvec, multiply, rotate, to_euler
from robins.sim.free_body import FreeBody, coning_start, free_body
from robins.sim.random import Component, stream

DEG = np.pi / 180.0
BODY = FreeBody(0.70, 1.0 / 3000.0, 1.0 / 400.0)
RIGID = BODY._replace(e2=0.0, e3=0.0)
START = (60 * DEG, 10 * DEG, 60 * DEG, 20 * DEG)  # spin, cone, elevation and azimuth
KEY = stream(3, 0, Component.TRAJECTORY)

_run = jax.jit(free_body, static_argnames="steps")
STEPS = 400  # of most runs, whose beginning is what is asked for: one length is compiled once


def run(key, body, q0, omega0, dt, steps, torque_noise):
    """Attitudes and rates at so many steps, `STEPS` at most."""
    q, omega = _run(key, body, q0, omega0, dt, STEPS, torque_noise)
    return q[: steps + 1], omega[: steps + 1]


def omega_dot(body, omega):
    e1, e2, e3 = body
    p, q, r = omega
    return np.array([-e2 * p, e1 * p * r - e3 * q, -e1 * p * q - e3 * r])


def integrated(body, q0, omega0, dt, steps):
    """Attitude matrices and rates by SciPy, attitude as nine direction cosines."""

    def slope(_, y):
        x, y_, z = omega = y[9:]
        skew = np.array([[0.0, -z, y_], [z, 0.0, -x], [-y_, x, 0.0]])
        return np.concatenate([(y[:9].reshape(3, 3) @ skew).ravel(), omega_dot(body, omega)])

    start = np.concatenate([rotation(q0).as_matrix().ravel(), omega0])
    t = dt * np.arange(steps + 1)
    y = solve_ivp(slope, (0.0, t[-1]), start, "DOP853", t, rtol=3e-14, atol=1e-14).y.T
    return y[:, :9].reshape(-1, 3, 3), y[:, 9:]


# The attitude of the two that are damped hard shows what is left of the fifth order in the step.
@pytest.mark.parametrize(
    ("body", "left"),
    [(BODY, 1e-11), (FreeBody(0.0, 0.0, 0.01), 1e-9), (FreeBody(-0.6, 0.02, 0.3), 1e-7)],
    ids=["rocket", "ball", "disc"],
)
def test_without_torque_it_is_the_solution_of_its_equations(body, left):
    q0, omega0 = coning_start(*START, body, 0.7)
    q, omega = run(KEY, body, q0, omega0, 0.1, 400, 0.0)
    matrices, rates = integrated(body, q0, omega0, 0.1, 400)
    np.testing.assert_allclose(omega, rates, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(rotation(q).as_matrix(), matrices, rtol=0.0, atol=left)


def test_what_a_strongly_damped_body_lacks_is_of_high_order():
    body = FreeBody(-0.6, 0.02, 0.5)
    q0, omega0 = coning_start(1.0, 0.4, *START[2:], body)
    truth = rotation(run(KEY, body, q0, omega0, 1.0 / 32.0, 256, 0.0)[0][-1])

    def miss(dt):
        q = run(KEY, body, q0, omega0, dt, round(8.0 / dt), 0.0)[0][-1]
        return (rotation(q).inv() * truth).magnitude()

    assert 13.0 < miss(1.0) / miss(0.5) < 19.0
    assert 13.0 < miss(0.5) / miss(0.25) < 19.0


@pytest.mark.parametrize("dt", [0.1, 7.0])
def test_angular_momentum_and_energy_are_kept_at_any_step(dt):
    q0, omega0 = coning_start(*START, RIGID)
    q, omega = _run(KEY, RIGID, q0, omega0, dt, 6000, 0.0)
    inertia = np.array([1.0 - RIGID.e1, 1.0, 1.0])  # over It
    momentum = rotation(q).apply(inertia * np.asarray(omega))
    np.testing.assert_allclose(momentum, np.tile(momentum[0], (6001, 1)), rtol=0.0, atol=1e-11)
    energy = np.sum(inertia * np.asarray(omega) ** 2, 1)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-11)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, rtol=1e-15)


def test_it_goes_round_its_momentum_at_the_rate_of_precession():
    q0, omega0 = coning_start(*START, RIGID)
    steps, dt = STEPS, 1.3
    q, _ = run(KEY, RIGID, q0, omega0, dt, steps, 0.0)
    nose = rotation(q).apply([1.0, 0.0, 0.0])
    along = rotation(q0).apply(np.array([1.0 - RIGID.e1, 1.0, 1.0]) * np.asarray(omega0))
    rate = np.linalg.norm(along)
    np.testing.assert_allclose(rate, 0.3 * START[0] / np.cos(START[1]), rtol=1e-14)
    turned = Rotation.from_rotvec(dt * np.arange(steps + 1)[:, None] * along)
    np.testing.assert_allclose(nose, turned.apply(nose[0]), rtol=0.0, atol=1e-10)


def test_it_starts_on_the_cone():
    spin, cone, elevation, azimuth = START
    level = np.cos(elevation)
    asked = np.array([level * np.cos(azimuth), level * np.sin(azimuth), -np.sin(elevation)])
    seen = []
    for phase in (0.0, 0.5 * np.pi, np.pi):
        q0, omega0 = coning_start(*START, BODY, phase)
        momentum = rotation(q0).apply(np.array([0.3, 1.0, 1.0]) * np.asarray(omega0))
        np.testing.assert_allclose(momentum / np.linalg.norm(momentum), asked, atol=1e-15)
        nose = rotation(q0).apply([1.0, 0.0, 0.0])
        np.testing.assert_allclose(np.arccos(nose @ asked), cone, rtol=1e-14)
        np.testing.assert_allclose(omega0[0], spin, rtol=1e-15)
        seen.append(nose)
    # first at the top, then clockwise seen along the momentum: to the right of it, then below
    np.testing.assert_allclose(np.arcsin(-seen[0][2]), elevation + cone, rtol=1e-14)
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    np.testing.assert_allclose(seen[1] @ right, np.sin(cone), rtol=1e-14)
    np.testing.assert_allclose(np.arcsin(-seen[2][2]), elevation - cone, rtol=1e-14)


def lyapunov(body, q0, omega0, sigma, end):
    """Covariance of small errors (turn in body axes, rates) about the motion without torque."""
    e1, e2, e3 = body

    def slope(_, y):
        p, q, r = omega = y[:3]
        jacobian = [[-e2, 0.0, 0.0], [e1 * r, -e3, e1 * p], [-e1 * q, -e1 * p, -e3]]
        f = np.zeros((6, 6))
        f[:3, :3] = -np.array([[0.0, -r, q], [r, 0.0, -p], [-q, p, 0.0]])
        f[:3, 3:], f[3:, 3:] = np.eye(3), jacobian
        cov = y[3:].reshape(6, 6)
        push = np.diag([0.0, 0.0, 0.0, sigma**2, sigma**2, sigma**2])
        return np.concatenate([omega_dot(body, omega), (f @ cov + cov @ f.T + push).ravel()])

    start = np.concatenate([omega0, np.zeros(36)])
    return solve_ivp(slope, (0.0, end), start, rtol=1e-9, atol=1e-18).y[3:, -1].reshape(6, 6)


@partial(jax.jit, static_argnames="steps")
def ends(keys, body, q0, omega0, dt, steps, noise):
    """Attitude and rates of many runs after the last step."""

    def one(key):
        q, omega = free_body(key, body, q0, omega0, dt, steps, noise)
        return q[-1], omega[-1]

    return jax.vmap(one)(keys)


@pytest.mark.parametrize(("dt", "steps"), [(0.1, 20), (0.4, 1), (2.0, 6)])
@pytest.mark.parametrize("body", [BODY, FreeBody(-0.6, 0.3, 0.5)], ids=["rod", "disc"])
def test_torque_spreads_attitude_and_rates_as_the_linear_theory_says(body, dt, steps):
    sigma, count = 1e-5, 8000
    q0, omega0 = coning_start(60 * DEG, 0.3, *START[2:], body)
    keys = jax.vmap(lambda k: stream(5, k, Component.TRAJECTORY))(jnp.arange(count))

    (q, omega), (still, calm) = (
        ends(keys, body, q0, omega0, dt, steps, noise) for noise in (sigma, 0.0)
    )
    turn = (rotation(still).inv() * rotation(q)).as_rotvec()
    error = np.concatenate([turn, np.asarray(omega) - np.asarray(calm)], 1)
    expected = lyapunov(body, q0, omega0, sigma, dt * steps)
    size = np.sqrt(np.diag(expected))
    got = error.T @ error / count
    # The spread of an entry, of a sample of normal numbers, is at most sqrt(2/count).
    near = 4.5 * np.sqrt(2.0 / count)
    if dt * body.e3 > 0.5:
        near += 0.02  # the part of the attitude that is drawn to leading order
    scale = np.outer(size, size)
    np.testing.assert_allclose(got / scale, expected / scale, atol=near)


def test_the_rocket_of_the_specification_keeps_off_the_vertical():
    q0, omega0 = coning_start(*START, BODY)
    keys = jax.vmap(lambda k: stream(1, k, Component.TRAJECTORY))(jnp.arange(50))
    fly = jax.vmap(lambda key: free_body(key, BODY, q0, omega0, 0.1, 6000, 0.02 * DEG))
    q, omega = jax.jit(fly)(keys)
    _, pitch, _ = to_euler(q)
    assert np.min(pitch) > 45 * DEG
    assert np.max(pitch) < 75 * DEG
    # spin and cone decay as they say, and the torque has moved each run another way
    np.testing.assert_allclose(np.mean(omega[:, -1, 0]), 60 * DEG * np.exp(-0.2), atol=0.3 * DEG)
    assert 0.3 * DEG < np.std(omega[:, -1, 0]) < 0.6 * DEG
    assert np.all(np.linalg.norm(omega[:, -1, 1:], axis=1) < 2.5 * DEG)


def test_numbers_depend_neither_on_the_length_of_the_run_nor_on_the_batch():
    q0, omega0 = coning_start(*START, BODY)
    long, short = (_run(KEY, BODY, q0, omega0, 0.1, steps, 1e-3) for steps in (STEPS, 20))
    batch = jax.vmap(lambda key: free_body(key, BODY, q0, omega0, 0.1, 20, 1e-3))(KEY[None])
    for whole, part, one in zip(long, short, batch, strict=True):
        np.testing.assert_array_equal(whole[:21], part)
        np.testing.assert_allclose(one[0], part, rtol=0.0, atol=1e-13)


def test_a_turned_frame_turns_the_motion():
    q0, omega0 = coning_start(*START, BODY)
    turn = from_rotvec(jnp.array([0.3, -1.0, 0.2]))
    q, omega = run(KEY, BODY, q0, omega0, 0.1, 50, 1e-2)
    turned, same = run(KEY, BODY, multiply(turn, q0), omega0, 0.1, 50, 1e-2)
    np.testing.assert_allclose(turned, multiply(turn[None], q), atol=1e-13)
    np.testing.assert_array_equal(omega, same)


def test_derivatives_are_finite_and_right_where_nothing_decays():
    @jax.jit
    def nose(spin, e1, e2):
        body = FreeBody(e1, e2, 0.0)
        q0, omega0 = coning_start(spin, 0.2, 1.0, 0.3, body)
        q, omega = free_body(KEY, body, q0, omega0, 0.1, 15, 1e-3)
        return rotate(q[-1], jnp.array([0.1, 1.0, 0.3])) @ omega[-1]

    slopes = jax.jit(jax.grad(nose, (0, 1, 2)))(1.0, 0.7, 0.0)
    h = 1e-5
    for k, slope in enumerate(slopes):
        at, way = np.array([1.0, 0.7, 0.0]), h * np.eye(3)[k]
        if k < 2:
            numeric = (nose(*(at + way)) - nose(*(at - way))) / (2.0 * h)
        else:  # a decay that is not negative: from one side
            once, twice = nose(*(at + way)), nose(*(at + 2.0 * way))
            numeric = (4.0 * once - twice - 3.0 * nose(*at)) / (2.0 * h)
        np.testing.assert_allclose(slope, numeric, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"body": FreeBody(1.0, 0.0, 0.0)}, "e1 must be"),
        ({"body": FreeBody(0.7, -0.1, 0.0)}, "e2 must be"),
        ({"body": FreeBody(0.7, 0.0, np.nan)}, "e3 must be"),
        ({"q0_nb": np.ones(3)}, "q0_nb must have shape"),
        ({"q0_nb": np.zeros(4)}, "q0_nb must"),
        ({"q0_nb": np.array([np.nan, 0.0, 0.0, 1.0])}, "q0_nb must"),
        ({"omega0_b": np.ones(4)}, "omega0_b must have shape"),
        ({"omega0_b": np.array([np.inf, 0.0, 0.0])}, "omega0_b must"),
        ({"dt_s": 0.0}, "dt_s must be"),
        ({"steps": 0}, "steps is 0"),
        ({"torque_noise": -1.0}, "torque_noise must be"),
    ],
)
def test_what_is_no_motion_is_refused(change, words):
    given = {"body": BODY, "q0_nb": np.array([1.0, 0.0, 0.0, 0.0]), "omega0_b": np.ones(3)}
    given |= {"dt_s": 0.1, "steps": 2, "torque_noise": 0.0}
    with pytest.raises(ValueError, match=words):
        free_body(KEY, **(given | change))


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (0, 0.0, "spin_rad_s must be"),
        (1, 1.58, "cone_half_angle_rad must be"),
        (1, -0.1, "cone_half_angle_rad must be"),
        (2, 2.0, "momentum_elevation_rad must be"),
        (3, np.nan, "momentum_azimuth_rad must be"),
        (4, FreeBody(-1.1, 0.0, 0.0), "e1 must be"),
        (5, np.inf, "phase_rad must be"),
    ],
)
def test_what_is_no_cone_is_refused(place, value, words):
    given = [*START, BODY, 0.0]
    given[place] = value
    with pytest.raises(ValueError, match=words):
        coning_start(*given)
