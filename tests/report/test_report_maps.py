"""The map: metres that are metres, on both sides of 180 degrees."""

import numpy as np
import pyproj
import pytest
from example_results import a_drive

from robins import report
from robins.report import maps
from robins.results import array


@pytest.mark.parametrize("lat_deg", [-75.0, 0.0, 48.7, 80.0])
def test_metres_on_the_map_are_those_of_the_ellipsoid(lat_deg):
    geod = pyproj.Geod(ellps="WGS84")
    for azimuth in (0.0, 37.0, 90.0, 200.0):
        lon, lat, _ = geod.fwd(179.99, lat_deg, azimuth, 2000.0)
        origin = np.deg2rad(lat_deg), np.deg2rad(179.99)
        got = maps.metres(np.deg2rad([lat]), np.deg2rad([lon]), origin)
        want = 2000.0 * np.array([np.cos(np.deg2rad(azimuth)), np.sin(np.deg2rad(azimuth))])
        # A map without projection bends by d^2 tan(lat)/2R over a distance d.
        bend = 2000.0**2 * abs(np.tan(np.deg2rad(lat_deg))) / 6.35e6 + 0.01
        np.testing.assert_allclose([got.north[0], got.east[0]], want, atol=bend)


def test_crossing_180_degrees_draws_no_line_across_the_map(drive):
    home = maps.paths(drive)["track"]
    there = a_drive(lon0=np.pi - 1e-5)
    assert np.ptp(there["lon_rad"].values) > 6.0  # it really crosses
    crossing = maps.paths(there)["track"]
    np.testing.assert_allclose(crossing.east, home.east, atol=1e-3)
    np.testing.assert_allclose(crossing.north, home.north, atol=1e-3)
    picture = maps.track(there)
    for line in picture.figure.axes[0].lines:
        if line.get_linestyle() != "None" and line.get_linewidth() != 3.0:  # the scale bar
            assert np.nanmax(np.abs(np.diff(line.get_xdata())), initial=0.0) < 100.0


def test_a_given_track_that_jumps_around_the_globe_is_broken_there(drive):
    east = np.where(drive["time"].values < 300.0, 0.0, -3e7) + np.zeros((2, 1))
    north = array("track", np.zeros_like(east), "north_m", unit="m")
    given = drive.assign(north | array("track", east, "east_m", unit="m"))
    path = maps.paths(given)["track"]
    np.testing.assert_array_equal(path.east, east)
    broken = maps.unwrapped(maps.Path(path.north[0], path.east[0]))
    assert np.isnan(broken.east).sum() == 1
    assert np.nanmax(np.abs(np.diff(broken.east))) == 0.0


@pytest.mark.parametrize("seconds", [30.0, 600.0])
def test_a_metre_is_as_long_north_as_east(seconds):
    picture = maps.track(a_drive(seconds=seconds))
    report.draw(picture)
    axes = picture.figure.axes[0]
    (x0, y0), (x1, y1) = axes.transData.transform([(0.0, 0.0), (10.0, 10.0)])
    assert (x1 - x0) == pytest.approx(y1 - y0, rel=1e-3)


def test_the_map_holds_everything_and_marks_fixes_ends_and_outage(drive):
    picture = maps.track(drive)
    axes = picture.figure.axes[0]
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    for path in maps.paths(drive).values():
        assert west < np.nanmin(path.east) <= np.nanmax(path.east) < east
        assert south < np.nanmin(path.north) <= np.nanmax(path.north) < north
    quality = drive["gnss_quality"].values
    labels = [text.get_text() for text in picture.figure.legends[0].texts]
    for value, name in ((1, "fix"), (2, "float"), (5, "single")):
        assert f"GNSS {name} ({np.sum(quality == value)})" in labels
    assert {"start", "end", "outage", "reference", "kalman", "robust"} <= set(labels)
    (outage,) = [line for line in axes.lines if line.get_linewidth() == 6.0]
    reference = maps.paths(drive)["reference"]
    hidden = drive["outage"].values
    shown = np.asarray(outage.get_xdata(), float)
    assert np.nanmin(shown) == pytest.approx(reference.east[hidden].min())
    assert np.nanmax(shown) == pytest.approx(reference.east[hidden].max())
    start = next(line for line in axes.lines if line.get_marker() == "o")
    assert start.get_xdata()[0] == pytest.approx(maps.paths(drive)["track"].east[0, 0])
    assert "N" in [text.get_text() for text in axes.texts]


def test_qualities_are_named_as_the_data_name_them(drive):
    drive = drive.copy(deep=True)
    drive["gnss_quality"].attrs |= {"flag_values": [1, 2], "flag_meanings": "wet half_dry"}
    picture = maps.track(drive)
    labels = " ".join(text.get_text() for text in picture.figure.legends[0].texts)
    assert "GNSS wet (" in labels
    assert "GNSS half dry (" in labels
    assert "GNSS quality 5 (" in labels


def test_the_scale_bar_is_as_long_as_it_says():
    for length in (0.7, 1.0, 3.0, 730.0, 99999.0):
        bar = maps._round(length)
        assert bar <= length * 1.00001
        assert length / bar < 2.5
        assert f"{bar:e}"[0] in "125"
