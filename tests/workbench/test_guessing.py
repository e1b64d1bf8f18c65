"""Columns guessed from headings: what is proved is right, what is not is marked or left out."""

import re
import tomllib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robins.logs import columns_from, open_log
from robins.units import to_si
from robins.workbench import InputError, guess

HZ, N = 100.0, 2000


def moved(seed=3, fast=1.0):
    """Rates [rad/s] and specific forces [m/s^2] of a unit that rolls and pitches in one place."""
    t, rng = np.arange(N) / HZ, np.random.default_rng(seed)
    phases = fast * np.outer(t, (0.2, 0.37, 0.5)) + rng.uniform(0, 6, 3)
    turn = Rotation.from_euler("ZYX", np.sin(phases) * (3.0, 0.5, 0.6))
    gyro = (turn[:-1].inv() * turn[1:]).as_rotvec() * HZ
    return t, np.vstack([gyro, gyro[-1:]]), turn.inv().apply([0.0, 0.0, -9.81])


def sheet(path, names, columns, separator=",", decimal="."):
    rows = np.column_stack(columns).tolist()
    cells = (separator.join(f"{x:.7f}".replace(".", decimal) for x in row) for row in rows)
    path.write_text("\n".join([separator.join(names), *cells]) + "\n")


@pytest.mark.parametrize(
    ("names", "units", "look"),
    [
        ("t ax ay az wx wy wz", "s m/s^2 rad/s", {}),
        ("timestamp accX accY accZ gyroX gyroY gyroZ", "ms g deg/s", {}),
        ("time_us|acc_x (g)|acc_y (g)|acc_z (g)|Gyro X [dps]|Gyro Y [dps]|Gyro Z [dps]",
         "us g deg/s", {"separator": ";", "decimal": ","}),
        ("Time|linear_acceleration.x|linear_acceleration.y|linear_acceleration.z|"
         "angular_velocity.x|angular_velocity.y|angular_velocity.z", "s m/s^2 deg/s", {}),
        ("ts a_x a_y a_z g_x g_y g_z", "ms mg rad/s", {"separator": "\t"}),
    ],
)  # fmt: skip
def test_a_table_is_declared_so_that_it_reads_right(tmp_path, names, units, look):
    names, (clock, force, rate) = names.split("|" if "|" in names else None), units.split()
    t, gyro, accel = moved()
    columns = [t / to_si(1.0, clock), accel / to_si(1.0, force), gyro / to_si(1.0, rate)]
    sheet(tmp_path / "my.csv", [*names, "Temp"], [*columns, 20.0 + t], **look)
    text = guess(tmp_path / "my.csv")
    (tmp_path / "own.toml").write_text(text)
    imu = open_log(tmp_path / "my.csv", columns_from(tmp_path / "own.toml"))
    np.testing.assert_allclose(imu.time_ns * 1e-9, t, atol=1e-9)
    np.testing.assert_allclose(imu.gyro, gyro, atol=2e-7)
    np.testing.assert_allclose(imu.accel, accel, atol=2e-5)
    assert "#   Temp: not known" in text
    if "dps" not in names[-1]:
        assert text.count("proved by gravity") == 6 - 3 * ("(g)" in names[1])


def test_what_numbers_do_not_tell_is_marked(tmp_path):
    """Rates of a unit at rest may have any unit; counts of a range are only likely."""
    t, zero = np.arange(N) / HZ, np.zeros((N, 3))
    down = np.tile([0.0, 0.0, 16384.0], (N, 1))
    noise = 1e-3 * np.random.default_rng(2).normal(size=(N, 3))
    sheet(tmp_path / "a.csv", ["t", "ax", "ay", "az", "gx", "gy", "gz"], [1.7e9 + t, down, noise])
    text = guess(tmp_path / "a.csv")
    declared = tomllib.loads(text)
    assert declared["body"] == "FLU"
    assert declared["columns"]["accel_x"]["unit"] == f"{2.0**-14!r} g"
    assert text.count("GUESSED: it may be deg/s") == 3
    assert "counts from 1970" in text
    sheet(
        tmp_path / "b.csv",
        ["ax", "ay", "az", "gx", "gy", "gz", "mx", "my", "mz"],
        [down, noise, 45.0 + zero],
    )
    text = guess(tmp_path / "b.csv")
    assert "NOT KNOWN: no column of time was found; state the rate" in text
    assert "mag_x" not in tomllib.loads(text)["columns"]
    assert '# mag_x = { name = "mx", unit = "" }   # UNIT NOT KNOWN: median size 77.9' in text
    (tmp_path / "b.csv").write_text("t,ax,ay,az,wx,wy,wz\n0,,,,1,2,3\n")  # one row, of the gyros
    assert "accel_x = " in guess(tmp_path / "b.csv")
    sheet(tmp_path / "c.csv", ["a", "b", "c", "d"], [zero, t])
    with pytest.raises(InputError, match="no sensor has all its headings; there are a, b, c, d"):
        guess(tmp_path / "c.csv")
    (tmp_path / "d.csv").write_text("1,2,3\n4,5,6\n")
    with pytest.raises(InputError, match="no line of names stands above rows of numbers"):
        guess(tmp_path / "d.csv")
    (tmp_path / "e.db3").write_bytes(b"SQLite format 3\0" + bytes(300))
    with pytest.raises(InputError, match=r"format is known: ROS 2.*no columns are needed"):
        guess(tmp_path / "e.db3")


def test_a_clock_and_axes_of_unusual_names_are_found(tmp_path):
    t, gyro, accel = moved()
    names = ["w1", "w2", "w3", "a1", "a2", "a3", "compass_1", "compass_2"]
    columns = [gyro, accel, np.tile([20.0, 5.0], (N, 1))]
    sheet(tmp_path / "a.csv", ["Zeit (ms)", *names], [1e3 * t, *columns])
    text = guess(tmp_path / "a.csv")
    assert 'time = { name = "Zeit (ms)", unit = "ms" }   # GUESSED: it rises' in text
    assert "GUESSED: 1, 2 and 3 behind a name are x, y and z" in text
    assert "#   compass_1: not known" in text
    declared = tomllib.loads(text)["columns"]
    assert [declared[f"accel_{axis}"]["name"] for axis in "xyz"] == ["a1", "a2", "a3"]
    sheet(tmp_path / "b.csv", ["Zeit", *names], [t, *columns])
    assert 'time = { name = "Zeit", unit = "s" }   # GUESSED: 100 rows' in guess(tmp_path / "b.csv")
    sheet(tmp_path / "c.csv", ["row", *names], [np.arange(N), *columns])
    assert "NOT KNOWN: no column of time was found" in guess(tmp_path / "c.csv")
    sheet(tmp_path / "d.csv", ["t", *names[:2], *names[3:6]], [t, gyro[:, :2], accel])
    with pytest.raises(InputError, match="gyro_x, gyro_y, gyro_z are not found, so no accel is"):
        guess(tmp_path / "d.csv")
    axes = ["gx", "gy", "ax", "ay", "az", "mx", "my", "mz"]
    field = np.tile([20.0, 5.0, 45.0], (N, 1))
    sheet(tmp_path / "e.csv", ["t", *axes], [t, gyro[:, :2], accel, field])
    assert "#   gx: gyro_z is not found, so the three are left out" in guess(tmp_path / "e.csv")


@pytest.mark.parametrize(
    ("heading", "line"),
    [
        ("alt [ft]", 'height = { name = "alt [ft]", unit = "ft" }   # unit by its heading'),
        ("alt (Fuss)", '# height = { name = "alt (Fuss)", unit = "" }   # UNIT NOT KNOWN'),
        ("ve [km/h]", 'v_east = { name = "ve [km/h]", unit = "km/h" }'),
        ("gx [deg/h]", 'gyro_x = { name = "gx [deg/h]", unit = "deg/h" }'),
        ("gx [LSB]", '# gyro_x = { name = "gx [LSB]", unit = "" }   # UNIT NOT KNOWN: the '),
        ("alt_baro [m]", "#   alt_baro [m]: its heading states baro"),
        ("Altitude (MSL)", "#   Altitude (MSL): its heading states msl"),
        ("t (UTC)", 'time = { name = "t (UTC)", unit = "s" }'),
        ("relative altitude (m)", "#   relative altitude (m): its heading states relative"),
    ],
)  # fmt: skip
def test_a_unit_or_a_word_in_a_heading_is_obeyed(tmp_path, heading, line):
    names = ["t", "alt", "lat", "lon", "vn", "ve", "vd", "ax", "ay", "az", "gx", "gy", "gz"]
    plain = re.sub(r" [\[(].*", "", heading)
    names = [heading if name == plain else name for name in names]
    names += [heading] if heading not in names else []
    down = [0.0] * (names.index("az") - 1) + [9.8] + [0.0] * (len(names) - names.index("az") - 1)
    rows = np.tile(down, (30, 1))
    sheet(tmp_path / "a.csv", names, [np.arange(30) / HZ, rows])
    text = guess(tmp_path / "a.csv")
    assert any(found.startswith(line) for found in text.splitlines()), text


@pytest.mark.parametrize("rate", [0.1, 1.0, 2.0, 4.0, 20.0])
@pytest.mark.parametrize(("unit", "leap"), [("s", 18), ("ms", 18_000), ("us", 18_000_000)])
def test_fixes_alone_are_slow_and_the_offset_is_in_the_unit_of_the_column(
    tmp_path, rate, unit, leap
):
    for start, why in ((0.0, "GUESSED: "), (1.7e9, f"counts from 1970; offset = {leap} would")):
        t = (start + np.arange(30) / rate) / to_si(1.0, unit)
        sheet(tmp_path / "a.csv", ["t", "lat", "lon", "alt"], [t, np.ones((30, 3))])
        assert f'"t", unit = "{unit}" }}   # {why}' in guess(tmp_path / "a.csv")


def test_an_archive_and_fixes_are_declared_too(tmp_path):
    t, gyro, accel = moved()
    np.savez(tmp_path / "a.npz", t=t, gyr=np.rad2deg(gyro), acc=accel)
    text = guess(tmp_path / "a.npz")
    (tmp_path / "own.toml").write_text(text)
    imu = open_log(tmp_path / "a.npz", columns_from(tmp_path / "own.toml"))
    np.testing.assert_allclose(imu.gyro, gyro, rtol=1e-12)
    fixes = {f"gnss/{name}": np.ones(3000) for name in ("spectrum", "noise")}  # of another length
    np.savez(tmp_path / "b.npz", t=t, gyr=gyro, acc=accel, **fixes)
    text = guess(tmp_path / "b.npz")
    assert "accel_x = " in text
    assert "#   gnss/noise: has 3000 rows, not 2000" in text
    names = [
        "UTC time",
        "Latitude",
        "Longitude",
        "Altitude (m)",
        "VN",
        "VE",
        "VD",
        "altitude_accuracy",
    ]
    rows = "".join(f"2025-06-11T20:34:{k:02d}Z,48.1,11.5,500,1,2,0,3\n" for k in range(20))
    (tmp_path / "fix.csv").write_text(",".join(names) + "\n" + rows)
    text = guess(tmp_path / "fix.csv")
    (tmp_path / "own.toml").write_text(text)
    fixes = open_log(tmp_path / "fix.csv", columns_from(tmp_path / "own.toml"))
    assert np.rad2deg(fixes.lat_rad[0]) == pytest.approx(48.1)
    assert fixes.v_n[0].tolist() == [1.0, 2.0, 0.0]
    assert fixes.time_ns[0] == (1_749_674_067 - 27 + 18) * 10**9
