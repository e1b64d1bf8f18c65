import datetime
from decimal import Decimal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robins.logs.findings import LogError
from robins.logs.timebase import (
    calendar_to_ns,
    decimals_to_ns,
    ns_to_decimal,
    stamps_to_ns,
    week_to_ns,
)


def read(*texts, exponent=9):
    return decimals_to_ns(np.array([t.encode() for t in texts], "S40"), exponent)


@given(st.lists(st.tuples(st.integers(0, 9_223_372_035), st.text("0123456789", max_size=9))))
def test_seconds_are_exact_to_the_nanosecond(parts):
    texts = [f"{whole}.{decimals}" if decimals else str(whole) for whole, decimals in parts]
    ns, good = read(*texts)
    assert good.all()
    assert ns.tolist() == [int(Decimal(t) * 10**9) for t in texts]


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        (" 12.5 ", 12_500_000_000),
        ("-0.000000001", -1),
        ("+3", 3_000_000_000),
        (".25", 250_000_000),
        ("7.", 7_000_000_000),
        ("1.5e3", 1_500_000_000_000),
        ("0.0000000004", 0),
        ("0.0000000005", 1),
        ("1.99999999999", 2_000_000_000),
        ("000000000000000000000001", 1_000_000_000),
        ("9223372036.854775807", 2**63 - 1),
    ],
)
def test_other_ways_to_write_seconds(text, ns):
    assert read(text)[0].tolist() == [ns]
    assert read(text)[1].all()


@pytest.mark.parametrize(
    "text",
    [
        *("", " ", ".", "-", "1.2.3", "1,5", "nan", "inf", "0x10", "1_0", "12:00", "1 2"),
        *("1e999999999", "9223372036.854775808", "1403636579758555392"),
    ],
)
def test_what_is_no_time_in_seconds_is_marked_and_others_are_still_read(text):
    ns, good = read("1.5", text, "2.5")
    assert good.tolist() == [True, False, True]
    assert ns[[0, 2]].tolist() == [1_500_000_000, 2_500_000_000]


def test_nanoseconds_of_euroc_are_exact_and_no_stamps_are_none():
    ns, good = read("1403636579758555392", "1403636579763555584", exponent=0)
    assert (ns.tolist(), good.all()) == ([1403636579758555392, 1403636579763555584], True)
    assert [len(found) for found in decimals_to_ns(np.zeros(0, "S40"))] == [0, 0]


@given(st.integers(-(2**63), 2**63 - 1))
def test_writing_and_reading_are_inverse(ns):
    text = ns_to_decimal(ns)
    assert Decimal(text) * 10**9 == ns
    back, good = read(text)
    assert good.all()
    assert back[0] == ns


def test_a_time_in_ns_read_as_seconds_is_named():
    rows = np.array([7, 8])
    with pytest.raises(LogError, match=r"log.csv line 8: time = '17564022409.*ns, us or ms.*secon"):
        stamps_to_ns("log.csv", "time", np.array([b"1.0", b"1756402240961000000"]), rows)
    with pytest.raises(LogError, match=r"line 8: time = 'noon': is not a time stamp; repair"):
        stamps_to_ns("log.csv", "time", np.array([b"1.0", b"noon"]), rows)


@given(st.datetimes(datetime.datetime(1980, 1, 6), datetime.datetime(2099, 1, 1)))
def test_calendar_against_datetime(when):
    since = when - datetime.datetime(1970, 1, 1)
    ns = (since.days * 86400 + since.seconds) * 10**9 + since.microseconds * 1000
    assert calendar_to_ns(f"{when:%Y/%m/%d}", f"{when:%H:%M:%S.%f}") == ns


def test_utc_gets_the_leap_seconds_of_its_day():
    def leap(date):
        return (calendar_to_ns(date, "0:0:0", utc=True) - calendar_to_ns(date, "0:0:0")) / 1e9

    dates = ["1980/01/06", "1981/07/01", "1999/01/01", "2016/12/31", "2017/01/01", "2025/08/28"]
    assert [leap(d) for d in dates] == [0, 1, 13, 17, 18, 18]


@pytest.mark.parametrize(
    ("date", "clock"),
    [
        ("2025/13/01", "0:0:0"),
        ("28.8.2025", "0:0:0"),
        *(("2025/08/28", c) for c in ("24:0:0", "0:60:0", "0:0:61", "0:0", "0:0:-1", "0:0:nan")),
    ],
)
def test_no_date_or_time(date, clock):
    with pytest.raises(ValueError, match=r"is not year|is no time|month must be"):
        calendar_to_ns(date, clock)


def test_week_and_time_of_week_agree_with_the_calendar():
    # 2025-08-28 is a Thursday: day 4 of GPS week 2381.
    tow = 4 * 86400 + 17 * 3600 + 30 * 60 + 39
    ns = week_to_ns(np.array([2381]), np.array([tow * 10**9 + 749_000_000]))
    assert ns[0] == calendar_to_ns("2025/08/28", "17:30:39.749")
