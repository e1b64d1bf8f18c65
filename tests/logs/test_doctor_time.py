"""The doctor on time: each fault put into healthy stamps is found, named and mended."""

import dataclasses

import numpy as np
import pytest
from made_logs import GNSS_HZ, IMU_HZ, START_NS, TOTAL_S, found, rows_of, the

from robins.dataset import Trajectory
from robins.logs import examine

S = 1_000_000_000
N, M = round(TOTAL_S * IMU_HZ) + 1, round(TOTAL_S * GNSS_HZ) + 1


def shifted(table, rows, ns):
    time_ns = table.time_ns.copy()
    time_ns[rows] += ns
    return dataclasses.replace(table, time_ns=time_ns)


def without(table, first, count):
    keep = np.ones(len(table), bool)
    keep[first : first + count] = False
    return rows_of(table, keep)


# ------------------------------------------------------------------------------------- units


@pytest.mark.parametrize(("unit", "factor"), [("milliseconds", 1000), ("microseconds", 1_000_000)])
@pytest.mark.parametrize("name", ["imu", "gnss"])
def test_time_in_another_unit(drive, name, unit, factor):
    table = getattr(drive, name)
    f = the(dataclasses.replace(table, time_ns=(table.time_ns - START_NS) * factor), "time_unit")
    assert f.severity == "error"
    assert f"if the time column is in {unit}" in f.sentence


def test_time_too_fine(drive):
    table = dataclasses.replace(drive.imu, time_ns=(drive.imu.time_ns - START_NS) // 1000)
    assert "in another unit than seconds" in the(table, "time_unit").sentence


def test_time_that_stands(drive):
    assert "time_stands" in found(dataclasses.replace(drive.imu, time_ns=0 * drive.imu.time_ns))


def test_a_table_too_short(drive):
    assert "too_short" in found(rows_of(drive.imu, slice(0, 1)), "error")


# ------------------------------------------------------------------------------------- order


def test_duplicates(drive):
    f = the(shifted(drive.imu, [100, 200], -10_000_000), "time_duplicate")
    assert (f.severity, f.where, f.value) == ("warning", "line 102", 2)
    twice = rows_of(drive.imu, np.repeat(np.arange(N), 2))
    assert "writes faster than the sensor" in the(twice, "time_duplicate").sentence


@pytest.mark.parametrize("back", [15_000_000, S, 3600 * S])
def test_single_samples_that_go_back(drive, back):
    f = the(shifted(drive.imu, [500, 900], -back), "time_backward")
    assert (f.severity, f.where, f.value) == ("warning", "line 502", 2)


@pytest.mark.parametrize(
    ("back_s", "cause"),
    [
        (1.0, "This is a leap second"),
        (7200.0, "a change of time zone"),
        (86_400.0, "at midnight"),
        (604_800.0, "the second of the GPS week"),
        (1024 * 604_800.0, "the GPS week, which begins again after 1024 weeks"),
        (2**16 * 1e-3, "a 16-bit counter of milliseconds"),
        (2**32 * 1e-6, "a 32-bit counter of microseconds"),
        (2**32 * 1e-3, "a 32-bit counter of milliseconds"),
        (31.4, "The clock was set, or the logger restarted"),
    ],
)
def test_a_clock_set_back(drive, back_s, cause):
    spoilt = shifted(drive.imu, slice(5000, None), -round(back_s * 1e9))
    f = the(spoilt, "clock_set_back")
    assert (f.severity, f.where) == ("error", "line 5002")
    assert cause in f.sentence


@pytest.mark.parametrize(
    ("ahead_s", "severity", "cause"),
    [(1.0, "warning", "a leap second"), (18.0, "error", "18 leap"), (3600.0, "error", "zone")],
)
def test_a_clock_set_ahead_is_a_jump_not_a_gap(drive, ahead_s, severity, cause):
    moved = shifted(drive.imu, slice(5000, None), round(ahead_s * 1e9))
    f = the(moved, "time_jump")
    assert (f.severity, f.where) == (severity, "line 5002")
    assert cause in f.sentence
    assert not {"gap_long", "gap_short"} & set(found(moved))


# -------------------------------------------------------------------------------------- gaps


@pytest.mark.parametrize(
    ("lost", "severity", "code"),
    [(3, "note", "gap_short"), (50, "warning", "gap_short"), (1234, "warning", "gap_long")],
)
def test_gaps(drive, lost, severity, code):
    f = the(without(drive.imu, 5000, lost), code)
    assert (f.severity, f.where) == (severity, f"line {5000 + lost + 2}")
    assert f.value == pytest.approx((lost + 1) * 0.01)


def test_several_gaps_are_one_finding(drive):
    f = the(without(without(drive.imu, 6000, 40), 5000, 20), "gap_short")
    assert "(2 gaps, 0.62 s in all, the first at line 5001)" in f.sentence


def test_a_gnss_outage_is_noted(drive):
    assert the(without(drive.gnss, 200, 40), "gap_long").severity == "note"


def test_jitter(drive):
    noise = np.random.default_rng(0).integers(-3_000_000, 3_000_000, N)
    f = the(shifted(drive.imu, slice(None), noise), "time_jitter")
    assert f.severity == "note"
    assert "100 Hz" in f.sentence


# --------------------------------------------------------------------------- two time bases


def two(drive, imu_ns=None, gnss_ns=None):
    """IMU at rest, so that motion has no say, and GNSS with other stamps."""
    tables = []
    for table, time_ns in ((drive.imu, imu_ns), (drive.gnss, gnss_ns)):
        rest = rows_of(table, slice(0, len(table) // 8))
        time_ns = table.time_ns if time_ns is None else time_ns
        tables.append(dataclasses.replace(rest, time_ns=time_ns[: len(rest)]))
    return tables


WEEK = START_NS // S - (START_NS // S - 315_964_800) % 604_800


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (-WEEK, f"if GPS week 2288 ({WEEK} s) is added to the IMU's"),
        (-315_964_800, "counted from 1970, the IMU's from 1980"),
        (18, "in UTC, the IMU's in GPS time, 18 s ahead: they fit if +18 s is added"),
        (2 * 3600, "They fit if +2 h is added: one clock is in local time"),
        (-777_777, "No usual offset explains it"),
    ],
)
def test_no_overlap(drive, seconds, words):
    f = the(two(drive, imu_ns=drive.imu.time_ns + seconds * S), "no_overlap")
    assert f.severity == "error"
    assert words in f.sentence


def test_the_gnss_file_in_seconds_of_the_week(drive):
    f = the(two(drive, gnss_ns=drive.gnss.time_ns - WEEK * S), "no_overlap")
    assert "Its times are seconds of the GPS week" in f.sentence
    assert f"they fit if GPS week 2288 ({WEEK} s) is added." in f.sentence


def test_no_overlap_by_a_unit(drive):
    since = drive.imu.time_ns - START_NS + 20 * S
    f = the(two(drive, since * 1000, drive.gnss.time_ns - START_NS + 20 * S), "no_overlap")
    assert "They fit if the IMU's times are milliseconds" in f.sentence


def test_little_overlap(drive):
    f = the(two(drive, drive.imu.time_ns + 7 * S), "little_overlap")
    assert (f.severity, f.value) == ("warning", pytest.approx(2.7, abs=0.3))


def test_eighteen_seconds_at_both_ends(drive):
    late = dataclasses.replace(
        drive.gnss, time_ns=drive.gnss.time_ns + 18 * S, v_n=None, sigma_v=None
    )
    (f,) = [
        f for f in examine([drive.imu, late]) if "at both" in f.sentence or "begins" in f.sentence
    ]
    assert (f.severity, f.code, f.value) == ("warning", "leap_seconds", pytest.approx(18.0))


def test_truth_is_looked_at_too(drive):
    g = drive.gnss
    q = np.tile([1.0, 0, 0, 0], (M, 1))
    truth = Trajectory(g.time_ns - 10**15, g.lat_rad, g.lon_rad, g.alt_m, 0 * g.sigma_m, q)
    assert found([rows_of(drive.imu, slice(0, 1000)), truth]) == ["no_overlap"]
