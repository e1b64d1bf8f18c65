"""Every figure can be read: units on its axes, nothing covered, colours that differ."""

import itertools
import re

import matplotlib
import numpy as np
import pytest
from example_results import a_drive, a_summary, an_allan_curve
from figure_reading import collisions, visible_texts

from robins import report
from robins.report import style


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


def test_no_text_covers_another_or_leaves_the_figure(drawn):
    for shot in drawn:
        assert len(visible_texts(shot.picture.figure)) > 5
        assert collisions(shot.picture.figure) == [], shot.picture.name


def test_planted_collisions_are_found():
    figure, grid = style.new_figure(1, 1)
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
