"""What a run on the bench did, from the messages that passed: arrays, figures of merit, signals."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np

from robins.bench.wire.records import decode
from robins.bench.wire.schema import FLAGS, HELD, REFUSED, SAFE, SHORT, SILENT, USED, WHEELS
from robins.rotation import conjugate, multiply, to_rotvec

ARCSEC = np.pi / 648000.0
_KEPT = ("motion", "estimate", "innovation", "star", "gyro", "wheels")


class Flown(NamedTuple):
    """Arrays of a run; E steps, NaN where nothing was heard."""

    time_s: np.ndarray  # (E,) at the end of each step
    q_ib: np.ndarray  # (E, 4) true
    omega_b: np.ndarray  # (E, 3) true rate [rad/s]
    q_est_ib: np.ndarray  # (E, 4)
    bias: np.ndarray  # (E, 3) rad/s, estimated
    sigma: np.ndarray  # (E, 6) stated
    flags: np.ndarray  # (E,) of the estimate
    innovation: np.ndarray  # (E, 3) rad
    innovation_sigma: np.ndarray  # (E, 3)
    ratio: np.ndarray  # (E,)
    wheel_h: np.ndarray  # (E, 4) N m s


class Telemetry:
    """Listens to what passes."""

    def __init__(self, steps: int, step_ns: int):
        """Make room.

        Args:
            steps: E.
            step_ns: length of each.
        """
        self._step_ns = step_ns

        def room(*shape: int) -> np.ndarray:
            return np.full((steps, *shape), np.nan)

        self.flown = Flown(
            time_s=np.arange(1, steps + 1) * (step_ns * 1e-9),
            q_ib=room(4),
            omega_b=room(3),
            q_est_ib=room(4),
            bias=room(3),
            sigma=room(6),
            flags=np.zeros(steps, np.int64),
            innovation=room(3),
            innovation_sigma=room(3),
            ratio=room(),
            wheel_h=room(WHEELS),
        )
        self.star_frames = 0
        self.latest_innovation: tuple[np.ndarray, np.ndarray, float] | None = None

    def observe(self, message: str, time_ns: int, payload: bytes) -> None:
        """Take a message that passes."""
        if message not in _KEPT:
            return
        k = time_ns // self._step_ns - 1
        if not 0 <= k < len(self.flown.time_s):
            return
        said, f = decode(message, payload), self.flown
        if message == "motion":
            f.q_ib[k], f.omega_b[k] = said["q_ib"], said["omega_b"]
        elif message == "estimate":
            f.q_est_ib[k], f.bias[k], f.sigma[k] = said["q_ib"], said["gyro_bias"], said["sigma"]
            f.flags[k] = said["flags"]
        elif message == "innovation":
            f.innovation[k], f.innovation_sigma[k] = said["innovation"], said["sigma"]
            f.ratio[k] = said["ratio"]
            self.latest_innovation = said["innovation"], said["sigma"], said["ratio"]
        elif message == "wheels":
            f.wheel_h[k] = said["momentum"]
        elif message == "star":
            self.star_frames += bool(np.all(np.isfinite(said["q_ib"])))


def padded(momenta: np.ndarray) -> np.ndarray:
    """(E, 4) of as many wheels as there are, as the wire has them."""
    out = np.zeros((len(momenta), WHEELS))
    out[:, : momenta.shape[1]] = momenta
    return out


def turn(q_from: np.ndarray, q_to: np.ndarray) -> np.ndarray:
    """(E, 3) rotation vectors [rad] of conj(q_from) q_to, in the axes of the first."""
    return np.asarray(to_rotvec(multiply(conjugate(q_from), q_to)))


def attitude_error(flown: Flown) -> np.ndarray:
    """(E, 3) true less estimated attitude [rad], body axes."""
    return turn(flown.q_est_ib, flown.q_ib)


def flag(flown: Flown, text: str) -> np.ndarray:
    """(E,) bool, whether a flag of the estimate was set; by its text in `FLAGS`."""
    return (flown.flags >> FLAGS.index(text)) & 1 == 1


def rms_arcsec(error: np.ndarray, counted: slice) -> float:
    """Root sum square of the three axes, root mean over the counted steps."""
    some = error[counted]
    some = some[np.all(np.isfinite(some), -1)]
    return float(np.sqrt(np.mean(np.sum(some**2, -1)))) / ARCSEC if len(some) else float("nan")


def peak_arcsec(error: np.ndarray, counted: slice) -> float:
    """Greatest length over the counted steps."""
    size = np.linalg.norm(error[counted], axis=-1)
    return float(np.nanmax(size)) / ARCSEC if np.any(np.isfinite(size)) else float("nan")


def difference(flown: Flown, loop: Any) -> float:
    """Greatest difference of true and estimated attitude, bias and momenta of the wheels.

    Args:
        flown: on the bench.
        loop: the same of a run inside one program.
    """
    names = ("q_ib", "q_est_ib", "bias", "wheel_h")
    worst = 0.0
    for name in names:
        a, b = getattr(flown, name), getattr(loop, name)
        b = b[: len(a)]
        if a.shape[1:] != b.shape[1:]:
            a = a[:, : b.shape[1]]
        off = np.abs(a - b)
        if not np.all(np.isfinite(off)):
            return float("inf")
        worst = max(worst, float(np.max(off, initial=0.0)))
    return worst


Level = Literal["info", "warning", "alarm"]
_OF_FRAMES = USED | REFUSED | SHORT  # said of a star frame, so nothing between two frames


class Said(NamedTuple):
    """Something to tell people."""

    level: Level
    text: str


class Alarms:
    """Listens to the flags of one estimate after another."""

    def __init__(self) -> None:
        self._stands = 0  # flags that were said to have begun and not to have ended
        self._frames = 0  # refused in a row

    def hear(self, flags: int) -> list[Said]:
        """What there is to say of the next estimate.

        A sensor whose frames are refused one after another is said so once, and how many there were
        when one is used again.
        """
        now, begun = flags, self._stands
        if not flags & _OF_FRAMES:  # no frame: what was said of the last one stands
            now |= begun & (REFUSED | SHORT)
        new, over = now & ~begun, begun & ~now
        if flags & REFUSED:
            self._frames = 1 if new & REFUSED else self._frames + 1
        self._stands = now & ~USED
        said = []
        if new & REFUSED:
            said.append(Said("alarm", "star refused"))
        if over & REFUSED:
            frames = "one frame was" if self._frames == 1 else f"{self._frames} frames were"
            said.append(Said("info", f"star used again, {frames} refused"))
        for flag in (HELD, SILENT, SHORT):
            if new & flag:
                said.append(Said("warning", FLAGS[flag.bit_length() - 1]))
        if new & SAFE:
            said.append(Said("alarm", FLAGS[SAFE.bit_length() - 1]))
        if over & SAFE:
            said.append(Said("info", "the estimate can be steered by again"))
        return said
