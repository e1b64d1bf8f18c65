"""Numbers and stamps that no vehicle has: the doctor finds them, `clean` refuses them."""

import dataclasses

import numpy as np
import pytest
from log_samples import PHONE, RTKLIB
from made_nine_axis import tumble_dataset
from made_spoilt import a_path, put

from robins.logs import LogError, clean, examine, open_log


def spoilt(data, table, column, row, value):
    old = getattr(data, table)
    new = dataclasses.replace(old, **{column: put(row, value)(getattr(old, column))})
    return dataclasses.replace(data, **{table: new})


PLACES = [
    *(("imu", column) for column in ("gyro", "accel")),
    *(("gnss", column) for column in ("lat_rad", "lon_rad", "sigma_m", "sigma_v")),
    *(("truth", column) for column in ("lat_rad", "lon_rad", "alt_m", "v_n", "q_nb")),
]


@pytest.mark.parametrize("value", [1e308, -1e308])
def test_absurd_numbers_are_found_and_refused_in_every_table(drive, value):
    path = a_path()
    data = dataclasses.replace(drive, truth=path)
    assert examine(data) == []
    places = [place for place in PLACES if value > 0.0 or "sigma" not in place[1]]
    for k, (table, column) in enumerate(places):
        data = spoilt(data, table, column, 100 + k, value)
    told = examine(data)
    assert {f.code for f in told} == {"absurd"}
    assert {f.severity for f in told} == {"warning"}
    assert {f.value for f in told} == {1}
    said = {f.sentence.split(": ")[1].split(" here")[0] for f in told}
    assert said == {f"{column} is {value:g}" for _, column in places}
    counts = clean(data).counts
    for table in ("imu", "gnss", "truth"):
        assert counts[f"{table}_absurd"] == sum(t == table for t, _ in places)


def test_an_absurd_field_is_found_and_becomes_missing():
    tumble = tumble_dataset(10.0)
    data = spoilt(tumble, "mag", "field_t", (300, 1), 1e308)
    new = set(examine(data)) - set(examine(tumble))
    (told,) = new
    assert told.code == "absurd"
    assert "field_t is 1e+308 here" in told.sentence
    assert np.flatnonzero(np.isnan(clean(data).mag.field_t).any(axis=1)).tolist() == [300]


@pytest.mark.parametrize("value", [1e308, np.inf, 5e-324])
@pytest.mark.parametrize("rows", [slice(None), slice(400), slice(5)])
def test_no_number_is_too_much_for_the_doctor(value, rows):
    log = tumble_dataset(4.0)
    for table, column in (("imu", "gyro"), ("imu", "accel"), ("mag", "field_t")):
        assert examine(spoilt(log, table, column, rows, value))


def test_sigmas_without_measure_are_not_squared(drive):
    sigma_v = np.full_like(drive.gnss.sigma_v, 1e160)
    gnss = dataclasses.replace(drive.gnss, sigma_v=sigma_v)
    examine(dataclasses.replace(drive, gnss=gnss))
    assert not np.isfinite(clean(dataclasses.replace(drive, gnss=gnss)).gnss.v_n).any()


def test_an_infinite_place_in_a_path_is_found():
    path = a_path()
    told = examine(dataclasses.replace(path, lat_rad=put(7, np.inf)(path.lat_rad)))
    assert [(f.code, f.value) for f in told] == [("absurd", 1)]


# ------------------------------------------------------------------------------------- stamps


@pytest.mark.parametrize("time_ns", [2**62, -(2**62), 2**63 - 1, -(2**63)])
@pytest.mark.parametrize("judge", [examine, clean])
def test_a_stamp_of_another_century_is_refused_with_its_row(drive, time_ns, judge):
    data = spoilt(dataclasses.replace(drive, gnss=None), "imu", "time_ns", 50, time_ns)
    line = drive.imu.rows[50]
    with pytest.raises(LogError, match=f"line {line}: time_ns = {time_ns}: is 146 years or more"):
        judge(data)


@pytest.mark.parametrize(
    ("text", "old", "new", "field"),
    [
        (PHONE, "2025-", "6025-", "time"),
        (RTKLIB, "2025/", "6025/", "time"),
        (RTKLIB.replace("2025/08/28 17:30:39.749", "2381 408639.749"), "2381 ", "99381 ", "week"),
    ],
)
def test_a_year_changed_by_one_bit_is_refused_with_line_and_field(tmp_path, text, old, new, field):
    path = tmp_path / "log"
    first, row, *_ = text.splitlines(True)
    path.write_text(first + row + row.replace(old, new) + row)
    with pytest.raises(LogError, match=f"line 3: {field} = .*{new[:4]}.*: is no"):
        open_log(path, None, [])
