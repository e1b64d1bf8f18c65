"""A solution as a table: every number under a name that tells its unit."""

import numpy as np
import pandas as pd
import pytest
from example_folder import a_solution, a_summary, write
from small_replay import ALT_M, GAP, LAT_RAD, NAMES, TIME_S, a_replay, attitudes

from robins.results import ResultError, clocks, read, to_dataframe

LAST = len(TIME_S) - 1


def test_columns_tell_array_component_and_unit():
    table = to_dataframe(a_replay(), "ekf")
    assert list(table.columns) == [
        *("utc", "lat_deg", "lon_deg", "alt_m", "q_nb_w", "q_nb_x", "q_nb_y", "q_nb_z"),
        *(f"estimate_velocity_{axis}_m_per_s" for axis in ("north", "east", "down")),
        *(f"estimate_gyro_bias_{axis}_deg_per_h" for axis in "xyz"),
        *(f"estimate_euler_{angle}_deg" for angle in ("roll", "pitch", "heading")),
    ]
    assert table.index.name == "time_s"
    np.testing.assert_array_equal(table.index, TIME_S)
    last = table.iloc[LAST]
    assert last["lat_deg"] == pytest.approx(np.degrees(LAT_RAD[0, LAST]), rel=1e-15)
    assert last["alt_m"] == ALT_M[0, LAST]
    assert last["estimate_velocity_down_m_per_s"] == 3.0 * LAST + 2.0
    assert last["estimate_gyro_bias_z_deg_per_h"] == pytest.approx(1.0)
    assert table.iloc[GAP][["lat_deg", "q_nb_w", "estimate_euler_roll_deg"]].isna().all()


def test_si_is_si():
    table = to_dataframe(a_replay(), "ekf", si=True)
    assert table["lat_rad"].iloc[LAST] == LAT_RAD[0, LAST]
    assert table["estimate_gyro_bias_z_rad_per_s"].iloc[0] == np.radians(1.0) / 3600.0


def test_angles_are_those_of_the_quaternion():
    table = to_dataframe(a_replay(clock="sample_time"), "ekf+rts", "sample_time")
    heading, pitch, roll = attitudes()[1].as_euler("ZYX", degrees=True).T
    for name, angle in (("roll", roll), ("pitch", pitch), ("heading", heading)):
        found = table[f"estimate_euler_{name}_deg"].drop(index=TIME_S[GAP])
        np.testing.assert_allclose(found, np.delete(angle, GAP), atol=1e-9)


def test_all_filters_are_one_below_the_other():
    table = to_dataframe(a_replay())
    assert table.index.names == ["filter", "time_s"]
    for name in NAMES:
        pd.testing.assert_frame_equal(table.loc[name], to_dataframe(a_replay(), name))


def test_dates_are_utc_to_the_nanosecond():
    table = to_dataframe(a_replay(), "ekf")
    # 17:30:19 UTC is 17:30:37 GPS time
    assert table["utc"].iloc[0] == pd.Timestamp("2025-08-28 17:30:19.373456789", tz="UTC")
    assert "utc" not in to_dataframe(a_replay(dated=False))


def test_every_sensor_has_a_clock_and_components_may_have_units_of_their_own():
    solution = a_replay()
    assert clocks(solution) == ["time", "mag_time", "gnss_time"]
    table = to_dataframe(solution, "ekf", "mag_time")
    assert list(table.columns)[1:] == [
        *("innovation_mag_azimuth_rad", "innovation_mag_horizontal_part_t")
    ]
    assert table.iloc[1, 1:].tolist() == [2.0, 3.0]
    fixes = to_dataframe(solution, "ekf", "gnss_time")
    assert list(fixes.columns)[1:] == ["gnss_lat_deg", "gnss_lon_deg", "gnss_alt_m"]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("ekv",), "no filter 'ekv' in the solution; did you mean 'ekf'?"),
        (("ekf", "mag_times"), "no clock 'mag_times' in the solution; did you mean 'mag_time'?"),
    ],
)
def test_what_is_not_there_is_refused(given, message):
    with pytest.raises(ValueError, match=message.replace("?", r"\?")):
        to_dataframe(a_replay(), *given)


def test_a_result_is_a_table_too(tmp_path):
    write(tmp_path / "out", a_summary(), a_replay())
    pd.testing.assert_frame_equal(read(tmp_path / "out").to_dataframe(), to_dataframe(a_replay()))
    write(tmp_path / "of a run", a_summary(), a_solution())
    table = read(tmp_path / "of a run").to_dataframe("kalman")
    assert [*table.columns] == [
        *(f"error_attitude_{angle}_deg" for angle in ("roll", "pitch", "heading")),
        "outage",
    ]
    write(tmp_path / "short", a_summary())
    with pytest.raises(ResultError, match="has no time series"):
        read(tmp_path / "short").to_dataframe()
