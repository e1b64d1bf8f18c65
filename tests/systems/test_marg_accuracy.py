"""BROAD's errors, and what the names of frames mean for them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robins.dataset import AttitudeTable
from robins.systems.marg.replay import orientation_errors, rms_deg, truth_at
from robins.systems.marg.start import attitude_of


def scalar_first(rotation):
    return np.roll(rotation.as_quat(), 1, axis=-1)


def test_errors_are_those_of_the_definition():
    rng = np.random.default_rng(0)
    estimated, true = Rotation.random(200, random_state=rng), Rotation.random(200, random_state=rng)
    found = orientation_errors(scalar_first(estimated), scalar_first(true))
    w, _, _, z = scalar_first(estimated * true.inv()).T
    np.testing.assert_allclose(found.total, 2.0 * np.arccos(np.abs(w)), atol=1e-7)
    np.testing.assert_allclose(found.heading, 2.0 * np.arctan(z / w), atol=1e-12)
    np.testing.assert_allclose(found.inclination, 2.0 * np.arccos(np.hypot(w, z)), atol=1e-7)


@pytest.mark.parametrize("first", [1.0, -1.0])
def test_a_heading_error_and_a_tilt_are_told_apart(first):
    true = Rotation.from_euler("ZYX", [0.4, -1.1, 2.0])
    wrong = Rotation.from_euler("Z", 0.2) * Rotation.from_rotvec([0.05, 0.0, 0.0]) * true
    q = first * scalar_first(wrong)[None]
    e = orientation_errors(q, scalar_first(true)[None])
    assert e.heading[0] == pytest.approx(0.2, abs=1e-12)
    assert e.inclination[0] == pytest.approx(0.05, abs=1e-12)
    assert np.cos(e.total[0] / 2.0) == pytest.approx(np.cos(0.1) * np.cos(0.025), abs=1e-12)


def test_errors_are_the_same_in_enu_and_ned():
    rng = np.random.default_rng(1)
    estimated, true = Rotation.random(50, random_state=rng), Rotation.random(50, random_state=rng)
    relabel = Rotation.from_rotvec(np.pi * np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0]))
    ned = orientation_errors(scalar_first(estimated), scalar_first(true))
    enu = orientation_errors(scalar_first(relabel * estimated), scalar_first(relabel * true))
    np.testing.assert_allclose(enu.total, ned.total, atol=1e-12)
    np.testing.assert_allclose(enu.heading, -ned.heading, atol=1e-12)
    np.testing.assert_allclose(enu.inclination, ned.inclination, atol=1e-12)


def test_a_sensor_turned_to_the_left_by_a_right_angle_points_west():
    """Pins frames, order and direction: in ENU that is a yaw of +90 deg, in NED a heading of -90.

    A sensor that lies with x to the east, y to the north, z up has q_ENU = 1.
    """
    table = AttitudeTable(
        np.array([0, 10]),
        np.array([[1.0, 0.0, 0.0, 0.0], [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]]),
        nav="ENU",
    )
    q, counts = truth_at(table, table.time_ns)
    assert counts.all()
    x_n = Rotation.from_quat(np.roll(q, -1, axis=1)).apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(x_n, [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], atol=1e-12)
    # the same two attitudes from gravity and field: up is z; the field is along y, then along x
    up = np.array([0.0, 0.0, 9.81])
    for row, field_b in zip(q, ([0.0, 2.0, -4.0], [2.0, 0.0, -4.0]), strict=True):
        found = attitude_of(up, np.array(field_b))
        assert abs(found @ row) == pytest.approx(1.0, abs=1e-12)


def test_truth_is_the_nearest_and_counts_only_in_motion_and_where_it_is():
    q = np.tile([1.0, 0.0, 0.0, 0.0], (4, 1))
    q[2] = np.nan
    table = AttitudeTable(
        np.array([0, 100, 200, 300]), q, moving=np.array([False, True, True, True])
    )
    found, counts = truth_at(table, np.array([0, 90, 210, 301, 400]))
    assert counts.tolist() == [False, True, False, True, False]
    assert np.isnan(found[2]).all()
    assert np.isnan(found[4]).all()


def test_root_mean_square():
    assert rms_deg(np.radians([3.0, -4.0])) == pytest.approx(np.sqrt(12.5))
    assert np.isnan(rms_deg(np.zeros(0)))
