"""Page of the satellite, and notices of its estimates."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np

from robins.bench.live.feed import Signal
from robins.bench.rig import Told, View
from robins.bench.rigs.satellite.errors import ARCSEC, flag, turn
from robins.bench.rigs.satellite.faults import OFFERED
from robins.bench.rigs.satellite.kit import Kit
from robins.bench.rigs.satellite.messages import (
    AS_IT_IS,
    FLAGS,
    HELD,
    KEPT,
    REFUSED,
    RUN,
    SAFE,
    SHORT,
    SILENT,
    STAND_BY,
    USED,
)
from robins.bench.rigs.satellite.reference import wanted_after
from robins.bench.run.numbers import latest
from robins.bench.run.telemetry import Flown
from robins.rotation import from_rotvec, multiply

_XYZ = ("x", "y", "z")
_OF_FRAMES = USED | REFUSED | SHORT  # flags of a star frame, so none between two frames


def signals(given: Any) -> list[Signal]:
    """Signals on the page, by the parameters of an attitude loop."""

    def three(plot: str, unit: str, sigma: bool = False) -> list[Signal]:
        found = []
        for axis in _XYZ:
            found.append(Signal(f"{plot} {axis}", unit, plot))
            if sigma:
                found.append(Signal(f"{plot} sigma {axis}", unit, plot, "sigma", f"{plot} {axis}"))
        return found

    def attitude(of: str) -> list[Signal]:
        return [Signal(f"q {of} {c}", "1", "attitude", "attitude", of) for c in "wxyz"]

    momentum = "wheel momentum"
    return [
        *attitude("true"),
        *attitude("estimated"),
        *three("attitude error", "arcsec", sigma=True),
        *three("pointing error", "arcsec"),
        *three("innovation of the star sensor", "arcsec", sigma=True),
        Signal("test ratio", "1", "test ratio of the star sensor"),
        Signal("test ratio limit", "1", "test ratio of the star sensor", "limit"),
        *three("rate", "deg/s"),
        *(Signal(f"{momentum} {k}", "mN m s", momentum) for k in range(len(given.wheels.axes))),
        Signal(f"{momentum} limit", "mN m s", momentum, "limit"),
        Signal(f"{momentum} lower limit", "mN m s", momentum, "limit"),
    ]


def sample(flown: Flown, kit: Kit, since: int, step: int) -> list[float]:
    """The signals of a step; of star frames, which are rarer than samples, the latest."""
    now = slice(step, step + 1)
    q_ib = flown["motion.q_ib"][now]
    error = turn(flown["estimate.q_ib"][now], q_ib)[0] / ARCSEC
    sigma = flown["estimate.sigma"][step, :3] / ARCSEC
    pointing = turn(wanted_after(kit, flown, step + 1).q_ib[None], q_ib)[0] / ARCSEC
    innovation, its_sigma, ratio = (
        latest(flown[f"innovation.{name}"], since, step)
        for name in ("innovation", "sigma", "ratio")
    )
    wheels = len(kit.vehicle.craft.wheel_h)
    limit = 1e3 * float(np.asarray(kit.given.craft.wheel_momentum_limit)[0])
    return [
        *flown["motion.q_ib"][step],
        *flown["estimate.q_ib"][step],
        *np.ravel([error, sigma], order="F"),
        *pointing,
        *np.ravel([innovation / ARCSEC, its_sigma / ARCSEC], order="F"),
        float(ratio),
        1.0,
        *np.degrees(flown["motion.omega_b"][step]),
        *(1e3 * flown["wheels.momentum"][step, :wheels]),
        limit,
        -limit,
    ]


def counts(flown: Flown, done: int) -> dict[str, int]:
    """Counts on the page."""
    return {"refused_measurements": int(np.sum(flag(flown, "star refused")[:done]))}


class Alarms:
    """Listens to the flags of one estimate after another."""

    def __init__(self) -> None:
        self._stands = 0  # flags whose start was reported and whose end was not
        self._frames = 0  # refused in a row

    def hear(self, flown: Flown, step: int) -> list[Told]:
        """Notices of the estimate of a step."""
        flags = int(flown["estimate.flags"][step])
        return [one._replace(text=f"adm: {one.text}") for one in self.said(flags)]

    def said(self, flags: int) -> list[Told]:
        """Notices of the next estimate.

        Frames that are refused one after another are reported once, and their number when one
        is used again.
        """
        now, begun = flags, self._stands
        if not flags & _OF_FRAMES:  # no frame: the flags of the last one stand
            now |= begun & (REFUSED | SHORT | KEPT)
        new, over = now & ~begun, begun & ~now
        if flags & REFUSED:
            self._frames = 1 if new & REFUSED else self._frames + 1
        self._stands = now & ~USED
        said = []
        if new & REFUSED:
            said.append(Told("alarm", "star refused"))
        if over & REFUSED:
            frames = "one frame was" if self._frames == 1 else f"{self._frames} frames were"
            said.append(Told("info", f"star used again, {frames} refused"))
        for flag_ in (HELD, SILENT, SHORT, KEPT):
            if new & flag_:
                said.append(Told("warning", FLAGS[flag_.bit_length() - 1]))
        if new & SAFE:
            said.append(Told("alarm", FLAGS[SAFE.bit_length() - 1]))
        if over & SAFE:
            said.append(Told("info", "the estimate can be steered by again"))
        return said


def _turned(flown: Flown, kit: Kit, step: int, turn_rad: np.ndarray) -> tuple[str, dict[str, Any]]:
    """Attitude turned from the present target; it stays inertial."""
    now = wanted_after(kit, flown, step + 1).q_ib
    return "reference", {"q_ib": np.asarray(multiply(now, from_rotvec(jnp.asarray(turn_rad))))}


_SLEW_DEG = 10.0
SAYS = {
    **{
        f"slew {_SLEW_DEG:g} deg about {axis}": partial(_turned, turn_rad=turn_rad)
        for axis, turn_rad in zip(_XYZ, np.radians(_SLEW_DEG) * np.eye(3), strict=True)
    },
    "hold this attitude": partial(_turned, turn_rad=np.zeros(3)),
    "back to the course": lambda flown, kit, step: ("reference", {}),
    "control: stand by": lambda flown, kit, step: ("mode", {"mode": STAND_BY}),
    "control: run": lambda flown, kit, step: ("mode", {"mode": RUN}),
    "determination: reset": lambda flown, kit, step: ("mode", {"mode": AS_IT_IS, "reset": 1}),
}
"""Operator messages that the page offers."""

VIEW = View(signals, sample, Alarms, counts, OFFERED, SAYS)
