"""Percentiles of the error over the runs, and the mean error beside the RMS, as they are drawn."""

import numpy as np
import pytest
import xarray as xr
from figure_reading import collisions, lines_of

from robins import report
from robins.report import curves, scatter, style
from robins.results import array, variable

NAMES = ["kf", "ekf"]
TIME = np.arange(30) * 0.5
ARCMIN = np.deg2rad(1.0 / 60.0)


@pytest.fixture
def run():
    levels = np.array([1.0, 4.0, 9.0, 12.0]) * np.array([[[1.0]], [[2.0]]])
    sizes = ARCMIN * levels * np.exp(-TIME / 20.0)[:, None]
    enu = {"unit": "rad", "frame": "ENU", "axes": ["E", "N"], "display_unit": "arcmin"}
    shown = {"unit": "rad", "display_unit": "arcmin", "axes": ["5 %", "50 %", "95 %", "99 %"]}
    rms = np.full((2, 30, 2), 3.0 * ARCMIN)
    return xr.Dataset(
        array("percentile", sizes, "attitude", runs=50, bins=0.0366, **shown)
        | array("rms", rms, "attitude", runs=50, **enu)
        | array("mean_error", rms * [-0.1, 0.5], "attitude", runs=50, **enu),
        {
            "filter": NAMES,
            "time": variable("time", TIME, "s", "time"),
            "thinned_time": variable("thinned_time", TIME, "s", "time"),
        },
    )


def test_median_and_highest_are_lines_and_the_middle_a_tint(run):
    picture = scatter.percentiles(run, "attitude")
    (axes,) = picture.figure.axes
    assert axes.get_yscale() == "log"
    values = run["percentile_attitude"].values / ARCMIN
    for i in range(2):
        (_, middle), (_, highest) = lines_of(axes, style.colour(i))
        np.testing.assert_allclose(middle, values[i, :, 1])
        np.testing.assert_allclose(highest, values[i, :, 3])
        corners = axes.collections[i].get_paths()[0].vertices
        at = corners[np.isclose(corners[:, 0], TIME[7]), 1]
        np.testing.assert_allclose((at.min(), at.max()), values[i, 7, [0, 2]])
    low, top = axes.get_ylim()
    assert low <= values.min() < values.max() <= top
    for words in ("median of 50 runs", "and the largest", "from 5 % to 95 %", "to 3.7"):
        assert words in picture.caption
    picture.figure.canvas.draw()
    assert not collisions(picture.figure)


def test_a_line_ends_where_a_percentile_diverged(run):
    run["percentile_attitude"][1, 20:, 3] = np.inf
    picture = scatter.percentiles(run, "attitude")
    (_, _), (_, highest) = lines_of(picture.figure.axes[0], style.colour(1))
    assert np.all(np.isfinite(highest[:20]))
    assert np.all(np.isnan(highest[20:]))
    assert np.isfinite(picture.figure.axes[0].get_ylim()).all()
    assert "ends where so many runs have diverged" in picture.caption
    run["percentile_attitude"][:] = np.inf
    scatter.percentiles(run, "attitude").figure.canvas.draw()


def test_of_many_filters_no_tints_are_drawn(run):
    many = xr.concat([run] * 3, "filter", data_vars="minimal")
    picture = scatter.percentiles(many, "attitude")
    assert not picture.figure.axes[0].collections
    assert "Tint" not in picture.caption


def test_the_mean_error_is_drawn_by_its_size_beside_the_rms(run):
    picture = curves.campaign(run, "attitude")
    for axes, share in zip(picture.figure.axes, (0.1, 0.5), strict=True):
        (_, rms), (_, mean) = lines_of(axes, style.colour(0))
        np.testing.assert_allclose(rms, 3.0)
        np.testing.assert_allclose(mean, 3.0 * share)
    assert "below 28" in picture.caption  # 1.96 / sqrt(50)
    assert "mean error" not in curves.campaign(run.drop_vars("mean_error_attitude"), "attitude")[2]


def test_percentiles_are_on_the_page(run):
    summary = {"filters": {n: {} for n in NAMES}, "claims": [], "counts": {}}
    names = [p.name for p in report.pictures(run, summary)]
    assert names[:2] == ["rms_attitude", "percentile_attitude"]
