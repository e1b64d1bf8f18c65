"""A sensor turned into a vehicle: samples, field and attitude together."""

import dataclasses

import numpy as np
import pytest
from made_nine_axis import archive, matrices, tumble, tumble_dataset

from robins.dataset import GnssTable
from robins.logs import Mounting, load_dataset
from robins.logs.mounting import turned

ANGLES = (170.0, -20.0, 65.0)


def dcm(q):
    """(n, 3, 3) of quaternions, by turning the three axes with them."""
    w, v = q[:, None, :1], q[:, None, 1:]
    e = np.eye(3)[None]
    return np.swapaxes(e + 2.0 * np.cross(v, np.cross(v, e) + w * e), 1, 2)


@pytest.fixture(scope="module")
def data():
    return tumble_dataset(8.0)


def to_nav(attitude, vectors):
    good = ~np.isnan(attitude.q_nb[:, 0])
    return np.einsum("nij,nj->ni", dcm(attitude.q_nb[good]), vectors[good])


def test_what_is_seen_from_the_ground_does_not_depend_on_the_mounting(data):
    """Gravity, rate and field in navigation axes are the same before and after."""
    mounting = Mounting(*ANGLES)
    out = turned(data, mounting)
    for before, after in (
        (data.imu.accel, out.imu.accel),
        (data.imu.gyro, out.imu.gyro),
        (1e6 * data.mag.field_t, 1e6 * out.mag.field_t),
    ):
        assert np.abs(before - after).max() > 0.5
        np.testing.assert_allclose(
            to_nav(out.attitude, after), to_nav(data.attitude, before), rtol=0, atol=1e-12
        )
    roll, pitch, yaw = np.deg2rad(ANGLES)
    C_sb = (
        matrices([0, 0, 1], np.array([yaw]))
        @ matrices([0, 1, 0], np.array([pitch]))
        @ matrices([1, 0, 0], np.array([roll]))
    )[0]
    np.testing.assert_allclose(out.mag.field_t, data.mag.field_t @ C_sb, rtol=0, atol=1e-18)
    assert out.attitude.nav == "ENU"


def test_turning_by_right_angles_keeps_every_bit_and_every_nan_on_its_axis(data):
    """Turns by right angles: the turn of the walk only exchanges axes."""
    mounting = Mounting(180.0, 0.0, -90.0)
    assert mounting.dcm_bs().tolist() == [[0, -1, 0], [-1, 0, 0], [0, 0, -1]]
    gyro = data.imu.gyro.copy()
    gyro[3, 2] = np.nan
    out = mounting.turn(dataclasses.replace(data.imu, gyro=gyro))
    np.testing.assert_array_equal(out.gyro, -gyro[:, [1, 0, 2]])
    with pytest.raises(ValueError, match="must be finite"):
        Mounting(np.nan).dcm_bs()


def test_missing_attitudes_stay_missing(data):
    out = turned(data.attitude, Mounting(*ANGLES))
    np.testing.assert_array_equal(np.isnan(out.q_nb), np.isnan(data.attitude.q_nb))
    np.testing.assert_array_equal(out.moving, data.attitude.moving)


def test_without_angles_nothing_is_rounded(data):
    out = turned(data, Mounting())
    for kind, name in (("imu", "gyro"), ("imu", "accel"), ("mag", "field_t"), ("attitude", "q_nb")):
        one, two = (getattr(getattr(d, kind), name) for d in (out, data))
        np.testing.assert_array_equal(one, two)
    assert turned(data, None) is data


def relabelled(data):
    """The same in right-forward-up, by the half turn about (1, 1, 0); navigation axes untouched."""
    T = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    w, x, y, z = data.attitude.q_nb.T
    q = np.sqrt(0.5) * np.stack([-x - y, w - z, w + z, x - y], axis=1)  # times (0, 1, 1, 0)
    changes = {
        "imu": {"gyro": data.imu.gyro @ T.T, "accel": data.imu.accel @ T.T},
        "mag": {"field_t": data.mag.field_t @ T.T},
        "attitude": {"q_nb": q},
    }
    tables = {
        kind: dataclasses.replace(getattr(data, kind), body="RFU", **columns)
        for kind, columns in changes.items()
    }
    return dataclasses.replace(data, **tables)


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), ANGLES])
@pytest.mark.parametrize("nav", ["ENU", "NED"])
def test_right_forward_up_is_named_anew_before_it_is_turned(data, angles, nav):
    """A phone's axes, and the same axes under their other name, give one answer."""
    frd = dataclasses.replace(data, attitude=dataclasses.replace(data.attitude, nav=nav))
    one, two = (turned(d, Mounting(*angles)) for d in (frd, relabelled(frd)))
    assert two.imu.body == two.mag.body == two.attitude.body == "FRD"
    assert two.attitude.nav == nav
    np.testing.assert_allclose(one.imu.gyro, two.imu.gyro, rtol=0, atol=1e-14)
    np.testing.assert_allclose(one.mag.field_t, two.mag.field_t, rtol=0, atol=1e-19)
    np.testing.assert_allclose(
        to_nav(one.attitude, one.imu.accel), to_nav(two.attitude, two.imu.accel), atol=1e-13
    )


def test_fixes_are_not_on_the_axes_of_the_sensor(data):
    zero = np.zeros(2)
    gnss = GnssTable(np.arange(2), zero, zero, zero, np.ones((2, 3)))
    assert turned(gnss, Mounting(*ANGLES)) is gnss


def test_a_dataset_is_loaded_turned(tmp_path):
    path = tmp_path / "trial.npz"
    path.write_bytes(archive(tumble(2.0)))
    plain, out = load_dataset([path]), load_dataset([path], mounting=Mounting(*ANGLES))
    by_hand = turned(plain, Mounting(*ANGLES))
    np.testing.assert_array_equal(out.mag.field_t, by_hand.mag.field_t)
    np.testing.assert_array_equal(out.attitude.q_nb, by_hand.attitude.q_nb)
