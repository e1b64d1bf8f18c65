"""The covariance bound beside filters, and the figures and tables of `robins bound`."""

import numpy as np
import pytest
import xarray as xr
from example_results import a_drive
from figure_reading import collisions, lines_of
from rich.console import Console

from robins import report
from robins.report import bounds, curves, style
from robins.results import array, variable

TIME = np.arange(1.0, 101.0)
AXES = ["north", "east"]
SENSORS = ["gnss", "barometer"]


@pytest.fixture(scope="module")
def told():
    """North is seen, best by GNSS; east is not seen, and runs away."""
    north, east = 8.0 / np.sqrt(1.0 + TIME), 8.0 + TIME
    every = np.stack([north, east], axis=1)
    unaided = np.stack([8.0 + 0.0 * TIME, 8.0 + 1.01 * TIME], axis=1)
    without = np.stack([0.9 * unaided, every])
    metres = {"unit": "m", "frame": "NED", "axes": AXES, "display_unit": "km"}
    return xr.Dataset(
        array("bound", every, "position", **metres)
        | array("bound_prior", [8.0, 8.0], "position", **metres)
        | array("bound_unaided", unaided, "position", **metres)
        | array("bound_without", without, "position", **metres)
        | array("bound_left", [0.1, 1.0], "position", frame="NED")
        | array("information", [np.log2(1.0 + TIME) / 2.0, 0.0 * TIME])
        | array("gramian", [1e-12, 100.0], nothing=1e-6)
        | array("gramian_rank", 1),
        {
            "time": variable("time", TIME, "s", "time since the start"),
            "sensor": SENSORS,
            "state": ["position north", "position east"],
            "direction": ["1: 100 % position east", "2: 100 % position north"],
        },
    )


def test_the_figure_shows_the_bound_and_what_each_sensor_buys(told):
    figure = bounds.sigmas(told, "position").figure
    figure.draw_without_rendering()
    north, east = figure.axes
    ((x, y),) = lines_of(north, style.colour(0))
    np.testing.assert_allclose(x, TIME)
    np.testing.assert_allclose(y, 8e-3 / np.sqrt(1.0 + TIME))  # km
    ((_, y),) = lines_of(north, style.colour(1))
    np.testing.assert_allclose(y, 0.0072)
    ((_, y),) = lines_of(east, style.GREY)
    np.testing.assert_allclose(y, (8.0 + 1.01 * TIME) / 1e3)
    assert north.get_yscale() == "log"
    assert not collisions(figure)


def test_what_runs_away_does_not_set_the_scale(told):
    away = told.copy(deep=True)
    away["bound_unaided_position"].values *= np.exp(TIME)[:, None]
    (north, _) = bounds.sigmas(away, "position").figure.axes
    low, high = north.get_ylim()
    assert low < 8e-3 / np.sqrt(101.0)
    assert 0.0072 < high < 1.0  # the line ends at 1e41


def test_the_map_shows_the_bits(told):
    figure = bounds.information(told).figure
    figure.draw_without_rendering()
    (mesh,) = figure.axes[0].collections
    shown = np.asarray(mesh.get_array()).reshape(2, -1)
    np.testing.assert_allclose(shown, told["information"].values)
    assert [t.get_text() for t in figure.axes[0].get_yticklabels()] == list(told.state.values)
    assert not collisions(figure)


def test_a_page_holds_these_figures_and_no_other(told):
    names = [picture.name for picture in report.pictures(told, {"filters": {}})]
    assert names == ["bound_position", "information"]


def test_rows_tell_what_is_seen_and_what_it_is_worth(told):
    north, east = bounds.rows(told, bounds.epochs(told, [25.0, 100.0]))
    assert (north.state, north.unit, north.verdict) == ("position north", "km", "seen")
    np.testing.assert_allclose(north.sigma, [8e-3 / np.sqrt(26.0), 8e-3 / np.sqrt(101.0)])
    assert north.left == pytest.approx(1.0 / np.sqrt(101.0))
    np.testing.assert_allclose(north.without, [0.0072, 8e-3 / np.sqrt(101.0)])
    assert (east.verdict, east.unaided) == ("not seen", pytest.approx(0.109))


@pytest.mark.parametrize(
    ("sigma", "start", "unaided", "verdict"),
    [
        (0.5, 0.5, 1.0, "seen"),
        (0.5, np.nan, 1.0, "seen"),  # nothing at the start to learn of
        (0.5, 0.51, 1.0, "hardly seen"),
        (0.6, 0.1, 1.0, "hardly seen"),
        (0.1, 0.96, 1.0, "not seen"),  # held, but where it began stays unknown
        (1.0, 0.1, 1.0, "not seen"),
        (0.0, np.nan, 0.0, "known"),
    ],
)
def test_a_verdict_takes_the_start_and_the_end(sigma, start, unaided, verdict):
    assert bounds.BoundRow("x", "m", 1.0, [sigma], unaided, [], start).verdict == verdict


def test_the_table_and_its_sentences(told):
    console = Console(width=160, color_system=None)
    with console.capture() as capture:
        console.print(bounds.table(told, bounds.epochs(told)))
    text = capture.get()
    for expected in ("without GNSS", "hardly", "25 s", "26 s", "100 s", "no sensor", "9.95 %"):
        assert (expected in text) == (expected not in ("hardly", "25 s"))
    rank, *directions = bounds.sentences(told)
    assert "has rank 1 of 2" in rank
    assert directions == [
        "1: 100 % position east: not seen",
        "2: 100 % position north: the measurements weigh 100 times the prior",
    ]


def test_the_worth_of_an_only_sensor_is_that_of_all(told):
    one = told.isel(sensor=[0])
    assert bounds.sensors(one) == []
    assert [row.without for row in bounds.rows(one, [99])] == [[], []]
    assert not lines_of(bounds.sigmas(one, "position").figure.axes[0], style.colour(1))


def test_metrics_and_columns(told):
    assert bounds.metrics(told) == {"position_bound_km": pytest.approx([8e-3 / 101**0.5, 0.108])}
    head, *rows = bounds.csv(told).splitlines()
    assert head.startswith("time_s,bound position north [m],bound position east [m],unaided")
    assert "without_barometer position east [m]" in head
    assert len(rows) == 100
    np.testing.assert_allclose([float(v) for v in rows[-1].split(",")][:3], [100, 0.796, 108], 1e-3)


def test_a_time_outside_the_run_is_refused(told):
    assert bounds.epochs(told, [30.2, 10.0]) == [9, 29]
    with pytest.raises(ValueError, match="200 s is not within the run, 1 s to 100 s"):
        bounds.epochs(told, [200.0])


# ------------------------------------------------------------------------------ beside filters


@pytest.mark.parametrize(("runs", "draw", "signs"), [(20, "campaign", [1]), (0, "errors", [3, -3])])
def test_the_bound_is_drawn_beside_the_filters(runs, draw, signs):
    ds = a_drive(runs=runs)
    count = ds.sizes["time"]
    best = np.linspace(0.4, 0.2, count)[:, None] * np.ones(3)
    plain = getattr(curves, draw)(ds, "attitude").figure
    shown = {"unit": "rad", "frame": "NED", "display_unit": "deg"}
    ds = ds.assign(array("bound", np.radians(best), "attitude", **shown))
    figure = getattr(curves, draw)(ds, "attitude").figure
    labels = [t.get_text() for t in figure.legends[0].texts]
    assert sum("covariance bound" in label for label in labels) == 1
    assert not any("covariance bound" in t.get_text() for t in plain.legends[0].texts)
    figure.draw_without_rendering()
    assert not collisions(figure)
    for axes in figure.axes:
        drawn = [line for line in axes.lines if line.get_color() == style.TRUTH]
        for line, sign in zip(drawn, signs, strict=True):
            x, y = line.get_xdata(), line.get_ydata()
            np.testing.assert_allclose([y[0], y[-1]], [0.4 * sign, 0.2 * sign])
            assert len(x) > 2
