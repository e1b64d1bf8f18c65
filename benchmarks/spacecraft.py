"""A spacecraft over one orbit at 10 Hz: its motion alone, with control, and by SciPy in NumPy.

The peer integrates the equations of the rate, with the same control held over each step, by RK45 to
a relative 1e-9: some hundred steps of it, for it takes milliseconds a step.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from timing import best_of, show

from robins.earth.wgs84 import GM
from robins.rotation import conjugate, rotate
from robins.sim.attitude_control import (
    allocate,
    allocation_matrix,
    controller,
    desaturation_dipole,
    torque,
)
from robins.sim.attitude_reference import nadir
from robins.sim.orbit import circular_orbit, field_along_orbit
from robins.sim.spacecraft import advance, craft_state, rate_b, spacecraft, wheel_momentum_b

DT, STEPS, BATCH, BATCH_STEPS, PEER_STEPS = 0.1, 56_000, 64, 2_000, 300
J = np.array([[1.9, 0.02, -0.03], [0.02, 2.1, 0.01], [-0.03, 0.01, 2.4]])
S = 3**-0.5
AXES = np.array([[1.0, 0.0, 0.0, S], [0.0, 1.0, 0.0, S], [0.0, 0.0, 1.0, S]])
RESIDUAL = np.array([0.05, -0.03, 0.04])
CRAFT = spacecraft(J, AXES, 5e-3, 0.1, 5.0, RESIDUAL)
CONTROL = controller(J)
PINV = allocation_matrix(AXES)


def moved(state, given, wheels, dipole):
    _, place, field = given
    return advance(CRAFT, state, wheels, dipole, place, field, jnp.zeros(3), DT)


def free(state, given):
    """One step with wheels that are told where to go beforehand."""
    after = moved(state, given, 1e-2 * given[0].omega_b[0] * jnp.ones(4), jnp.ones(3))
    return after, after


def controlled(state, given):
    """One step of pointing and unloading."""
    (q_ref, omega_ref, alpha_ref), _, field = given
    held = wheel_momentum_b(CRAFT, state.wheel_h)
    field_b = rotate(conjugate(state.q_ib), field)
    dipole = desaturation_dipole(CONTROL.desaturation_k, held, field_b, CRAFT.dipole_limit_a_m2)
    wanted = torque(CONTROL, state.q_ib, rate_b(CRAFT, state), q_ref, omega_ref, alpha_ref, held)
    wheels = allocate(jnp.asarray(PINV), wanted - jnp.cross(dipole, field_b))
    after = moved(state, given, wheels, dipole)
    return after, after


def peer(given, steps):
    """The same in NumPy and SciPy, in body axes: rate, attitude and wheels."""
    reference, places, fields = given
    q_ref, omega_ref = (np.array(x[:steps]) for x in reference[:2])
    places, fields = np.array(places[:steps]), np.array(fields[:steps])
    inverse = np.linalg.inv(J)

    def slope(_, y, wheels, dipole, place, field):
        q, w, h = y[:4], y[4:7], y[7:]
        C = Rotation.from_quat(q, scalar_first=True).as_matrix()
        r_b, field_b = C.T @ place, C.T @ field
        gravity = 3.0 * GM / np.linalg.norm(r_b) ** 5 * np.cross(r_b, J @ r_b)
        outside = gravity + np.cross(dipole + RESIDUAL, field_b)
        q_dot = 0.5 * np.concatenate([[-q[1:] @ w], q[0] * w + np.cross(q[1:], w)])
        w_dot = inverse @ (outside + AXES @ wheels - np.cross(w, J @ w + AXES @ h))
        return np.concatenate([q_dot, w_dot, -wheels])

    y = np.concatenate([q_ref[0], omega_ref[0], np.full(4, 0.02)])
    for k in range(steps):
        turn, wanted = (Rotation.from_quat(q, scalar_first=True) for q in (y[:4], q_ref[k]))
        error = wanted.inv() * turn
        held, w = AXES @ y[7:], y[4:7]
        field_b = turn.inv().apply(fields[k])
        dipole = np.clip(2e-3 * np.cross(held, field_b) / (field_b @ field_b), -5.0, 5.0)
        rate_error = w - error.inv().apply(omega_ref[k])
        feedback = -(0.12**2) * error.as_rotvec() - 2.0 * 0.9 * 0.12 * rate_error
        u = J @ feedback + np.cross(w, J @ w + held) - np.cross(dipole, field_b)
        wheels = np.clip(PINV @ u, -5e-3, 5e-3)
        given = (wheels, dipole, places[k], fields[k])
        y = solve_ivp(slope, (0.0, DT), y, rtol=1e-9, atol=1e-12, args=given).y[:, -1]
    return y


def main():
    orbit = circular_orbit(500e3, np.radians(97.4), 0.3, 0.1, DT * np.arange(STEPS))
    given = (nadir(orbit), orbit.r_i_m, field_along_orbit(orbit))
    short = jax.tree.map(lambda x: x[:BATCH_STEPS], given)
    first = [x[0] for x in given[0]]
    start = craft_state(CRAFT, first[0], first[1], 0.02)
    starts = jax.vmap(lambda h: craft_state(CRAFT, first[0], first[1], h))(
        jnp.linspace(0.0, 0.02, BATCH)
    )
    alone = jax.jit(lambda s: jax.lax.scan(free, s, given)[1])
    pointing = jax.jit(lambda s: jax.lax.scan(controlled, s, given)[1])
    many = jax.jit(jax.vmap(lambda s: jax.lax.scan(controlled, s, short)[1]))
    seconds = best_of(
        {
            "alone": lambda: alone(start),
            "pointing": lambda: pointing(start),
            "many": lambda: many(starts),
            "peer": lambda: peer(given, PEER_STEPS),
        }
    )
    got = np.asarray(pointing(start).q_ib[PEER_STEPS - 1])
    apart = np.abs(got @ peer(given, PEER_STEPS)[:4])
    assert apart > 1.0 - 1e-12, "the peer has gone another way"
    beside = seconds["peer"] / PEER_STEPS
    show("SciPy RK45 and NumPy, motion and control", beside, 1.0, "step")
    show("robins, motion alone, one orbit", seconds["alone"] / STEPS, 1.0, "step")
    show("robins, motion and control, one orbit", seconds["pointing"] / STEPS, 1.0, "step", beside)
    each = seconds["many"] / BATCH / BATCH_STEPS
    show(f"robins, a batch of {BATCH}", each, 1.0, "step and run", beside)
    print(f"one orbit of {STEPS} steps: {seconds['pointing']:.3f} s", flush=True)


if __name__ == "__main__":
    main()
