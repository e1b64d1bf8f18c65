"""A spacecraft against the equations of its rate, closed forms, point masses and its limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from robins.earth.wgs84 import GM
from robins.linalg.scalars import matrix, scalars
from robins.sim.spacecraft import (
    advance,
    craft_state,
    gravity_gradient,
    rate_b,
    spacecraft,
    wheel_momentum_b,
)

J = np.array([[1.9, 0.02, -0.03], [0.02, 2.1, 0.01], [-0.03, 0.01, 2.4]])
S = 3**-0.5
AXES = np.array([[1.0, 0.0, 0.0, S], [0.0, 1.0, 0.0, S], [0.0, 0.0, 1.0, S]])
RESIDUAL = np.array([0.05, -0.03, 0.04])
CRAFT = spacecraft(J, AXES, 5e-3, 0.1, 5.0, RESIDUAL)
STEPS = 2000  # of every run, so that one program does for all
NOTHING = np.zeros(3)
Q0 = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_quat(scalar_first=True)


@jax.jit
def _run(craft, state, torque, dipole, place, field, disturbance, dt):
    def body(state, given):
        wheel_torque, disturbance = given
        after = advance(craft, state, wheel_torque, dipole, place, field, disturbance, dt)
        return after, (after, rate_b(craft, after))

    return jax.lax.scan(body, state, (torque, disturbance))[1]


def run(craft, state, torque, dt, dipole=NOTHING, place=NOTHING, field=NOTHING, push=NOTHING):
    """States and rates after each of STEPS steps, as NumPy."""
    pushes = np.broadcast_to(push, (STEPS, 3))
    given = (jnp.asarray(x) for x in (torque, dipole, place, field, pushes, dt))
    return jax.tree.map(np.asarray, _run(craft, state, *given))


def matrices(q):
    return Rotation.from_quat(q, scalar_first=True).as_matrix()


@pytest.mark.parametrize("dt", [0.1, 0.05])
def test_wheels_do_not_change_the_momentum_of_the_whole(dt):
    t = dt * np.arange(STEPS)[:, None]
    torque = 4e-3 * np.sin(t * [0.2, 0.11, 0.07, 0.05] + [0.0, 1.0, 2.0, 3.0])
    start = craft_state(CRAFT, Q0, [1e-3, -5e-3, 2e-3], [0.02, -0.01, 0.03, 0.0])
    states, rates = run(CRAFT, start, torque, dt)
    assert np.max(np.linalg.norm(rates, axis=1)) > 0.02  # it does slew
    body = rates @ J.T + states.wheel_h @ AXES.T  # by its definition, of rates and wheels
    total = (matrices(states.q_ib) @ body[..., None])[..., 0]
    np.testing.assert_allclose(total, np.tile(start.momentum_i, (STEPS, 1)), rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(states.q_ib, axis=1), 1.0, rtol=0.0, atol=5e-16)


# Torques a hundred times those in orbit, and a place deep in the Earth, to see every term.
BLOCK_S, BLOCKS = 10.0, 4
FORCED = {
    "dipole": np.array([3.0, -7.0, 1.0]),  # the second beyond its limit of 5
    "place": np.array([4e5, -7e5, 6e5]),
    "field": np.array([2e-4, 3e-4, -1e-4]),
}


def forced(dt):
    """Inputs that are the same over blocks of 10 s."""
    rng = np.random.default_rng(5)
    torque, push = rng.uniform(-3e-3, 3e-3, (BLOCKS, 4)), rng.uniform(-2e-3, 2e-3, (BLOCKS, 3))
    block = np.minimum(dt * np.arange(STEPS) / BLOCK_S + 1e-9, BLOCKS - 1).astype(int)
    return torque, push, torque[block], push[block]


@pytest.fixture(scope="module")
def integrated():
    """The equations of the rate in body axes by SciPy, attitude as nine direction cosines."""
    torques, pushes, *_ = forced(1.0)
    inverse = np.linalg.inv(J)
    limited = np.clip(FORCED["dipole"], -5.0, 5.0) + RESIDUAL

    def slope(_, y, wheel_torque, push):
        C, w, h = y[:9].reshape(3, 3), y[9:12], y[12:]
        r_b, field_b = C.T @ FORCED["place"], C.T @ FORCED["field"]
        gravity = 3.0 * GM / np.linalg.norm(r_b) ** 5 * np.cross(r_b, J @ r_b)
        outside = gravity + np.cross(limited, field_b) + push
        w_dot = inverse @ (outside + AXES @ wheel_torque - np.cross(w, J @ w + AXES @ h))
        x, y_, z = w
        skew = np.array([[0.0, -z, y_], [z, 0.0, -x], [-y_, x, 0.0]])
        return np.concatenate([(C @ skew).ravel(), w_dot, -wheel_torque])

    start = craft_state(CRAFT, Q0, [0.02, -0.03, 0.025], [0.02, -0.01, 0.03, 0.0])
    y = np.concatenate([matrices(Q0).ravel(), [0.02, -0.03, 0.025], start.wheel_h])
    for k in range(BLOCKS):
        tight = {"rtol": 3e-14, "atol": 1e-15, "args": (torques[k], pushes[k])}
        y = solve_ivp(slope, (0.0, BLOCK_S), y, "DOP853", **tight).y[:, -1]
    return start, y[:9].reshape(3, 3), y[9:12], y[12:]


def misses(integrated, dt):
    """Errors of attitude [rad] and rate [rad/s] after all blocks."""
    start, C, w, h = integrated
    _, _, torque, push = forced(dt)
    states, rates = run(CRAFT, start, torque, dt, **FORCED, push=push)
    at = round(BLOCKS * BLOCK_S / dt) - 1
    np.testing.assert_allclose(states.wheel_h[at], h, rtol=0.0, atol=1e-13)
    turn = Rotation.from_matrix(C.T @ matrices(states.q_ib[at])).magnitude()
    return turn, np.linalg.norm(rates[at] - w)


def test_it_moves_as_the_equations_of_its_rate_say(integrated):
    turn, rate = misses(integrated, 0.05)
    assert np.linalg.norm(integrated[2]) > 0.03
    assert turn < 1e-12
    assert rate < 1e-13


def test_the_error_is_of_the_fourth_order_in_the_step(integrated):
    coarse, middle, fine = (np.array(misses(integrated, dt)) for dt in (2.0, 1.0, 0.5))
    assert np.all(fine > 1e-10)  # far above rounding
    for ratio in (*(coarse / middle), *(middle / fine)):
        assert 13.0 < ratio < 19.5


def test_a_symmetric_body_without_wheels_goes_round_in_closed_form():
    along, across, dt = 1.0, 3.0, 0.05
    body = spacecraft(np.diag([along, across, across]), np.zeros((3, 0)), 0.0, 0.0, 0.0)
    start = craft_state(body, Q0, [0.3, 0.1, -0.05])
    states, rates = run(body, start, np.zeros((STEPS, 0)), dt)
    t = dt * np.arange(1, STEPS + 1)[:, None]
    # About the momentum at H/across, and about the axis of symmetry the other way.
    spin = 0.3 * (1.0 - along / across) * t * [1.0, 0.0, 0.0]
    swing = Rotation.from_rotvec(t * np.asarray(start.momentum_i) / across)
    asked = swing * Rotation.from_quat(Q0, scalar_first=True) * Rotation.from_rotvec(spin)
    np.testing.assert_allclose(matrices(states.q_ib), asked.as_matrix(), rtol=0.0, atol=5e-7)
    energy = np.sum(rates**2 * [along, across, across], axis=1)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-7)


def test_gravity_turns_a_body_as_it_turns_its_masses():
    rng = np.random.default_rng(2)
    mass, half = rng.uniform(1.0, 3.0, 5), rng.normal(0.0, 1.0, (5, 3))
    # Each mass has its like on the other side, so that the next term of the series is none.
    mass, at = np.tile(mass, 2), np.concatenate([half, -half])
    inertia = np.einsum("k,kij->ij", mass, [(p @ p) * np.eye(3) - np.outer(p, p) for p in at])
    r_b = np.array([6e3, -9e3, 4e3])
    from_centre = r_b + at
    pull = -GM * (mass / np.linalg.norm(from_centre, axis=1) ** 3)[:, None] * from_centre
    asked = np.sum(np.cross(at, pull), axis=0)
    got = gravity_gradient(matrix(jnp.asarray(inertia)), scalars(jnp.asarray(r_b)))
    np.testing.assert_allclose(got, asked, rtol=0.0, atol=1e-6 * np.linalg.norm(asked))
    none = gravity_gradient(matrix(jnp.asarray(inertia)), scalars(jnp.zeros(3)))
    np.testing.assert_array_equal(none, NOTHING)


def test_a_body_longest_towards_the_earth_swings_about_it():
    """Libration in pitch of a dumb-bell at rest in inertial space but for gravity."""
    moments = np.array([2.0, 3.0, 1.2])
    body = spacecraft(np.diag(moments), np.zeros((3, 0)), 0.0, 0.0, 0.0)
    radius = 2e6
    n = np.sqrt(GM / radius**3)
    start = craft_state(body, [np.cos(5e-4), 0.0, np.sin(5e-4), 0.0], NOTHING)
    states, _ = run(body, start, np.zeros((STEPS, 0)), 2.0, place=np.array([0.0, 0.0, -radius]))
    angle = 2.0 * np.arcsin(states.q_ib[:, 2])
    swing = n * np.sqrt(3.0 * (moments[0] - moments[2]) / moments[1])
    t = 2.0 * np.arange(1, STEPS + 1)
    assert swing * t[-1] > 2.0 * np.pi
    np.testing.assert_allclose(angle, 1e-3 * np.cos(swing * t), rtol=0.0, atol=1e-8)


one_step = jax.jit(advance)


def wheels_after(craft, wheel_h, torque, dt=0.1):
    start = craft_state(craft, Q0, NOTHING, wheel_h)
    nothing = [jnp.zeros(3)] * 4
    end = one_step(craft, start, jnp.asarray(torque), *nothing, dt)
    np.testing.assert_array_equal(end.momentum_i, start.momentum_i)
    return np.asarray(end.wheel_h), np.asarray(rate_b(craft, end))


def test_a_wheel_pushes_the_body_one_way_and_goes_the_other():
    h, rate = wheels_after(CRAFT, 0.0, [2e-3, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(h, [-2e-4, 0.0, 0.0, 0.0], rtol=1e-14)
    np.testing.assert_allclose(rate, np.linalg.solve(J, [2e-4, 0.0, 0.0]), rtol=1e-6)


def test_a_wheel_gives_no_more_than_its_torque_and_a_lost_one_none():
    h, _ = wheels_after(CRAFT, 0.0, [1.0, -1.0, 5e-3, -4e-3])
    np.testing.assert_allclose(h, [-5e-4, 5e-4, -5e-4, 4e-4], rtol=1e-14)
    broken = spacecraft(J, AXES, 5e-3, 0.1, 5.0, RESIDUAL, wheel_works=[1, 0, 1, 1])
    h, _ = wheels_after(broken, 0.01, [1.0, -1.0, 5e-3, -4e-3])
    np.testing.assert_allclose(h, [0.0095, 0.01, 0.0095, 0.0104], rtol=1e-14)


def test_a_full_wheel_gives_torque_only_away_from_its_limit():
    # A push of the body forward takes from the wheel: at -0.1 there is nothing more to take.
    h, rate = wheels_after(CRAFT, [-0.1, 0.1, -0.1, 0.1], [5e-3, -5e-3, -5e-3, 5e-3])
    np.testing.assert_allclose(h, [-0.1, 0.1, -0.0995, 0.0995], rtol=1e-14)
    left = np.array([-0.1, 0.1, -0.0995, 0.0995]) - [-0.1, 0.1, -0.1, 0.1]
    np.testing.assert_allclose(rate, np.linalg.solve(J, -AXES @ left), rtol=0.0, atol=1e-6)
    # It stops at the limit exactly, and one that was given more is not torn back.
    h, _ = wheels_after(CRAFT, [-0.0998, 0.0998, 0.12, 0.12], [5e-3, -5e-3, -5e-3, 5e-3])
    np.testing.assert_array_equal(h[:3], [-0.1, 0.1, 0.12])
    np.testing.assert_allclose(h[3], 0.1195, rtol=1e-14)


def test_the_state_keeps_the_rate_it_was_given():
    omega, h = np.array([0.01, -0.02, 0.03]), np.array([0.01, 0.02, -0.03, 0.04])
    state = craft_state(CRAFT, Q0, omega, h)
    np.testing.assert_allclose(rate_b(CRAFT, state), omega, rtol=1e-14)
    np.testing.assert_allclose(wheel_momentum_b(CRAFT, state.wheel_h), AXES @ h, rtol=1e-14)
    total = matrices(Q0) @ (J @ omega + AXES @ h)
    np.testing.assert_allclose(state.momentum_i, total, rtol=0.0, atol=1e-16)


def test_derivatives_are_those_of_differences_and_a_batch_is_its_runs():
    scale = jnp.array([0.999, 1.0, 1.001])
    start = craft_state(CRAFT, Q0, [0.02, -0.03, 0.025], 0.01)
    given = [jnp.asarray(FORCED[k]) for k in ("dipole", "place", "field")]

    def rate(scale):
        torque = scale * jnp.array([1e-3, -2e-3, 0.0, 3e-3])
        end = advance(CRAFT, start, torque, *given, scale * 1e-3 * jnp.ones(3), 0.5)
        return end.q_ib @ jnp.arange(1.0, 5.0) + rate_b(CRAFT, end) @ jnp.ones(3)

    both = jax.jit(jax.vmap(jax.value_and_grad(rate)))
    values, slopes = both(scale)
    assert np.all(np.isfinite(slopes))
    np.testing.assert_allclose(slopes[1], (values[2] - values[0]) / 2e-3, rtol=1e-7)
    np.testing.assert_allclose(values[2], both(scale[::-1])[0][0], rtol=1e-15)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"inertia_b": np.eye(2)}, r"inertia_b must be a finite matrix \(3, 3\)"),
        ({"inertia_b": np.diag([1.0, np.nan, 1.0])}, "inertia_b must be a finite"),
        ({"inertia_b": J + np.triu(np.full((3, 3), 1e-3), 1)}, "inertia_b must be symmetric"),
        ({"inertia_b": np.diag([1.0, 1.0, -1.0])}, "must be positive definite"),
        ({"inertia_b": np.diag([1.0, 1.0, 2.1])}, "none is greater than the sum of the others"),
        ({"wheel_axes_b": AXES.T}, r"shape \(4, 3\): it must be \(3, W\)"),
        ({"wheel_axes_b": AXES * [1.0, 1.0, 1.01, 1.0]}, "wheel 2, .* has length 1.01"),
        ({"wheel_axes_b": np.full((3, 4), np.nan)}, "wheel 0, .* has length nan"),
        ({"wheel_torque_limit": -1e-3}, "wheel_torque_limit must be"),
        ({"wheel_momentum_limit": [0.1, 0.1, -0.1, 0.1]}, "wheel_momentum_limit must be"),
        ({"wheel_momentum_limit": [0.1, 0.1]}, "wheel_momentum_limit must be a number or of shape"),
        ({"dipole_limit_a_m2": -5.0}, "dipole_limit_a_m2 must be"),
        ({"residual_dipole_b": np.inf}, "residual_dipole_b must be"),
        ({"wheel_works": [1.0, 0.5, 1.0, 1.0]}, "wheel_works must be 0 or 1"),
    ],
)
def test_what_is_no_spacecraft_is_refused(change, words):
    given = {"inertia_b": J, "wheel_axes_b": AXES, "wheel_torque_limit": 5e-3}
    given |= {"wheel_momentum_limit": 0.1, "dipole_limit_a_m2": 5.0}
    with pytest.raises(ValueError, match=words):
        spacecraft(**(given | change))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ((np.ones(4), NOTHING, 0.0), "q_ib must be a unit quaternion"),
        ((np.ones(3), NOTHING, 0.0), "q_ib must have shape"),
        ((Q0, np.zeros(2), 0.0), "omega_b must have shape"),
        ((Q0, np.full(3, np.nan), 0.0), "omega_b must be"),
        ((Q0, NOTHING, np.zeros(3)), "wheel_h must be"),
    ],
)
def test_what_is_no_state_is_refused(given, words):
    with pytest.raises(ValueError, match=words):
        craft_state(CRAFT, *given)
