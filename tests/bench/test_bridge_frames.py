"""Frames and units of the bridges, by matrices, by angles, and by figures known to everybody."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robins.bench.bridges import frames

# Rows: the axes of the new frame in those of the old one.
T = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]], float)
D = np.diag([1.0, -1.0, -1.0])
ANGLE = st.floats(-math.pi, math.pi)


def scalar_first(rotation: Rotation) -> np.ndarray:
    return rotation.as_quat(scalar_first=True)


def same_turn(p, q, atol=1e-12):
    return abs(abs(np.dot(p, q)) - 1.0) < atol


def test_directions_by_name():
    north, east, down = np.eye(3)
    np.testing.assert_array_equal(frames.enu_from_ned(north), [0, 1, 0])
    np.testing.assert_array_equal(frames.enu_from_ned(east), [1, 0, 0])
    np.testing.assert_array_equal(frames.enu_from_ned(down), [0, 0, -1])
    forward, right, down = np.eye(3)
    np.testing.assert_array_equal(frames.flu_from_frd(forward), [1, 0, 0])
    np.testing.assert_array_equal(frames.flu_from_frd(right), [0, -1, 0])
    np.testing.assert_array_equal(frames.flu_from_frd(down), [0, 0, -1])


@given(st.lists(st.floats(-1e6, 1e6), min_size=6, max_size=6))
def test_there_and_back_loses_no_digit(numbers):
    v = np.array(numbers).reshape(2, 3)
    np.testing.assert_array_equal(frames.ned_from_enu(frames.enu_from_ned(v)), v)
    np.testing.assert_array_equal(frames.frd_from_flu(frames.flu_from_frd(v)), v)
    np.testing.assert_array_equal(frames.enu_from_ned(v), v @ T.T)
    np.testing.assert_array_equal(frames.flu_from_frd(v), v @ D.T)


@given(ANGLE, st.floats(-1.5, 1.5), ANGLE)
def test_an_attitude_is_that_of_the_matrices(roll, pitch, heading):
    turn = Rotation.from_euler("ZYX", [heading, pitch, roll])
    ros = frames.enu_flu_from_ned_frd(scalar_first(turn))
    assert same_turn(ros, scalar_first(Rotation.from_matrix(T @ turn.as_matrix() @ D.T)))
    assert same_turn(frames.ned_frd_from_enu_flu(ros), scalar_first(turn))
    # A vector seen in the body arrives at the same place by either way.
    v_b = np.array([0.3, -1.2, 2.0])
    by_ros = Rotation.from_quat(frames.xyzw(ros)).apply(frames.flu_from_frd(v_b))
    np.testing.assert_allclose(by_ros, frames.enu_from_ned(turn.apply(v_b)), atol=1e-12)


def test_level_and_facing_north_is_a_yaw_of_90_deg_in_ros():
    """REP 103: a yaw of zero faces east, and yaw grows counter-clockwise."""
    ros = frames.xyzw(frames.enu_flu_from_ned_frd(np.array([1.0, 0.0, 0.0, 0.0])))
    np.testing.assert_allclose(Rotation.from_quat(ros).as_euler("ZYX", degrees=True), [90, 0, 0])


def test_scalar_last_and_first():
    q = np.array([[1.0, 2.0, 3.0, 4.0]])
    np.testing.assert_array_equal(frames.xyzw(q), [[2.0, 3.0, 4.0, 1.0]])
    np.testing.assert_array_equal(frames.wxyz(frames.xyzw(q)), q)


def test_covariances_are_those_of_turned_samples():
    rng = np.random.default_rng(1)
    samples = rng.normal(size=(50, 3)) @ np.array([[2.0, 1.0, 0.0], [0.0, 1.0, 3.0], [0.5, 0, 1]])
    P = np.cov(samples.T)
    in_enu, in_flu = np.cov(frames.enu_from_ned(samples).T), np.cov(frames.flu_from_frd(samples).T)
    np.testing.assert_allclose(frames.enu_covariance_from_ned(P), in_enu, rtol=1e-12)
    np.testing.assert_allclose(frames.flu_covariance_from_frd(P), in_flu, rtol=1e-12)
    np.testing.assert_allclose(frames.ned_covariance_from_enu(in_enu), P, rtol=1e-12)
    np.testing.assert_allclose(frames.frd_covariance_from_flu(in_flu), P, rtol=1e-12)


def test_units():
    assert frames.degE7(math.pi / 4) == pytest.approx(450_000_000)
    assert frames.rad_from_degE7(-1_800_000_000) == pytest.approx(-math.pi)
    assert frames.gauss(50_000e-9) == pytest.approx(0.5)  # the field of the Earth, about


@pytest.mark.parametrize(
    ("north", "east", "cdeg"), [(1, 0, 0), (0, 1, 9000), (-1, 0, 18000), (0, -1, 27000)]
)
def test_courses_are_clockwise_from_north(north, east, cdeg):
    assert frames.course_cdeg(np.array([north, east, 5.0])) == pytest.approx(cdeg)
