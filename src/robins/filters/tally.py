"""Counts of the outcomes of a run's steps, and the warnings that follow from them."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from robins.filters.belief import FAILURES, SENTENCES, Code, StepInfo
from robins.filters.consistency_limits import (
    FEWEST,
    NIS_HIGH,
    NIS_LOW,
    REFUSED_SHARE,
    TEST_LEVEL,
    correlated_band,
)
from robins.filters.values import Numbers
from robins.filters.whiteness import innovation_sums, suspicions
from robins.manifold import State

APART_SHARE = 0.1  # share of measurements with diverging local filters above which it is reported


class StepWarning(UserWarning):
    """A run has steps that were not taken, or measurements that contradict exact knowledge."""


class Tally(NamedTuple):
    """Counts of the outcomes of a run's steps; leading axes, of several runs, are summed."""

    predictions: Numbers  # (codes,) number of predictions by `Code`
    updates: dict[str, Numbers]  # (codes,) number of updates by `Code`, by sensor
    nis: dict[str, Numbers]  # () sum of the normalised innovations squared, by sensor
    dof: dict[str, Numbers]  # () sum of their degrees of freedom, by sensor
    looks: Mapping[
        str, np.ndarray
    ] = {}  # `whiteness.innovation_sums` by sensor, where steps were kept

    @classmethod
    def blank(cls, sensors: Collection[str]) -> Tally:
        """Tally of zero steps."""
        zeros = (jnp.zeros(len(Code), int), jnp.zeros(()), jnp.zeros((), int))
        updates, nis, dof = (dict.fromkeys(sensors, zero) for zero in zeros)
        return cls(zeros[0], updates, nis, dof)

    def add_step(self, prediction: Numbers, info: Mapping[str, StepInfo]) -> Tally:
        """Add a step: the code of its prediction, and its updates by sensor."""
        judged = {k: (i.dof > 0) & (i.code != int(Code.REFUSED)) for k, i in info.items()}
        predictions = self.predictions + _one(prediction)
        updates = {k: self.updates[k] + _one(i.code) for k, i in info.items()}
        # A contradiction has an infinite NIS, but may use no component.
        nis = {
            k: self.nis[k] + jnp.where(judged[k] | jnp.isinf(i.nis), i.nis, 0.0)
            for k, i in info.items()
        }
        dof = {k: self.dof[k] + jnp.where(judged[k], i.dof, 0) for k, i in info.items()}
        return Tally(predictions, self.updates | updates, self.nis | nis, self.dof | dof)

    def with_innovations(
        self, info: Mapping[str, tuple[State, ...]], readings: Mapping[str, State] | None = None
    ) -> Tally:
        """Add sums of innovations and readings over the steps, for `doubts`; not in `jit`.

        Both are by sensor: info is a `StepInfo` of all steps, or a tuple with its innovation,
        sigma, nis and dof; readings are the measurements of the run.
        """
        given = readings or {}
        looks = {}
        for name, one in info.items():
            i = jax.tree_util.tree_map(np.asarray, one)  # NumPy compiles no programs
            looks[name] = innovation_sums(i.innovation, i.sigma, i.nis, i.dof, given.get(name))
        return self._replace(looks=looks)

    def counts(self, sensor: str | None = None) -> dict[Code, int]:
        """Count the occurrences of each code in predictions, or in the updates of a sensor."""
        numbers = np.asarray(self.predictions if sensor is None else self.updates[sensor])
        total = numbers.reshape(-1, len(Code)).sum(axis=0)
        return {Code(i): int(number) for i, number in enumerate(total) if number}


def _one(code: Numbers) -> Numbers:
    return (jnp.arange(len(Code)) == code).astype(int)


def not_taken(tally: Tally) -> list[str]:
    """Sentences on steps that were not taken and on contradictions."""
    counts = tally.counts()
    total = sum(counts.values())
    found = [
        f"{number} of {total} predictions are {code.name}: {SENTENCES[code]}. The belief stays "
        "behind by these steps"
        for code, number in counts.items()
        if code is not Code.DONE
    ]
    for sensor in tally.updates:
        counts = tally.counts(sensor)
        total = sum(counts.values())
        found += [
            f"{number} of {total} updates with '{sensor}' are {code.name}: {SENTENCES[code]}"
            for code, number in counts.items()
            if code in FAILURES
        ]
    return found


def doubts(tally: Tally, bounds: bool = False, assumed: Collection[str] = ()) -> list[str]:
    """Sentences on reasons to doubt the results of a filter.

    They name steps that were not taken, and contradictions; sensors with more than a third of the
    measurements refused; sensors with more than a tenth of the measurements where the local filters
    of a joined one were more than 5 standard deviations apart; and sensors with a mean NIS per
    degree of freedom above 4 or below 1/16 and outside the 99.9 % band of chi-square with a tenth
    of the degrees of freedom. A run that keeps whole steps (`Tally.with_innovations`) is also
    tested by `whiteness.suspicions`.

    Args:
        tally: of a run (`Solution.tally`), or of several with leading axes.
        bounds: the filter states bounds, not standard deviations (an H-infinity filter), so the
            mean NIS of the run is not tested.
        assumed: sensors with deliberately large noise: neither a small NIS nor the sign and order
            of their innovations are tested.
    """
    found = not_taken(tally)
    for sensor in tally.updates:
        counts = tally.counts(sensor)
        refused = counts.get(Code.REFUSED, 0)
        measured = sum(counts.values()) - counts.get(Code.MISSING, 0)
        if measured >= FEWEST and refused > REFUSED_SHARE * measured:
            found.append(
                f"{refused} of {measured} measurements of '{sensor}' were refused: look at the "
                "noise of the sensor and of the motion, and at the initial state"
            )
        apart = counts.get(Code.APART, 0)
        if measured >= FEWEST and apart > APART_SHARE * measured:
            found.append(
                f"the local filter of '{sensor}' and another one differed by more than 5 standard "
                f"deviations at {apart} of {measured} measurements: a sensor of one of them may "
                "have an error that the model leaves out"
            )
        nis, dof = float(np.sum(tally.nis[sensor])), int(np.sum(tally.dof[sensor]))
        if not bounds and dof >= FEWEST:
            found += _nis_sentence(sensor, nis / dof, dof, sensor in assumed)
    return found + suspicions(tally.looks, assumed)


def _nis_sentence(sensor: str, ratio: float, dof: int, cautious: bool) -> list[str]:
    """Sentence on a mean NIS per degree of freedom that is far from one."""
    low, high = correlated_band(dof, TEST_LEVEL)
    if (cautious or min(low, NIS_LOW) <= ratio) and ratio <= max(high, NIS_HIGH):
        return []
    why = (
        "larger than the filter expects: its standard deviations are too small"
        if ratio > 1.0
        else "smaller than the filter expects: its standard deviations are too large"
    )
    return [
        f"the innovations of '{sensor}' are {why} (mean NIS per degree of freedom {ratio:.3g}, "
        "one is right)"
    ]


def warn_not_taken(tally: Tally) -> None:
    """Warn with a `StepWarning` of steps that were not taken, at the caller of a run."""
    if found := not_taken(tally):
        warnings.warn("; ".join(found), StepWarning, stacklevel=4)
