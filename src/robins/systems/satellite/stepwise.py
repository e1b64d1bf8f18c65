"""A gain redesigned at every star frame, by the LMI of the plant at the current angular rate.

This is the patent's filter as stated: at every step the transition is formed from the rate that
the gyro reports, and the mixed H2/H-infinity inequality is solved for it. The plant is that of the
error of attitude and gyro bias, from star frame to star frame (period T), in arcsec and s:

    A(w) = [exp(-[w]x T)  -T I; 0  I],   y = dtheta + star noise,   z = dtheta,

w the rate over the last sample of the gyro, less the estimated bias. The patent's own plant, a
quaternion of four components, has no bias to estimate; its discretisation I + T Omega(w)/2
lengthens the quaternion, and with its noise inputs the optimal gain uses the star sensor alone
(docs/systems/satellite.md). A frame is the step here: between frames no gain is used.

At rest the axes decouple, and the gain is that of `robins.systems.satellite.design`. Each axis
has its own bound, so its modelling error n is scaled to make all bounds one.

No bound is guaranteed for a varying plant: see `robins.filters.synthesis.lmi.EveryStep`.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from robins.filters import Belief, Code, Rule, StepInfo, StepWarning
from robins.filters.kalman import FilterState
from robins.filters.linearise import Transition
from robins.filters.observation import Observation
from robins.filters.rules.constant_gain import corrected
from robins.filters.synthesis import (
    EveryStep,
    FrozenTimeWarning,
    NotCertified,
    Plant,
    Unreachable,
    current_form,
    kalman_design,
)
from robins.filters.values import Numbers, value
from robins.rotation import conjugate, multiply, to_rotvec
from robins.systems.satellite.design import GainSpec, SensorNoise, axis_plant
from robins.systems.satellite.nodes import NO_GAIN, STAR

NAME, _FAILED = NO_GAIN.split(".")


class FrozenPlant(NamedTuple):
    """Plant data that do not depend on the angular rate, arcsec and s; NumPy or JAX."""

    sample_s: Any  # () of the gyro
    period_s: Any  # () of the star sensor
    noise: Any  # (6, 6) factor of the gyro's noise over a period
    error: Any  # (6, 3) Bn, each axis over its bound on the H-infinity norm
    star: Any  # (3,) sigma of a star frame


def frozen(b: SensorNoise, spec: GainSpec, sample_s: float) -> FrozenPlant:
    """Design data of three axes, from the assumed noise of the sensors.

    Args:
        b: noise of gyro and star sensor.
        spec: input of n, and the bound of an axis as a share of the Kalman filter's norm.
        sample_s: sampling interval of the gyro [s].
    """
    noise, error, star = np.zeros((6, 6)), np.zeros((6, 3)), np.zeros(3)
    for i, star_rad in enumerate(b.star_rad):
        plant = axis_plant(b, star_rad, spec.enters)
        gamma = spec.share * kalman_design(plant).hinf
        rows = [i, 3 + i]
        noise[np.ix_(rows, rows)] = plant.Bw[:, :2]
        error[rows, i] = plant.Bn[:, 0] / gamma
        star[i] = plant.Dw[0, 2]
    return FrozenPlant(np.asarray(sample_s), np.asarray(b.period_s), noise, error, star)


def plant_at(rate_b: Numbers, of: FrozenPlant) -> Plant:
    """Plant of a craft at a constant rate [rad/s], body axes; current form.

    Its gain must have an H-infinity norm of at most one.
    """
    T, eye, none, seen = float(of.period_s), np.eye(3), np.zeros((3, 3)), np.eye(3, 6)
    x, y, z = -T * np.asarray(rate_b, float)
    S = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = float(np.sqrt(x * x + y * y + z * z)) / np.pi
    back = eye + np.sinc(angle) * S + 0.5 * np.sinc(0.5 * angle) ** 2 * (S @ S)  # Rodrigues
    A = np.block([[back, -T * eye], [none, eye]])
    return current_form(A, of.noise, of.error, seen, np.diag(of.star), L=seen)


def gain_at(rate_b: Numbers, of: FrozenPlant) -> tuple[np.ndarray, np.ndarray]:
    """The certified gain at a rate, on the host.

    A function of its arguments alone: the scaling of the program is that of the craft at rest.

    Args:
        rate_b: (3,) angular rate [rad/s].
        of: plant data.

    Returns:
        (6, 3) gain of attitude and bias [1, 1/s], and () bool, True if it is valid: its certified
        norms meet the requirement.
    """
    known = FrozenPlant(*(np.asarray(x, float) for x in of))
    each = _designer(*((x.shape, x.tobytes()) for x in known))
    try:
        return each(plant_at(rate_b, known)), np.asarray(True)
    except (NotCertified, Unreachable):
        return np.zeros((6, 3)), np.asarray(False)


@lru_cache(maxsize=16)
def _designer(*numbers: tuple[tuple[int, ...], bytes]) -> EveryStep:
    of = FrozenPlant(*(np.frombuffer(data).reshape(shape) for shape, data in numbers))
    with warnings.catch_warnings():  # documented on the page of the filter
        warnings.simplefilter("ignore", FrozenTimeWarning)
        return EveryStep(1.0, like=plant_at(np.zeros(3), of))


class RedesignMemory(NamedTuple):
    """Memory of the rule."""

    of: FrozenPlant
    q_ib: Array  # (4,) estimate before the last sample of the gyro
    turn: Array  # (3,) rad, over that sample, body axes
    gain: Array  # (6, 3) of the last frame whose design passed; before it that of `initial_state`
    failed: Array  # () frames whose design did not pass


@value
class LmiStep(Rule):
    """Update with the gain of an LMI for the plant at the current rate, solved on the host.

    A frame whose design fails uses the last accepted gain. The covariance is the one for the gain
    used, as with `constant_gain`. Begin a state by `initial_state`.

    Notes: ``lmi_step.failed``, true if the design of this frame failed.
    """

    name = NAME

    def init(self, belief: Belief, dims: Mapping[str, int]) -> RedesignMemory:
        none = FrozenPlant(*(jnp.zeros(shape) for shape in ((), (), (6, 6), (6, 3), (3,))))
        q_ib = belief.mean.attitude.wxyz
        return RedesignMemory(none, q_ib, jnp.zeros(3), jnp.zeros((6, 3)), jnp.asarray(0))

    def settle(self, memory: RedesignMemory, belief: Belief):
        return memory._replace(q_ib=belief.mean.attitude.wxyz), belief, int(Code.DONE)

    def process(self, memory: RedesignMemory, transition: Transition):
        turn = to_rotvec(multiply(conjugate(memory.q_ib), transition.mean.attitude.wxyz))
        return memory._replace(turn=turn), transition

    def after(self, memory: RedesignMemory, posterior: Belief, info: StepInfo, o: Observation):
        shapes = jax.ShapeDtypeStruct((6, 3), float), jax.ShapeDtypeStruct((), bool)
        solved = partial(jax.pure_callback, gain_at, shapes, vmap_method="sequential")
        found, passed = jax.lax.cond(
            jnp.any(info.used),
            solved,
            lambda rate_b, of: (memory.gain, jnp.asarray(True)),
            memory.turn / memory.of.sample_s,
            memory.of,
        )
        gain = jnp.where(passed, found, memory.gain)
        if o.sensor == STAR:
            posterior, info = corrected(gain, posterior, info, o)
        memory = memory._replace(gain=gain, failed=memory.failed + (~passed).astype(int))
        return memory, posterior, info.noted(NAME, **{_FAILED: ~passed})

    def report(self, start: RedesignMemory, final: RedesignMemory, again: Any, time: Any) -> None:
        """Report the failed designs of a run; in a stream each note reports its own.

        Warns:
            StepWarning: there are failed designs.
        """
        if again is None:
            return
        if number := int(final.failed) - int(start.failed):
            warnings.warn(
                f"{number} designs at a star frame did not pass the test of their true norms: the "
                "gain of the frame before stayed",
                StepWarning,
                stacklevel=2,
            )


def initial_state(state: FilterState, of: FrozenPlant, gain: Numbers) -> FilterState:
    """Initial state of a filter with the rule `LmiStep`.

    Args:
        state: of a filter with the rule `LmiStep`.
        of: plant data.
        gain: (6, 3), used until the first design passes.
    """
    as_arrays = FrozenPlant(*(jnp.asarray(x, float) for x in of))

    def with_design(memory: PyTree) -> PyTree:
        if not isinstance(memory, RedesignMemory):
            return memory
        return memory._replace(of=as_arrays, gain=jnp.asarray(gain, float))

    return state._replace(memory=tuple(map(with_design, state.memory)))
