"""Error dynamics and Phi against the mechanisation itself, entry by entry."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ins_states import (
    NOISE,
    SIZE,
    WEIGHT,
    block,
    error_dynamics,
    gentle,
    linear,
    padded,
    state,
    violent,
)

from robins.ins.increments import Increments
from robins.ins.state import propagate
from robins.manifold import local, retract


def raw_sample(x, f_b, omega_b, dt):
    """Readings of the sensors of x over one interval dt, as a block padded with zeros."""
    rate = omega_b * (1.0 + x.gyro_scale) + x.gyro_bias
    force = f_b * (1.0 + x.accel_scale) + x.accel_bias
    return padded(Increments(np.array([dt]), *(np.asarray(a * dt)[None] for a in (rate, force))))


def miss(x, increments, d):
    """Error after a block that begins with error d[:21] while the sensors add d[21:].

    They read more than is true, so that the truth is behind where the state goes.
    """
    dt = increments.dt[:, None]
    read = increments._replace(
        theta=increments.theta - dt * d[None, 21:24], dv=increments.dv - dt * d[None, 24:]
    )
    return local(propagate(x, increments, NOISE), propagate(retract(x, d[:21]), read, NOISE))


jacobian = jax.jit(lambda x, inc: jax.jacfwd(lambda d: miss(x, inc, d))(jnp.zeros(27)))
dynamics = jax.jit(error_dynamics)


def numerical(x, f_b, omega_b):
    """F and the part of G that the sensors have, from the Jacobian of ever shorter steps."""
    slopes = []
    for dt in (4e-3, 2e-3, 1e-3):
        J = np.array(jacobian(x, raw_sample(x, f_b, omega_b, dt)))
        J[:, :21] -= np.eye(21)
        slopes.append(J / dt)
    # the error of each is a series in dt: two steps of Richardson's extrapolation
    coarse, middle, fine = slopes
    limit = (8.0 * fine - 6.0 * middle + coarse) / 3.0
    return limit[:, :21], limit[:, 21:]


@pytest.mark.parametrize(("seed", "lat_deg"), [(0, 80.0), (1, -80.0), (3, 0.5), (4, None)])
def test_every_entry_of_the_error_dynamics(seed, lat_deg):
    x = state(seed, lat_deg)
    rng = np.random.default_rng(seed + 100)
    f_b, omega_b = jnp.asarray(rng.uniform(-20, 20, 3)), jnp.asarray(rng.uniform(-1, 1, 3))
    F, G = (np.asarray(a) for a in dynamics(x, f_b, omega_b, NOISE))
    F_num, G_num = numerical(x, f_b, omega_b)
    # what is left of the extrapolation; an error in position is hardly amplified within a step
    floor = np.full((21, 21), 1e-11)
    floor[:, 6:9] = 1e-16 + 1e-11 * np.eye(21)[:, 6:9]  # 1 has been taken off the diagonal
    tolerance = 2e-6 * np.abs(F) + floor / WEIGHT
    assert (np.abs(F - F_num) <= tolerance).all(), np.argwhere(np.abs(F - F_num) > tolerance)
    # A single wrong sign cannot hide: every entry that is there stands out of its tolerance.
    hidden = (F != 0.0) & (2.0 * np.abs(F) <= 10.0 * tolerance)
    assert not hidden.any(), np.argwhere(hidden)
    np.testing.assert_allclose(G[:, :6], G_num, rtol=2e-6, atol=1e-9)
    np.testing.assert_array_equal(G[9:, 6:], np.eye(12))
    np.testing.assert_array_equal(G[:9, 6:], 0.0)


def test_jacobian_against_differences():
    """Derivatives by `jacfwd`, which the tests here use, against differences of the states."""
    x, increments = state(4), block(violent)
    size = 0.1 * np.append(SIZE, np.repeat([1e-3, 1e-1], 3))
    steps = jnp.asarray(np.concatenate([np.diag(size), -np.diag(size)]))
    both = np.asarray(jax.jit(jax.vmap(miss, (None, None, 0)))(x, increments, steps))
    slopes = (both[:27] - both[27:]).T / 2.0 / size[None]
    J = jacobian(x, increments)
    weight = size[None] / size[:21, None]
    np.testing.assert_allclose(slopes * weight, J * weight, atol=1e-7)


def test_dynamics_of_a_plain_navigation_state():
    x = state(2)
    f_b, omega_b = jnp.array([1.0, 2.0, -9.0]), jnp.array([0.1, 0.2, 0.3])
    F, G = dynamics(x, f_b, omega_b)
    F_nav, G_nav = dynamics(x.nav, f_b, omega_b)
    assert F_nav.shape == (9, 9)
    assert G_nav.shape == (9, 6)
    np.testing.assert_array_equal(F_nav, F[:9, :9])
    gain = np.concatenate([1.0 + x.gyro_scale, 1.0 + x.accel_scale])
    np.testing.assert_allclose(G_nav, np.asarray(G[:9, :6]) * gain[None], rtol=1e-15)


def test_states_have_the_dimension_their_fields_ask_for():
    def shapes(x):
        return [a.shape for a in jax.eval_shape(error_dynamics, x, jnp.ones(3), jnp.ones(3))]

    bare = state(0, scales=False)
    assert shapes(bare) == [(15, 15), (15, 12)]
    assert shapes(bare._replace(accel_scale=jnp.zeros(3))) == [(18, 18), (18, 15)]


@pytest.mark.parametrize(("motion", "tolerance"), [(violent, 3e-6), (gentle, 5e-7)])
def test_phi_is_the_jacobian_of_a_second(motion, tolerance):
    """Errors of SIZE come out right to a few millionths of SIZE."""
    x, increments = state(1, 80.0), block(motion)
    J = np.asarray(jacobian(x, increments))[:, :21]
    assert (np.abs(J) * WEIGHT)[:9, 9:].max() > 1e-2  # the errors of the sensors do get there
    _, Phi, _ = linear(x, increments, NOISE, 4)
    assert (np.abs(Phi - J) * WEIGHT).max() < tolerance
    # Fewer segments are worse by the square of their length.
    _, Phi, _ = linear(x, increments, NOISE, 1)
    assert 8.0 * tolerance < (np.abs(Phi - J) * WEIGHT).max() < 30.0 * tolerance
