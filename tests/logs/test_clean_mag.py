"""Field and attitude beside the inertial samples: nothing bad passes, nothing good is lost."""

import dataclasses

import numpy as np
import pytest
from made_nine_axis import tumble_dataset

from robins.dataset import AttitudeTable, MagTable
from robins.logs import LogError, clean

N = 60
RNG = np.random.default_rng(6)
TIME_NS = 10**18 + np.arange(N) * 5_000_000
Q = RNG.normal(size=(N, 4))
MAG = MagTable(TIME_NS, 1e-5 * RNG.normal(size=(N, 3)), source="m.npz", rows=np.arange(2, N + 2))
ATTITUDE = AttitudeTable(
    TIME_NS, Q / np.linalg.norm(Q, axis=1)[:, None], "ENU", moving=np.arange(N) > 9, source="m.npz"
)


@pytest.fixture(scope="module")
def base():
    return tumble_dataset(2.0)


def cleaned(base, **tables):
    out = clean(dataclasses.replace(base, **tables))
    return out, {k: n for k, n in out.counts.items() if n and not k.startswith("imu")}


def replaced(table, name, row, value):
    column = getattr(table, name).copy()
    column[row] = value
    return dataclasses.replace(table, **{name: column})


def test_what_is_sound_passes_bit_by_bit(base):
    out, counts = cleaned(base, mag=MAG, attitude=ATTITUDE)
    assert counts == {}
    for one, two in ((out.mag, MAG), (out.attitude, ATTITUDE)):
        for f in dataclasses.fields(one):
            assert np.array_equal(getattr(one, f.name), getattr(two, f.name)), f.name


@pytest.mark.parametrize(
    ("value", "reason"),
    [(np.nan, "nan"), (np.inf, "inf"), (-np.inf, "inf"), (1e308, "absurd"), (-1.5, "absurd")],
)
def test_a_bad_component_goes_missing_and_is_counted(base, value, reason):
    out, counts = cleaned(base, mag=replaced(MAG, "field_t", (7, 1), value), attitude=None)
    assert counts == {f"mag_{reason}": 1}
    assert len(out.mag) == N
    assert np.isnan(out.mag.field_t).sum() == 1
    good = ~np.isnan(out.mag.field_t)
    np.testing.assert_array_equal(out.mag.field_t[good], MAG.field_t[good])
    assert np.isfinite(clean(base).mag.field_t).all()


def test_small_numbers_are_numbers(base):
    out, counts = cleaned(base, mag=replaced(MAG, "field_t", (7, 1), 5e-324), attitude=None)
    assert counts == {}
    assert out.mag.field_t[7, 1] == 5e-324


@pytest.mark.parametrize(
    ("value", "reason"),
    [(np.nan, "nan"), (np.inf, "inf"), (7.0, "absurd"), (1e308, "absurd")],
)
def test_an_attitude_is_missing_whole(base, value, reason):
    out, counts = cleaned(base, mag=None, attitude=replaced(ATTITUDE, "q_nb", (7, 2), value))
    assert counts == {f"attitude_{reason}": 1}
    assert np.isnan(out.attitude.q_nb).all(axis=1).tolist() == [k == 7 for k in range(N)]
    others = np.arange(N) != 7
    np.testing.assert_array_equal(out.attitude.q_nb[others], ATTITUDE.q_nb[others])


def test_a_quaternion_of_zeros_is_none(base):
    out, counts = cleaned(base, mag=None, attitude=replaced(ATTITUDE, "q_nb", 7, 0.0))
    assert counts == {"attitude_absurd": 1}
    assert np.isnan(out.attitude.q_nb[7]).all()


@pytest.mark.parametrize(
    ("step_ns", "reason"),
    [(0, "duplicate"), (-5_000_000, "backward"), (-(10**9), "backward"), (3600 * 10**9, "ahead")],
)
@pytest.mark.parametrize("kind", ["mag", "attitude"])
def test_a_row_out_of_order_is_as_if_it_had_never_been(base, kind, step_ns, reason):
    table = MAG if kind == "mag" else ATTITUDE
    arrays = {
        f.name: np.insert(getattr(table, f.name), 20, getattr(table, f.name)[19], axis=0)
        for f in dataclasses.fields(table)
        if isinstance(getattr(table, f.name), np.ndarray)
    }
    arrays["time_ns"][20] = TIME_NS[19] + step_ns
    other = {"mag": None, "attitude": None}
    more = cleaned(base, **(other | {kind: dataclasses.replace(table, **arrays)}))
    assert more[1] == {f"{kind}_{reason}": 1}
    out = getattr(more[0], kind)
    for name, value in arrays.items():
        np.testing.assert_array_equal(getattr(out, name), np.delete(value, 20, 0), err_msg=name)


def test_rows_that_are_missing_stay_beside_the_samples(base):
    field_t = base.mag.field_t.copy()
    field_t[3:9] = np.nan
    out, counts = cleaned(base, mag=dataclasses.replace(base.mag, field_t=field_t))
    assert counts == {"mag_nan": 6, "attitude_nan": 20}
    assert len(out.imu) == len(out.mag) == len(out.attitude) == 200


def test_arrays_that_are_no_tables(base):
    for table, message in (
        (dataclasses.replace(MAG, field_t=MAG.field_t[:-1]), r"field_t: has shape \(59, 3\)"),
        (dataclasses.replace(MAG, field_t=MAG.field_t * 1j), "field_t: holds complex128"),
        (dataclasses.replace(MAG, time_ns=TIME_NS * 1.0), "time_ns: is float64 of shape"),
        (dataclasses.replace(ATTITUDE, q_nb=ATTITUDE.q_nb[:, :3]), r"q_nb: has shape \(60, 3\)"),
        (dataclasses.replace(ATTITUDE, moving=np.ones(N)), "moving: is float64, not bool"),
        (dataclasses.replace(ATTITUDE, moving=ATTITUDE.moving[1:]), r"moving: has shape \(59,\)"),
    ):
        kind = "mag" if isinstance(table, MagTable) else "attitude"
        with pytest.raises(LogError, match=message):
            clean(dataclasses.replace(base, **{kind: table}))


def test_single_precision_and_strides_are_the_same_numbers(base):
    wide = np.zeros((N, 6), np.float32)
    wide[:, ::2] = MAG.field_t
    out, _ = cleaned(base, mag=dataclasses.replace(MAG, field_t=wide[:, ::2]))
    assert out.mag.field_t.dtype == np.float64
    assert out.mag.field_t.flags.c_contiguous
    np.testing.assert_array_equal(out.mag.field_t, MAG.field_t.astype(np.float32))
