"""The doctor on GNSS velocities against differences of the positions: axes, unit, sign, delay."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robins.dataset import GnssTable
from robins.logs.findings import Finding
from robins.logs.gnss_motion import Steps, Track, lateness, steps_of, track_of
from robins.logs.quiet import error, median_of, warning

_AXES = {"NED": ("north", "east", "down"), "ENU": ("east", "north", "up")}
_SCALES = {
    3.6: ("km/h", "divide them by 3.6"),
    1.0 / 0.514444: ("knots", "multiply them by 0.514444"),
    1.0 / 0.3048: ("ft/s", "multiply them by 0.3048"),
    100.0: ("cm/s", "divide them by 100"),
    1000.0: ("mm/s", "divide them by 1000"),
}
_LATE_S = 0.03


def check_velocity(gnss: GnssTable) -> Iterator[Finding]:
    """Findings about velocities; none if there are none, or if the receiver hardly moves."""
    track = track_of(gnss)
    steps = steps_of(track) if track else None
    if track is None or steps is None:
        return
    late = lateness(track)
    if late is not None:
        steps = steps_of(track, late) or steps
    p, v = steps.of_position[:, :2], steps.of_velocity[:, :2]
    change, scale = _horizontal(p, v)
    if change is None:
        left = float(np.sum((p - v) ** 2) / np.sum(p**2))
        if left > 0.5:
            yield _disagreement(gnss, left)
        return
    if change:
        yield _wrong_axes(gnss, change)
    elif abs(scale - 1.0) > 0.1:
        yield _wrong_scale(gnss, 1.0 / scale)
    # East, north, up for north, east, down reverses the third axis too; said once is enough.
    if "exchanged" not in change and _vertical_reversed(steps, track):
        names = ("down", "up") if gnss.nav == "NED" else ("up", "down")
        yield error(
            gnss,
            "velocity_sign",
            "vertical",
            f"the height changes against the vertical velocity. The third component is probably "
            f"{names[1]}, not {names[0]}; turn its sign.",
        )
    if not change and late is not None and abs(late) > _LATE_S:
        yield _late(gnss, track, late)


def _disagreement(gnss: GnssTable, left: float) -> Finding:
    return warning(
        gnss,
        "velocity_disagrees",
        left,
        "the velocities do not describe the motion of the positions, in whatever order, sign or "
        "unit. One of them belongs to another sensor, time or axis; compare plots of both before "
        "you trust either.",
    )


def _wrong_axes(gnss: GnssTable, change: str) -> Finding:
    exchanged = "exchanged" in change
    if exchanged and _place_exchanged(gnss):
        cause = "Latitude and longitude are exchanged; name the columns the other way round"
    elif exchanged:
        other = _AXES["ENU" if gnss.nav == "NED" else "NED"]
        cause = (
            f"The velocity columns are probably {', '.join(other)}, not "
            f"{', '.join(_AXES[gnss.nav])}; say so or reorder them"
        )
    else:
        cause = "A sign convention differs (south or west positive); turn that sign"
    return error(
        gnss,
        "velocity_axes",
        change,
        f"the positions move as the velocities say only with {change}. {cause}.",
    )


def _late(gnss: GnssTable, track: Track, late: float) -> Finding:
    epoch = float(np.median(np.diff(track.time_s)))
    half = abs(late - epoch / 2) < 0.2 * epoch
    cause = (
        " That is half an epoch: the receiver gives the mean velocity of the last epoch."
        if half
        else ""
    )
    return warning(
        gnss,
        "velocity_late",
        late,
        f"the velocities are {abs(late):.2f} s {'older' if late > 0 else 'younger'} than their "
        f"stamps, judged by the positions.{cause} At 2 m/s^2 that is {2 * abs(late):.2f} m/s of "
        "error: take them at their true time, or raise their sigmas.",
    )


def _horizontal(p: np.ndarray, v: np.ndarray) -> tuple[str | None, float]:
    """How v must be changed to fit p: words (empty: not at all; None: nothing fits) and scale."""
    best = ("", 0.0, np.inf)
    as_is = np.inf
    for exchange in (False, True):
        for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            turned = (v[:, ::-1] if exchange else v) * signs
            scale = max(float(np.sum(p * turned) / np.sum(v * v)), 0.0)
            left = float(np.sum((p - scale * turned) ** 2) / np.sum(p * p))
            words = "exchanged horizontal axes" if exchange else ""
            minus = [name for name, s in zip(("north", "east"), signs, strict=True) if s < 0]
            if minus:
                words += f"{' and ' if words else ''}reversed {' and '.join(minus)}"
            if words == "":
                as_is = left
            if scale > 0 and left < best[2]:
                best = (words, scale, left)
    if best[2] > 0.3:
        return None, 0.0
    # Along a straight road several changes fit alike; then nothing is wrong.
    if best[0] != "" and as_is < 3.0 * best[2] + 0.02:
        return "", float(np.sum(p * v) / np.sum(v * v))
    return best[0], best[1]


def _vertical_reversed(steps: Steps, track: Track) -> bool:
    p, v = (x[:, 2] - x[:, 2].mean() for x in steps)
    if np.std(p) < max(3.0 * track.sigma_m, 0.05) or np.std(v) == 0.0:
        return False
    return float(np.sum(p * v) / np.sqrt(np.sum(p * p) * np.sum(v * v))) < -0.5


def _place_exchanged(gnss: GnssTable) -> bool:
    """Whether exchanging latitude and longitude explains more than exchanging velocities."""
    tracks = track_of(gnss, swap=True), track_of(gnss)
    swapped, as_is = (steps_of(track) if track else None for track in tracks)
    if swapped is None or as_is is None:
        return False
    by_place = np.sum((swapped.of_position - swapped.of_velocity)[:, :2] ** 2)
    turned = as_is.of_velocity[:, [1, 0]]
    return bool(by_place < np.sum((as_is.of_position[:, :2] - turned) ** 2))


def _wrong_scale(gnss: GnssTable, ratio: float) -> Finding:
    known = [words for value, words in _SCALES.items() if abs(ratio / value - 1.0) < 0.05]
    if known:
        cause = f"They are probably in {known[0][0]}: {known[0][1]}"
    elif 10.0 < ratio < 60.0 and abs(median_of(gnss.lat_rad)) < np.deg2rad(np.pi / 2):
        cause = "The positions are radians that were read as degrees: convert them"
    else:
        cause = "A unit or a column is wrong; compare with a known speed"
    return error(
        gnss,
        "velocity_unit",
        ratio,
        f"velocities are {ratio:.3g} times what the positions say. {cause}.",
    )
