"""Estimates of a filter in the formats of other programs: CSV, TUM, KML, GPX."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import xarray as xr

from robins import __version__, rotation
from robins.earth import dcm_en, ecef_from_geodetic
from robins.errors import require_known
from robins.logs.timebase import ns_to_decimal
from robins.results import Outcome, find
from robins.results.dataframe import clocks, stamps_ns, to_dataframe, utc
from robins.workbench.errors import InputError, refusing

FOLDER = "exports"  # in the result folder
_KML, _GX = "http://www.opengis.net/kml/2.2", "http://www.google.com/kml/ext/2.2"
_GPX = "http://www.topografix.com/GPX/1/1"
_COLOURS = ("ffb47430", "ff2a7fd6", "ff4f9d2f", "ff8b2d7b", "ff3c3cc8")  # aabbggrr, of KML
_NED_TO_ENU = np.array([0.0, 1.0, 1.0, 0.0]) / np.sqrt(2.0)  # half a turn about north-east
_HEIGHTS = "Heights are above the WGS-84 ellipsoid, not above the sea."


class ExportTrack(NamedTuple):
    """A track over the Earth; E positions, NaN between the pieces of a log."""

    name: str
    text: str  # whose places they are
    clock: str  # of the solution, at whose times they are
    lat_rad: np.ndarray  # (E,)
    lon_rad: np.ndarray  # (E,)
    alt_m: np.ndarray  # (E,) above the ellipsoid
    utc: np.ndarray | None  # (E,) datetime64[ns]; None where no date is known

    @property
    def complete(self) -> np.ndarray:
        """(E,) which places have all three coordinates."""
        return np.isfinite(self.lat_rad + self.lon_rad + self.alt_m)

    @property
    def first(self) -> tuple[float, float, float]:
        """First complete position: latitude [rad], longitude [rad], height [m]."""
        row = np.argmax(self.complete)
        return float(self.lat_rad[row]), float(self.lon_rad[row]), float(self.alt_m[row])

    def pieces(self) -> Iterator[tuple[list[tuple[str, str, str]], list[str] | None]]:
        """Latitude and longitude [deg] and height [m] of each piece, as text, and dates."""
        edges = np.flatnonzero(np.diff(self.complete, prepend=False, append=False))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            rows = slice(begin, end)
            angles = (np.degrees(a[rows]) for a in (self.lat_rad, self.lon_rad))
            places = zip(*angles, self.alt_m[rows], strict=True)
            dates = None if self.utc is None else np.datetime_as_string(self.utc[rows], unit="us")
            yield (
                [(f"{lat:.9f}", f"{lon:.9f}", f"{alt:.4f}") for lat, lon, alt in places],
                None if dates is None else [f"{date}Z" for date in dates],
            )


class ExportFormat(NamedTuple):
    """A format that a result can be exported in."""

    text: str
    needs: str  # role of the arrays without which there is nothing to write
    write: Callable[[xr.Dataset, str], dict[str, bytes]]  # of a solution and its name, files


_NEEDED = {"attitude": "attitudes", "track": "places on the Earth"}


def tracks(solution: xr.Dataset) -> list[ExportTrack]:
    """Tracks of the filters, the reference and the fixes."""
    found = []
    for role, name in (("track", ""), ("reference", "reference"), ("gnss", "GNSS fixes")):
        places = find(solution, role)
        if not places.keys() >= {"lat_rad", "lon_rad", "alt_m"}:
            continue
        lat, lon, alt = (places[k] for k in ("lat_rad", "lon_rad", "alt_m"))
        text, clock = str(lat.attrs["long_name"]).replace("latitude", "place"), str(lat.dims[-1])
        date = utc(solution, clock)
        names = _filters(solution) if "filter" in lat.dims else [name]
        rows = zip(names, *(np.atleast_2d(x.values) for x in (lat, lon, alt)), strict=True)
        found += [ExportTrack(one, text, clock, a, o, h, date) for one, a, o, h in rows]
    return [track for track in found if np.any(track.complete)]


def export(solution: xr.Dataset, formats: Sequence[str], name: str = "robins") -> dict[str, bytes]:
    """Files in the formats of other programs, by their names; nothing is written.

        for file, content in export(results.read("walk").solution, ["kml", "tum"]).items():
            Path(file).write_bytes(content)

    Args:
        solution: of a result or an outcome.
        formats: names out of `FORMATS`.
        name: of what was run, for the headings of the files.

    Raises:
        InputError: there is no such format, or the solution has nothing to write in it.
    """
    there = {role for role in ("attitude",) if find(solution, role)}
    require_formats(formats, there | ({"track"} if tracks(solution) else set()), name)
    files: dict[str, bytes] = {}
    for one in formats:
        files |= FORMATS[one].write(solution, name)
    return files


def require_formats(formats: Sequence[str], there: Collection[str], where: str) -> None:
    """Refuse unknown formats, and those that need arrays which are missing.

    Args:
        formats: names.
        there: roles of existing arrays, of "attitude" and "track".
        where: name of what is exported, for the message.

    Raises:
        InputError: one of them; the message names those that are possible.
    """
    possible = [name for name, one in FORMATS.items() if not one.needs or one.needs in there]
    for name in formats:
        with refusing("--export"):
            require_known("format", name, FORMATS, "robins")
        if name not in possible:
            what = f"{name} is made of {_NEEDED[FORMATS[name].needs]}, and {where} has none"
            fix = f"use {', '.join(possible)}."
            raise InputError(what, "--export", fix)


def with_exports(outcome: Outcome, formats: Sequence[str], name: str) -> Outcome:
    """The outcome with its solution in other formats among its files, and lines that name them.

    A failed export is a warning, so that the run is not lost.
    """
    if not formats or outcome.solution is None:
        return outcome
    try:
        made = export(outcome.solution, formats, name)
    except InputError as error:
        return replace(outcome, warnings=[*outcome.warnings, f"nothing was exported: {error}"])
    files = {f"{FOLDER}/{file}": content for file, content in made.items()}
    lines = [f"Export: {{out}}/{file}" for file in files]
    return replace(
        outcome,
        files={**outcome.files, **files},
        notes=[*outcome.notes, *_remarks(outcome.solution, formats)],
        last_lines=[*lines, *outcome.last_lines],
    )


def _remarks(solution: xr.Dataset, formats: Sequence[str]) -> list[str]:
    """Sentences on what the files do not contain."""
    remarks, ways = [], tracks(solution)
    if "tum" in formats and not ways:
        remarks.append(
            "The files .tum hold attitudes only: no place was found, x, y and z are zero."
        )
    maps = [name for name in ("kml", "gpx") if name in formats]
    if maps and ways and ways[0].utc is None:
        remarks.append(
            f"The tracks in {' and '.join(maps)} have no times: the stamps of the log have no date."
        )
    return remarks


def _csv(solution: xr.Dataset, name: str) -> dict[str, bytes]:
    """A file for each filter, and one more for each other clock of its estimates."""
    found = {}
    for clock in _clocks_of_estimates(solution):
        more = "" if clock == "time" else f"-{clock.removesuffix('_time')}"
        for one in _filters(solution):
            table = to_dataframe(solution, one, clock)
            text = table.to_csv(date_format="%Y-%m-%dT%H:%M:%S.%fZ", lineterminator="\n")
            found[f"{_file(one)}{more}.csv"] = text.encode()
    return found


def _tum(solution: xr.Dataset, name: str) -> dict[str, bytes]:
    """A file for each filter, of the rows that have an attitude, and a place if there are any."""
    attitude = find(solution, "attitude")[""]
    clock = str(attitude.dims[1])
    stamps, since = stamps_ns(solution, clock), "the zero of the log's own clock"
    if stamps is None:
        stamps, since = np.round(solution[clock].values * 1e9).astype(np.int64), "the start"
    elif (date := utc(solution, clock)) is not None:
        behind = int((stamps[0] - date[0].astype(np.int64)) // 1_000_000_000)
        since = f"1970-01-01 in GPS time; UTC is {behind} s behind"
    axes = attitude.attrs["frame"].split(" to ")[0]
    ways = {track.name: track for track in tracks(solution) if track.clock == clock}
    origin = next((way.first for way in ways.values()), None)
    found = {}
    for one in _filters(solution):
        q_nb = attitude.sel(filter=one).values
        place, q, note = np.zeros((len(q_nb), 3)), q_nb, "zero: no place was found"
        if origin is not None and one in ways:
            place, q = _local_frame(origin, ways[one], q_nb)
            lat, lon, alt = *np.degrees(origin[:2]), origin[2]
            note = f"{ways[one].text}, m east, north, up of"
            note += f" {lat:.9f} deg, {lon:.9f} deg, {alt:.4f} m (WGS-84)"
        lines = [
            f"# {name}, {one}; written by robins {__version__}",
            f"# t: s since {since}",
            f"# x y z: {note}",
            f"# qx qy qz qw: scalar last, turns {axes} axes into east, north, up",
            "# t x y z qx qy qz qw",
        ]
        scalar_last = np.roll(rotation.multiply(_NED_TO_ENU, q), -1, axis=1)
        rows = np.concatenate([place, scalar_last], axis=1)
        for k in np.flatnonzero(np.isfinite(rows).all(axis=1)):
            t, (x, y, z, *quaternion) = ns_to_decimal(int(stamps[k])), rows[k]
            turned = " ".join(f"{component:.9f}" for component in quaternion)
            lines.append(f"{t} {x:.6f} {y:.6f} {z:.6f} {turned}")
        found[f"{_file(one)}.tum"] = ("\n".join(lines) + "\n").encode()
    return found


def _local_frame(
    origin: tuple[float, float, float], track: ExportTrack, q_nb: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Places (E, 3) [m] east, north, up of an origin, and q_nb (E, 4) with the axes of NED there.

    Both are exact at any distance, where north and down differ from those at the origin.
    """
    r_e = np.asarray(ecef_from_geodetic(track.lat_rad, track.lon_rad, track.alt_m))
    C_eo, C_en = dcm_en(*origin[:2]), dcm_en(track.lat_rad, track.lon_rad)
    north, east, down = ((r_e - np.asarray(ecef_from_geodetic(*origin))) @ np.asarray(C_eo)).T
    q_eo, q_en = (np.asarray(rotation.from_dcm(C)) for C in (C_eo, C_en))
    q_on = rotation.multiply(rotation.conjugate(q_eo), q_en)
    return np.stack([east, north, -down], axis=1), rotation.multiply(q_on, q_nb)


def _kml(solution: xr.Dataset, name: str) -> dict[str, bytes]:
    """One file, a track for each filter, the reference and the fixes; drawn on the ground."""
    root = ElementTree.Element("kml", {"xmlns": _KML, "xmlns:gx": _GX})
    document = _child(root, "Document")
    _child(document, "name", name)
    note = f"{_HEIGHTS} So the tracks are drawn on the ground. Written by robins {__version__}."
    _child(document, "description", note)
    for number, track in enumerate(tracks(solution)):
        mark = _child(document, "Placemark")
        _child(mark, "name", track.name)
        _child(mark, "description", track.text)
        look = _child(_child(mark, "Style"), "LineStyle")
        _child(look, "color", _COLOURS[number % len(_COLOURS)])
        _child(look, "width", "3")
        several = _child(mark, "MultiGeometry" if track.utc is None else "gx:MultiTrack")
        for rows, dates in track.pieces():
            if dates is None:
                line = _child(several, "LineString")
                _child(line, "tessellate", "1")
                _child(line, "altitudeMode", "clampToGround")
                places = (f"{lon},{lat},{alt}" for lat, lon, alt in rows)
                _child(line, "coordinates", " ".join(places))
                continue
            line = _child(several, "gx:Track")
            _child(line, "altitudeMode", "clampToGround")
            for date in dates:
                _child(line, "when", date)
            for lat, lon, alt in rows:
                _child(line, "gx:coord", f"{lon} {lat} {alt}")
    return {"tracks.kml": _xml(root)}


def _gpx(solution: xr.Dataset, name: str) -> dict[str, bytes]:
    """One file of GPX 1.1, a track for each filter, the reference and the fixes."""
    about = {"xmlns": _GPX, "version": "1.1", "creator": f"robins {__version__}"}
    root = ElementTree.Element("gpx", about)
    metadata = _child(root, "metadata")
    _child(metadata, "name", name)
    _child(metadata, "desc", _HEIGHTS)
    for track in tracks(solution):
        way = _child(root, "trk")
        _child(way, "name", track.name)
        _child(way, "desc", track.text)
        for rows, dates in track.pieces():
            segment = _child(way, "trkseg")
            for (lat, lon, alt), date in zip(rows, dates or [None] * len(rows), strict=True):
                point = _child(segment, "trkpt")
                point.attrib.update(lat=lat, lon=lon)
                _child(point, "ele", alt)
                if date is not None:
                    _child(point, "time", date)
    return {"tracks.gpx": _xml(root)}


FORMATS = {
    "csv": ExportFormat("a table for each filter", "", _csv),
    "tum": ExportFormat("t x y z qx qy qz qw, a file for each filter", "attitude", _tum),
    "kml": ExportFormat("tracks for globes and maps", "track", _kml),
    "gpx": ExportFormat("tracks, GPX 1.1", "track", _gpx),
}
"""Formats in which a result can be exported."""


def _clocks_of_estimates(solution: xr.Dataset) -> list[str]:
    roles = ("track", "attitude", "estimate", "error", "sigma")
    arrays = [array for role in roles for array in find(solution, role).values()]
    return [clock for clock in clocks(solution) if any(clock in a.dims for a in arrays)]


def _filters(solution: xr.Dataset) -> list[str]:
    return [str(name) for name in solution["filter"].values]


def _file(filter_name: str) -> str:
    return re.sub(r"[^\w.+-]", "_", filter_name)


def _child(parent: ElementTree.Element, tag: str, text: str | None = None) -> ElementTree.Element:
    child = ElementTree.SubElement(parent, tag)
    child.text = text
    return child


def _xml(root: ElementTree.Element) -> bytes:
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"
