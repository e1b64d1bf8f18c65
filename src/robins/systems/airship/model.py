"""The airship's navigation states, their motion and that of their errors.

The mean is the navigation state itself, so the estimate is fed back to the inertial navigation by
construction, and the paper's nonlinear error model (40) (see `error_model`) is the difference of
two such states. An error is true minus estimated, in the order of the tangent:

    phi    rad      C_true = exp(phi x) C, seen in n     Nav: nine states, as in the paper
    dv_n   m/s      north, east, down
    dp     m        north, east, down
    db_g   rad/s    bias of the gyros, body axes         InsState: fifteen
    db_a   m/s^2    bias of the accelerometers
    dw     m/s      north, east                          WithWind: two more on either

The mean moves by the mechanisation (`robins.ins.mechanise`), its error by dx/dt = F x + G n as in
Groves (2013), section 14.2, but with position in metres (`robins.ins.errors`). With C = C_b^n,
f = C (f_b - b_a), w_c = 2 w_ie + w_en and a subscript for a derivative, w_in,v = d w_in / d v,

          phi        dv                    dp                   db_g  db_a  dw
    F = [ -[w_in x]  -w_in,v               -w_in,p              -C    .     .      ]
        [ -[f x]     [v x] w_in,v - [w_c x]  g_,p + [v x] w_c,p   .     -C    .      ]
        [ .          I                     dp/dt_,p             .     .     .      ]
        [ .          .                     .                    .     .     .      ]  db_g, db_a
        [ .          .                     .                    .     .     -I/tau ]

    Q = G diag(q_g^2 I, q_a^2 I, 2 sigma^2/tau I) G',   G: -C into phi, -C into dv, I into dw.

A step of a filter is an epoch; Phi and L, with Q = L L' over the step, are those of
`robins.ins.transition`, or `white_noise_factor` where there are no biases. H is in `instruments`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike, Float

from robins import _float64  # noqa: F401
from robins.filters import Motion
from robins.ins.frames import swap
from robins.ins.increments import Increments
from robins.ins.mechanise import Nav, step
from robins.ins.state import InsNoise, InsState, propagate, propagate_linear
from robins.linalg import block_diagonal
from robins.systems.airship.parameters import Airship
from robins.systems.airship.world import AirshipCourse, start_sigma
from robins.systems.parts import moved_by


class WithWind(NamedTuple):
    """A navigation state and the error of the assumed wind."""

    base: Any  # Nav or InsState
    wind_error: Array  # (2,) m/s north east, assumed minus true

    @property
    def nav(self) -> Nav:
        """Attitude, velocity and position alone."""
        return navigation(self.base)


_WindError = tuple[Array, Array]
"""Sigma () [m/s] on each axis and time constant () [s] of a first-order Gauss-Markov process."""


def navigation(x: Any) -> Nav:
    """Attitude, velocity and position of any state of this study."""
    return x if isinstance(x, Nav) else x.nav


def nine_states(noise: InsNoise) -> Motion:
    """Motion of the paper's states, a `Nav`; input of a step: one increment.

    The assumed noise is one number for the three gyro axes and one for the accelerometers.
    """
    return Motion(step, Partial(_noise, noise), Partial(_linear, noise))


def white_noise_factor(noise: InsNoise, dt: ArrayLike) -> Float[Array, "9 9"]:
    """Factor L of Q over a step of constant white noise.

    Attitude is a random walk; velocity is another, with position as its integral,

        Q_phi = q_g^2 dt I,   Q_v,p = q_a^2 [dt  dt^2/2; dt^2/2  dt^3/3] (x) I.
    """
    root, eye, zero = jnp.sqrt(jnp.asarray(dt)), jnp.eye(3), jnp.zeros((3, 3))
    phi, v = (root * jnp.asarray(s) * eye for s in (noise.gyro_arw, noise.accel_vrw))
    shift, own = 0.5 * dt * v, dt / jnp.sqrt(12.0) * v
    return jnp.block([[phi, zero, zero], [zero, v, zero], [zero, shift, own]])


def _noise(noise: InsNoise, x: Nav, block: Increments) -> Array:
    return white_noise_factor(noise, block.dt)


def _linear(noise: InsNoise, x: Nav, block: Increments):
    """The step and its Jacobian, the first nine rows and columns of that of fifteen states."""
    one = jax.tree.map(lambda a: jnp.asarray(a, float)[None], block)
    new, Phi, _ = propagate_linear(InsState.start(x), one, noise, segments=1)
    return new.nav, Phi[:9, :9], white_noise_factor(noise, block.dt)


def with_biases(noise: InsNoise) -> Motion:
    """Motion of an `InsState`; input of a step: K increments."""
    return moved_by(_step_ins, _linear_ins, noise)


def _step_ins(noise: InsNoise, x: InsState, block: Increments) -> InsState:
    return propagate(x, block, noise)


def _linear_ins(noise: InsNoise, x: InsState, block: Increments):
    return propagate_linear(x, block, noise, segments=1)


def with_wind(base: Motion, wind: _WindError) -> Motion:
    """A motion with two more states, `WithWind`.

    The error of the wind is a stationary Gauss-Markov process: over a step of dt

        w' = e^(-dt/tau) w + v,   E v v' = sigma^2 (1 - e^(-2 dt/tau)) I.
    """
    moves, noise, linear = (Partial(f, base, wind) for f in (_step_wind, _noise_wind, _linear_wind))
    return Motion(moves, noise, linear)


def _wind_step(wind: _WindError, block: Increments) -> tuple[Array, Array]:
    """Decay and driving sigma over a step."""
    sigma, time_s = wind
    ratio = jnp.sum(jnp.asarray(block.dt)) / time_s
    return jnp.exp(-ratio), sigma * jnp.sqrt(-jnp.expm1(-2.0 * ratio))


def _step_wind(base: Motion, wind: _WindError, x: WithWind, block: Increments) -> WithWind:
    decay, _ = _wind_step(wind, block)
    return WithWind(base.step(x.base, block), decay * x.wind_error)


def _noise_wind(base: Motion, wind: _WindError, x: WithWind, block: Increments) -> Array:
    _, drive = _wind_step(wind, block)
    return block_diagonal(base.noise(x.base, block), drive * jnp.eye(2))


def _linear_wind(base: Motion, wind: _WindError, x: WithWind, block: Increments):
    assert base.linear is not None
    new, Phi, L = base.linear(x.base, block)
    (decay, drive), eye = _wind_step(wind, block), jnp.eye(2)
    new = WithWind(new, decay * x.wind_error)
    return new, block_diagonal(Phi, decay * eye), block_diagonal(L, drive * eye)


# ----------------------------------------------------------------------- assumptions of a filter


ENU_OF_NED = np.kron(np.eye(3), swap(np.eye(3)))  # (9, 9) of attitude, velocity, position


class States(NamedTuple):
    """The states of a filter: their motion model, their construction, and initial sigmas."""

    motion: Callable[[Airship, AirshipCourse], Motion]
    # navigation, biases of gyros and accelerometers, error of the wind -> state
    of: Callable[[Nav, Array, Array, Array], Any]
    sigma: Callable[[Airship, AirshipCourse], list[Any]]  # initial, to be concatenated
    # (9, 9) reported = this @ the first nine errors
    reported: Callable[[AirshipCourse], np.ndarray] = lambda course: ENU_OF_NED
    in_parts: bool = False  # an epoch comes as several increments


def believed_noise(given: Airship) -> InsNoise:
    """Process noise for filters of nine states, in which velocity noise stands for the biases."""
    return InsNoise(jnp.asarray(given.believed.gyro_noise), jnp.asarray(given.believed.accel_noise))


def _wind(given: Airship) -> _WindError:
    return jnp.asarray(given.air_data.wind_error), jnp.asarray(given.air_data.wind_time)


def _product_motion(given: Airship, course: AirshipCourse) -> Motion:
    imu, factor = given.imu, given.believed.accel_noise_factor
    noise = InsNoise(jnp.asarray(imu.gyro_noise), factor * jnp.asarray(imu.accel_noise))
    return with_wind(with_biases(noise), _wind(given))


NINE = States(
    lambda given, course: nine_states(believed_noise(given)),
    lambda nav, gyro, accel, wind: nav,
    lambda given, course: [start_sigma(given)],
)
WIND_STATES = States(
    lambda given, course: with_wind(nine_states(believed_noise(given)), _wind(given)),
    lambda nav, gyro, accel, wind: WithWind(nav, wind),
    lambda given, course: [start_sigma(given), np.full(2, given.air_data.wind_error)],
)
PRODUCT = States(
    _product_motion,
    lambda nav, gyro, accel, wind: WithWind(
        InsState(nav.q_nb, nav.v_n, nav.position, gyro, accel), wind
    ),
    lambda given, course: [
        *(start_sigma(given), given.imu.gyro_bias, given.imu.accel_bias),
        np.full(2, given.air_data.wind_error),
    ],
    in_parts=True,
)
