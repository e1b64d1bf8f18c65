"""Shares within a limit, worst-case margins, and bounds that are told from standard deviations."""

import numpy as np
import pytest
import xarray as xr
from figure_reading import collisions, lines_of
from scipy import stats

from robins import report
from robins.report import curves, style, updates
from robins.results import array, variable

NAMES = ["kf", "hinf-deg", "adaptive-hinf"]
TIME = np.arange(40) * 0.5


@pytest.fixture(scope="module")
def aligned():
    size = (3, 40)
    rng = np.random.default_rng(1)
    share = np.linspace(0.0, 1.0, 40) * np.array([[1.0], [0.6], [0.3]])
    gamma = np.array([[np.nan], [2.0], [np.nan]]) * np.ones(size)
    xi = np.array([[np.nan], [np.nan], [4.0]]) * np.ones(size)
    bound = np.linspace(1.9, 0.5, 40)
    only = np.array([[1.0], [np.nan], [np.nan]])
    enu = {"unit": "rad", "frame": "ENU", "axes": ["E", "N", "U"], "display_unit": "arcmin"}
    return xr.Dataset(
        array("bounds", np.array([0, 1, 1], np.int8))
        | array("within", share, "5_arcmin", runs=50)
        | array("note", np.where(gamma > 0, bound, np.nan), "h_infinity_bound")
        | array("note", gamma, "h_infinity_gamma")
        | array("note", np.where(xi > 0, bound, np.nan), "adaptive_h_infinity_bound")
        | array("note", xi, "adaptive_h_infinity_xi")
        | array("rms", rng.random((*size, 3)), "attitude", runs=50, **enu)
        | array("mean_sigma", rng.random((*size, 3)), "attitude", **enu)
        | array("consistency", only + 0.01 * rng.random(size), "anees", runs=50, normalised=1)
        | array("consistency_dof", 9.0 * only * np.ones(size), "anees"),
        {"filter": NAMES, "time": variable("time", TIME, "s", "time")},
    )


def test_shares_are_drawn_as_they_are(aligned):
    picture = curves.within(aligned, "5_arcmin")
    (axes,) = picture.figure.axes
    for i in range(3):
        ((x, y),) = lines_of(axes, style.colour(i))
        np.testing.assert_allclose(x, TIME)
        np.testing.assert_allclose(y, aligned["within_5_arcmin"].values[i])
    assert "50" in picture.caption
    picture.figure.canvas.draw()
    assert not collisions(picture.figure)


def test_shares_stand_in_the_interval_of_their_probability(aligned):
    axes = curves.within(aligned, "5_arcmin").figure.axes[0]
    assert len(axes.collections) == 3
    for i, tint in enumerate(axes.collections):
        corners = tint.get_paths()[0].vertices
        for k in (0, 17, 39):
            hits = round(50 * float(aligned["within_5_arcmin"][i, k]))
            at = corners[np.isclose(corners[:, 0], TIME[k]), 1]
            want = stats.binomtest(hits, 50).proportion_ci(method="exact")
            np.testing.assert_allclose((at.min(), at.max()), (want.low, want.high), atol=1e-9)
    many = xr.concat([aligned, aligned], "filter", data_vars="minimal")
    picture = curves.within(many, "5_arcmin")
    assert not picture.figure.axes[0].collections  # six tints could not be told apart
    assert "Tint" not in picture.caption


def test_worst_case_curves_are_of_the_filters_that_have_a_gamma(aligned):
    picture = curves.worst_case(aligned)
    (axes,) = picture.figure.axes
    assert not lines_of(axes, style.colour(0))
    for i, gamma in ((1, 2.0), (2, 4.0)):
        ((_, y),) = lines_of(axes, style.colour(i))
        np.testing.assert_allclose(y, np.linspace(1.9, 0.5, 40) / gamma)
    picture.figure.canvas.draw()
    assert not collisions(picture.figure)
    assert curves.worst_case(aligned.drop_vars("note_h_infinity_gamma")) is not None
    plain = aligned.drop_vars([n for n in aligned if str(n).startswith("note_")])
    assert curves.worst_case(plain) is None


def test_bounds_are_never_called_covariances(aligned):
    picture = curves.campaign(aligned, "attitude")
    assert "hinf-deg, adaptive-hinf" in picture.caption
    assert "a bound, not a covariance" in picture.caption
    (legend,) = picture.figure.legends
    assert any("a bound, not a covariance" in t.get_text() for t in legend.texts)
    picture.figure.canvas.draw()
    assert not collisions(picture.figure)
    honest = aligned.assign(bounds=aligned["bounds"] * 0)
    assert "bound" not in curves.campaign(honest, "attitude").caption


def test_a_filter_that_diverged_or_states_far_too_much_does_not_set_the_scale(aligned):
    lost = aligned.copy(deep=True)
    lost["rms_attitude"][1] = np.inf
    lost["mean_sigma_attitude"][2] *= 1e3
    for axes in curves.campaign(lost, "attitude").figure.axes:
        most = np.rad2deg(60.0 * lost["rms_attitude"].values[[0, 2]].max())
        assert axes.get_ylim()[1] <= 1.3 * most


def test_the_band_is_that_of_the_filter_with_a_covariance(aligned):
    band = updates.band(aligned["anees"], aligned["anees_dof"])
    np.testing.assert_allclose(band.low[0], updates.quantile(0.025, 450.0) / 450.0)
    picture = updates.consistency(aligned, "anees")
    assert "hinf" not in picture.figure.axes[0].get_title(loc="left")
    assert picture.figure.axes[0].collections
    flipped = aligned.isel(filter=[1, 0, 2])
    assert updates.consistency(flipped, "anees").figure.axes[0].collections


def test_all_are_on_the_page(aligned):
    summary = {"filters": {n: {} for n in NAMES}, "claims": [], "counts": {}}
    names = [p.name for p in report.pictures(aligned, summary)]
    assert {"within_5_arcmin", "worst_case", "rms_attitude", "anees"} <= set(names)
