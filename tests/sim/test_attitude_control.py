"""Control against the second-order loop it is to be, allocation, and wheels unloaded in orbit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from robins.earth.wgs84 import GM
from robins.rotation import conjugate, from_rotvec, multiply, rotate
from robins.sim.attitude_control import (
    allocate,
    allocate_within,
    allocation_matrix,
    controller,
    desaturation_dipole,
    torque,
)
from robins.sim.attitude_reference import nadir, slews
from robins.sim.orbit import circular_orbit, field_along_orbit
from robins.sim.spacecraft import advance, craft_state, rate_b, spacecraft, wheel_momentum_b

DEG = np.pi / 180.0
J = np.array([[1.9, 0.02, -0.03], [0.02, 2.1, 0.01], [-0.03, 0.01, 2.4]])
S = 3**-0.5
AXES = np.array([[1.0, 0.0, 0.0, S], [0.0, 1.0, 0.0, S], [0.0, 0.0, 1.0, S]])
RESIDUAL = np.array([0.05, -0.03, 0.04])
CRAFT = spacecraft(J, AXES, 5e-3, 0.1, 5.0, RESIDUAL)
STRONG = spacecraft(J, AXES, 5.0, 10.0, 5.0)  # with wheels that are never at a limit
CONTROL = controller(J)
PINV = jnp.asarray(allocation_matrix(AXES))
STEPS = 15000


@jax.jit
def closed_loop(craft, control, start, reference, places, fields, dt):
    """Control that knows the state exactly, over STEPS steps."""

    def body(state, given):
        reference, place, field = given
        held = wheel_momentum_b(craft, state.wheel_h)
        field_b = rotate(conjugate(state.q_ib), field)
        dipole = desaturation_dipole(control.desaturation_k, held, field_b, craft.dipole_limit_a_m2)
        wanted = torque(control, state.q_ib, rate_b(craft, state), *reference, held)
        wheels = allocate(PINV, wanted - jnp.cross(dipole, field_b))
        after = advance(craft, state, wheels, dipole, place, field, jnp.zeros(3), dt)
        return after, state

    states = jax.lax.scan(body, start, (reference, places, fields))[1]
    return states, jax.vmap(lambda s: rate_b(craft, s))(states)


def second_order(t, wn=0.12, zeta=0.9):
    """Solution of theta'' + 2 zeta wn theta' + wn^2 theta = 0 from one and at rest."""
    damped = wn * np.sqrt(1.0 - zeta**2)
    swing = np.cos(damped * t) + zeta * wn / damped * np.sin(damped * t)
    return np.exp(-zeta * wn * t) * swing


def test_an_error_dies_out_as_the_second_order_loop_while_the_reference_slews():
    error = np.array([0.5, -0.3, 0.4])

    def simulated(dt):
        time = dt * np.arange(STEPS)
        orbit = circular_orbit(500e3, 97.4 * DEG, 0.3, 0.1, time)
        reference = slews(nadir(orbit), 0.3, [100.0, 150.0, 120.0], time)
        q_ref = reference.q_ib[0]
        q = multiply(q_ref, from_rotvec(jnp.asarray(error)))
        back = Rotation.from_rotvec(-error)  # at rest against the reference
        start = craft_state(STRONG, q, back.apply(np.array(reference.omega_b[0])), 0.3)
        nothing = jnp.zeros((STEPS, 3))
        states, _ = closed_loop(STRONG, CONTROL, start, reference, nothing, nothing, dt)
        wanted, got = (
            Rotation.from_quat(np.array(q), scalar_first=True)
            for q in (reference.q_ib, states.q_ib)
        )
        return (wanted.inv() * got).as_rotvec()

    fine, middle = simulated(0.005)[: STEPS // 2 : 2], simulated(0.01)[: STEPS // 4]
    t = 0.01 * np.arange(STEPS // 4)
    asked = second_order(t)[:, None] * error
    # Torque that is held over a step delays the loop by half of it: halved with the step.
    late = np.max(np.abs(middle - asked)), np.max(np.abs(fine[: STEPS // 4] - asked))
    assert 1.9 < late[0] / late[1] < 2.1
    np.testing.assert_allclose(2.0 * fine[: STEPS // 4] - middle, asked, rtol=0.0, atol=1e-6)
    assert asked[-1, 0] < 0.05 * error[0]


def test_an_error_of_more_than_half_a_turn_goes_the_short_way():
    rest = [jnp.zeros(3)] * 4
    q = from_rotvec(jnp.array([0.0, 0.0, 350.0 * DEG]))
    wanted = torque(CONTROL, q, rest[0], jnp.array([1.0, 0, 0, 0]), *rest[:3])
    np.testing.assert_allclose(wanted, J @ [0.0, 0.0, 0.12**2 * 10.0 * DEG], rtol=1e-12)
    same = torque(CONTROL, -q, rest[0], jnp.array([1.0, 0, 0, 0]), *rest[:3])
    np.testing.assert_array_equal(same, wanted)


def test_on_the_reference_the_torque_is_that_of_its_motion():
    omega, alpha, held = np.random.default_rng(3).normal(size=(3, 3))
    q = from_rotvec(jnp.array([0.3, -1.0, 0.2]))
    omega_j, alpha_j, held_j = (jnp.asarray(x) for x in (omega, alpha, held))
    got = torque(CONTROL, q, omega_j, q, omega_j, alpha_j, held_j)
    np.testing.assert_allclose(got, J @ alpha + np.cross(omega, J @ omega + held), rtol=1e-12)


@pytest.mark.parametrize("lost", [None, 0, 1, 2, 3])
def test_wheels_that_work_share_the_torque_least_in_norm(lost):
    works = np.ones(4)
    if lost is not None:
        works[lost] = 0.0
    pinv = allocation_matrix(AXES, works)
    wanted = np.array([1e-3, -2e-3, 3e-3])
    given = np.asarray(allocate(jnp.asarray(pinv), jnp.asarray(wanted)))
    np.testing.assert_allclose(AXES @ given, wanted, rtol=0.0, atol=1e-17)
    if lost is not None:
        assert given[lost] == 0.0
    else:
        idle = np.array([S, S, S, -1.0])  # torques that are felt by no axis
        np.testing.assert_allclose(AXES @ idle, 0.0, atol=1e-16)
        assert abs(given @ idle) < 1e-18


def test_a_full_wheel_leaves_the_torque_to_the_others():
    share = jax.jit(lambda t, h: allocate_within(jnp.asarray(AXES), PINV, t, h, jnp.full(4, 0.1)))
    wanted = jnp.array([1e-3, -2e-3, 5e-4])
    free = share(wanted, jnp.zeros(4))
    np.testing.assert_allclose(free, PINV @ wanted, atol=1e-18)
    for k in range(4):
        # full in the direction in which its torque would fill it further, then in the other
        h = jnp.zeros(4).at[k].set(-0.1 * jnp.sign(free[k]))
        held = share(wanted, h)
        assert held[k] == 0.0
        others = np.delete(AXES, k, axis=1)
        np.testing.assert_allclose(np.delete(held, k), np.linalg.solve(others, wanted), atol=1e-15)
        np.testing.assert_array_equal(share(wanted, -h), free)
    # two full wheels of four leave no three axes: as much as can be had is not less than before
    h = -0.1 * jnp.sign(free) * jnp.array([1.0, 1.0, 0.0, 0.0])
    np.testing.assert_array_equal(share(wanted, h), free)


@pytest.mark.parametrize(
    ("axes", "works", "words"),
    [
        (AXES[:, :3], [0, 1, 1], r"wheels \[1, 2\] of 3 give torque about 2 independent axes"),
        (AXES[:, [0, 1, 0]], 1.0, "about 2 independent axes"),
        (AXES, [0, 0, 1, 1], r"wheels \[2, 3\] of 4"),
        (np.zeros((3, 0)), 1.0, "about 0 independent axes"),
        (AXES.T, 1.0, r"wheel_axes_b must have shape \(3, W\)"),
        (AXES, [1.0, 1.0], "works must be a number or of shape"),
        (AXES, 2.0, "works must be"),
    ],
)
def test_wheels_that_cannot_hold_a_body_are_refused(axes, works, words):
    with pytest.raises(ValueError, match=words):
        allocation_matrix(axes, works)


def test_the_dipole_takes_the_momentum_across_the_field():
    held, field = np.array([0.02, -0.03, 0.01]), np.array([2e-5, 1e-5, -3e-5])
    size, given = jnp.full(3, 5.0), (jnp.asarray(held), jnp.asarray(field))
    dipole = np.asarray(desaturation_dipole(2e-3, *given, size))
    along = field * (held @ field) / (field @ field)
    np.testing.assert_allclose(np.cross(dipole, field), -2e-3 * (held - along), rtol=1e-12)
    # What is too much for one axis is scaled as a whole.
    less = np.asarray(desaturation_dipole(2e-3, *given, size.at[1].set(0.01)))
    assert abs(dipole[1]) > 0.01
    np.testing.assert_allclose(less, dipole * 0.01 / abs(dipole[1]), rtol=1e-12)
    none = desaturation_dipole(2e-3, given[0], jnp.zeros(3), size)
    np.testing.assert_array_equal(none, np.zeros(3))


@pytest.fixture(scope="module")
def unloading():
    """1500 s of pointing to nadir at 500 km with each wheel at 0.02 N m s, by gain of unloading."""
    time = 0.1 * np.arange(STEPS)
    orbit = circular_orbit(500e3, 97.4 * DEG, 0.3, 0.1, time)
    field = field_along_orbit(orbit)
    reference = nadir(orbit)
    start = craft_state(CRAFT, reference.q_ib[0], reference.omega_b[0], 0.02)

    def momentum_b(k):
        control = CONTROL._replace(desaturation_k=jnp.asarray(k, float))
        states, _ = closed_loop(CRAFT, control, start, reference, orbit.r_i_m, field, 0.1)
        return np.asarray(states.wheel_h) @ AXES.T

    return time, orbit, field, reference, momentum_b


def test_the_magnetorquers_unload_the_wheels(unloading):
    *_, momentum_b = unloading
    held = momentum_b(2e-3)
    np.testing.assert_allclose(held[0], 0.02 * (1.0 + S), rtol=1e-12)
    # 0.0096 N m s after 1500 s in the study, which did not say where on the orbit it began
    assert 0.006 < np.max(np.abs(held[-1])) < 0.0096
    size = np.linalg.norm(held, axis=1)[::1000]
    assert np.all(np.diff(size) < 0.0)
    # with the other sign they would load them
    assert np.max(np.abs(momentum_b(-2e-3)[-1])) > 0.08


def test_the_momentum_of_the_whole_changes_as_torques_say(unloading):
    """A body that points to nadir exactly, by SciPy: only the total momentum is left."""
    time, orbit, field, reference, momentum_b = unloading
    q, omega = np.array(reference.q_ib), np.array(reference.omega_b)
    C = Rotation.from_quat(q, scalar_first=True).as_matrix()
    body = C @ (J @ omega[0])
    places, fields = np.array(orbit.r_i_m), np.array(field)

    def slope(t, total):
        at = np.stack([np.interp(t, time, x) for x in (*body.T, *places.T, *fields.T)])
        body_i, r, b = at.reshape(3, 3)
        turn = C[min(round(t / 0.1), STEPS - 1)]
        held, b_unit = total - body_i, b / np.linalg.norm(b)
        across = held - b_unit * (b_unit @ held)
        r_b = turn.T @ r
        gravity = turn @ (3.0 * GM / np.linalg.norm(r) ** 5 * np.cross(r_b, J @ r_b))
        return -2e-3 * across + np.cross(turn @ RESIDUAL, b) + gravity

    start = body[0] + C[0] @ AXES @ np.full(4, 0.02)
    end = solve_ivp(slope, (0.0, time[-1]), start, rtol=1e-8, atol=1e-10, max_step=10.0).y[:, -1]
    asked = C[-1].T @ (end - body[-1])
    np.testing.assert_allclose(momentum_b(2e-3)[-1], asked, rtol=0.0, atol=3e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"inertia_b": np.eye(2)}, "inertia_b must have shape"),
        ({"inertia_b": np.full((3, 3), np.nan)}, "inertia_b must be"),
        ({"wn": 0.0}, "wn must be"),
        ({"zeta": -0.1}, "zeta must be"),
        ({"desaturation_k": -2e-3}, "desaturation_k must be"),
    ],
)
def test_what_is_no_controller_is_refused(change, words):
    with pytest.raises(ValueError, match=words):
        controller(**({"inertia_b": J} | change))
