"""States and motions for the tests of an aided INS: any attitude, fast, high, with bad sensors."""

import jax
import jax.numpy as jnp
import numpy as np

from robins.earth import Geodetic
from robins.ins.errors import decay_rates, frame_dynamics, scale_of
from robins.ins.increments import Increments
from robins.ins.mechanise import Nav
from robins.ins.state import InsNoise, InsState, propagate_linear
from robins.rotation import Rotation, skew

# what an error of each kind amounts to: rad, m/s, m, rad/s, m/s^2, scales
SIZE = np.repeat([1e-3, 1.0, 1.0, 1e-4, 1e-2, 1e-3, 1e-3], 3)
WEIGHT = SIZE[None] / SIZE[:, None]  # of an entry that takes one kind to another
NOISE = InsNoise(*(np.full(3, a) for a in (1e-4, 1e-3, 1e-7, 1e-5, 300.0, 200.0, 1e-6, 1e-6)))

linear = jax.jit(propagate_linear, static_argnums=3)


def error_dynamics(state, f_b, omega_ib_b, noise=None):
    """F and G of ``dx/dt = F x + G w`` at a state.

    Args:
        state: a `Nav` (n = 9) or an `InsState` (n = 15, or up to 21 with scale factors).
        f_b: true specific force [m/s^2], that is, corrected for the state's biases and scales.
        omega_ib_b: true angular rate [rad/s], likewise.
        noise: an `InsNoise`, for the decay of the biases; None: they are constant.

    Returns:
        F, and G for unit white noise of each gyro and accelerometer (with the sign of a sensor
        error), then of the drive of each bias and scale: m = 6 for a `Nav`, else n - 3.
    """
    C = state.q_nb.as_dcm()
    F_nav = frame_dynamics(state).at[3:6, 0:3].set(-skew(C @ f_b))
    zero = jnp.zeros((3, 3))
    kinds = [("gyro", 0, omega_ib_b), ("accel", 3, f_b)]
    into = {}  # effect of the errors of a sensor on the nine
    for sensor, at, _ in kinds:
        blocks = [zero, zero, zero]
        blocks[at // 3] = -C / (1.0 + scale_of(state, sensor))[None]
        into[sensor] = jnp.concatenate(blocks)
    G_nav = jnp.concatenate([into["gyro"], into["accel"]], 1)
    if not hasattr(state, "gyro_bias"):
        return F_nav, G_nav
    columns = [into["gyro"], into["accel"]]
    columns += [
        into[sensor] * value[None]
        for sensor, _, value in kinds
        if getattr(state, f"{sensor}_scale") is not None
    ]
    B = jnp.concatenate(columns, 1)
    m = B.shape[1]
    lower = jnp.concatenate([jnp.zeros((m, 9)), -jnp.diag(decay_rates(state, noise))], 1)
    F = jnp.concatenate([jnp.concatenate([F_nav, B], 1), lower])
    G = jnp.zeros((9 + m, 6 + m)).at[:9, :6].set(G_nav).at[9:, 6:].set(jnp.eye(m))
    return F, G


def state(seed=0, lat_deg=None, scales=True):
    rng = np.random.default_rng(seed)
    lat = np.deg2rad(rng.uniform(-80.0, 80.0) if lat_deg is None else lat_deg)
    nav = Nav(
        Rotation(jnp.asarray(rng.normal(size=4))),
        jnp.asarray(rng.uniform(-300.0, 300.0, 3)),
        Geodetic(
            *(jnp.asarray(a, float) for a in (lat, rng.uniform(-3.0, 3.0), rng.uniform(-500, 3e4)))
        ),
    )
    nav = nav._replace(q_nb=Rotation(nav.q_nb.wxyz / jnp.linalg.norm(nav.q_nb.wxyz)))
    scale = rng.normal(0.0, 1e-3, (2, 3)) if scales else (None, None)
    return InsState(
        *nav,
        jnp.asarray(rng.normal(0.0, 1e-4, 3)),
        jnp.asarray(rng.normal(0.0, 1e-2, 3)),
        *(None if s is None else jnp.asarray(s) for s in scale),
    )


def gentle(t, xp=np):
    """Rate and specific force of a turn, (..., 3) each."""
    one = xp.ones_like(t)
    return (
        xp.stack([0.02 * one, 0.05 * xp.cos(t), 0.2 * one], -1),
        xp.stack([one, 2.0 * xp.cos(t), -9.8 * one], -1),
    )


def violent(t, xp=np):
    """A body that shakes at 1 to 2 Hz with 2 rad/s and 2 g."""
    return (
        xp.stack([2 * xp.sin(9 * t), 1.5 * xp.cos(7 * t), 1 + 2 * xp.sin(5 * t)], -1),
        xp.stack([10 * xp.sin(11 * t), 15 * xp.cos(8 * t), -9.8 + 20 * xp.sin(6 * t)], -1),
    )


def block(motion, count=100, dt=0.01):
    """Raw increments of a motion; what coning is in them does not matter here."""
    rate, force = motion((np.arange(count) + 0.5) * dt)
    return Increments(np.full(count, dt), rate * dt, force * dt)


def padded(increments, count=100):
    """Block padded with increments of zero length."""
    more = count - len(increments.dt)
    return jax.tree.map(lambda a: np.concatenate([a, np.zeros((more, *a.shape[1:]))]), increments)
