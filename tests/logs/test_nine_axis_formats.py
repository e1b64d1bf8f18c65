"""Archives and CSV of nine-axis sensors: read exactly, or refused (F04, F29)."""

import io
import zipfile

import numpy as np
import pytest
from made_nine_axis import HZ, archive, broad_bytes, tumble

from robins.dataset import Dataset, ImuTable
from robins.logs import LogError, LogWarning, load_dataset, load_pair, open_log

TRIALS = {
    "broad_01_undisturbed_slow_rotation_A": (56940, 162),
    "broad_07_undisturbed_fast_rotation_B": (52518, 1594),
    "broad_15_undisturbed_fast_translation_A": (52556, 86),
    "broad_24_disturbed_tapping_A": (57746, 4824),
    "broad_28_disturbed_stationary_magnet_A": (52628, 1444),
    "broad_33_disturbed_attached_magnet_2cm": (48279, 4182),
}
ARRAYS = tumble(2.0)


def read(tmp_path, content, name="log", findings=None):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return open_log(path, None, [] if findings is None else findings)


def refusal(tmp_path, content, name="log"):
    with pytest.raises(LogError) as caught:
        read(tmp_path, content, name)
    return str(caught.value)


def same(one, two):
    """Equality of the numbers of two datasets, NaN where NaN is."""
    for kind, fields in {
        "imu": ("time_ns", "gyro", "accel"),
        "mag": ("time_ns", "field_t"),
        "attitude": ("time_ns", "q_nb", "moving"),
    }.items():
        a, b = getattr(one, kind), getattr(two, kind)
        if not all(np.array_equal(getattr(a, f), getattr(b, f), equal_nan=True) for f in fields):
            return False
    return True


# ------------------------------------------------------------------------------------------- BROAD


def test_a_trial_becomes_three_tables_on_one_clock(tmp_path):
    data = read(tmp_path, archive(ARRAYS), "trial.npz")
    assert data.name == "trial"
    for table in (data.imu, data.mag, data.attitude):
        assert table.time_ns.tolist() == [10_000_000 * k for k in range(200)]
        assert table.body == "FRD"
        assert table.source.endswith("trial.npz")
    assert data.imu.kind == "rate"
    np.testing.assert_array_equal(data.imu.gyro, ARRAYS["imu_gyr"])
    np.testing.assert_array_equal(data.imu.accel, ARRAYS["imu_acc"])
    np.testing.assert_allclose(data.mag.field_t * 1e6, ARRAYS["imu_mag"], rtol=1e-15)
    assert data.attitude.nav == "ENU"
    np.testing.assert_array_equal(data.attitude.moving, ARRAYS["movement"])
    missing = np.isnan(ARRAYS["opt_quat"][:, 0])
    assert missing.sum() == 20
    np.testing.assert_array_equal(np.isnan(data.attitude.q_nb), np.repeat(missing[:, None], 4, 1))
    np.testing.assert_allclose(
        data.attitude.q_nb[~missing], ARRAYS["opt_quat"][~missing], rtol=0, atol=1e-15
    )


def test_time_is_made_from_the_rate_without_adding_up_roundings(tmp_path):
    """285.7 Hz is 2000/7: after 7 * 10^4 samples exactly 245 s have passed."""
    n = 70_001
    arrays = {
        name: np.zeros((n, width), np.float32)
        for name, width in {"imu_gyr": 3, "imu_acc": 3, "imu_mag": 3, "opt_quat": 4}.items()
    }
    arrays["opt_quat"][:, 0] = 1.0
    arrays |= {"movement": np.zeros(n, bool), "sampling_rate": np.array(2000 / 7)}
    time_ns = read(tmp_path, archive(arrays)).imu.time_ns
    assert time_ns[-1] == 245_000_000_000
    assert set(np.diff(time_ns).tolist()) == {3_500_000}


def test_single_precision_is_widened_not_rounded(tmp_path):
    single = {k: v.astype(np.float32) if v.ndim == 2 else v for k, v in ARRAYS.items()}
    data = read(tmp_path, archive(single))
    assert data.imu.gyro.dtype == np.float64
    np.testing.assert_array_equal(data.imu.gyro.astype(np.float32), single["imu_gyr"])
    length = np.linalg.norm(data.attitude.q_nb, axis=1)
    np.testing.assert_allclose(length[~np.isnan(length)], 1.0, rtol=1e-15)


def test_quaternions_that_are_none(tmp_path):
    q = ARRAYS["opt_quat"].copy()
    q[7] *= 1.2
    q[9, 2] = np.nan
    path = tmp_path / "trial.npz"
    path.write_bytes(archive(ARRAYS | {"opt_quat": q}))
    with pytest.warns(LogWarning, match="row 8: the quaternion opt_quat has length 1.2"):
        data = open_log(path)
    gone = np.flatnonzero(np.isnan(data.attitude.q_nb).all(axis=1))
    assert gone.tolist()[:2] == [7, 9]
    told = refusal(tmp_path, archive(ARRAYS | {"opt_quat": 2.0 * ARRAYS["opt_quat"]}))
    assert "length of opt_quat = 2.0: is not of unit length, as in 180 of 180 rows" in told


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"imu_mag": None}, "has no array imu_mag; it has imu_acc, imu_gyr, movement, opt_pos"),
        ({"movement": None, "sampling_rate": None}, "has no array movement, sampling_rate"),
        ({"imu_acc": ARRAYS["imu_acc"].T}, r"imu_acc: is float64 of shape \(3, 200\) where \(n, 3"),
        ({"imu_gyr": ARRAYS["imu_gyr"][:-1]}, r"imu_acc: is float64 of shape .* as imu_gyr has"),
        ({"imu_mag": ARRAYS["imu_mag"] * 1j}, "imu_mag: is complex128 of shape"),
        ({"imu_mag": ARRAYS["imu_mag"].astype(str)}, "imu_mag: is <U.* of real numbers is needed"),
        ({"imu_mag": ARRAYS["imu_mag"].astype(object)}, "'imu_mag' is no plain array .*pickle"),
        ({"opt_quat": ARRAYS["opt_quat"][:, :3]}, r"opt_quat: is float64 of shape \(200, 3\)"),
        ({"movement": ARRAYS["movement"] * 1.0}, "movement: is float64 of .* of bool is needed"),
        ({"movement": np.array(True)}, r"movement: is bool of shape \(\)"),
        ({"sampling_rate": np.array(0.0)}, "sampling_rate = 0.0: is not between 0.1 and 100000 Hz"),
        ({"sampling_rate": np.array(np.nan)}, "sampling_rate = nan: is not between"),
        ({"sampling_rate": np.array("fast")}, "sampling_rate: is <U4 of shape"),
        ({"sampling_rate": np.array([100.0, 100.0])}, r"sampling_rate: is float64 of shape \(2,\)"),
    ],
)
def test_arrays_that_are_not_what_they_should_be(tmp_path, change, message):
    arrays = {k: v for k, v in (ARRAYS | change).items() if v is not None}
    path = tmp_path / "trial.npz"
    path.write_bytes(archive(arrays))
    with pytest.raises(LogError, match=message):
        open_log(path, "broad-npz", [])


def test_an_empty_trial(tmp_path):
    none = {k: v[:0] if v.ndim else v for k, v in ARRAYS.items()}
    assert "imu_gyr: has no rows; record it again" in refusal(tmp_path, archive(none))


def test_a_cut_archive_is_refused_at_every_place(tmp_path):
    """Its index comes last, so nothing of it can be believed."""
    whole = broad_bytes(0.3)
    for end in np.linspace(4, len(whole) - 1, 200).astype(int):
        told = refusal(tmp_path, whole[:end])
        assert any(
            part in told
            for part in (
                f"cut short or damaged after {end} bytes",
                "zip archive",
                "no known",
                "NUL",
            )
        ), told


def test_damage_is_refused_or_touches_no_number(tmp_path):
    whole = broad_bytes(0.3)
    good = read(tmp_path, whole)
    rng = np.random.default_rng(8)
    index = whole.index(b"PK\x01\x02") * 8
    bits = {*rng.integers(0, index, 300).tolist(), *rng.integers(index, len(whole) * 8, 400)}
    seen = []
    for bit in bits:
        data = bytearray(whole)
        data[bit // 8] ^= 1 << (bit % 8)
        try:
            answer = read(tmp_path, bytes(data))
        except LogError:
            seen.append(False)
        else:  # a date, say
            assert isinstance(answer, Dataset)
            assert same(answer, good)
            seen.append(True)
    for at in range(0, len(whole) - 16, 97):
        data = whole[:at] + bytes(16) + whole[at + 16 :]
        if data != whole:
            try:
                assert same(read(tmp_path, data), good)
            except LogError:
                seen.append(False)
    assert 0.3 < 1.0 - np.mean(seen) < 1.0


def test_more_numbers_than_the_header_says_are_refused(tmp_path):
    """Nothing is read past what an array says of itself, and nothing is left over."""
    file = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive(ARRAYS))) as old, zipfile.ZipFile(file, "w") as new:
        for name in old.namelist():
            more = b"\0" * 24 if name == "imu_mag.npy" else b""
            new.writestr(name, old.read(name) + more)
    assert "'imu_mag' holds 4824 bytes where its header declares 4800" in refusal(
        tmp_path, file.getvalue()
    )


def test_another_archive_is_told_from_a_trial(tmp_path):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as other:
        other.writestr("readme.txt", "hello")
    assert "is a zip archive, not a text log; unpack it first" in refusal(tmp_path, file.getvalue())
    header = {"descr": "<f8", "fortran_order": False, "shape": (10**15, 3)}
    np.lib.format.write_array_header_1_0(lie := io.BytesIO(), header)
    with zipfile.ZipFile(file := io.BytesIO(), "w") as new:
        new.writestr("imu_gyr.npy", lie.getvalue() + bytes(64))
    told = refusal(tmp_path, file.getvalue())
    assert "'imu_gyr' holds 64 bytes where its header declares 24000000000000000" in told
    lone = archive({"imu_acc": np.zeros((3, 3)), "x": np.zeros(3)})
    assert "has no array imu_gyr, " in refusal(tmp_path, lone)


def test_of_a_trial_only_the_samples_are_those_of_a_slave(tmp_path):
    master, slave = tmp_path / "master.csv", tmp_path / "slave.npz"
    master.write_text(
        "time_s,lat_deg,lon_deg,height_m,v_north_m_s,v_east_m_s,v_down_m_s,roll_deg,pitch_deg,"
        "heading_deg\n0,48,11,500,1,2,3,0,0,30\n1,48,11,500,1,2,3,0,0,30\n"
    )
    slave.write_bytes(broad_bytes(1.0))
    pair = load_pair(master, slave)
    assert len(pair.imu) == 100
    assert pair.mag is None
    with pytest.raises(LogError, match="holds no path of a master INS; give --master the right"):
        load_pair(slave, slave)


@pytest.mark.parametrize("name", TRIALS)
def test_the_trials_themselves(data_dir, name):
    path = data_dir / f"{name}.npz"
    data = load_dataset([path])
    rows, missing = TRIALS[name]
    assert len(data.imu) == len(data.mag) == len(data.attitude) == rows
    assert np.isnan(data.attitude.q_nb[:, 0]).sum() == missing
    with np.load(path, allow_pickle=False) as raw:
        np.testing.assert_array_equal(data.imu.gyro, raw["imu_gyr"].astype(float))
        np.testing.assert_array_equal(data.imu.accel, raw["imu_acc"].astype(float))
        np.testing.assert_allclose(data.mag.field_t * 1e6, raw["imu_mag"], rtol=1e-7)
    # Gravity must be up and the field north and down by attitude truth: no axis is turned.
    still = ~data.attitude.moving & ~np.isnan(data.attitude.q_nb[:, 0])
    q = data.attitude.q_nb[still]

    def to_enu(v):
        w, u = q[:, :1], q[:, 1:]
        return np.median(v + 2.0 * np.cross(u, np.cross(u, v) + w * v), axis=0)

    np.testing.assert_allclose(to_enu(data.imu.accel[still]), [0.0, 0.0, 9.81], atol=0.2)
    east, north, up = to_enu(data.mag.field_t[still]) * 1e6
    # North of Berlin, 19 uT, and down, 46 uT, but for the steel of the laboratory.
    assert abs(east) < 5.0
    assert 10.0 < north < 25.0
    assert -50.0 < up < -35.0


# -------------------------------------------------------------------------------------------- x-io

XIO = "Time (s)," + ",".join(
    f"{sensor} {axis} ({unit})"
    for sensor, unit in (("Gyroscope", "deg/s"), ("Accelerometer", "g"), ("Magnetometer", "uT"))
    for axis in "XYZ"
)
XIO_ROWS = [f"{0.01 * k:.9f},180,-90,{k},0.5,-1,{k},20,-30,{k}.5" for k in range(8)]


def xio(header=XIO, rows=XIO_ROWS):
    return "\n".join([header, *rows]) + "\n"


def test_without_a_magnetometer_it_is_an_imu(tmp_path):
    header = ",".join(XIO.split(",")[:7])
    table = read(tmp_path, xio(header, [",".join(row.split(",")[:7]) for row in XIO_ROWS]))
    assert isinstance(table, ImuTable)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("Magnetometer Z (uT)", "Magnetometer Z (a.u.)"), r"Magnetometer Z \(a.u.\): .*unit"),
        (("Magnetometer Z (uT)", "Magnetometer Z (deg/s)"), r"Magnetometer Z \(deg/s\): .*magneti"),
    ],
)
def test_headers_that_are_not_understood(tmp_path, change, message):
    with pytest.raises(LogError, match=message):
        read(tmp_path, xio(XIO.replace(*change)))


def test_decimal_commas_are_refused_however_they_look(tmp_path):
    one = [row.replace(",0.5,", ",0,5,") if k == 3 else row for k, row in enumerate(XIO_ROWS)]
    assert "line 5: 11 fields where the first lines have 10" in refusal(tmp_path, xio(rows=one))
    # In every line alike, they would shift all columns behind them.
    every = [row.replace(",0.5,", ",0,5,") for row in XIO_ROWS]
    for told in (
        refusal(tmp_path, xio(rows=every[1:])),
        refusal(tmp_path, phone(rows=[row.replace("15.1", "15,1") for row in PHONE_ROWS])),
    ):
        assert "line 2" in told
        assert "with a decimal point, not a comma" in told
    split = [row.replace(",", ";").replace(".", ",") for row in XIO_ROWS]
    assert "with a decimal point, not a comma" in refusal(
        tmp_path, xio(XIO.replace(",", ";"), split)
    )


def test_a_cut_drive_gives_the_exact_prefix(tmp_path):
    text = phone().encode()
    good = read(tmp_path, text)
    for end in range(0, len(text), 7):
        found = []
        if text[:end].count(b"\n") < 2:  # no whole line of samples
            with pytest.raises(LogError):
                read(tmp_path, text[:end])
            continue
        data = read(tmp_path, text[:end], findings=found)
        n = len(data.imu)
        if n < len(good.imu):
            np.testing.assert_array_equal(data.imu.gyro, good.imu.gyro[:n])
            np.testing.assert_array_equal(data.imu.time_ns, good.imu.time_ns[:n])
            np.testing.assert_array_equal(data.mag.field_t, good.mag.field_t[: len(data.mag)])
        whole_lines = text[:end].endswith(b"\n")
        assert [f.code for f in found] == ([] if whole_lines else ["ends_early"])


# ------------------------------------------------------------------------------------------- phone

PHONE = (
    "time,bearingAccuracy,speedAccuracy,verticalAccuracy,horizontalAccuracy,speed,bearing,altitude,"
    "longitude,latitude,qw,acc_z,acc_y,acc_x,gyro_z,gyro_y,gyro_x,mag_z,mag_y,mag_x,pressure"
)
PHONE_ROWS = [
    f"2025-06-11 20:34:{27 + k}+00:00,10,0.5,3,15.1,2,90,{40 + k},-75.15,39.98,1,9.8,0.1,0.2,0.3,"
    f"0.2,0.1,-40,20,{k},1014"
    for k in range(6)
]


def phone(header=PHONE, rows=PHONE_ROWS):
    return "\n".join([header, *rows]) + "\n"


def test_a_drive_of_a_phone(tmp_path):
    data = read(tmp_path, phone())
    # 2025-06-11 20:34:27 UTC is 1749674067 s after 1970; GPS time is 18 s ahead.
    assert data.imu.time_ns[0] == 1_749_674_085_000_000_000
    assert np.diff(data.gnss.time_ns).tolist() == [1_000_000_000] * 5
    assert data.imu.body == data.mag.body == "RFU"
    assert data.imu.accel[0].tolist() == [0.2, 0.1, 9.8]
    assert data.imu.gyro[0].tolist() == [0.1, 0.2, 0.3]
    np.testing.assert_allclose(data.mag.field_t[2], [2e-6, 20e-6, -40e-6], rtol=1e-14)
    g = data.gnss
    np.testing.assert_allclose(np.rad2deg([g.lat_rad[0], g.lon_rad[0]]), [39.98, -75.15])
    assert g.alt_m.tolist() == [40.0 + k for k in range(6)]
    # 2 m/s to the east, across it unsure by 10 deg; of the vertical nothing is known.
    np.testing.assert_allclose(g.v_n[0, :2], [0.0, 2.0], atol=1e-15)
    assert np.isnan(g.v_n[:, 2]).all()
    np.testing.assert_allclose(g.sigma_v[0, :2], np.sqrt(0.25 + (2.0 * np.deg2rad(10.0)) ** 2))
    # 68 % of a circular normal distribution lie within the radius stated.
    rng = np.random.default_rng(2)
    radius = np.linalg.norm(g.sigma_m[0, :2] * rng.standard_normal((200_000, 2)), axis=1)
    assert abs(np.mean(radius < 15.1) - 0.68) < 0.005
    assert g.sigma_m[0, 2] == 3.0


def test_a_line_is_a_sample_only_of_what_it_holds(tmp_path):
    cells = [row.split(",") for row in PHONE_ROWS]
    cells[1][11:17] = [""] * 6  # no inertial sample
    cells[2][11] = ""  # one without z
    cells[3][17:20] = [""] * 3  # no magnetic field
    cells[4][9] = cells[4][8] = ""  # no fix
    data = read(tmp_path, phone(rows=[",".join(c) for c in cells]))
    assert data.imu.rows.tolist() == [2, 4, 5, 6, 7]
    assert np.isnan(data.imu.accel).sum() == 1
    assert data.mag.rows.tolist() == [2, 3, 4, 6, 7]
    assert data.gnss.rows.tolist() == [2, 3, 4, 5, 7]
    assert len(data.gnss) == len(data.gnss.v_n) == 5


def test_times_of_other_zones_and_with_decimals(tmp_path):
    stamps = ["2025-06-11T22:34:27.5+02:00", "2025-06-11 16:04:28-0430", "2025-06-11 20:34:29Z"]
    rows = [
        ",".join([s, *row.split(",")[1:]]) for s, row in zip(stamps, PHONE_ROWS[:3], strict=True)
    ]
    time_ns = read(tmp_path, phone(rows=rows)).imu.time_ns - 1_749_674_085_000_000_000
    assert time_ns.tolist() == [500_000_000, 1_000_000_000, 2_000_000_000]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (phone(PHONE.replace("mag_x", "mx")), "line 1: the header lacks mag_x; is it of another"),
        (phone(PHONE.replace("qw", "mag_x")), "line 1: the header names mag_x twice; keep one"),
        (phone().replace("20:34:29", "20:99:29"), r"line 4: time = '.*' *: is not a date and time"),
        (phone().replace("29+00:00", "29"), "line 4: time = '2025-06-11 20:34:29': is not a date"),
        (phone().replace("9.8", "9.8x"), "line 2: acc_z = '9.8x': is not a number"),
        (phone(rows=[r.replace("-40,20,", ",,").rsplit(",", 2)[0] + ",,1" for r in PHONE_ROWS]),
         "no line has magnetic field; record that sensor as well"),
    ],
)  # fmt: skip
def test_drives_that_are_refused(tmp_path, text, message):
    with pytest.raises(LogError, match=message):
        read(tmp_path, text)


# ------------------------------------------------------------------------------------ as they came


def test_the_sample_of_fusion(data_dir):
    data = load_dataset([data_dir / "fusion_sensor_data.csv.xz"])
    assert len(data.imu) == len(data.mag) == 13514
    assert data.imu.time_ns[1] == 10_078_907
    np.testing.assert_allclose(data.imu.gyro[1], np.deg2rad([0.01654156, -0.3308571, 0.04700107]))
    np.testing.assert_allclose(data.mag.field_t[0], [15.3017e-6, 0.4328527e-6, -41.06483e-6])
    assert abs(np.median(np.linalg.norm(data.imu.accel, axis=1)) - 9.8) < 0.1
    assert HZ == 100.0


def test_the_drive_of_strapdown_rs(data_dir):
    data = load_dataset([data_dir / "strapdownrs_phone_2025-06-11.csv.xz"])
    assert (len(data.imu), len(data.mag), len(data.gnss)) == (456, 448, 1648)
    size = np.linalg.norm(data.imu.accel, axis=1)
    assert abs(np.nanmedian(size) - 9.8) < 0.05
    assert data.imu.accel[0].tolist() == [1.8476419418506074, 8.288432051626485, 4.857616680391719]
    # Field and gravity keep their angle about as they should at 40 deg north, in Android's axes.
    both = np.intersect1d(data.imu.rows, data.mag.rows)
    f, m = (
        t[np.isin(rows, both)]
        for t, rows in ((data.imu.accel, data.imu.rows), (data.mag.field_t, data.mag.rows))
    )
    cosine = np.sum(f * m, axis=1) / np.linalg.norm(f, axis=1) / np.linalg.norm(m, axis=1)
    assert -0.95 < np.nanmedian(cosine) < -0.75
