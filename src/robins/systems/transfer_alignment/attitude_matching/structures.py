"""The filter without knowledge of the structure: a bank of hypotheses on flexure and flutter.

Attitudes alone do not separate flexure from an error of the slave's attitude, unless its amplitude
and time constant are known. So a bank (`robins.filters.composite.imm`) holds a filter of fifteen
states for each hypothesis,

    stiff, or flexure of 4.6', 10', 22' or 46' (three a decade) with a time constant of 1 s or 10 s
    no flutter, or flutter of three times the noise of the records

each with Huber's rule; stiff has a probability of one half. There is no hypothesis of noisier
gyros: attitudes alone do not separate those from flexure, and a bank with them fails on a stiff
structure. The numbers were chosen on the random seed 100. The time constants are decades, which
happen to be those of two scenarios.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import ArrayLike

from robins import units
from robins.filters import Filter, kalman
from robins.filters.composite.bank import EVERY, HypothesisRow, bank, transitions
from robins.filters.composite.imm import Mode
from robins.filters.rule import Rule
from robins.filters.rules import huber
from robins.filters.values import Numbers, number
from robins.sim.flexure import Flexure, transition
from robins.systems.parts import moved_by
from robins.systems.transfer_alignment.attitude_matching import model as am

_SIGMAS, _TIMES_S, _FLUTTERS = (4.64, 10.0, 21.5, 46.4), (1.0, 10.0), (0.0, 3.0)
_WEIGHED = 0.99  # share of good records that keep their full weight
_OTHER = 1e-5  # probability of a change to each other structure in a step

_ARCMIN = units.parse("1 arcmin", "angle")
START = Flexure(np.full(3, 10.0 * _ARCMIN), np.full(3, 1.0))
"""Uncertainty at the start of the states of an unknown structure."""


class StructureHypothesis(NamedTuple):
    """Hypothesis about the structure: its flexure and flutter."""

    sigma: ArrayLike  # rad, of the flexure; 0: stiff
    time: ArrayLike  # s, its time constant
    flutter: ArrayLike  # sigma over that of the noise of the records


def hypotheses() -> list[HypothesisRow]:
    """18 structures: every flexure with every flutter, and the faults that each one implies."""
    swings = [(0.0, 1.0), *((s * _ARCMIN, t) for s in _SIGMAS for t in _TIMES_S)]
    return [
        HypothesisRow(
            StructureHypothesis(*swing, f),
            ("flexure",) * (swing[0] > 0.0) + (am.ATTITUDE,) * (f > 0.0),
        )
        for swing in swings
        for f in _FLUTTERS
    ]


def _moved(swing, noise, x, F):
    F = F.at[am.STATES :, am.STATES :].set(swing)
    return F @ x, F, noise


def _mode(weight: Rule, given: tuple[Numbers, ...], row: StructureHypothesis) -> Mode:
    gyro, noise_rad, period_s = map(jnp.asarray, given)
    Phi, L = transition(row.sigma, row.time, 1.0, period_s)
    # a stiff structure drops the initial flexure
    swing = jnp.where(jnp.asarray(row.sigma) > 0.0, jnp.kron(Phi, jnp.eye(3)), 0.0)
    drive = jnp.zeros((am.STATES_FLEXIBLE, 6)).at[am.STATES :].set(jnp.kron(L, jnp.eye(3)))
    G = jnp.concatenate([gyro, drive], axis=1)
    white = noise_rad * jnp.hypot(1.0, row.flutter)
    return Mode(kalman(rules=(weight,)), moved_by(None, _moved, swing, G), (am.reading(white),))


def structure_filter(
    system: am.LinearSystem, noise_rad: float, period_s: float
) -> Callable[[StructureHypothesis], Mode]:
    """Function to make the filter of a hypothesis (see `structure_bank`)."""
    given = system.G[:, :3], noise_rad, period_s
    return Partial(_mode, huber(_WEIGHED), tuple(number("numbers are real", x) for x in given))


def structure_bank(system: am.LinearSystem, noise_rad: float, period_s: float) -> Filter:
    """The bank over `hypotheses`.

    Args:
        system: with flexure states, whose parameters are not used.
        noise_rad: noise of the master's attitude [rad].
        period_s: period of the records [s].
    """
    rows = hypotheses()
    stiff = np.array([row.numbers.sigma == 0.0 for row in rows])
    start = np.where(stiff, 0.5 / np.sum(stiff), 0.5 / np.sum(~stiff))
    change = transitions(len(rows), [(EVERY, EVERY, _OTHER)])
    return bank(structure_filter(system, noise_rad, period_s), rows, change, start)
