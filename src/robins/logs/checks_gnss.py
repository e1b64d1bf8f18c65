"""Checks of GNSS fixes: place, height, sigmas, quality, decimals.

Also of their velocities against differences of positions: axes, unit, sign, delay.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from robins.dataset import GnssTable
from robins.logs.findings import Finding
from robins.logs.gnss_motion import FixTrack, PositionSteps, steps_of, track_of, velocity_delay
from robins.logs.limits import ALT_LIMIT_M, LAT_LIMIT, LON_LIMIT, SPEED_LIMIT
from robins.logs.quiet import error, finding, median_of, note, warning
from robins.logs.tables import place_of

_AXES = {"NED": ("north", "east", "down"), "ENU": ("east", "north", "up")}


def check_gnss(gnss: GnssTable) -> Iterator[Finding]:
    """All findings about a GNSS table by itself."""
    if not len(gnss):
        return
    yield from _missing(gnss)
    wrong_place = list(_place(gnss))
    yield from wrong_place
    yield from _height(gnss)
    yield from _sigmas(gnss)
    yield from _quality(gnss)
    if not wrong_place:
        yield from _resolution(gnss)


def _missing(gnss: GnssTable) -> Iterator[Finding]:
    columns = {
        "latitude": (gnss.lat_rad, np.finfo(float).max),  # positions have a check of their own
        "longitude": (gnss.lon_rad, np.finfo(float).max),
        "height": (gnss.alt_m, ALT_LIMIT_M),
    }
    if gnss.v_n is not None:
        for k, axis in enumerate(_AXES[gnss.nav]):
            columns[f"velocity {axis}"] = gnss.v_n[:, k], SPEED_LIMIT
    for name, (column, limit) in columns.items():
        bad = ~(np.abs(column) <= limit)
        if bad.any():
            k = int(np.argmax(bad))
            # Phones state speed and bearing, but no vertical velocity.
            never = name.startswith("velocity") and bool(np.isnan(column).all())
            severity = "note" if never else "error" if bad.all() else "warning"
            yield finding(severity, gnss, "gnss_missing", int(bad.sum()), k)(
                f"{name} is {column[k]:g} here, missing or impossible in {bad.sum()} of "
                f"{len(gnss)} fixes. The receiver had none, or the columns are others; a replay "
                "leaves it out and keeps the other components of those fixes."
            )


def _place(gnss: GnssTable) -> Iterator[Finding]:
    lat, lon = gnss.lat_rad, gnss.lon_rad
    known = np.isfinite(lat) & np.isfinite(lon)
    if not known.any():
        return
    beyond = known & ((np.abs(lat) > LAT_LIMIT) | (np.abs(lon) > LON_LIMIT))
    if 2 * beyond.sum() > known.sum():  # single values are errors, not another unit
        k = int(np.argmax(beyond))
        lat_deg, lon_deg = np.rad2deg(lat[k]), np.rad2deg(lon[k])
        if abs(lat_deg) <= 360.0 and abs(lon_deg) <= 90.0:
            cause = "Latitude and longitude are exchanged; name the columns the other way round"
        elif abs(lat[k]) <= 90.0 and abs(lon[k]) <= 360.0:
            cause = "They are degrees where radians are needed; convert them (numpy.deg2rad)"
        else:
            cause = "The columns are not latitude and longitude, or scaled (1e-7 deg?); check them"
        yield error(gnss, "position_unit", float(lat_deg), k)(
            f"latitude {lat_deg:.6g} deg, longitude {lon_deg:.6g} deg is no place on Earth "
            f"({beyond.sum()} of {len(gnss)} fixes). {cause}."
        )
        return
    zero = known & (lat == 0.0) & (lon == 0.0)
    if zero.any():
        yield error(gnss, "no_fix_as_zero", int(zero.sum()), int(np.argmax(zero)))(
            f"latitude and longitude are both exactly 0 in {zero.sum()} of {len(gnss)} fixes. The "
            "receiver had no fix and wrote zeros; delete those lines, or write nan."
        )
        return
    lat_deg, lon_deg = np.rad2deg(lat[known]), np.rad2deg(lon[known])
    if np.all(np.abs(lat_deg) <= np.pi / 2) and np.all(np.abs(lon_deg) <= np.pi):
        yield warning(gnss, "position_in_radians", float(lat_deg[0]))(
            f"all places lie within latitude {lat_deg[0]:.5f} deg, longitude {lon_deg[0]:.5f} deg "
            "or so, in the Gulf of Guinea. The file probably holds radians where degrees are "
            "expected; convert them, unless you were there."
        )


def _height(gnss: GnssTable) -> Iterator[Finding]:
    alt = median_of(gnss.alt_m)
    if alt < -500.0 or alt > 12_000.0:
        hidden = alt < -12_000.0 or alt > 2_000_000.0
        yield finding("error" if hidden else "warning", gnss, "height", alt)(
            f"the median height is {alt:.6g} m, where nobody drives, sails or flies by air. The "
            "column is in mm or feet, or is another one; if this is a rocket, all is well."
        )


def _sigmas(gnss: GnssTable) -> Iterator[Finding]:
    groups = [("position", "m", gnss.sigma_m, place_of(gnss))]
    if gnss.sigma_v is not None and gnss.v_n is not None:
        groups.append(("velocity", "m/s", gnss.sigma_v, gnss.v_n))
    for what, unit, sigma, values in groups:
        bad = (np.isfinite(values) & (sigma <= 0.0)).any(axis=1)
        if bad.any():
            k = int(np.argmax(bad))
            shown = ", ".join(f"{s:g}" for s in sigma[k])
            yield warning(gnss, "sigma_not_positive", int(bad.sum()), k)(
                f"the {what} sigmas are ({shown}) {unit} here, and not all positive in {bad.sum()} "
                f"of {len(gnss)} fixes. Zero means unknown, not exact: a replay leaves such "
                "components out, or assumes the usual sigma of the kind of fix where none is "
                'positive; `[gnss] sigma = "2 m"` states another.'
            )
        if np.isfinite(values).any() and np.isnan(sigma).all():
            yield note(gnss, "sigma_missing", len(gnss))(
                f"the {what} has no sigma in any fix. A replay assumes the usual one of the kind "
                "of fix (fixed 0.02 m, float 0.3 m, single or unknown 3 m); "
                '`[gnss] sigma = "2 m"` in its configuration states another.'
            )
        typical = median_of(sigma[sigma > 0.0])
        if typical < 1e-3 or typical > 1e3:
            yield warning(gnss, "sigma_absurd", typical)(
                f"the {what} sigmas are {typical:.3g} {unit} (median), which no receiver has. "
                f"They may be variances or in another unit; a filter would "
                f"{'trust them blindly' if typical < 1 else 'ignore the fixes'}."
            )


def _quality(gnss: GnssTable) -> Iterator[Finding]:
    if gnss.quality is None:
        return
    size = np.linalg.norm(gnss.sigma_m[:, :2], axis=-1)
    fixed, other = gnss.quality == 1, gnss.quality > 1
    if not (fixed.any() and other.any()):
        return
    sure, unsure = median_of(size[fixed]), median_of(size[other])
    k = int(np.argmax(other))
    if 0.0 < unsure < 1.5 * sure:
        ratio = unsure / sure
        share = "the sigma" if abs(ratio - 1.0) < 0.05 else f"{ratio:.2g} times the sigma"
        yield warning(gnss, "float_sigma", ratio, k)(
            f"{other.sum()} of {len(gnss)} fixes are float or worse (Q > 1), the first of them "
            f"here, but state {share} of fixed ones ({unsure:.3g} m). The receiver is too sure of "
            "them; scale their sigmas, by 2 for float and 5 for single."
        )


def _resolution(gnss: GnssTable) -> Iterator[Finding]:
    """Resolution of the recorded positions relative to their sigma."""
    lat_deg = np.unique(np.rad2deg(gnss.lat_rad[np.isfinite(gnss.lat_rad)]))
    if len(lat_deg) < 10:
        return
    step_m = float(np.min(np.diff(lat_deg))) * 111_000.0
    sigma = median_of(gnss.sigma_m[:, 0])
    if step_m > sigma > 0.0:
        yield note(gnss, "position_resolution", step_m)(
            f"latitude is written in steps of {step_m * 1e3:.1f} mm, its sigma is "
            f"{sigma * 1e3:.1f} mm. The file has too few decimals for such good fixes; that adds "
            f"{step_m / np.sqrt(12.0) * 1e3:.1f} mm of noise. Write nine decimals."
        )


_SCALES = {
    3.6: ("km/h", "divide them by 3.6"),
    1.0 / 0.514444: ("knots", "multiply them by 0.514444"),
    1.0 / 0.3048: ("ft/s", "multiply them by 0.3048"),
    100.0: ("cm/s", "divide them by 100"),
    1000.0: ("mm/s", "divide them by 1000"),
}
_LATE_S = 0.03
_FAR_S = 1.5


def check_velocity(gnss: GnssTable) -> Iterator[Finding]:
    """Findings about velocities; none if there are none, or if the receiver hardly moves."""
    track = track_of(gnss)
    steps = steps_of(track) if track else None
    if track is None or steps is None:
        return
    late = velocity_delay(track)
    if late is not None:
        steps = steps_of(track, late) or steps
    # Between fixes far apart the vehicle turns, so velocities give its displacement only roughly.
    far_apart = float(np.median(np.diff(track.time_s))) > _FAR_S
    p, v = steps.of_position[:, :2], steps.of_velocity[:, :2]
    change, scale = _horizontal(p, v)
    if change is None:
        left = float(np.sum((p - v) ** 2) / np.sum(p**2))
        if left > 0.5 and not far_apart:
            yield _disagreement(gnss, left)
        return
    if change:
        yield _wrong_axes(gnss, change)
    elif abs(scale - 1.0) > 0.1 and not (far_apart and 0.5 < scale < 2.0):
        yield _wrong_scale(gnss, 1.0 / scale)
    # East, north, up for north, east, down reverses the third axis too; one finding suffices.
    if "exchanged" not in change and _vertical_reversed(steps, track):
        names = ("down", "up") if gnss.nav == "NED" else ("up", "down")
        yield error(gnss, "velocity_sign", "vertical")(
            f"the height changes against the vertical velocity. The third component is probably "
            f"{names[1]}, not {names[0]}; turn its sign."
        )
    if not change and late is not None and abs(late) > _LATE_S:
        yield _late(gnss, track, late)


def _disagreement(gnss: GnssTable, left: float) -> Finding:
    return warning(gnss, "velocity_disagrees", left)(
        "the velocities do not describe the motion of the positions, in whatever order, sign or "
        "unit. One of them belongs to another sensor, time or axis; compare plots of both before "
        "you trust either."
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
    return error(gnss, "velocity_axes", change)(
        f"the positions move as the velocities say only with {change}. {cause}."
    )


def _late(gnss: GnssTable, track: FixTrack, late: float) -> Finding:
    epoch = float(np.median(np.diff(track.time_s)))
    cause = ""
    if abs(late - epoch / 2) < 0.2 * epoch:
        cause = " That is half an epoch: the receiver gives the mean velocity of the last epoch."
    return warning(gnss, "velocity_late", late)(
        f"the velocities are {abs(late):.2f} s {'older' if late > 0 else 'younger'} than their "
        f"stamps, judged by the positions.{cause} At 2 m/s^2 that is {2 * abs(late):.2f} m/s of "
        "error: take them at their true time, or raise their sigmas."
    )


def _horizontal(p: np.ndarray, v: np.ndarray) -> tuple[str | None, float]:
    """Change of v that fits p, in words ("": none needed; None: nothing fits), and scale."""
    fits: list[tuple[str, float, float]] = []  # words, scale, share left; as it is first
    for exchange, *signs in itertools.product((False, True), (1, -1), (1, -1)):
        turned = (v[:, ::-1] if exchange else v) * signs
        scale = max(float(np.sum(p * turned) / np.sum(v * v)), 0.0)
        left = float(np.sum((p - scale * turned) ** 2) / np.sum(p * p))
        minus = [name for name, s in zip(("north", "east"), signs, strict=True) if s < 0]
        words = ["exchanged horizontal axes"] if exchange else []
        words += [f"reversed {' and '.join(minus)}"] if minus else []
        fits.append((" and ".join(words), scale, left))
    forward = [one for one in fits if one[1] > 0.0]
    change, scale, left = min(forward, key=lambda one: one[2], default=("", 0.0, np.inf))
    if left > 0.3:
        return None, 0.0
    # Along a straight road several changes fit equally well; then none is reported.
    if change != "" and fits[0][2] < 3.0 * left + 0.02:
        return "", float(np.sum(p * v) / np.sum(v * v))
    return change, scale


def _vertical_reversed(steps: PositionSteps, track: FixTrack) -> bool:
    p, v = (x[:, 2] - x[:, 2].mean() for x in steps)
    if np.std(p) < max(3.0 * track.sigma_m, 0.05) or np.std(v) == 0.0:
        return False
    return float(np.sum(p * v) / np.sqrt(np.sum(p * p) * np.sum(v * v))) < -0.5


def _place_exchanged(gnss: GnssTable) -> bool:
    """True if exchanging latitude and longitude fits better than exchanging velocities."""
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
    return error(gnss, "velocity_unit", ratio)(
        f"velocities are {ratio:.3g} times what the positions say. {cause}."
    )
