"""Formats of one's own, in TOML and Python: read, written, or refused with the key (F30)."""

import dataclasses

import numpy as np
import pytest

from robins.dataset import AttitudeTable, Dataset, GnssTable, ImuTable, MagTable, Trajectory
from robins.logs import (
    Column,
    LogError,
    TextFormat,
    clean,
    columns_from,
    examine,
    formats_of,
    load_dataset,
    open_log,
    write_log,
)

TOML = """
separator = ";"
body = "FLU"
[columns]
time = { name = "t", unit = "ms" }
gyro_x = { name = "wx", unit = "deg/s" }
gyro_y = { name = "wy", unit = "deg/s" }
gyro_z = { name = "wz", unit = "deg/s" }
accel_x = { name = "ax", unit = "g" }
accel_y = { name = "ay", unit = "g" }
accel_z = { name = "az", unit = "mg", scale = 0.5 }
"""
MAG = "".join(f'mag_{a} = {{ name = "m{a}", unit = "uT" }}\n' for a in "xyz")
FIXES = """
lat = { name = "lat", unit = "deg" }
lon = { name = "lon", unit = "deg" }
height = { name = "h", unit = "m" }
"""
LOG = '"t";"wx";"mode";"wy";"wz";"ax";"ay";"az"\n' + "".join(
    f"{10 * k}.25;{k};run;90;180;0.5;-1;2000\n" for k in range(5)
)


@pytest.fixture
def own(tmp_path):
    """Write a declaration and a log; their paths."""

    def write(toml=TOML, log=LOG):
        (tmp_path / "own.toml").write_text(toml)
        (tmp_path / "log.csv").write_text(log)
        return tmp_path / "own.toml", tmp_path / "log.csv"

    return write


def test_a_newcomers_log_is_read_as_declared(own):
    declared, log = own()
    imu = open_log(log, columns_from(declared))
    assert isinstance(imu, ImuTable)
    assert imu.time_ns.tolist() == [250_000 + 10_000_000 * k for k in range(5)]
    # x forward, y left, z up: y and z of forward-right-down are reversed
    np.testing.assert_allclose(np.rad2deg(imu.gyro[3]), [3.0, -90.0, -180.0], rtol=1e-15)
    np.testing.assert_allclose(imu.accel[0] / 9.80665, [0.5, 1.0, -1.0], rtol=1e-15)
    assert (imu.kind, imu.body, imu.rows.tolist()) == ("rate", "FRD", [2, 3, 4, 5, 6])
    assert load_dataset([log], formats=formats_of([log], [declared])).name == "log"
    declared, log = own("skip = 2\n" + TOML, "my logger\nt;0.5\n" + LOG)
    np.testing.assert_array_equal(open_log(log, columns_from(declared)).gyro, imu.gyro)


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("FRD", [1, 2, 3]),
        ("FLU", [1, -2, -3]),
        ("LBU", [-2, -1, -3]),
        ("DFR", [2, 3, 1]),
        ("BRU", [-1, 2, -3]),
    ],
)
def test_axes_are_turned_to_forward_right_down(own, body, expected):
    row = columns_from(own(TOML.replace("FLU", body).replace("mg", "g").replace("0.5", "1"))[0])
    log = own(log=LOG.splitlines()[0] + "\n0;57;a;0;0;1;2;3\n0;0;a;0;0;1;2;3\n")[1]
    np.testing.assert_allclose(open_log(log, row).accel[0] / 9.80665, expected, rtol=1e-15)


def test_places_count_from_one_where_there_is_no_header(own):
    places = {"t": 2, "wx": 3, "wy": 4, "wz": 6, "ax": 7, "ay": 8, "az": 9}
    toml = "skip = 2\n" + TOML
    for name, place in places.items():
        toml = toml.replace(f'name = "{name}"', f"place = {place}")
    log = "my logger\nv 1.2\n" + "".join(f"A;{k};1;2;?;3;0;0;2000;\n" for k in range(4))
    declared, path = own(toml, log)
    imu = load_dataset([path], formats=formats_of([path], [declared])).imu
    np.testing.assert_allclose(np.rad2deg(imu.gyro[0]), [1.0, -2.0, -3.0])
    path.write_text(log.replace("A;2;1;2", "A;2;1;two"))
    with pytest.raises(LogError, match=r"line 5: column 4 = 'two': is not a number"):
        open_log(path, columns_from(declared))


@pytest.mark.parametrize("separator", [",", ";", "\t", " ", "|"])
def test_any_separator_and_cells_that_are_empty(own, separator):
    toml = TOML.replace('";"', repr(separator).replace("'", '"'))
    missing = "nan" if separator == " " else ""
    rows = [
        [str(k), missing if k == 1 else "1", "m", "2", "3", "0", "0", missing] for k in range(3)
    ]
    log = "\n".join(separator.join(row) for row in [LOG.split("\n")[0].split(";"), *rows]) + "\n"
    imu = open_log(own(log=log)[1], columns_from(own(toml, log)[0]))
    assert np.isnan(imu.gyro[:, 0]).tolist() == [False, True, False]
    assert np.isnan(imu.accel[:, 2]).all()


def test_a_row_belongs_to_the_tables_of_which_it_has_a_number(own):
    header = LOG.split("\n")[0] + ";mx;my;mz;lat;lon;h\n"
    rows = [f"{k};1;a;2;3;0;0;2000;" + ("1;2;3;" if k % 2 else ";;;") for k in range(6)]
    rows = [r + ("47;8;400" if k == 4 else ";;") for k, r in enumerate(rows)]
    declared, path = own(TOML + MAG + FIXES, header + "\n".join(rows) + "\n")
    row = columns_from(declared)
    data = open_log(path, row)
    assert isinstance(data, Dataset)
    assert (data.imu.rows.tolist(), data.mag.rows.tolist()) == ([2, 3, 4, 5, 6, 7], [3, 5, 7])
    assert data.gnss.rows.tolist() == [6]
    assert data.gnss.v_n is None
    assert np.isnan(data.gnss.sigma_m).all()
    np.testing.assert_allclose(data.mag.field_t[0], [1e-6, -2e-6, -3e-6], rtol=1e-14)
    again = path.parent / "again.csv"
    write_log(again, data, row)
    back = open_log(again, row)
    for kind in ("imu", "mag", "gnss"):
        one, other = getattr(back, kind), getattr(data, kind)
        np.testing.assert_array_equal(one.time_ns, other.time_ns)
    np.testing.assert_allclose(back.mag.field_t, data.mag.field_t, rtol=5e-16)
    np.testing.assert_allclose(back.imu.accel, data.imu.accel, rtol=5e-16)


@pytest.mark.parametrize(
    ("columns", "kind"),
    [
        ("dtheta_x dtheta_y dtheta_z dv_x dv_y dv_z", ImuTable),
        ("mag_x mag_y mag_z", MagTable),
        ("lat lon height sigma_north sigma_east sigma_down v_north v_east v_down", GnssTable),
        ("lat lon height quality", GnssTable),
        ("lat lon height v_north v_east v_down roll pitch heading", Trajectory),
        ("east north up q_w q_x q_y q_z omega_x omega_y omega_z", Trajectory),
        ("roll pitch heading", AttitudeTable),
    ],
)
def test_columns_decide_which_table_it_is(tmp_path, columns, kind):
    names = columns.split()
    row = TextFormat("own", "mine", tuple(Column(q, q) for q in ["time", *names]))
    path = tmp_path / "log.csv"
    cells = {"q_w": "1", "q_x": "0", "q_y": "0", "q_z": "0"}
    line = ",".join(cells.get(q, "0.5") for q in names)
    path.write_text("# origin: 47.0 deg, 8.0 deg, 0.0 m\n" + ",".join(["time", *names]) + "\n")
    with path.open("a") as file:
        file.writelines(f"{k},{line}\n" for k in range(3))
    table = open_log(path, row)
    assert type(table) is kind
    again = tmp_path / "again.csv"
    write_log(again, table, row)
    back = open_log(again, row)
    for field in dataclasses.fields(table):
        one, other = getattr(back, field.name), getattr(table, field.name)
        if isinstance(other, np.ndarray) and field.name != "rows":
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-9)


def test_dates_counts_constants_rates_offsets_and_decimal_commas(own):
    """Forms in which loggers write time and numbers, each by hand."""

    def read(toml, rows):
        declared, log = own(toml, LOG.splitlines()[0] + "\n" + rows)
        row = columns_from(declared)
        with pytest.raises(LogError, match="such a format is only read"):
            write_log(log.parent / "x.csv", open_log(log, row), row)
        return open_log(log, row)

    cells = ";1;m;2;3;0;0;2000\n"
    dated = TOML.replace('"ms"', '"iso"')
    times = read(
        dated, f"2025-06-11T22:34:27.5+02:00{cells}2025-06-11 16:04:29-0430{cells}"
    ).time_ns
    assert (times - 1_749_674_085 * 10**9).tolist() == [500_000_000, 2_000_000_000]
    for unit, leap in (("iso UTC", 18), ("iso GPS", 0)):
        (time,) = read(dated.replace('"iso"', f'"{unit}"'), f"2025-06-11 20:34:27{cells}").time_ns
        assert time == (1_749_674_067 + leap) * 10**9
    declared, log = own(dated, LOG.splitlines()[0] + f"\n2025-06-11 20:34:27{cells}")
    with pytest.raises(LogError, match=r"t = '2025.*': is not a date and time with its"):
        open_log(log, columns_from(declared))
    rate = 'rate = "50 Hz"\n' + TOML.replace('time = { name = "t", unit = "ms" }\n', "")
    rate = rate.replace('{ name = "wy", unit', "{ value = 7, unit")
    imu = read(rate, cells[1:].join(["t;"] * 3) + cells[1:])
    assert imu.time_ns.tolist() == [0, 20_000_000, 40_000_000]
    np.testing.assert_allclose(np.rad2deg(imu.gyro[:, 1]), -7.0)
    comma = 'decimal = ","\n' + TOML.replace("scale = 0.5", "scale = 0.5, offset = -100")
    comma = comma.replace('unit = "ms"', 'unit = "ms", offset = 0.25')
    imu = read(comma, "1,5;0,5;a,b;2;3;0,25;0;2000,5\n")
    assert imu.time_ns.tolist() == [1_750_000]
    np.testing.assert_allclose(np.rad2deg(imu.gyro[0, 0]), 0.5)
    np.testing.assert_allclose(imu.accel[0, 2] / 9.80665e-3, -(2000.5 * 0.5 - 100))


@pytest.mark.parametrize(("unit", "stamp", "ns"), [
    ("0.1 ms", "12345", 1_234_500_000), ("39.0625 us", "3", 117_188), ("39.0625 us", "1.6", 62_500),
    ("10 ns", "7.5", 75), ("1e-3 ms", "2", 2_000), ("2 s", "1756402240.5", 3_512_804_481 * 10**9),
])  # fmt: skip
def test_a_stamp_counts_so_many_of_a_unit_exactly(own, unit, stamp, ns):
    declared, log = own(TOML.replace('"ms"', f'"{unit}"'))
    log.write_text(LOG.splitlines()[0] + f"\n{stamp};1;m;2;3;0;0;2000\n")
    row = columns_from(declared)
    imu = open_log(log, row)
    assert imu.time_ns.tolist() == [ns]
    write_log(log, imu, row)
    assert open_log(log, row).time_ns.tolist() == [ns]


def test_rows_of_several_sensors_are_told_by_a_text(own):
    """Android's loggers: a row a sensor; specific forces are taken to the stamps of the gyros."""
    triads = (("gyro", "rad/s", "GYR"), ("accel", "m/s^2", "ACC"), ("mag", "uT", "MAG"))
    toml = '[columns]\ntime = { name = "t", unit = "ms" }\n' + "".join(
        f'{q}_{a} = {{ name = "{a}", unit = "{u}", where = {{ sensor = "{s}" }} }}\n'
        for q, u, s in triads for a in "xyz"
    )  # fmt: skip
    rows = ['0,"ACC",0,0,8', "5,GYR,1,2,3", "6,BARO,1013,,", "10,MAG,20,0,-40", "15,GYR,4,5,6"]
    log = "t,sensor,x,y,z\n" + "\n".join([*rows, "20,ACC,0,0,12", "25,GYR,7,8,9"]) + "\n"
    declared, path = own(toml, log)
    data = open_log(path, columns_from(declared))
    assert data.imu.time_ns.tolist() == [5_000_000, 15_000_000, 25_000_000]
    assert data.imu.gyro[1].tolist() == [4, 5, 6]
    np.testing.assert_allclose(data.imu.accel[:, 2], [9.0, 11.0, np.nan])
    np.testing.assert_allclose(data.mag.field_t, [[20e-6, 0, -40e-6]])
    path.write_text(log.replace("sensor", "kind"))
    with pytest.raises(LogError, match="line 1: the header lacks sensor; it has t, kind, x, y, z"):
        open_log(path, columns_from(declared))
    with pytest.raises(
        LogError, match=r"gyro_x: where = .*: is not one column and its text; write"
    ):
        columns_from(own(toml.replace('sensor = "GYR"', "sensor = 1", 1))[0])


def test_lines_above_a_header_are_passed_over(own):
    above = "Logger 3.1\nserial;0042\nrange;16 g\n\n"
    declared, log = own(log=above + LOG)
    imu = load_dataset([log], formats=formats_of([log], [declared])).imu
    assert imu.rows.tolist() == [6, 7, 8, 9, 10]


def test_the_name_of_a_format_is_for_files_that_are_not_recognised(tmp_path):
    known = tmp_path / "imu.csv"
    known.write_text(
        "time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,accel_x_g,accel_y_g,accel_z_g\n0,0,0,0,0,0,-1\n"
    )
    rows = tmp_path / "path"
    rows.write_text("1 2 3\n")
    assert formats_of([known, rows], ["format:tum"]) == {str(rows): "tum"}
    assert formats_of([known], ["format:tum"]) == {str(known): "tum"}
    with pytest.raises(LogError, match="no format is called 'tmu'; choose one of"):
        formats_of([rows], ["format:tmu"])
    with pytest.raises(LogError, match="--format tum: all files are recognised; omit the name"):
        formats_of([known, known], ["format:tum"])


# ------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("separator", "seperator"), r"own.toml seperator: is not a .*; did you mean separator\?"),
        (('";"', "1"), "own.toml: separator = 1: is not text; give text"),
        (('";"', '"ab"'), "own.toml: separator = 'ab': cannot separate numbers; give one char"),
        (('"FLU"', '"FLD"'), "own.toml: body = 'FLD': is left-handed; give a right-handed"),
        (('"FLU"', '"FFU"'), "own.toml: body = 'FFU': names one axis twice"),
        (('"FLU"', '"XYZ"'), "own.toml: body = 'XYZ': is not three of the ways F, B, R, L, D, U"),
        (("body", 'nav = "EUN"\nbody'), "own.toml: nav = 'EUN': is neither NED nor ENU"),
        (("body", "skip = -1\nbody"), "own.toml: skip = -1: is less than 0; count lines from 0"),
        (("gyro_x", "gryo_x"), r"quantity .*; did you mean gyro_x\? If not, choose one of time,"),
        (('"deg/s"', '"deg/sec"'), r"columns.gyro_x: unit = 'deg/sec': .*did you mean deg/s"),
        (('"deg/s"', '"g"'), "columns.gyro_x: unit = 'g': g is a.*; an angle rate"),
        (('"ms"', '"min"'), "columns.time: unit = 'min': is no unit of time stamps; .*ms, us, ns"),
        ((', unit = "g" }', " }"), "columns.accel_x: has no unit; state one of m/s"),
        (("scale = 0.5", "scale = 0"), "columns.accel_z: scale = 0.0: cannot scale anything"),
        (("scale = 0.5", "scale = true"), "columns.accel_z.scale = True: is not a number"),
        (("scale = 0.5", "bias = 2"), "accel_z.bias: is not a known key; choose one of name"),
        (("scale = 0.5", "offset = nan"), "columns.accel_z: has an offset or value that is not"),
        (('name = "t"', "value = 3"), "columns.time: value = 3.0: is not for time; state rate"),
        (('name = "wx"', 'name = "a", value = 3'), "gyro_x: has both name and value; state"),
        (("body", 'rate = "100"\nbody'), "own.toml: rate: '100' has no unit; .*; give it like"),
        (("body", 'rate = "1 MHz"\nbody'), "rate = 1000000.0: is not between 0.1 and 100000 Hz"),
        (("body", 'rate = "100 Hz"\nbody'), "columns: there is no time, or there are two; state"),
        (("body", 'decimal = ";"\nbody'), 'own.toml: decimal = \';\': cannot be the sign of dec'),
        (('name = "wx"', 'nam = "wx"'), r"gyro_x.nam: is not a known key; did you mean name\?"),
        (('name = "wx"', "place = 0"), "columns.gyro_x: place = 0: is less than 1; count"),
        (('name = "wx"', f"place = {10**19}"), "gyro_x: place = 10*: is beyond 10000; count"),
        (('name = "wx"', "place = 3"), "columns: some have names and some have places"),
        (('name = "wx"', 'name = "a", place = 3'), "columns.gyro_x: has both name and place"),
        (('name = "wx", ', ""), "columns.gyro_x: has neither name nor place"),
        (('{ name = "wx", unit = "deg/s" }', '"wx"'), "columns.gyro_x = 'wx': is not a table"),
        (("gyro_z", "gyro_y"), "own.toml: is no TOML: .*; repair it"),
        (('gyro_z = { name = "wz", unit = "deg/s" }\n', ""), "without gyro_z a table is not whole"),
        (("gyro_z = {", "dt = {"), "columns.dt: unit = 'deg/s': .*a time"),
        (("time =", "week ="), "columns.week: unit = 'ms': ms is a time; a ratio"),
        (("[columns]", "[cols]"), "own.toml cols: is not a known key; did you mean columns"),
        ((TOML, ""), "own.toml columns: states no columns; state them, such"),
        ((TOML[TOML.index("gyro_x") :], FIXES + MAG), "make mag and gnss alone, where"),
        ((TOML[TOML.index("gyro_x") :], ""), "make no table; state all columns of a table: the"),
        ((TOML[TOML.index("gyro_x") :], MAG + 'quality = { name = "q" }'), "quality have no use"),
        ((TOML[TOML.index("gyro_x") :], "".join(f'{q} = {{ name = "{q}", unit = "deg" }}\n'
          for q in ("roll", "pitch", "heading"))), "body = 'FLU': does not go with nav NED"),
    ],
)  # fmt: skip
def test_a_declaration_that_is_refused_names_file_and_key(own, change, message):
    assert change[0] in TOML
    with pytest.raises(LogError, match=message) as caught:
        columns_from(own(TOML.replace(*change, 1))[0])
    assert str(caught.value).startswith(str(own()[0]))


def test_a_declaration_that_cannot_be_read(tmp_path, own):
    with pytest.raises(LogError, match=r"none.toml: cannot be read: No such file"):
        columns_from(tmp_path / "none.toml")
    own()[0].write_bytes(b"\xff\xfe")
    with pytest.raises(LogError, match=r"own.toml: is no TOML: "):
        columns_from(tmp_path / "own.toml")


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        (TOML.replace('"wx"', '"gx"'), 'log.csv line 1: the header lacks gx; it has t, wx, mode, .*'
         "; state the names that it has in .*own.toml"),
        (TOML.replace('";"', '","'), "the header lacks t, wx, .*; state separator = ';' in .*own"),
    ],
)  # fmt: skip
def test_a_declaration_that_does_not_fit_is_told_with_what_lacks(own, toml, message):
    declared, log = own(toml)
    with pytest.raises(LogError, match=message):
        open_log(log, formats_of([log], [declared])[str(log)])


def test_each_declaration_fits_one_file(own, tmp_path):
    declared, log = own()
    with pytest.raises(LogError, match=r"log.csv: fits both .*own.toml and .*own.toml; give"):
        formats_of([log], [declared, declared])
    (tmp_path / "image").write_bytes(b"\0\1\2")
    with pytest.raises(LogError, match=r"own.toml: its columns fit none of the files"):
        formats_of([tmp_path / "image"], [declared])
    assert formats_of([log], []) == {}


WHEELS = """
wheel_speed = { name = "speed", unit = "km/h" }
sigma_wheel_speed = { value = 0.1, unit = "m/s" }
"""


def test_the_speed_of_the_wheels_is_a_column(own, tmp_path):
    """One file with the samples or one of its own: read, examined, cleaned, written."""
    names, *rows = LOG.splitlines()
    log = "\n".join([f"{names};speed", *(f"{row};{3.6 * k}" for k, row in enumerate(rows))])
    declared, whole = own(TOML + WHEELS, log + "\n")
    one = open_log(whole, columns_from(declared))
    (tmp_path / "wheels.toml").write_text('[columns]\ntime = { name = "t", unit = "s" }' + WHEELS)
    (tmp_path / "imu.toml").write_text(TOML)
    own_file = tmp_path / "wheels.csv"
    own_file.write_text("t,speed\n" + "".join(f"0.0{k}025,{3.6 * k}\n" for k in range(5)))
    paths = [str(whole), str(own_file)]
    formats = {
        path: columns_from(tmp_path / f"{name}.toml")
        for path, name in zip(paths, ("imu", "wheels"), strict=True)
    }
    several = load_dataset(paths, formats=formats)
    for data in (one, several):
        np.testing.assert_array_equal(data.odometry.time_ns, data.imu.time_ns)
        np.testing.assert_allclose(data.odometry.speed_mps, np.arange(5.0))
        np.testing.assert_allclose(data.odometry.sigma_speed, 0.1)
    assert several.odometry.source == str(own_file)
    spoilt = several.odometry.speed_mps.copy()
    spoilt[2:4] = np.nan, 1e9
    data = dataclasses.replace(
        several, odometry=dataclasses.replace(several.odometry, speed_mps=spoilt)
    )
    got = clean(data)
    assert got.odometry.speed_mps.tolist() == pytest.approx([0.0, 1.0, 4.0])
    assert {k: n for k, n in got.counts.items() if "odom" in k and n} == {
        "odometry_nan": 1,
        "odometry_absurd": 1,
    }
    assert "absurd" in {f.code for f in examine(data) if f.file == str(own_file)}
    both = WHEELS.replace("value = 0.1", 'name = "sigma"')
    (tmp_path / "both.toml").write_text('[columns]\ntime = { name = "t", unit = "s" }' + both)
    format = columns_from(tmp_path / "both.toml")
    write_log(tmp_path / "again.csv", several.odometry, format)
    again = open_log(tmp_path / "again.csv", format)
    np.testing.assert_allclose(again.speed_mps, several.odometry.speed_mps, rtol=5e-16)
    np.testing.assert_array_equal(again.sigma_speed, several.odometry.sigma_speed)
    replaced = load_dataset(paths, formats=formats | {paths[0]: columns_from(declared)})
    assert [f.code for f in replaced.findings] == ["table_replaced"]
    assert replaced.odometry.source == str(own_file)
