"""Figures show the numbers they are given, in their units, whatever is absent."""

import numpy as np
import pytest
from example_results import FILTERS, a_drive, a_summary, an_allan_curve
from figure_reading import collisions, lines_of
from scipy.stats import chi2

from robins import report
from robins.report import comparing, curves, instruments, series, style, updates
from robins.results import Probability, array


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
    values = np.zeros((2, len(heading), 3))
    values[..., 2] = np.mod(heading + np.pi, 2.0 * np.pi) - np.pi
    turning = drive.drop_vars("error_attitude").assign(
        array("estimate", values, "attitude", unit="rad", frame="NED")
    )
    axes = curves.estimates(turning, "attitude").figure.axes[2]
    _, y = lines_of(axes, style.colour(0))[0]
    assert np.isnan(y).sum() == 2
    assert np.nanmax(np.abs(np.diff(y))) < 0.1


@pytest.mark.parametrize("degrees", [1.0, 3.0, 15.0, 750.0])
@pytest.mark.parametrize("probability", [0.005, 0.025, 0.5, 0.975, 0.9995])
def test_quantiles_are_those_of_scipy(degrees, probability):
    got = updates.quantile(probability, degrees)
    assert got == pytest.approx(chi2.ppf(probability, degrees), rel=1e-9)


def test_bands_are_those_of_the_field(drive):
    """N = 50 runs, n = 15 states: the published band of ANEES is 13.5201 to 16.5557."""
    fifty = a_drive(2, runs=50, seconds=60.0)
    band = updates.band(fifty["anees"])
    assert band.low[0, 0] == pytest.approx(13.5201, abs=5e-5)
    assert band.high[0, 0] == pytest.approx(16.5557, abs=5e-5)
    assert band.expected == 15.0
    fifty["anees"].attrs["normalised"] = 1
    normalised = updates.band(fifty["anees"])
    np.testing.assert_allclose(normalised.low, band.low / 15.0)
    np.testing.assert_allclose(normalised.high, band.high / 15.0)
    assert normalised.expected == 1.0
    single = updates.band(drive["nis_gnss_position"])
    assert single.low[0, 0] == pytest.approx(chi2.ppf(0.025, 3))
    dof = drive["nis_gnss_position"] * 0.0 + 2.0
    dof[:, 0] = 0.0
    varying = updates.band(drive["nis_gnss_position"], dof)
    assert varying.high[0, 1] == pytest.approx(chi2.ppf(0.975, 2))
    assert np.isnan(varying.high[0, 0])
    nees = drive["nees"].copy()
    nees.attrs |= {"band_low": 3.0, "band_high": 4.0, "probability": 0.9}
    given = updates.band(nees)
    assert (given.low[0, 0], given.high[0, 0], given.probability) == (3.0, 4.0, 0.9)
    nees.attrs = {}
    assert updates.band(nees) is None


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
    assert "refused" in [text.get_text() for text in figure.legends[0].texts]


def test_a_filter_without_updates_is_not_in_the_legend(drive):
    smoothed = drive.copy(deep=True)
    for name in ("innovation", "innovation_sigma", "nis", "refused"):
        array = smoothed[f"{name}_gnss_position"].astype(float)
        array[1] = np.nan
        smoothed[f"{name}_gnss_position"] = array.assign_attrs(
            smoothed[f"{name}_gnss_position"].attrs
        )
    smoothed["refused_gnss_position"][0] = 0.0
    figure = updates.innovations(smoothed, "gnss_position").figure
    labels = [text.get_text() for text in figure.legends[0].texts]
    assert labels == ["kalman", "±3σ expected", "chi-square band", "outage"]


def test_a_few_large_innovations_do_not_hide_the_others(drive):
    wild = drive.copy(deep=True)
    wild["innovation_gnss_position"][0, 50, 1] = -80.0
    picture = updates.innovations(wild, "gnss_position")
    scales = [axes.get_yscale() for axes in picture.figure.axes]
    assert scales == ["linear", "symlog", "linear", "linear"]
    assert "logarithmic" in picture.caption
    axes = picture.figure.axes[1]
    assert axes.get_ylim()[0] < -80.0
    small, large = (axes.transData.transform((0.0, y))[1] for y in (2.7, 80.0))
    middle = axes.transData.transform((0.0, 0.0))[1]
    assert (small - middle) > 0.1 * (large - middle)  # three sigma of 80 would be 0.03
    report.draw(picture)
    assert collisions(picture.figure) == []
    assert "logarithmic" not in updates.innovations(drive, "gnss_position").caption


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
    picture = comparing.comparison(town)
    shown = {axes.get_title(loc="left"): axes for axes in picture.figure.axes if axes.get_visible()}
    assert "Velocity RMS [m/s]" not in shown  # a list is not one number
    assert "Worst step [µs]" not in shown  # nobody has it
    axes = shown["Horizontal RMS [m]"]
    assert [bar.get_width() for bar in axes.patches] == pytest.approx([0.0213, 0.0213 * 1.7])
    assert [text.get_text() for text in axes.texts] == ["0.0213", "0.03621"]
    assert axes.get_xlim()[0] == 0.0


def test_a_probability_is_a_bar_with_its_interval_on_it():
    few, none = (Probability.among(np.arange(50) < n) for n in (10, 0))
    filters = {"a": {"diverged_share": few}, "b": {"diverged_share": none}}
    picture = comparing.comparison(a_summary() | {"filters": filters})
    axes = picture.figure.axes[0]
    assert [bar.get_width() for bar in axes.patches] == [0.2, 0.0]
    assert [list(line.get_xdata()) for line in axes.lines] == [[*few[1:3]], [*none[1:3]]]
    assert [text.get_text() for text in axes.texts] == ["0.2", "0"]
    assert axes.texts[0].xy[0] == few.high  # behind the line
    assert "interval" in picture.caption


def test_one_filter_is_compared_with_nothing():
    assert comparing.comparison(a_summary(1)) is None


def test_a_missing_metric_has_no_bar():
    filters = {"a": {"x_m": 1.0}, "b": {"x_m": None}, "c": {"x_m": -2.0}}
    picture = comparing.comparison(a_summary() | {"filters": filters})
    axes = picture.figure.axes[0]
    assert [bar.get_width() for bar in axes.patches] == [1.0, 0.0, -2.0]
    assert [text.get_text() for text in axes.texts] == ["1", "–", "-2"]
    assert axes.get_xlim()[0] < -2.0


def test_the_allan_curve_is_drawn_in_field_units_with_its_fit():
    solution = an_allan_curve()
    figure = instruments.allan(solution, "gyro").figure
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
