"""The filters of the product model; one of them has no information on the disturbance.

That one, "adaptive", is a bank of hypotheses. A single innovation does not show whether the
record or the gyros are disturbed. The following innovations do, and so does the velocity, which
neither flexure nor gyro noise affects directly. So several filters of the same 24 states run in
parallel, each under its own hypothesis, as an interacting multiple model
(`robins.filters.composite.imm`):

                stiff structure           flexing structure
    quiet       the stated noise          and the flexure of the model
    kicked      -                         its drive 10 times as strong, for some tenths of a second
    noisy       gyro noise 15 times       likewise
    drifting    and a bias that walks     likewise, for some tens of seconds

Each weights outliers by Huber's rule. A structure is permanently stiff or flexing, so the two
halves mix by one part in 10^5 only. The bank ignores the assumed structure: a wrong one costs more
than none. The numbers are the same for all scenarios. The gyro factor and the structure belong to
no scenario; they were chosen on runs of A to D and on wrong structures, random seed 100. The
strength of a kick and the probabilities are older, and were chosen with knowledge of B to D.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike

from robins.filters import Filter, kalman, taylor, unscented
from robins.filters.composite.bank import HypothesisRow, bank
from robins.filters.linearise import Transition
from robins.filters.rule import Memory, Rule
from robins.filters.rules import huber
from robins.filters.values import Numbers, number, value
from robins.sim.flexure import Flexure
from robins.systems.transfer_alignment.product.parameters import Structure

_ATTITUDE, _GYRO_BIAS, _FLEXURE = slice(0, 3), slice(9, 12), slice(18, 24)
_STATES = 24
_STIFF = 1e-3  # share of the flexure left in a stiff structure: negligible
_WEIGHED = 0.99  # share of good records that keep their full weight


class NoiseHypothesis(NamedTuple):
    """Factors on process noise."""

    gyro: ArrayLike = 1.0  # noise of the gyros
    walk: ArrayLike = 0.0  # rad/s/sqrt(s) of the gyro biases in units of the gyro noise: 1/s
    flexure: ArrayLike = 1.0  # drive of the flexure


QUIET, NOISY, DRIFTING = (
    NoiseHypothesis(),
    NoiseHypothesis(gyro=15.0),
    NoiseHypothesis(gyro=15.0, walk=15.0),
)
KICKED = NoiseHypothesis(flexure=10.0)


@value
class HypothesisNoise(Rule):
    """The rule of `under_hypothesis`."""

    hypothesis: NoiseHypothesis
    stiff: Numbers  # () one for a stiff structure, else zero

    name = "supposing"

    def process(self, memory: Memory, transition: Transition):
        """Process noise of the hypothesis; removes the flexure of a stiff structure."""
        t, (gyro, walk, flexure) = transition, self.hypothesis
        stiff = jnp.asarray(self.stiff) > 0.0
        grown = jnp.ones(_STATES).at[_ATTITUDE].set(gyro).at[_FLEXURE].set(flexure)
        kept = jnp.ones(_STATES).at[_FLEXURE].set(jnp.where(stiff, _STIFF, 1.0))
        # The noise factor is triangular, and gyro noise enters by its first three columns.
        one_axis = jnp.sqrt(jnp.sum(t.noise[_ATTITUDE] ** 2) / 3.0)
        wander = jnp.zeros((_STATES, 3)).at[_GYRO_BIAS].set(walk * one_axis * jnp.eye(3))
        noise = jnp.concatenate([t.noise * grown[None], wander], 1)
        mean = t.mean._replace(flexure=jnp.where(stiff, 0.0, t.mean.flexure))
        spread, noise = t.spread * kept[:, None], noise * kept[:, None]
        return memory, t._replace(mean=mean, spread=spread, noise=noise)


def under_hypothesis(hypothesis: NoiseHypothesis, stiff: ArrayLike) -> Rule:
    """Filter under a hypothesis; a stiff structure has negligible flexure."""
    own = NoiseHypothesis(*(number("a hypothesis is of real numbers", x) for x in hypothesis))
    return HypothesisNoise(own, number("stiff is one or zero", stiff))


GYROS, FLEXURE = ("gyros",), ("flexure",)  # disturbed parts in a mode
# Changes in one step of the filter, tenths of a second: from the row's hypothesis to the column's.
_STIFF_MODES = ((QUIET, ()), (NOISY, GYROS), (DRIFTING, GYROS))
_STIFF_CHANGES = (
    (1.0 - 1.5e-4, 1e-4, 5e-5),
    (5e-4, 1.0 - 1.5e-3, 1e-3),
    (5e-3, 2e-2, 1.0 - 2.5e-2),
)
_STIFF_START = (0.98, 0.01, 0.01)
_FLEXING_MODES = ((QUIET, ()), (KICKED, FLEXURE), (NOISY, GYROS), (DRIFTING, GYROS))
_FLEXING_CHANGES = (
    (1.0 - 5.15e-3, 5e-3, 1e-4, 5e-5),
    (0.5, 0.5 - 2e-4, 1e-4, 1e-4),
    (5e-4, 1e-4, 1.0 - 1.6e-3, 1e-3),
    (5e-3, 1e-4, 2e-2, 1.0 - 2.51e-2),
)
_FLEXING_START = (0.97, 0.01, 0.01, 0.01)
_OTHER_HALF = 1e-5  # probability of a change between stiff and flexing in a step


def hypothesis_changes() -> np.ndarray:
    """(7, 7) probabilities of a change in one step: three stiff hypotheses, four flexing ones."""
    stiff, flexing = np.array(_STIFF_CHANGES), np.array(_FLEXING_CHANGES)
    stay = 1.0 - _OTHER_HALF
    return np.block(
        [
            [stay * stiff, _OTHER_HALF * np.tile(_FLEXING_START, (len(stiff), 1))],
            [_OTHER_HALF * np.tile(_STIFF_START, (len(flexing), 1)), stay * flexing],
        ]
    )


def _mode(weight: Rule, row: tuple[NoiseHypothesis, Array]) -> Filter:
    return kalman(taylor(), (under_hypothesis(*row), weight), form="joseph")


def hypothesis_bank() -> Filter:
    """The bank of hypotheses, for a product model with flexure states."""
    halves = (1.0, _STIFF_MODES), (0.0, _FLEXING_MODES)
    rows = [HypothesisRow((one, stiff), wrong) for stiff, modes in halves for one, wrong in modes]
    start = 0.5 * np.array([*_STIFF_START, *_FLEXING_START])
    return bank(Partial(_mode, huber(_WEIGHED)), rows, hypothesis_changes(), start)


# ----------------------------------------------------------------------------------- by name


OUTLIERS = 0.999  # share of good records that keep their full weight in the other filters
# Flexure assumed for an unknown structure. Too short a time is safe, too long is not.
_TEN_ARCMIN = math.radians(10.0 / 60.0)
UNKNOWN = Structure(sigma=(_TEN_ARCMIN, _TEN_ARCMIN, _TEN_ARCMIN), time=(5.0, 5.0, 5.0))


class Variant(NamedTuple):
    """Construction of a named filter, and the condition for flexure states in its model."""

    flexes: Literal["never", "believed", "always", "untold"]
    make: Callable[[], Filter]

    def flexure(self, believed: Structure | None) -> Flexure | None:
        """Flexure modelled by the filter's states; None where it has none."""
        if self.flexes == "untold" or (self.flexes == "always" and believed is None):
            return UNKNOWN.flexure
        return None if believed is None or self.flexes == "never" else believed.flexure


VARIANTS = {
    "kf": Variant("never", lambda: kalman(taylor())),
    "product": Variant("believed", lambda: kalman(taylor(), (huber(OUTLIERS),))),
    "product-joseph": Variant("believed", lambda: kalman(taylor(), (huber(OUTLIERS),), "joseph")),
    "product-flexure": Variant("always", lambda: kalman(taylor(), (huber(OUTLIERS),))),
    "product-ukf": Variant("believed", lambda: kalman(unscented(), (huber(OUTLIERS),))),
    "adaptive": Variant("untold", hypothesis_bank),
    "product-adaptive": Variant("untold", hypothesis_bank),  # its name in earlier versions
}
FILTERS = tuple(VARIANTS)
