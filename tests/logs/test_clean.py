"""Bad samples anywhere (F01-F04, F06, F07, F10): refused, counted, then absent."""

import dataclasses
import inspect

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_logs import rows_of, with_gnss, with_imu
from made_spoilt import in_bursts, read_at_once

from robins.dataset import AttitudeTable, Dataset, GnssTable, ImuTable, MagTable, Trajectory
from robins.ins.increments import from_imu
from robins.logs import LogError, Mounting, clean, examine, load_dataset, write_log

N = 200
IMU = ImuTable(
    time_ns=10**18 + np.arange(N) * 5_000_000,
    gyro=np.random.default_rng(1).normal(size=(N, 3)),
    accel=np.random.default_rng(2).normal(size=(N, 3)),
    kind="rate",
    source="imu.csv",
    rows=np.arange(1, N + 1),
)
M = 30
GNSS = GnssTable(
    time_ns=10**18 + np.arange(M) * 200_000_000,
    lat_rad=0.8 + 1e-7 * np.arange(M),
    lon_rad=0.1 + 1e-7 * np.arange(M),
    alt_m=400.0 + 0.1 * np.arange(M),
    sigma_m=np.full((M, 3), 0.02),
    v_n=np.random.default_rng(3).normal(size=(M, 3)),
    sigma_v=np.full((M, 3), 0.05),
    quality=np.ones(M, int),
    source="gnss.pos",
    rows=np.arange(1, M + 1),
)
Q = np.random.default_rng(6).normal(size=(M, 4))
Q /= np.linalg.norm(Q, axis=1)[:, None]
DATA = Dataset(
    "made",
    IMU,
    GNSS,
    Trajectory(GNSS.time_ns, GNSS.lat_rad, GNSS.lon_rad, GNSS.alt_m, GNSS.v_n, Q, source="t.csv"),
    mag=MagTable(GNSS.time_ns, 1e-5 * GNSS.v_n, source="m.npz", rows=np.arange(2, M + 2)),
    attitude=AttitudeTable(GNSS.time_ns, Q, "ENU", moving=np.arange(M) > 9, source="m.npz"),
)
DATA = dataclasses.replace(DATA, master=DATA.truth)
TABLES = ["imu", "gnss", "truth", "master", "mag", "attitude"]


def cleaned(**tables):
    return clean(dataclasses.replace(DATA, **tables))


def assert_same(one, two):
    """Bit by bit, line numbers left out: those of later rows move by the row put in."""
    assert type(one) is type(two)
    for f in dataclasses.fields(one):
        a, b = getattr(one, f.name), getattr(two, f.name)
        if isinstance(a, np.ndarray) and f.name != "rows":
            assert a.dtype == b.dtype
            assert a.tobytes() == b.tobytes(), f.name


def assert_all_same(one, two):
    for kind in TABLES:
        if getattr(two, kind) is not None:
            assert_same(getattr(one, kind), getattr(two, kind))


def put(table, name, row, value):
    """The table with one number changed."""
    column = getattr(table, name).copy()
    column[row] = value
    return dataclasses.replace(table, **{name: column})


def refused(counts):
    return {reason: n for reason, n in counts.items() if n}


def put_in(table, at, time_ns, **values):
    """The table with one more row in place `at`: a copy of the one before, with changes."""
    arrays = {}
    for f in dataclasses.fields(table):
        column = getattr(table, f.name)
        if isinstance(column, np.ndarray):
            row = column[at - 1].copy() if f.name not in values else values[f.name]
            arrays[f.name] = np.insert(column, at, time_ns if f.name == "time_ns" else row, axis=0)
    return dataclasses.replace(table, **arrays)


def spoil(kind, table, at, axis, pick):
    """One bad row in place `at`, and the reason it should be counted under."""
    before = int(table.time_ns[at - 1])
    between = (before + int(table.time_ns[at])) // 2 if at < len(table) else before + 1
    sensor = ("gyro", "accel")[axis // 3]
    row = getattr(table, sensor)[at - 1].copy()
    if kind in ("nan", "inf", "-inf", "1e308", "1e9"):
        row[axis % 3] = float(kind)
        return put_in(table, at, between, **{sensor: row}), (
            kind if kind == "nan" else "inf" if "inf" in kind else "absurd"
        )
    if kind == "duplicate":
        return put_in(table, at, before, gyro=row + 1.0), "duplicate"
    back = {"sample": 5_000_000, "second": 10**9, "hour": 3600 * 10**9}[pick]
    return put_in(table, at, before - back), "backward" if back else "duplicate"


KINDS = ["nan", "inf", "-inf", "1e308", "1e9", "duplicate", "backward"]
BACK = ["sample", "second", "hour"]


@pytest.fixture(scope="module", params=["made", "walk"])
def data(request):
    if request.param == "made":
        return Dataset("made", IMU, GNSS)
    files = request.getfixturevalue("walk_files")
    return load_dataset(files, mounting=Mounting(180.0, 0.0, -90.0))


@given(draw=st.data())
def test_one_bad_imu_sample_anywhere(data, draw):
    at = draw.draw(st.integers(1, len(data.imu)))
    kind, pick = draw.draw(st.sampled_from(KINDS)), draw.draw(st.sampled_from(BACK))
    imu, reason = spoil(kind, data.imu, at, draw.draw(st.integers(0, 5)), pick)
    got = clean(dataclasses.replace(data, imu=imu))
    assert_all_same(got, data)
    # A step back by one sample meets the stamp before the last: an earlier time all the same.
    assert refused(got.counts) == {f"imu_{reason}": 1}
    assert got.imu_gaps == clean(data).imu_gaps


@given(
    st.sampled_from(TABLES),
    st.integers(1, M - 2),
    st.sampled_from([(0, "duplicate"), (-(10**9) - 7, "backward"), (3600 * 10**9, "ahead")]),
)
def test_a_row_out_of_order_is_as_if_it_had_never_been(kind, at, step):
    table = getattr(DATA, kind)
    got = cleaned(**{kind: put_in(table, at, table.time_ns[at - 1] + step[0])})
    assert_all_same(got, DATA)
    assert refused(got.counts) == {f"{kind}_{step[1]}": 1}


def test_a_clean_log_passes_bit_by_bit_and_all_reasons_are_listed():
    got = clean(DATA)
    assert_all_same(got, DATA)
    reasons = ("absurd", "ahead", "backward", "duplicate", "inf", "nan")
    listed = [f"{kind}_{reason}" for kind in TABLES for reason in reasons]
    assert got.counts == dict.fromkeys([*listed, "gnss_sigma"], 0)
    assert clean(Dataset("bare", IMU)).gnss is None


def test_cleaning_twice_changes_nothing_and_keeps_the_counts():
    once = cleaned(imu=put(IMU, "gyro", (7, 1), np.nan), counts={"imu_nan": 2, "late": 5})
    twice = clean(once)
    assert refused(once.counts) == {"imu_nan": 3, "late": 5}
    assert twice.counts == once.counts
    assert_same(twice.imu, once.imu)


def test_many_bad_samples_of_every_kind_at_once():
    rng = np.random.default_rng(8)
    gyro, accel, time_ns = IMU.gyro.copy(), IMU.accel.copy(), IMU.time_ns.copy()
    bad = rng.permutation(np.arange(1, N - 1))[:60].reshape(6, 10)
    gyro[bad[0], 0] = np.nan
    accel[bad[1], 1] = np.inf
    gyro[bad[2], 2] = -1e20
    accel[bad[0], 2] = np.inf  # a row is counted once, by its first reason
    good = np.ones(N, bool)
    good[bad[:3]] = False
    got = clean(with_imu(DATA, gyro=gyro, accel=accel, time_ns=time_ns))
    assert_same(got.imu, rows_of(IMU, good))
    assert refused(got.counts) == {"imu_nan": 10, "imu_inf": 10, "imu_absurd": 10}


def test_denormals_and_large_but_possible_numbers_pass():
    gyro, accel = IMU.gyro.copy(), IMU.accel.copy()
    gyro[3], accel[4] = [5e-324, -1e-310, 60.0], [5e5, -1e-308, 0.0]
    got = clean(with_imu(DATA, gyro=gyro, accel=accel))
    assert refused(got.counts) == {}
    assert_same(got.imu, dataclasses.replace(IMU, gyro=gyro, accel=accel))


@pytest.mark.parametrize(
    ("rows", "step_ns", "lost", "counts", "gaps"),
    [
        (slice(120, N), -100_000_000, slice(120, 140), {"duplicate": 1, "backward": 19}, [119]),
        (slice(60, N), -(10**17), slice(60), {"ahead": 60}, []),
        (slice(50, 51), 3600 * 10**9, slice(50, 51), {"ahead": 1}, []),
    ],
    ids=["set back", "a restart", "a lone stamp in the future"],
)
def test_a_clock_that_steps_costs_the_shorter_part(rows, step_ns, lost, counts, gaps):
    """A clock set back: time is refused until it passes, and declared as a gap."""
    time_ns = IMU.time_ns.copy()
    time_ns[rows] += step_ns
    got = clean(with_imu(DATA, time_ns=time_ns))
    keep = np.delete(np.arange(N), lost)
    assert_same(got.imu, rows_of(dataclasses.replace(IMU, time_ns=time_ns), keep))
    assert refused(got.counts) == {f"imu_{reason}": n for reason, n in counts.items()}
    assert got.imu_gaps == [(time_ns[before], time_ns[lost.stop]) for before in gaps]


@pytest.mark.parametrize(
    ("kind", "lost", "declared"),
    [("rate", 1, False), ("rate", 2, True), ("increment", 1, True), ("rate", 60, True)],
)
def test_gaps_are_declared(kind, lost, declared):
    keep = np.ones(N, bool)
    keep[100 : 100 + lost] = False
    got = clean(dataclasses.replace(DATA, imu=rows_of(dataclasses.replace(IMU, kind=kind), keep)))
    gap = (int(IMU.time_ns[99]), int(IMU.time_ns[100 + lost]))
    assert got.imu_gaps == ([gap] if declared else [])


def test_ten_nan_in_a_row_are_one_gap():
    got = cleaned(imu=put(IMU, "gyro", slice(40, 50), np.nan))
    assert refused(got.counts) == {"imu_nan": 10}
    assert got.imu_gaps == [(IMU.time_ns[39], IMU.time_ns[50])]


def test_nan_for_ever_is_refused_with_the_reason():
    message = r"imu.csv: fewer than two of 200 .*\(refused: 200 nan\); the"
    with pytest.raises(LogError, match=message):
        clean(with_imu(DATA, gyro=np.full((N, 3), np.nan)))


@pytest.mark.parametrize("stamps", [read_at_once, in_bursts])
@pytest.mark.parametrize("kind", ["rate", "increment"])
def test_samples_read_at_once_are_spread_evenly(stamps, kind):
    """Samples, and the field of the same file, whose readings may repeat within a batch."""
    imu = dataclasses.replace(IMU, kind=kind)
    field_t = np.repeat(np.random.default_rng(4).normal(size=(N // 10, 3)), 10, axis=0) * 1e-5
    data = dataclasses.replace(DATA, imu=imu, mag=MagTable(IMU.time_ns, field_t))
    at_once = dataclasses.replace(imu, time_ns=stamps(imu.time_ns))
    got = clean(dataclasses.replace(data, imu=at_once, mag=MagTable(at_once.time_ns, field_t)))
    assert_all_same(got, data)
    assert refused(got.counts) == {"imu_spread": N - N // 10, "mag_spread": N - N // 10}
    assert got.imu_gaps == []


def test_lost_decimals_cost_half_of_the_last_one():
    rounded = (IMU.time_ns + 5_000_000) // 10_000_000 * 10_000_000
    got = clean(with_imu(DATA, time_ns=rounded))
    assert np.abs(got.imu.time_ns - IMU.time_ns).max() <= 5_000_000
    assert np.all(np.abs(np.diff(got.imu.time_ns)[1:] - 5_000_000) < 10)


def test_a_lost_batch_is_a_gap_and_repeated_rows_are_no_batch():
    keep = np.delete(np.arange(N), np.r_[100:110])
    at_once = dataclasses.replace(rows_of(IMU, keep), time_ns=read_at_once(IMU.time_ns)[keep])
    got = cleaned(imu=at_once)
    assert_same(got.imu, rows_of(IMU, keep))
    assert got.imu_gaps == [(IMU.time_ns[99], IMU.time_ns[110])]
    twice = clean(with_imu(DATA, **vars(rows_of(IMU, np.arange(2 * N) // 2))))
    assert_same(twice.imu, IMU)
    assert refused(twice.counts) == {"imu_duplicate": N}


# ------------------------------------------------------------------------------------- GNSS


@given(st.integers(0, M - 1), st.integers(0, 5), st.sampled_from([np.nan, np.inf, -np.inf, 1e300]))
def test_one_bad_gnss_component_leaves_the_others(at, axis, bad):
    name = ("lat_rad", "lon_rad", "alt_m", "v_n", "v_n", "v_n")[axis]
    place = at if axis < 3 else (at, axis - 3)
    got = cleaned(gnss=put(GNSS, name, place, bad))
    reason = "nan" if np.isnan(bad) else "inf" if np.isinf(bad) else "absurd"
    assert refused(got.counts) == {f"gnss_{reason}": 1}
    expected = put(GNSS, name, place, np.nan)
    for name in ("lat_rad", "lon_rad", "alt_m", "v_n", "sigma_m", "sigma_v"):
        np.testing.assert_array_equal(getattr(got.gnss, name), getattr(expected, name))


@pytest.mark.parametrize(
    ("bad", "reason"), [(0.0, "sigma"), (-1.0, "sigma"), (np.nan, "nan"), (np.inf, "inf")]
)
def test_a_component_without_a_usable_sigma_is_missing(bad, reason):
    got = cleaned(gnss=put(GNSS, "sigma_m", (4, 2), bad))
    assert np.flatnonzero(np.isnan(got.gnss.alt_m)).tolist() == [4]
    assert np.all(got.gnss.sigma_m > 0)
    assert refused(got.counts) == {f"gnss_{reason}": 1}


@pytest.mark.parametrize(
    ("change", "kept", "assumed"),
    [
        (
            {"sigma_m": np.zeros((M, 3))},
            "sigma_v",
            [[0.02, 0.02, 0.04], [0.3, 0.3, 0.6], [3, 3, 6]],
        ),
        (
            {"sigma_v": -GNSS.sigma_v},
            "sigma_m",
            [[0.05, 0.05, 0.1], [0.1, 0.1, 0.2], [0.3, 0.3, 0.6]],
        ),
        ({"sigma_v": GNSS.sigma_v * np.nan}, "sigma_m", [[0.05] * 2, [0.1] * 2, [0.3] * 2]),
        ({"sigma_m": GNSS.sigma_m * [1, 1, 0]}, "sigma_v", [[None, None, 0.04], [None, None, 0.6]]),
    ],
    ids=["zero", "negative", "missing", "of the height"],
)
def test_sigmas_that_are_never_positive_are_assumed_by_the_kind_of_fix(change, kept, assumed):
    """Fixed, float and single; what is stated stays."""
    quality = np.repeat([1, 2, 5], M // 3)
    got = clean(with_gnss(DATA, quality=quality, **change))
    (name,) = change
    for k, row in enumerate(assumed):
        for axis, sigma in enumerate(row):
            stated = getattr(GNSS, name)[:, axis]
            expected = stated[quality == (1, 2, 5)[k]] if sigma is None else sigma
            np.testing.assert_array_equal(
                getattr(got.gnss, name)[quality == (1, 2, 5)[k], axis], expected
            )
    np.testing.assert_array_equal(getattr(got.gnss, kept), getattr(GNSS, kept))
    marks = got.gnss.assumed_m if name == "sigma_m" else got.gnss.assumed_v
    for k, axis in np.ndindex(len(assumed), len(assumed[0])):
        assert (marks[quality == (1, 2, 5)[k], axis] == (assumed[k][axis] is not None)).all()
    assert [f.code for f in got.findings] == ["sigma_assumed"]
    assert refused(got.counts) == {}
    assert clean(got).findings == got.findings
    np.testing.assert_array_equal(getattr(clean(got).gnss, f"assumed{name[5:]}"), marks)


def test_a_fix_without_any_component_is_refused_whole():
    nan = np.nan
    hole = {"lat_rad": nan, "lon_rad": nan, "alt_m": nan, "v_n": np.full(3, nan)}
    got = cleaned(gnss=put_in(GNSS, 9, GNSS.time_ns[8] + 1000, **hole))
    assert_same(got.gnss, GNSS)
    assert refused(got.counts) == {"gnss_nan": 1}


def test_positions_without_velocities():
    got = clean(with_gnss(DATA, v_n=None, sigma_v=None))
    assert got.gnss.v_n is None
    np.testing.assert_array_equal(got.gnss.alt_m, GNSS.alt_m)


# ------------------------------------------------------------------- paths, field and attitude


def test_a_row_of_a_path_is_refused_whole():
    got = cleaned(truth=put(DATA.truth, "q_nb", (3, 0), np.nan))
    assert_same(got.truth, rows_of(DATA.truth, np.arange(M) != 3))
    assert refused(got.counts) == {"truth_nan": 1}
    without = put(DATA.truth, "v_n", (3, 0), np.nan)
    assert_same(cleaned(truth=without).truth, without)


@pytest.mark.parametrize(
    ("value", "reason"),
    [(np.nan, "nan"), (np.inf, "inf"), (-np.inf, "inf"), (1e308, "absurd"), (-1.5, "absurd")],
)
@pytest.mark.parametrize(
    ("kind", "column", "whole"), [("mag", "field_t", False), ("attitude", "q_nb", True)]
)
def test_what_is_bad_beside_the_samples_goes_missing_and_its_row_stays(
    kind, column, whole, value, reason
):
    table = getattr(DATA, kind)
    got = cleaned(**{kind: put(table, column, (7, 1), value)})
    expected = getattr(table, column).copy()
    expected[7, slice(None) if whole else 1] = np.nan
    np.testing.assert_array_equal(getattr(getattr(got, kind), column), expected)
    assert refused(got.counts) == {f"{kind}_{reason}": 1}


def test_small_numbers_are_numbers_and_a_quaternion_of_zeros_is_none():
    small = put(DATA.mag, "field_t", (7, 1), 5e-324)
    assert_same(cleaned(mag=small).mag, small)
    got = cleaned(attitude=put(DATA.attitude, "q_nb", 7, 0.0))
    assert refused(got.counts) == {"attitude_absurd": 1}
    assert np.isnan(got.attitude.q_nb[7]).all()


# ------------------------------------------------------------------------------ arrays (F04)


@pytest.mark.parametrize("kind", ["float32", "big-endian", "strided", "integer", "fortran"])
def test_other_arrays_of_numbers_give_the_same(kind):
    change = {
        "float32": lambda a: a.astype(np.float32),
        "big-endian": lambda a: a.astype(">f8"),
        "strided": lambda a: np.repeat(a, 2, axis=0)[::2],
        "integer": lambda a: np.round(a * 10).astype(np.int32),
        "fortran": np.asfortranarray,
    }[kind]
    gyro = change(IMU.gyro)
    got = clean(with_imu(DATA, gyro=gyro, time_ns=IMU.time_ns.astype(">i8"))).imu
    assert (got.gyro.dtype, got.time_ns.dtype) == (np.float64, np.int64)
    assert got.gyro.flags.c_contiguous
    np.testing.assert_array_equal(got.gyro, gyro.astype(np.float64))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gyro": np.full((N, 3), None)}, r"imu.csv: gyro: holds object, not real numbers; give"),
        ({"gyro": IMU.gyro.astype(str)}, r"gyro: holds <U32, not real numbers"),
        ({"accel": IMU.accel.astype(complex)}, r"accel: holds complex128, not real"),
        ({"accel": IMU.accel[:-1]}, r"accel: has shape \(199, 3\) where \(200, 3\) is needed; one"),
        ({"accel": IMU.accel[:, :2]}, r"shape \(200, 2\)"),
        ({"time_ns": IMU.time_ns * 1e-9}, r"time_ns: is float64 of .*; give time as int64 nano"),
        ({"rows": IMU.rows[:5]}, r"rows: has shape \(5,\)"),
        ({"kind": "rates"}, r"kind = 'rates': is neither 'rate' nor 'increment'"),
        ({"field_t": DATA.mag.field_t[:-1]}, r"field_t: has shape \(29, 3\)"),
        ({"field_t": DATA.mag.field_t * 1j}, "field_t: holds complex128"),
        ({"q_nb": Q[:, :3], "moving": None}, r"q_nb: has shape \(30, 3\)"),
        ({"moving": np.ones(M)}, "moving: is float64, not bool"),
        ({"moving": DATA.attitude.moving[1:]}, r"moving: has shape \(29,\)"),
    ],
)
def test_arrays_that_are_no_table(change, message):
    kind = next(k for k in ("imu", "mag", "attitude") if hasattr(getattr(DATA, k), [*change][-1]))
    good = getattr(DATA, kind)
    table = object.__new__(type(good))  # as a user without checked annotations would have it
    for f in dataclasses.fields(good):
        object.__setattr__(table, f.name, change.get(f.name, getattr(good, f.name)))
    with pytest.raises(LogError, match=message):
        cleaned(**{kind: table})


def test_velocities_without_their_sigmas():
    with pytest.raises(LogError, match="belong together; give sigma_v as well"):
        clean(with_gnss(DATA, sigma_v=None))


def test_what_is_no_dataset_or_no_table_is_named(drive):
    imu = drive.imu
    with pytest.raises(TypeError, match=r"clean takes Dataset, got ImuTable; .*\(name, imu="):
        inspect.unwrap(clean)(imu)
    with pytest.raises(TypeError, match="from_imu takes ImuTable, got Dataset"):
        inspect.unwrap(from_imu)(drive)
    for call, *first in ((examine,), (write_log, "nowhere.csv")):
        with pytest.raises(TypeError, match=f"{call.__name__} takes Dataset, .*, got ndarray"):
            inspect.unwrap(call)(*first, np.zeros((3, 3)))
