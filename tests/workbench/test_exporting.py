"""Exports, read by other programs, or computed by other packages."""

import io
from xml.etree import ElementTree

import gpxpy
import numpy as np
import pandas as pd
import pyproj
import pytest
from scipy.spatial.transform import Rotation
from small_replay import (
    ALT_M,
    FIX_S,
    GAP,
    LAT_RAD,
    LON_RAD,
    NAMES,
    ORIGIN_NS,
    TIME_S,
    a_replay,
    attitudes,
)

from robins import logs
from robins.results import Outcome, to_dataframe
from robins.workbench import InputError, export, replay
from robins.workbench.formats import FORMATS, with_exports

KML = {"": "http://www.opengis.net/kml/2.2", "gx": "http://www.google.com/kml/ext/2.2"}
WHOLE = np.delete(np.arange(len(TIME_S)), GAP)
STAMPS_NS = ORIGIN_NS + np.round(TIME_S * 1e9).astype(np.int64)
UTC = pd.to_datetime(STAMPS_NS - 18 * 10**9, utc=True)
FIRST = np.degrees(LAT_RAD[0, 0]), np.degrees(LON_RAD[0, 0]), ALT_M[0, 0]


def read_tum(files, name):
    text = files[f"{name}.tum"].decode()
    return np.loadtxt(io.StringIO(text)), [line for line in text.splitlines() if line[0] == "#"]


def earth_axes(lat_rad, lon_rad):
    """East, north and up as columns, along the axes of the Earth."""
    turn = Rotation.from_euler("ZY", np.stack([lon_rad, -lat_rad], axis=-1))
    return turn.as_matrix()[..., [1, 2, 0]]


# ---------------------------------------------------------------------------------------------- TUM


@pytest.mark.parametrize("filter_number", [0, 1])
def test_tum_holds_places_as_proj_finds_them(filter_number):
    rows, comments = read_tum(export(a_replay(), ["tum"]), NAMES[filter_number])
    lat, lon, alt = FIRST
    # from the Earth-fixed place of the origin, which every filter has in common
    pipeline = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={lon:.17g} +lat_0={lat:.17g} +h_0={alt}"
    )
    there = (np.degrees(LON_RAD), np.degrees(LAT_RAD), ALT_M)
    enu = np.stack(pipeline.transform(*(x[filter_number, WHOLE] for x in there)), axis=1)
    assert np.ptp(enu[:, 0]) > 3e4
    np.testing.assert_allclose(rows[:, 1:4], enu, rtol=0, atol=2e-6)
    assert f"east, north, up of {lat:.9f} deg, {lon:.9f} deg, {alt:.4f} m" in comments[2]
    assert "place of the antenna" in comments[2]


@pytest.mark.parametrize("filter_number", [0, 1])
def test_tum_holds_attitudes_scalar_last_along_the_axes_of_the_origin(filter_number):
    rows, comments = read_tum(export(a_replay(), ["tum"]), NAMES[filter_number])
    found = Rotation.from_quat(rows[:, 4:]).as_matrix()
    C_nb = attitudes()[filter_number].as_matrix()[WHOLE]  # north, east, down
    C_enu_b = C_nb[:, [1, 0, 2]] * np.array([1.0, 1.0, -1.0])[:, None]
    here = earth_axes(LAT_RAD[filter_number, WHOLE], LON_RAD[filter_number, WHOLE])
    C_origin = earth_axes(LAT_RAD[0, 0], LON_RAD[0, 0])
    np.testing.assert_allclose(found, C_origin.T @ here @ C_enu_b, rtol=0, atol=3e-9)
    assert "scalar last, turns FRD axes into east, north, up" in comments[3]


def test_tum_has_the_stamps_of_the_log_to_the_nanosecond():
    files = export(a_replay(), ["tum"])
    lines = files["ekf.tum"].decode().splitlines()
    told = [line.split()[0] for line in lines if line[0] != "#"]
    assert [int(t.replace(".", "").ljust(19, "0")) for t in told] == STAMPS_NS[WHOLE].tolist()
    assert lines[1] == "# t: s since 1970-01-01 in GPS time; UTC is 18 s behind"
    undated = export(a_replay(dated=False), ["tum"])["ekf.tum"].decode().splitlines()
    assert undated[1] == "# t: s since the zero of the log's own clock"
    assert undated[5].startswith("86400.250 ")


def test_tum_without_places_has_zeros_and_says_so():
    rows, comments = read_tum(export(a_replay(placed=False), ["tum"]), "ekf")
    assert not rows[:, 1:4].any()
    assert comments[2] == "# x y z: zero: no place was found"
    C_enu_n = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    expected = C_enu_n @ attitudes()[0].as_matrix()[WHOLE]
    np.testing.assert_allclose(Rotation.from_quat(rows[:, 4:]).as_matrix(), expected, atol=3e-9)


# ------------------------------------------------------------------------------------- KML and GPX


def test_kml_has_a_track_for_each_filter_and_one_of_the_fixes():
    root = ElementTree.fromstring(export(a_replay(), ["kml"], "walk")["tracks.kml"])
    assert root.find("Document/name", KML).text == "walk"
    assert "above the WGS-84 ellipsoid" in root.find("Document/description", KML).text
    marks = root.findall("Document/Placemark", KML)
    assert [m.find("name", KML).text for m in marks] == [*NAMES, "GNSS fixes"]
    for number, mark in enumerate(marks[:2]):
        pieces = mark.findall("gx:MultiTrack/gx:Track", KML)
        assert [len(p.findall("when", KML)) for p in pieces] == [GAP, len(TIME_S) - GAP - 1]
        assert {p.find("altitudeMode", KML).text for p in pieces} == {"clampToGround"}
        when = [w.text for p in pieces for w in p.findall("when", KML)]
        assert pd.to_datetime(when).tolist() == UTC[WHOLE].floor("us").tolist()
        coord = [c.text.split() for p in pieces for c in p.findall("gx:coord", KML)]
        there = (np.degrees(LON_RAD[number]), np.degrees(LAT_RAD[number]), ALT_M[number])
        expected = np.stack(there, axis=1)[WHOLE]
        np.testing.assert_allclose(np.array(coord, float), expected, rtol=0, atol=6e-10)
    assert len(marks[2].findall("gx:MultiTrack/gx:Track/when", KML)) == len(FIX_S)


def test_kml_without_dates_has_lines():
    root = ElementTree.fromstring(export(a_replay(dated=False), ["kml"])["tracks.kml"])
    assert not list(root.iter(f"{{{KML['']}}}when"))
    lines = root.findall("Document/Placemark/MultiGeometry/LineString", KML)
    assert [line.find("altitudeMode", KML).text for line in lines] == ["clampToGround"] * 5
    coordinates = lines[0].find("coordinates", KML).text.split()
    assert len(coordinates) == GAP
    expected = np.degrees(LON_RAD[0, 0]), np.degrees(LAT_RAD[0, 0]), ALT_M[0, 0]
    np.testing.assert_allclose([*map(float, coordinates[0].split(","))], expected, atol=6e-10)


@pytest.mark.parametrize("dated", [True, False])
def test_gpx_is_read_by_another_package(dated):
    read = gpxpy.parse(export(a_replay(dated=dated), ["gpx"], "walk")["tracks.gpx"].decode())
    assert (read.version, read.name) == ("1.1", "walk")
    assert "above the WGS-84 ellipsoid" in read.description
    assert [track.name for track in read.tracks] == [*NAMES, "GNSS fixes"]
    assert [len(track.segments) for track in read.tracks] == [2, 2, 1]
    for number, track in enumerate(read.tracks[:2]):
        points = [point for segment in track.segments for point in segment.points]
        found = [(p.latitude, p.longitude, p.elevation) for p in points]
        there = (np.degrees(LAT_RAD[number]), np.degrees(LON_RAD[number]), ALT_M[number])
        np.testing.assert_allclose(found, np.stack(there, 1)[WHOLE], rtol=0, atol=6e-10)
        times = [p.time for p in points]
        if dated:
            assert times == UTC[WHOLE].floor("us").to_pydatetime().tolist()
        else:
            assert set(times) == {None}


# -------------------------------------------------------------------------------------------- CSV


def test_csv_reads_back_as_the_table():
    files = export(a_replay(), ["csv"])
    assert sorted(files) == ["ekf+rts.csv", "ekf.csv"]
    back = pd.read_csv(io.BytesIO(files["ekf.csv"]), index_col="time_s", parse_dates=["utc"])
    made = to_dataframe(a_replay(), "ekf")
    assert back["utc"].tolist() == made["utc"].dt.floor("us").tolist()
    numbers = made.drop(columns="utc")
    pd.testing.assert_frame_equal(back.drop(columns="utc"), numbers, check_exact=True)


def test_csv_has_a_file_more_for_attitudes_on_a_clock_of_their_own():
    files = export(a_replay(clock="sample_time", placed=False), ["csv"])
    assert sorted(files) == [*("ekf+rts-sample.csv", "ekf+rts.csv", "ekf-sample.csv", "ekf.csv")]
    sample = pd.read_csv(io.BytesIO(files["ekf-sample.csv"]))
    assert [*sample.columns[2:]] == [
        *(f"q_nb_{axis}" for axis in "wxyz"),
        *(f"estimate_euler_{angle}_deg" for angle in ("roll", "pitch", "heading")),
    ]


# ------------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("formats", "message"),
    [
        (["csv", "kmz"], "no format 'kmz' in robins; did you mean 'kml'?"),
        (["tum", "gpx"], "gpx is made of places on the Earth, and hand has none; use csv, tum."),
    ],
)
def test_a_format_that_does_not_fit_is_refused_with_those_that_do(formats, message):
    with pytest.raises(InputError) as caught:
        export(a_replay(placed=False), formats, "hand")
    assert message in str(caught.value)


def test_no_attitude_no_poses():
    without = a_replay().drop_vars("q_nb")
    with pytest.raises(InputError, match=r"tum is made of attitudes, .* use csv, kml, gpx"):
        export(without, ["tum"])


@pytest.mark.parametrize(
    ("system", "exports", "message"),
    [
        ("marg", ["csv", "kml"], "a replay with marg has none; use csv, tum."),
        ("marg", ["cvs"], "no format 'cvs' in robins; did you mean 'csv'?"),
        ("ins-gnss", ["csv", "gpz"], "no format 'gpz' in robins; did you mean 'gpx'?"),
    ],
)
def test_a_replay_refuses_it_before_a_log_is_read(monkeypatch, system, exports, message):
    monkeypatch.setattr(logs, "load_dataset", lambda *_, **__: pytest.fail("the log was read"))
    with pytest.raises(InputError) as caught:
        replay(["walk.csv"], system=system, exports=exports)
    assert str(caught.value).startswith("--export: ")
    assert message in str(caught.value)


# -------------------------------------------------------------------------------- with an outcome


def test_an_outcome_has_the_files_and_names_them():
    outcome = Outcome(solution=a_replay(), notes=["first"], last_lines=["Next:   go on"])
    made = with_exports(outcome, list(FORMATS), "walk")
    assert sorted(made.files) == sorted(f"exports/{f}" for f in export(a_replay(), list(FORMATS)))
    assert made.last_lines[:-1] == [f"Export: {{out}}/{file}" for file in made.files]
    assert made.last_lines[-1] == "Next:   go on"
    assert made.notes == ["first"]
    assert with_exports(outcome, [], "walk") is outcome


def test_what_files_do_not_say_is_a_note():
    undated = with_exports(Outcome(solution=a_replay(dated=False)), ["kml", "gpx"], "walk")
    assert undated.notes == [
        "The tracks in kml and gpx have no times: the stamps of the log have no date."
    ]
    hand = with_exports(Outcome(solution=a_replay(placed=False)), ["tum"], "hand")
    assert hand.notes == [
        "The files .tum hold attitudes only: no place was found, x, y and z are zero."
    ]


def test_a_run_is_not_lost_by_what_cannot_be_exported():
    outcome = Outcome(solution=a_replay(placed=False), warnings=["first"])
    made = with_exports(outcome, ["kml"], "own")
    assert made.files == {}
    assert made.warnings[0] == "first"
    assert made.warnings[1].startswith("nothing was exported: --export: kml is made of places")
