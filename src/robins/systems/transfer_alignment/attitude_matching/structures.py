"""The filter without knowledge of the structure: hypotheses of it, side by side.  Attitudes alone
do not separate a swing of the structure from an error of the slave's attitude, unless it is known
how fast and how far it swings. So a bank (`robins.filters.composite.imm`) holds a filter of fifteen
states for each hypothesis,

    stiff, or swings by 4.6', 10', 22' or 46' (three a decade) in 1 s or 10 s
    flutters not at all, or by three times the noise of the records

each with Huber's rule; it is stiff as likely as not. None is of noisier gyros: attitudes alone do
not separate those from a swing, and a bank that has them is lost where nothing flexes. The numbers
were chosen on the random seed 100. The times are decades, and those of two scenarios by that.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike

from robins import units
from robins.filters import Filter, Motion, kalman
from robins.filters.composite.bank import EVERY, HypothesisRow, bank, transitions
from robins.filters.composite.imm import Mode
from robins.filters.rule import Rule
from robins.filters.rules import huber
from robins.filters.values import Numbers, number
from robins.sim.flexure import Flexure, transition
from robins.systems.transfer_alignment.attitude_matching import model as am

_SIGMAS, _TIMES_S, _FLUTTERS = (4.64, 10.0, 21.5, 46.4), (1.0, 10.0), (0.0, 3.0)
_WEIGHED = 0.99  # share of right records that keep their weight
_OTHER = 1e-5  # that a structure becomes each other one in a step

_ARCMIN = units.parse("1 arcmin", "angle")
START = Flexure(np.full(3, 10.0 * _ARCMIN), np.full(3, 1.0))
"""Uncertainty at the start of the states of an unknown structure."""


class StructureHypothesis(NamedTuple):
    """A structure."""

    sigma: ArrayLike  # rad, of the swing; 0: stiff
    time: ArrayLike  # s
    flutter: ArrayLike  # of the noise of the records


def hypotheses() -> list[HypothesisRow]:
    """18 structures: every swing with every flutter; wrong is what no structure of none has."""
    swings = [(0.0, 1.0), *((s * _ARCMIN, t) for s in _SIGMAS for t in _TIMES_S)]
    return [
        HypothesisRow(
            StructureHypothesis(*swing, f),
            ("flexure",) * (swing[0] > 0.0) + (am.ATTITUDE,) * (f > 0.0),
        )
        for swing in swings
        for f in _FLUTTERS
    ]


def _with(F: Array, swing: Array) -> Array:
    return F.at[am.STATES :, am.STATES :].set(swing)


def _move(swing, x, F):
    return _with(F, swing) @ x


def _moved(swing, noise, x, F):
    F = _with(F, swing)
    return F @ x, F, noise


def _mode(weight: Rule, given: tuple[Numbers, ...], row: StructureHypothesis) -> Mode:
    gyro, noise_rad, period_s = map(jnp.asarray, given)
    Phi, L = transition(row.sigma, row.time, 1.0, period_s)
    # a stiff structure forgets what the start supposes
    swing = jnp.where(jnp.asarray(row.sigma) > 0.0, jnp.kron(Phi, jnp.eye(3)), 0.0)
    drive = jnp.zeros((am.STATES_FLEXIBLE, 6)).at[am.STATES :].set(jnp.kron(L, jnp.eye(3)))
    G = jnp.concatenate([gyro, drive], axis=1)
    motion = Motion(Partial(_move, swing), G, linear=Partial(_moved, swing, G))
    white = noise_rad * jnp.hypot(1.0, row.flutter)
    return Mode(kalman(rules=(weight,)), motion, (am.reading(white),))


def structure_filter(
    system: am.LinearSystem, noise_rad: float, period_s: float
) -> Callable[[StructureHypothesis], Mode]:
    """Function that makes the filter of a hypothesis (see `structure_bank`)."""
    given = system.G[:, :3], noise_rad, period_s
    return Partial(_mode, huber(_WEIGHED), tuple(number("numbers are real", x) for x in given))


def structure_bank(system: am.LinearSystem, noise_rad: float, period_s: float) -> Filter:
    """The bank over `hypotheses`.

    Args:
        system: with states of the flexure, whose swing is not looked at.
        noise_rad: of the master's attitude.
        period_s: of the records.
    """
    rows = hypotheses()
    stiff = np.array([row.numbers.sigma == 0.0 for row in rows])
    start = np.where(stiff, 0.5 / np.sum(stiff), 0.5 / np.sum(~stiff))
    change = transitions(len(rows), [(EVERY, EVERY, _OTHER)])
    return bank(structure_filter(system, noise_rad, period_s), rows, change, start)
