"""Numbers and names as people read them."""

import math

import pytest
from rich.console import Console

from robins import report
from robins.report import numbers


@pytest.mark.parametrize(
    ("metric", "text", "unit"),
    [
        ("horizontal_rms_m", "Horizontal RMS", "m"),
        ("attitude_rms_arcmin", "Attitude RMS", "arcmin"),
        ("velocity_rms_m_per_s", "Velocity RMS", "m/s"),
        ("velocity_rms_mps", "Velocity RMS", "m/s"),
        ("p_rms_deg_s", "P RMS", "deg/s"),
        ("gyro_bias_rms_deg_per_h", "Gyro bias RMS", "deg/h"),
        ("angle_random_walk_deg_per_sqrt_h", "Angle random walk", "deg/√h"),
        ("rate_random_walk_deg_per_h_per_sqrt_h", "Rate random walk", "deg/h/√h"),
        ("noise_density_ug_per_sqrt_hz", "Noise density", "µg/√Hz"),
        ("peak_m_per_s2", "Peak", "m/s²"),
        ("nis_inside_percent", "NIS inside", "%"),
        ("anees", "ANEES", ""),
        ("share_below_5_arcmin", "Share below 5 arcmin", ""),
        ("settled_share_5_arcmin", "Settled share 5 arcmin", ""),
        ("euler", "Euler angles", ""),
        ("accel_bias_rms_mg", "Accelerometer bias RMS", "mg"),
        ("step_us", "Step", "µs"),
        ("cycles_per_s", "Cycles", "1/s"),
        ("updates", "Updates", ""),
        ("m", "M", ""),
    ],
)
def test_a_metric_is_told_in_words_and_unit(metric, text, unit):
    assert numbers.label(metric) == (text, unit)
    assert str(numbers.label(metric)) == (f"{text} [{unit}]" if unit else text)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0213, "0.0213"),
        (0.021349, "0.02135"),
        (1.0, "1"),
        (100.0, "100"),
        (12345.678, "12346"),
        (99999.4, "99999"),
        (123456.0, "1.235e5"),
        (-0.0005, "-5e-4"),
        (1.5e-12, "1.5e-12"),
        (0.0, "0"),
        (math.nan, "–"),
        (math.inf, "–"),
        (None, "–"),
        (7, "7"),
        (1234567, "1\u2009234\u2009567"),
        (True, "yes"),
        ([1.0, None, 0.25], "1, –, 0.25"),
        ([1.0, 2.0, 3.0, 4.0], "1, 2, 3, 4"),
        ([1.0, 2.0, None, 0.5, 4.0], "0.5 to 4 (5 values)"),
        ([[0.5, 2.0], [0.25, None]], "0.25 to 2 (2 values)"),
        ([None] * 5, "5 values"),
        ([], ""),
        ({"a": 0.5}, "a 0.5"),
        ("text", "text"),
    ],
)
def test_a_number_is_shown_to_four_digits(value, text):
    assert numbers.show(value) == text


@pytest.mark.parametrize("value", [3.14159, 0.0012345, 87654.3, 2.5e-7, -41.7, 1e22, 0.99996])
def test_what_is_shown_is_the_number_to_its_last_digit(value):
    assert float(numbers.show(value)) == pytest.approx(value, rel=5.1e-4)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ([0.95, 1.05], "0.95 to 1.05"),
        ([None, 0.29], "at most 0.29"),
        ([0.9, None], "at least 0.9"),
        ([None, None], "–"),
        (None, "–"),
        (2.0, "2"),
        ("see text", "see text"),
    ],
)
def test_a_band_is_a_range(value, text):
    assert numbers.band(value) == text


@pytest.mark.parametrize(
    ("verdicts", "text"),
    [
        ([], "No claims are attached to this scenario."),
        (["reproduced"], "1 of 1 claim reproduced."),
        (["reproduced", "partly", "not", "not"], "1 of 4 claims reproduced, 1 partly, 2 not."),
    ],
)
def test_the_verdict_counts_the_claims(verdicts, text):
    assert report.verdict([{"verdict": v} for v in verdicts]) == text


@pytest.mark.parametrize(
    ("value", "band", "shown"),
    [
        (1.0, [0.9, 1.1], "1"),
        (1.2, [0.9, 1.1], "1.2 !"),
        (0.8, [0.9, 1.1], "0.8 !"),
        (0.8, [None, 1.1], "0.8"),
        (1.2, [None, 1.1], "1.2 !"),
        (None, [0.9, 1.1], "–"),
        (1.2, None, "1.2"),
    ],
)
def test_a_number_outside_its_own_band_is_marked(value, band, shown):
    assert numbers.marked({"nis_x": value, "nis_x_band": band}, "nis_x") == shown


def test_the_verdict_on_a_replay_stands_above_its_numbers(town):
    said = "With care: ekf, position NIS 1.3."
    changed = {"ekf": {"nis_x": 1.3, "nis_x_band": [0.9, 1.1]}}
    text = plain(town | {"verdict": said, "filters": changed})
    assert text.startswith(said)
    assert "1.3 !" in text
    assert "! outside its band" in text


def plain(summary, width=100):
    """The tables of a terminal as plain text."""
    console = Console(width=width, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(report.table(summary, width))
    return capture.get()


def test_the_table_of_a_terminal_holds_every_metric_claim_and_refusal(town):
    text = plain(town)
    for expected in (
        *("Horizontal RMS [m]", "0.0213", "kalman", "robust", "reproduced"),
        *("Smoothed error in 15 s outages", "at most 0.29", "1 of 2 claims reproduced, 1 partly."),
        *("IMU duplicate time 2", "GNSS not finite 14"),
    ):
        assert expected in " ".join(text.split())


def test_markup_in_names_is_printed_as_it_is(town):
    text = plain(town | {"filters": {"[red]x": {"a[/]b_m": 1.0}}})
    assert "[red]x" in text
    assert "A[/]b [m]" in text


def test_an_empty_summary_prints_nothing(town):
    assert plain(town | {"filters": {}, "claims": [], "counts": {}}) == ""


def test_filters_without_room_come_in_tables_of_their_own(town):
    filters = {f"filter-{i}": {"a_m": 1.0, **({"b_m": 2.0} if i > 6 else {})} for i in range(9)}
    text = plain(town | {"filters": filters, "claims": [], "counts": {}}, 60)
    assert max(map(len, text.splitlines())) <= 60
    heads = [line.split()[1:] for line in text.splitlines() if line.startswith("metric")]
    assert len(heads) > 1
    assert [name for head in heads for name in head] == list(filters)
    # a metric that none of a group has takes no row there
    assert sum(line.startswith("B") for line in text.splitlines()) == 1
