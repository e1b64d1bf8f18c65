"""Self-contradictions of a replay: states and innovations inconsistent with its assumptions.

A filter whose model is wrong keeps a small sigma, but its states show it: a declination beyond that
of any room, gyro gains beyond those of any product, and a velocity or position that repeatedly
exceeds the stated sigma, which means a wrong tilt.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from robins.filters import Code
from robins.systems.marg.model import MAGNETOMETER, TRAVEL, MargState
from robins.systems.marg.parameters import MargReplay
from robins.systems.suspects import edges
from robins.systems.tables import SensorUpdates

_SIGMAS = 3.0
_LOOKS = 20  # measurements of travel in a mean square
_LEAST_LOOKS = 10  # fewest of them, in a short log
_SQUARE = 1.5  # limit of that mean square, per component, in stated variances
_LASTING_S = 5.0
_GAP_SHARE = 0.002  # share of samples at the end of their range that could not be restored


class Contradictions(NamedTuple):
    """Contradictions found in each of B blocks."""

    declination: np.ndarray  # (B,) bool
    gain: np.ndarray  # (B,) bool
    tilt: np.ndarray  # (B,) bool
    refused: np.ndarray  # (B,) bool

    @property
    def any(self) -> np.ndarray:
        """Mask (B,) of blocks with any contradiction."""
        return self.declination | self.gain | self.tilt | self.refused


def doubts_of(
    declination: np.ndarray,
    gain: np.ndarray,
    updates: Mapping[str, SensorUpdates],
    parameters: MargReplay,
    bare: np.ndarray | bool = False,
) -> Contradictions:
    """Contradictions of states or innovations of a filter or a smoother with the parameters.

    - declination: beyond three times its sigma in the parameters;
    - gain: any of the nine beyond three times its sigma;
    - tilt: mean square of velocity and position over 20 successive measurements of travel (10 at
      least in a short log) above 1.5 times the stated variance, whatever the filter has learned;
    - refused: ten or more successive magnetometer measurements.

    Args:
        declination: (B,) [rad].
        gain: (B, ...) gyro gains of each block.
        updates: by sensor, of the filter or of the run that was smoothed; travel as in `as_stated`.
        parameters: assumptions of the filter.
        bare: (B,) bool, the gyros are taken for those of an uncalibrated chip.
    """
    gyro = parameters.gyro
    usual = np.where(bare, np.hypot(gyro.gain, gyro.bare_gain), gyro.gain)
    declination = np.abs(declination)
    gain = np.max(np.abs(gain.reshape(len(declination), -1)), axis=1)
    none = np.zeros(len(declination), dtype=bool)
    tilt, refused = none, none
    if TRAVEL in updates:
        tilt = _too_large(updates[TRAVEL])
    if MAGNETOMETER in updates:
        refused = _in_a_row(updates[MAGNETOMETER], 10)
    return Contradictions(
        declination > _SIGMAS * parameters.magnetometer.declination,
        gain > _SIGMAS * usual,
        tilt,
        refused,
    )


def squared(innovation: np.ndarray, parameters: MargReplay) -> np.ndarray:
    """Sum of squares of travel innovations (..., 6), normalised by the stated sigmas."""
    travel = parameters.travel
    ratio = innovation / np.repeat([travel.velocity, travel.place], 3)
    return np.asarray(np.sum(ratio**2, axis=-1))


def as_stated(
    updates: Mapping[str, SensorUpdates], parameters: MargReplay
) -> dict[str, SensorUpdates]:
    """Updates whose NIS of travel is replaced by `squared`."""
    travel = updates[TRAVEL]
    square = squared(np.asarray(travel.innovation), parameters)
    return {**updates, TRAVEL: travel._replace(nis=square)}


def _too_large(update: SensorUpdates) -> np.ndarray:
    nis, dof = np.asarray(update.nis), np.asarray(update.dof)
    looks = np.flatnonzero(dof == np.max(dof, initial=0))
    out = np.zeros(len(nis), dtype=bool)
    count = min(_LOOKS, len(looks))
    if count < _LEAST_LOOKS or dof[looks[0]] == 0:
        return out
    sums = np.cumsum(np.concatenate([[0.0], nis[looks] / dof[looks]]))
    over = (sums[count:] - sums[:-count]) / count > _SQUARE
    for last in np.flatnonzero(over) + count - 1:
        out[looks[last - count + 1] : looks[last] + 1] = True
    return out


def _in_a_row(update: SensorUpdates, least: int) -> np.ndarray:
    code, dof = np.asarray(update.code), np.asarray(update.dof)
    refused = code == int(Code.REFUSED)
    out, looks = np.zeros(len(code), dtype=bool), np.flatnonzero(refused | (dof > 0))
    for first, end in edges(refused[looks]):
        if end - first >= least:
            out[looks[first] : looks[end - 1] + 1] = True
    return out


def sentences(name: str, doubt: Contradictions, mean: MargState, dt_s: np.ndarray) -> list[str]:
    """Warnings on contradictions of a filter that last more than 5 s, with their consequences.

    Args:
        name: of the filter.
        doubt: its contradictions.
        mean: its states, leading axis B.
        dt_s: (B,) durations of the blocks [s].
    """
    out = []
    most = float(np.degrees(np.max(np.abs(np.asarray(mean.declination)), initial=0.0)))
    largest = 100.0 * float(np.max(np.abs(np.asarray(mean.gyro_gain)), initial=0.0))
    sentence = {
        "declination": f"the field is turned by up to {most:.0f} deg against its mean, beyond "
        "three of its standard deviations (magnetometer.declination): either the field here bends "
        "that much, or the heading is wrong by as much",
        "gain": f"a gain of the gyros is {largest:.1f} %, beyond three of its standard deviations "
        "(gyro.gain): the gyros are worse than stated, or the gains take up another error, "
        "and the heading with them",
        "tilt": "velocity and place do not stay as small as stated (travel.velocity, "
        "travel.place), or the tilt is wrong: its stated sigma is too small",
        "refused": "the field was refused ten times in a row or more: the heading came from the "
        "gyros alone, and may be off by more than is stated",
    }
    for what, where in doubt._asdict().items():
        seconds = float(np.sum(np.asarray(dt_s)[where]))
        if seconds > _LASTING_S:
            out.append(f"{name}: for {seconds:.0f} s {sentence[what]}.")
    return out


def of_samples(counts: Mapping[str, int], samples: int) -> list[str]:
    """Warnings if too many samples are at the end of their range, or from gyros that hang."""
    lost, off = counts["imu_saturated"] - counts["imu_bridged"], []
    if lost > _GAP_SHARE * samples:
        off.append(f"{lost} samples are at the end of their range and could not be put back")
    if counts["imu_frozen"] > _GAP_SHARE * samples:
        off.append(
            f"the gyros repeat one turn over {counts['imu_frozen']} samples, as if they hang"
        )
    return [f"{what}: the attitude may be off by more than is stated after them." for what in off]
