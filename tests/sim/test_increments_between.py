"""Increments between given states: the mechanisation leads from each to the next."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins.dataset import Trajectory
from robins.ins.increments import from_imu
from robins.ins.mechanise import nav_at, step
from robins.rotation import from_euler
from robins.sim.ideal_imu import ideal_increments, increments_between

STEPS, DT_S = 40, 0.1


def swaying(size: float) -> Trajectory:
    """A body that turns by up to 4 deg in a step, by size, and climbs; equal steps."""
    t = DT_S * np.arange(STEPS + 1)
    roll, pitch, turn = 0.3 * np.sin(1.5 * t), 0.2 * np.sin(2.0 * t + 1.0), 0.4 * t
    angles = (jnp.asarray(a) for a in (size * roll, size * pitch, 3.0 + size * turn))
    q = np.asarray(from_euler(*angles))
    v = np.stack([20.0 * np.cos(0.5 * t), 20.0 * np.sin(0.5 * t), -2.0 + 0.0 * t], 1)
    lat, lon = 0.6 + 3e-6 * t, 1.9 + 4e-6 * t
    return Trajectory((t * 1e9).round().astype(np.int64), lat, lon, 2e4 + 2.0 * t, v, q)


between, leads = jax.jit(increments_between), jax.jit(jax.vmap(step))


@pytest.mark.parametrize(
    ("size", "turn_rad", "push_m_s"), [(0.1, 1e-13, 1e-12), (1.0, 2e-11, 2e-11)]
)
def test_each_step_leads_to_the_next_state(size, turn_rad, push_m_s):
    path = swaying(size)
    before, after = (nav_at(path, rows) for rows in (slice(-1), slice(1, None)))
    found = between(before, after, jnp.full(STEPS, DT_S))
    largest = np.max(np.linalg.norm(found.theta, axis=1))
    assert 0.8 * size < np.degrees(largest) / 4.0 < 1.2 * size
    reached = leads(before, found)
    turn = jax.vmap(lambda a, b: a.local(b))(after.q_nb, reached.q_nb)
    np.testing.assert_allclose(turn, 0.0, atol=turn_rad)
    np.testing.assert_allclose(reached.v_n, after.v_n, atol=push_m_s)


def test_they_are_those_of_the_table():
    """`ideal_increments` makes samples of which `from_imu` makes increments, coning and all."""
    path = swaying(0.1)
    before, after = (nav_at(path, rows) for rows in (slice(-1), slice(1, None)))
    found = between(before, after, jnp.full(STEPS, DT_S))
    table, _ = from_imu(ideal_increments(path))
    np.testing.assert_allclose(found.dt, table.dt, rtol=1e-9)
    # Both lead to the same attitude and velocity; the frame's turn over the displacement differs by
    # what the table makes of the slope of the force: a millimetre on the Earth.
    np.testing.assert_allclose(found.theta, table.theta, atol=1e-9)
    np.testing.assert_allclose(found.dv, table.dv, atol=1e-8)


def test_a_body_at_rest_feels_gravity_and_the_turning_earth():
    lat, alt = 0.6, 0.0
    place, q_nb = (np.full(2, x) for x in (lat, 1.0, alt)), np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    still = Trajectory(np.array([0, 10**8]), *place, np.zeros((2, 3)), q_nb)
    start = nav_at(still, slice(0, 1))
    rest = between(start, start, jnp.array([0.1]))
    earth = 7.292115e-5 * np.array([np.cos(lat), 0.0, -np.sin(lat)])
    np.testing.assert_allclose(rest.theta[0] / 0.1, earth, atol=1e-15)
    e2, gamma_e, k = 0.00669437999014, 9.7803253359, 0.00193185265241  # WGS84, Somigliana
    s2 = np.sin(lat) ** 2
    gravity = gamma_e * (1.0 + k * s2) / np.sqrt(1.0 - e2 * s2)
    np.testing.assert_allclose(rest.dv[0] / 0.1, [0.0, 0.0, -gravity], atol=1e-4)
