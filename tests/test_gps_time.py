"""Leap seconds, against the dates at which they came."""

import datetime

import numpy as np
import pytest

from robins.gps_time import GPS_EPOCH_S, dated, gps_of, leap_seconds, utc_of
from robins.logs.timebase import calendar_to_ns

NS = 1_000_000_000


@pytest.mark.parametrize(
    ("date", "clock", "behind"),
    [
        ("1980/1/6", "00:00:00", 0),
        ("1981/6/30", "23:59:59", 0),
        ("1981/7/1", "00:00:00", 1),
        ("1999/1/1", "00:00:00", 13),
        ("2016/12/31", "23:59:59.5", 17),
        ("2017/1/1", "00:00:00", 18),
        ("2025/8/28", "17:30:39.749", 18),
    ],
)
def test_utc_of_a_stamp_is_the_clock_it_was_read_from(date, clock, behind):
    stamp = calendar_to_ns(date, clock, utc=True)
    assert stamp - calendar_to_ns(date, clock) == behind * NS
    year, month, day = map(int, date.split("/"))
    assert leap_seconds(datetime.date(year, month, day)) == behind
    (found,) = utc_of(np.array([stamp]))
    assert found == np.datetime64(f"{year}-{month:02d}-{day:02d}T{clock}")
    assert dated(stamp)
    one = utc_of(np.asarray(stamp))
    assert isinstance(one, np.ndarray)
    assert one == found
    assert gps_of(one.astype(np.int64)) == stamp


def test_a_leap_second_is_shown_as_the_second_after_it():
    before = calendar_to_ns("2016/12/31", "23:59:59", utc=True)
    shown = utc_of(before + NS * np.arange(4)).astype("datetime64[s]").astype(str)
    assert shown.tolist() == [
        "2016-12-31T23:59:59",
        *("2017-01-01T00:00:00", "2017-01-01T00:00:00"),
        "2017-01-01T00:00:01",
    ]


def test_stamps_before_gps_have_no_date():
    assert not dated(GPS_EPOCH_S * NS - 1)
    assert dated(GPS_EPOCH_S * NS)
