"""Updates with a gain designed offline."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from robins import linalg, manifold
from robins.errors import require
from robins.filters.belief import Belief, StepInfo
from robins.filters.kalman import FilterState
from robins.filters.model import Given
from robins.filters.observation import Observation, left_out
from robins.filters.rule import Rule
from robins.filters.trees import select
from robins.filters.values import Numbers, finite_leaf, value


class GainMemory(NamedTuple):
    """Memory of the rule. Gains are data: exchanging one in a state compiles nothing."""

    gains: dict[str, Array]  # (n, m) by sensor


@value
class ConstantGain(Rule):
    """Rule of `constant_gain`: the update `corrected`, with the gains in the memory."""

    gains: dict[str, Numbers]  # (n, m) by sensor

    name = "constant_gain"

    def init(self, belief: Belief, dims: Mapping[str, int]) -> GainMemory:
        n = belief.factor.shape[0]
        for name, K in self.gains.items():
            require(name in dims, f"constant_gain: no sensor '{name}'; this model has {list(dims)}")
            if K.shape != (n, dims[name]):
                raise ValueError(
                    f"constant_gain: the gain of '{name}' is {K.shape}, state and sensor need "
                    f"({n}, {dims[name]})"
                )
        return GainMemory({name: jnp.asarray(K) for name, K in self.gains.items()})

    def after(self, memory: GainMemory, posterior: Belief, info: StepInfo, o: Observation):
        if o.sensor not in memory.gains:
            return memory, posterior, info
        return memory, *corrected(memory.gains[o.sensor], posterior, info, o)


def corrected(
    gain: Array, posterior: Belief, info: StepInfo, o: Observation
) -> tuple[Belief, StepInfo]:
    """Belief x- + K (y - h(x-)), (I - K H) P- (I - K H)' + K (Omega + R) K', and its information.

    Args:
        gain: (n, m) K; columns of components not used are set to zero.
        posterior: belief of the usual update, returned if nothing is used.
        info: information of the usual update.
        o: the measurement relative to the prior.
    """
    spread, excess, noise, deficit, used = left_out(o)
    used = used & info.used
    K = jnp.where(used[None, :], gain, 0.0)
    S = o.prior.factor
    moved = K @ jnp.where(used, o.residual, 0.0)
    factor = linalg.tria(S - K @ spread, K @ excess, K @ noise)
    if deficit is not None:
        factor = linalg.downdate(factor, K @ deficit)
    belief = Belief(manifold.retract(o.prior.mean, moved), factor)
    belief = select(jnp.any(used), belief, posterior)
    return belief, info._replace(gain=K).noted("constant_gain", moved=jnp.max(jnp.abs(moved)))


def constant_gain(gains: Mapping[str, Given]) -> Rule:
    """Update the mean with a constant gain, and compute the covariance for this gain.

        x+ = x- + K (y - h(x-)),   P+ = (I - K H) P- (I - K H)' + K (Omega + R) K'

    K is the gain of a steady-state design (`robins.filters.synthesis`), in current form. The
    covariance holds for any gain (Joseph form; Brown & Hwang 2012, eq. 4.2.11), and grows during
    outages of the sensor. Columns of components that are missing or refused are set to zero;
    sensors without a gain are updated as usual. Put it after rules that fade the prior.

    Notes: ``constant_gain.moved``, the largest component of the correction.

    Args:
        gains: (n, m) by name of the sensor, in the tangent spaces of state and measurement.

    Raises:
        ValueError: there is no gain, or one is not finite; at `init`, a sensor is unknown or a gain
            has the wrong shape.
    """
    require(gains, "constant_gain: give at least one gain, {'sensor': (n, m) array}")
    what = "constant_gain: the gain of"
    return ConstantGain({name: finite_leaf(f"{what} '{name}'", K) for name, K in gains.items()})


def with_gains(state: FilterState, gains: Mapping[str, Given]) -> FilterState:
    """Filter state with other gains of the same shapes, which may be traced or batched.

    Raises:
        ValueError: the filter has no `constant_gain` rule, or names or shapes differ.
    """
    if not any(isinstance(one, GainMemory) for one in state.memory):
        raise ValueError("this filter has no constant_gain rule whose gains could be exchanged")

    def exchanged(memory: GainMemory) -> GainMemory:
        new = {name: jnp.asarray(K, float) for name, K in gains.items()}
        shapes = [{k: v.shape for k, v in of.items()} for of in (new, memory.gains)]
        if shapes[0] != shapes[1]:
            raise ValueError(
                f"gains have shapes {shapes[0]}, the filter was begun with {shapes[1]}"
            )
        return memory._replace(gains=new)

    held = tuple(exchanged(one) if isinstance(one, GainMemory) else one for one in state.memory)
    return state._replace(memory=held)
