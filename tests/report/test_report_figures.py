"""Figures show the numbers they are given, in their units, and nothing covers anything."""

import itertools
import re

import matplotlib
import numpy as np
import pyproj
import pytest
from example_results import FILTERS, a_drive, a_summary, an_allan_curve
from matplotlib.transforms import Bbox
from scipy.stats import chi2

from robins import report
from robins.report import allan_curve, bands, bars, curves, maps, series, style, updates
from robins.results import variable


def lines_of(axes, colour):
    """Line data of a colour, by how they were drawn: x, y."""
    return [
        (np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float))
        for line in axes.lines
        if line.get_color() == colour
    ]


@pytest.fixture(scope="module")
def drawn(drive, town):
    """Every picture of the drive, of a campaign and of an Allan analysis, drawn once."""
    settings = dict(matplotlib.rcParams)
    made = report.pictures(drive, town)
    made += report.pictures(a_drive(3, runs=50, seconds=120.0), a_summary(3))
    made += report.pictures(an_allan_curve(), a_summary(1))
    shots = [report.draw(picture) for picture in made]
    assert dict(matplotlib.rcParams) == settings  # nothing is left behind
    return shots


def test_every_array_gets_its_figure(drawn):
    assert [shot.picture.name for shot in drawn] == [
        *("track", "error_position", "error_velocity", "error_attitude", "error_gyro_bias"),
        *("estimate_gyro_bias", "height", "innovation_gnss_position", "nees", "comparison"),
        *("rms_position", "rms_velocity", "rms_attitude", "rms_gyro_bias", "anees", "comparison"),
        "allan_gyro",
    ]


def test_no_figure_is_left_to_pyplot(drawn):
    from matplotlib import pyplot

    assert drawn
    assert pyplot.get_fignums() == []


def test_every_axis_says_what_it_shows_and_in_which_unit(drawn):
    pure = {"NIS", "NEES", "ANEES"}
    for shot in drawn:
        picture = shot.picture
        for axes in picture.figure.axes:
            if not axes.get_visible():
                continue
            if picture.name == "comparison":  # categories upwards; the title names the metric
                assert re.search(r"\w+ \[.+\]$", axes.get_title(loc="left")), picture.name
                continue
            if axes.get_subplotspec().is_last_row():
                assert re.search(r"\w+.* \[\w+\]$", axes.get_xlabel()), picture.name
            if axes.get_subplotspec().is_first_col():
                label = axes.get_ylabel()
                assert label in pure or re.search(r"\w+ \[.+\]$", label), picture.name


def visible_texts(figure):
    """Every text a reader sees, with its box in pixels."""
    texts = [text for legend in figure.legends for text in legend.texts]
    for axes in figure.axes:
        if axes.get_visible():
            texts += [*axes.texts, axes.xaxis.label, axes.yaxis.label, axes._left_title]
            for axis in (axes.xaxis, axes.yaxis):
                texts.append(axis.get_offset_text())
                # Matplotlib keeps labels of ticks out of range; this lists the ones it draws.
                texts += [tick.label1 for tick in axis._update_ticks()]
    seen = [(t.get_text(), t.get_window_extent()) for t in texts if t.get_visible()]
    return [(text, box) for text, box in seen if text.strip()]


def collisions(figure):
    """Texts that stick out of the figure or cover another."""
    texts = visible_texts(figure)
    bad = []
    for text, box in texts:
        outside = (-box.x0, -box.y0, box.x1 - figure.bbox.x1, box.y1 - figure.bbox.y1)
        if max(outside) > 1.0:
            bad.append(text)
    for (a, first), (b, second) in itertools.combinations(texts, 2):
        shared = Bbox.intersection(first, second)
        if shared is not None and shared.width > 1.0 and shared.height > 1.0:
            bad.append(f"{a!r} covers {b!r}")
    return bad


def test_no_text_covers_another_or_leaves_the_figure(drawn):
    for shot in drawn:
        assert len(visible_texts(shot.picture.figure)) > 5
        assert collisions(shot.picture.figure) == [], shot.picture.name


def test_planted_collisions_are_found():
    figure, grid = style.new(1, 1)
    figure.set_layout_engine("none")  # it would make room for what sticks out
    for x in (0.5, 0.51, 1.2):
        grid[0, 0].text(x, 0.5, f"at {x}", transform=grid[0, 0].transAxes)
    figure.canvas.draw()
    assert "'at 0.5' covers 'at 0.51'" in collisions(figure)
    assert "at 1.2" in collisions(figure)


def test_no_legend_covers_data(drawn):
    for shot in drawn:
        figure = shot.picture.figure
        for legend in figure.legends:
            box = legend.get_window_extent()
            assert all(not box.overlaps(axes.get_window_extent()) for axes in figure.axes)
        assert not any(axes.get_legend() for axes in figure.axes)


def luminance(colour):
    """Relative luminance (WCAG 2)."""
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in colour]
    return float(np.dot(linear, [0.2126, 0.7152, 0.0722]))


# Machado, Oliveira and Fernandes (2009), severity 1: what is seen of linear RGB.
_BLIND = {
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
}


@pytest.mark.parametrize("kind", _BLIND)
def test_the_first_colours_differ_for_the_colour_blind(kind):
    rgb = np.array([matplotlib.colors.to_rgb(c) for c in style.COLOURS[:4]])
    seen = np.clip(rgb @ np.array(_BLIND[kind]).T, 0.0, 1.0)
    for a, b in itertools.combinations(seen, 2):
        assert np.linalg.norm(a - b) > 0.15
    for colour in rgb[:3]:
        assert 1.05 / (luminance(colour) + 0.05) > 3.0  # contrast on white


# ---------------------------------------------------------------------------------- the numbers


def test_errors_are_drawn_in_their_unit_with_three_sigma(drive):
    figure = curves.errors(drive, "attitude").figure
    for k, axes in enumerate(figure.axes):
        for i in range(2):
            found = lines_of(axes, style.colour(i))
            assert len(found) == 3  # error, minus and plus three sigma
            (_, error), (_, low), (_, high) = found
            sigma = np.rad2deg(drive["sigma_attitude"].values[i, :, k])
            want = np.rad2deg(drive["error_attitude"].values[i, :, k])
            np.testing.assert_allclose([error.min(), error.max()], [want.min(), want.max()])
            np.testing.assert_allclose([high.min(), high.max()], 3 * sigma[[sigma.argmin(), 0]])
            np.testing.assert_allclose(low.max(), -3.0 * sigma.min())


def test_only_a_steep_start_is_cut_off_and_it_is_said(drive):
    axes = curves.errors(drive, "attitude").figure.axes[0]
    later = drive["time"].values > 0.2 * drive["time"].values[-1]
    sigma = np.rad2deg(3.0 * drive["sigma_attitude"].values[:, :, 0])
    assert axes.get_ylim()[1] == pytest.approx(1.25 * sigma[:, later].max())
    (note,) = axes.texts
    assert note.get_text() == f"starts at {sigma.max():.3g}"
    calm = curves.errors(drive, "position").figure.axes[0]
    assert not calm.texts
    assert calm.get_ylim()[1] > 3.0 * drive["sigma_position"].values[:, :, 0].max()


def test_what_goes_off_late_is_never_cut_off(drive):
    wild = drive.copy(deep=True)
    wild["error_velocity"][1, -5, 2] = 1e4
    axes = curves.errors(wild, "velocity").figure.axes[2]
    assert axes.get_ylim()[1] > 1e4


def test_biases_are_drawn_within_three_sigma(drive):
    axes = curves.estimates(drive, "gyro_bias").figure.axes[1]
    value, low, high = (y for _, y in lines_of(axes, style.colour(0)))
    unit = 3600.0 * 180.0 / np.pi
    want = unit * drive["estimate_gyro_bias"].values[0, :, 1]
    reach = 3.0 * unit * drive["sigma_gyro_bias"].values[0, :, 1]
    np.testing.assert_allclose([value.min(), value.max()], [want.min(), want.max()])
    np.testing.assert_allclose(low.min(), (want - reach).min())
    np.testing.assert_allclose(high.max(), (want + reach).max())
    bottom, top = axes.get_ylim()
    assert bottom < want.min()
    assert top > want.max()


def test_an_angle_that_wraps_is_not_drawn_across_the_figure(drive):
    heading = np.deg2rad(np.linspace(0.0, 700.0, drive.sizes["time"]))
    wrapped = np.mod(heading + np.pi, 2.0 * np.pi) - np.pi
    values = np.zeros((2, len(heading), 3))
    values[..., 2] = wrapped
    turning = drive.drop_vars("error_attitude").assign(
        estimate_attitude=variable(
            ("filter", "time", "axis_attitude"), values, "rad", "attitude", "NED"
        )
    )
    axes = curves.estimates(turning, "attitude").figure.axes[2]
    _, y = lines_of(axes, style.colour(0))[0]
    assert np.isnan(y).sum() == 2
    assert np.nanmax(np.abs(np.diff(y))) < 0.1


@pytest.mark.parametrize("degrees", [1.0, 3.0, 15.0, 750.0])
@pytest.mark.parametrize("probability", [0.005, 0.025, 0.5, 0.975, 0.9995])
def test_quantiles_are_those_of_scipy(degrees, probability):
    got = bands.quantile(probability, degrees)
    assert got == pytest.approx(chi2.ppf(probability, degrees), rel=1e-9)


def test_bands_are_those_of_the_field(drive):
    """N = 50 runs, n = 15 states: the published band of ANEES is 13.5201 to 16.5557."""
    fifty = a_drive(2, runs=50, seconds=60.0)
    band = bands.band(fifty, "anees")
    assert band is not None
    assert band.low[0, 0] == pytest.approx(13.5201, abs=5e-5)
    assert band.high[0, 0] == pytest.approx(16.5557, abs=5e-5)
    assert band.expected == 15.0
    fifty["anees"].attrs["normalised"] = 1
    normalised = bands.band(fifty, "anees")
    assert normalised is not None
    np.testing.assert_allclose(normalised.low, band.low / 15.0)
    np.testing.assert_allclose(normalised.high, band.high / 15.0)
    assert normalised.expected == 1.0
    single = bands.band(drive, "nis_gnss_position", "nis_dof_gnss_position")
    assert single is not None
    assert single.low[0, 0] == pytest.approx(chi2.ppf(0.025, 3))
    drive = drive.copy()
    drive["nis_dof_gnss_position"] = drive["nis_gnss_position"] * 0.0 + 2.0
    drive["nis_dof_gnss_position"][:, 0] = 0.0
    varying = bands.band(drive, "nis_gnss_position", "nis_dof_gnss_position")
    assert varying is not None
    assert varying.high[0, 1] == pytest.approx(chi2.ppf(0.975, 2))
    assert np.isnan(varying.high[0, 0])
    drive["nees"].attrs |= {"band_low": 3.0, "band_high": 4.0, "probability": 0.9}
    given = bands.band(drive, "nees")
    assert given is not None
    assert (given.low[0, 0], given.high[0, 0], given.probability) == (3.0, 4.0, 0.9)
    drive["nees"].attrs = {"units": "1", "long_name": "NEES"}
    assert bands.band(drive, "nees") is None


def test_the_share_inside_the_band_is_counted_and_told(drive):
    values = drive["nis_gnss_position"].values
    low, high = chi2.ppf([0.025, 0.975], 3)
    figure = updates.innovations(drive, "gnss_position").figure
    told = figure.axes[-1].get_title(loc="left")
    for i, name in enumerate(FILTERS[:2]):
        valid = values[i][~np.isnan(values[i])]
        share = 100.0 * np.mean((valid >= low) & (valid <= high))
        assert f"{name} {share:.1f}\u00a0%" in told


def test_innovations_are_drawn_between_three_sigma_and_refusals_are_marked(drive):
    figure = updates.innovations(drive, "gnss_position").figure
    axes = figure.axes[0]
    (x, y), (_, low), (_, high) = lines_of(axes, style.colour(0))
    np.testing.assert_array_equal(y, drive["innovation_gnss_position"].values[0, :, 0])
    np.testing.assert_array_equal(x, drive["gnss_time"].values)
    assert (low.min(), high.max()) == pytest.approx((-2.7, 2.7))
    crosses = [line for line in axes.lines if line.get_marker() == "x"]
    np.testing.assert_array_equal(crosses[0].get_xdata(), drive["gnss_time"].values[[40]])
    labels = [text.get_text() for text in figure.legends[0].texts]
    assert "refused" in labels


def test_a_steep_statistic_is_drawn_on_a_logarithmic_axis(drive):
    wild = drive.copy(deep=True)
    wild["nis_gnss_position"][0, 7] = 5e4
    assert updates.innovations(wild, "gnss_position").figure.axes[-1].get_yscale() == "log"
    assert updates.innovations(drive, "gnss_position").figure.axes[-1].get_yscale() == "linear"


def test_a_campaign_is_drawn_with_the_scatter_its_number_of_runs_allows():
    solution = a_drive(1, runs=20, seconds=60.0)
    axes = curves.campaign(solution, "velocity").figure.axes[0]
    _, rms = lines_of(axes, style.colour(0))[0]
    want = solution["rms_velocity"].values[0, :, 0]
    np.testing.assert_allclose([rms.min(), rms.max()], [want.min(), want.max()])
    (band,) = [c for c in axes.collections if c.get_label() != "outage"]
    edges = band.get_paths()[0].vertices[:, 1]
    sigma = solution["mean_sigma_velocity"].values[0, :, 0]
    assert edges.max() == pytest.approx(sigma.max() * np.sqrt(chi2.ppf(0.975, 20) / 20))
    assert edges.min() == pytest.approx(sigma.min() * np.sqrt(chi2.ppf(0.025, 20) / 20))


def test_the_height_profile_shows_all_there_is(drive):
    axes = curves.height(drive).figure.axes[0]
    drawn = [np.asarray(line.get_ydata(), float) for line in axes.lines]
    for name in ("gnss_alt_m", "reference_alt_m"):
        assert any(y.max() == drive[name].values.max() for y in drawn)
    for i in range(2):
        assert any(y.max() == drive["alt_m"].values[i].max() for y in drawn)


def test_bars_are_as_long_as_their_numbers(town):
    picture = bars.comparison(town)
    assert picture is not None
    shown = {axes.get_title(loc="left"): axes for axes in picture.figure.axes if axes.get_visible()}
    assert "Velocity RMS [m/s]" not in shown  # a list is not one number
    assert "Worst step [µs]" not in shown  # nobody has it
    axes = shown["Horizontal RMS [m]"]
    assert [bar.get_width() for bar in axes.patches] == pytest.approx([0.0213, 0.0213 * 1.7])
    assert [text.get_text() for text in axes.texts] == ["0.0213", "0.03621"]
    assert axes.get_xlim()[0] == 0.0


def test_one_filter_is_compared_with_nothing():
    assert bars.comparison(a_summary(1)) is None


def test_a_missing_metric_has_no_bar():
    filters = {"a": {"x_m": 1.0}, "b": {"x_m": None}, "c": {"x_m": -2.0}}
    picture = bars.comparison(a_summary() | {"filters": filters})
    assert picture is not None
    axes = picture.figure.axes[0]
    assert [bar.get_width() for bar in axes.patches] == [1.0, 0.0, -2.0]
    assert [text.get_text() for text in axes.texts] == ["1", "–", "-2"]
    assert axes.get_xlim()[0] < -2.0


def test_the_allan_curve_is_drawn_in_field_units_with_its_fit():
    solution = an_allan_curve()
    figure = allan_curve.allan(solution, "gyro").figure
    unit = 3600.0 * 180.0 / np.pi
    for k, axes in enumerate(figure.axes):
        assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
        (x, measured), *_ = lines_of(axes, style.colour(0))
        np.testing.assert_allclose(measured, unit * solution["allan_gyro"].values[:, k])
        np.testing.assert_array_equal(x, solution["tau"].values)
        (_, fit), *_ = lines_of(axes, style.colour(1))
        np.testing.assert_allclose(fit, unit * solution["allan_fit_gyro"].values[:, k])
        slopes = [y for _, y in lines_of(axes, style.GREY)]
        np.testing.assert_allclose(slopes, unit * solution["allan_slope_gyro"].values[:, :, k])
        bottom, top = axes.get_ylim()
        assert bottom < unit * solution["allan_low_gyro"].values.min()
        assert top > unit * solution["allan_high_gyro"].values.max()
    labels = [text.get_text() for text in figure.legends[0].texts]
    assert "95\u00a0% confidence" in labels
    assert "rate random walk" in labels


# -------------------------------------------------------------------------------------- the map


@pytest.mark.parametrize("lat_deg", [-75.0, 0.0, 48.7, 80.0])
def test_metres_on_the_map_are_those_of_the_ellipsoid(lat_deg):
    geod = pyproj.Geod(ellps="WGS84")
    for azimuth in (0.0, 37.0, 90.0, 200.0):
        lon, lat, _ = geod.fwd(179.99, lat_deg, azimuth, 2000.0)
        got = maps.metres(
            np.deg2rad([lat]), np.deg2rad([lon]), (np.deg2rad(lat_deg), np.deg2rad(179.99))
        )
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
    assert picture is not None
    for line in picture.figure.axes[0].lines:
        if line.get_linestyle() != "None" and line.get_linewidth() != 3.0:  # the scale bar
            assert np.nanmax(np.abs(np.diff(line.get_xdata())), initial=0.0) < 100.0


def test_a_given_track_that_jumps_around_the_globe_is_broken_there(drive):
    east = np.where(drive["time"].values < 300.0, 0.0, -3e7) + np.zeros((2, 1))
    given = drive.assign(
        track_north_m=variable(("filter", "time"), np.zeros_like(east), "m", "north"),
        track_east_m=variable(("filter", "time"), east, "m", "east"),
    )
    path = maps.paths(given)["track"]
    np.testing.assert_array_equal(path.east, east)
    broken = maps.unwrapped(maps.Path(path.north[0], path.east[0]))
    assert np.isnan(broken.east).sum() == 1
    assert np.nanmax(np.abs(np.diff(broken.east))) == 0.0


@pytest.mark.parametrize("seconds", [30.0, 600.0])
def test_a_metre_is_as_long_north_as_east(seconds):
    picture = maps.track(a_drive(seconds=seconds))
    assert picture is not None
    report.draw(picture)
    axes = picture.figure.axes[0]
    (x0, y0), (x1, y1) = axes.transData.transform([(0.0, 0.0), (10.0, 10.0)])
    assert (x1 - x0) == pytest.approx(y1 - y0, rel=1e-3)


def test_the_map_holds_everything_and_marks_fixes_ends_and_outage(drive):
    picture = maps.track(drive)
    assert picture is not None
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
    assert picture is not None
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


# ----------------------------------------------------------------------------- what may be absent


def blank(solution, *names):
    solution = solution.copy(deep=True)
    for name in names:
        solution[name][...] = np.nan
    return solution


ODD = {
    "no filter knows": lambda ds: blank(ds, *(n for n in ds if ds[n].dtype == float)),
    "the first filter died": lambda ds: ds.assign(
        {n: ds[n].where(ds["filter"] != "kalman") for n in ds if "filter" in ds[n].dims}
    ),
    "one epoch": lambda ds: ds.isel(time=[0], gnss_time=[0]),
    "two epochs": lambda ds: ds.isel(time=[0, 1], gnss_time=[0, 1]),
    "no updates": lambda ds: ds.isel(gnss_time=[]),
    "one filter": lambda ds: ds.isel(filter=[0]),
    "no sigma": lambda ds: ds.drop_vars([n for n in ds if "sigma" in n]),
    "no truth": lambda ds: ds.drop_vars([n for n in ds if n.startswith(("error_", "reference_"))]),
    "no fixes": lambda ds: ds.drop_vars([n for n in ds if n.startswith("gnss_")]),
    "no labels": lambda ds: ds.drop_vars([n for n in ds.coords if n.startswith("axis_")]),
    "standing": lambda ds: blank(ds).assign(lat_rad=ds["lat_rad"] * 0, lon_rad=ds["lon_rad"] * 0),
}


@pytest.mark.parametrize("change", ODD.values(), ids=ODD)
def test_odd_results_are_drawn_without_complaint(change, drive, town):
    few = drive.drop_vars([n for n in drive if "_position" in n and "gnss" not in n])
    few = few.drop_vars([*(n for n in few if "_velocity" in n), "error_gyro_bias"])
    solution = change(few.isel(time=slice(0, 300), gnss_time=slice(0, 60)))
    for name in solution.variables:
        solution[name].attrs |= drive.variables.get(name, solution[name]).attrs
    made = report.pictures(solution, town)
    assert made
    for picture in made:
        picture.figure.set_layout_engine("none")  # takes longer than the drawing
        picture.figure.canvas.draw()


def test_the_scatter_of_one_run_is_not_drawn(town):
    one = a_drive(1, runs=1, seconds=20.0)
    assert [picture.name for picture in report.pictures(one, town)] == ["anees", "comparison"]


def test_a_result_without_series_has_at_least_its_comparison(town):
    assert [picture.name for picture in report.pictures(None, town)] == ["comparison"]
    assert series.filters(an_allan_curve()) == []
