"""The arithmetic behind the doctor's judgement of motion, each against another computation."""

import dataclasses

import numpy as np
import pytest
from made_logs import rows_of, velocity_ned, with_gnss, with_imu
from scipy.spatial.transform import Rotation

from robins.logs import motion, motion_fit, motion_models
from robins.logs.checks_motion import estimates
from robins.logs.gnss_motion import lowest, steps_of, track_of, velocity_delay
from robins.logs.motion_fit import start_of, trimmed
from robins.logs.motion_models import judge
from robins.logs.quiet import signal_of, windows_of

RNG = np.random.default_rng(6)


def test_rotations_against_scipy():
    phi = RNG.normal(size=(4, 5, 3)) * np.logspace(-9, 0.5, 5)[:, None]
    expected = Rotation.from_rotvec(phi.reshape(-1, 3)).as_matrix().reshape(4, 5, 3, 3)
    np.testing.assert_allclose(motion.rotations(phi), expected, atol=1e-15)


def test_best_rotation_against_scipy():
    u = RNG.normal(size=(3, 12, 3))
    v = RNG.normal(size=(12, 3))
    R, left, _ = motion.kabsch(u, v)
    for k in range(3):
        best, rssd = Rotation.align_vectors(v, u[k])
        np.testing.assert_allclose(R[k], best.as_matrix(), atol=1e-12)
        assert left[k] == pytest.approx(rssd**2)


def test_best_reflection_undoes_a_mirror():
    u = RNG.normal(size=(1, 12, 3))
    mirror = Rotation.random(random_state=3).as_matrix() @ np.diag([1, 1, -1])
    _, proper, mirrored = motion.kabsch(u, u[0] @ mirror.T)
    assert mirrored[0] == pytest.approx(0.0, abs=1e-12)
    assert proper[0] > 1.0


def test_attitudes_in_blocks_against_one_after_the_other():
    turn = 0.05 * RNG.normal(size=(95, 3))
    out, attitude = motion._attitudes(turn), Rotation.identity()
    for k in range(95):
        np.testing.assert_allclose(out[k], attitude.as_matrix(), atol=1e-13)
        attitude = attitude * Rotation.from_rotvec(turn[k])
    np.testing.assert_allclose(out[95], attitude.as_matrix(), atol=1e-13)


def test_there_are_48_signed_permutations_the_identity_first():
    all_ = motion.signed_permutations()
    assert len(np.unique(all_, axis=0)) == 48
    np.testing.assert_array_equal(all_[0], np.eye(3))
    np.testing.assert_array_equal(
        all_ @ np.swapaxes(all_, 1, 2), np.broadcast_to(np.eye(3), (48, 3, 3))
    )


def verdict_of(data):
    return judge(data.imu, data.gnss, signal_of(data.imu), track_of(data.gnss))


def test_a_healthy_drive_leaves_only_the_noise(drive):
    verdict = verdict_of(drive)
    assert verdict.free == ()
    # Two velocities of 0.03 m/s to each change, less what some thirty parameters take away.
    assert 0.5 * 6 * 0.03**2 < trimmed(verdict.fit.squares) < 1.1 * 6 * 0.03**2


@pytest.mark.parametrize("velocities", [True, False])
def test_derivatives_against_differences(drive, velocities):
    data = drive if velocities else with_gnss(drive, v_n=None, sigma_v=None)
    views = verdict_of(data).views
    state = start_of(views)._replace(
        b_g=np.array([0.01, 0.0, -0.02]), b_a=np.array([0.3, 0.1, 0.2]), offset=np.array([0.2])
    )
    # its swing is as strong as gravity
    afar = state._replace(lever=np.array([200.0, -100.0, 50.0]))
    near_and_far = [(one, motion_fit._sums(views, one)[0]) for one in (state, afar)]
    # columns of the clock are smoothed over 0.2 s, so those of a swing are less exact
    others, clocks = range(motion_fit.RATE), (motion_fit.RATE, motion_fit.OFFSET)
    cases = [
        *((k, 0, 1e-3) for k in others),
        *((k, i, (0.2, 0.4)[i]) for k in clocks for i in (0, 1)),
    ]
    for k, which, most in cases:
        clock = k >= motion_fit.RATE
        state, u = near_and_far[which]
        step = 1e-5 if not clock else 2e-3 if k == motion_fit.RATE else 0.1
        ends = (
            motion_fit._sums(views, motion_fit._moved(state, sign * step * np.eye(26)[k]))[0][
                ..., 0
            ]
            for sign in (1, -1)
        )
        slope, column = np.subtract(*ends) / (2 * step), u[..., k + 1]
        if clock:  # turns the first axes too, so only lengths compare
            slope, column = (np.sum(u[..., 0] * x, axis=1) for x in (slope, column))
        assert np.linalg.norm(column - slope) < most * np.linalg.norm(slope), k


@pytest.mark.parametrize(
    ("changes", "name", "value"),
    [
        ({}, "gyros", 1.0),
        ({"gyro": lambda x: x / 1.87}, "gyros", 1.87),
        ({"gyro": lambda x: x * [1, 1, 0.5]}, "gyro z", 2.0),
        ({"gyro": lambda x: x @ about_z(20.0)}, "gyros turned", 20.0),
        ({"time_ns": lambda ns: ns + 300_000_000}, "offset", 0.3),
        ({"accel": lambda x: x * [1.3, 1, 1]}, "accel x", 1 / 1.3),
    ],
)
def test_estimates_lie_within_three_sigmas(drive, changes, name, value):
    verdict = verdict_of(
        with_imu(drive, **{k: f(getattr(drive.imu, k)) for k, f in changes.items()})
    )
    found, sigma = estimates(verdict)[name]
    assert abs(found - value) < 3.0 * sigma
    assert sigma < 0.1 * max(abs(value), 0.5)


def test_a_clock_is_cut_where_it_was_set():
    zero, lags = np.zeros(3), np.arange(-5.0, 5.05, 0.1)
    start = motion_fit.PairState(
        np.eye(3), zero, np.eye(3), zero, zero, 0.0, np.zeros(1), np.zeros(15, int)
    )
    late = np.repeat([0.0, -1.0, 2.0], [5, 4, 6])
    cost = 30.0 * np.minimum((lags - late[:, None]) ** 2, 1.0)
    state = motion_models._steps(start, lags, cost)
    np.testing.assert_allclose(state.offset[state.part], late, atol=1e-9)
    once = motion_models._steps(start, lags, cost - cost + cost[:1])
    np.testing.assert_allclose(once.offset, [0.0], atol=1e-9)


def about_z(degrees):
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def test_metres_against_pyins(drive):
    from pyins import transform  # with Numba

    track = track_of(drive.gnss)
    lla = np.column_stack(
        [np.rad2deg(drive.gnss.lat_rad), np.rad2deg(drive.gnss.lon_rad), drive.gnss.alt_m]
    )
    expected = transform.lla_to_ned(lla, lla[0])
    # pyins' axes stay those of the first fix, ours follow the ellipsoid: 0.5 km squared over 2 R.
    np.testing.assert_allclose(track.r_n, expected, atol=0.05)


def test_steps_over_a_second_and_their_lateness(drive):
    track = track_of(drive.gnss)
    t = track.time_s
    late = track._replace(v_n=velocity_ned(t - 0.25))
    assert velocity_delay(late) == pytest.approx(0.25, abs=0.02)
    steps = steps_of(late, 0.25)
    assert np.sqrt(np.mean((steps.of_position - steps.of_velocity) ** 2)) < 1.5 * 0.02 * np.sqrt(2)


def test_lowest_point_of_a_parabola():
    x = np.arange(5.0)
    assert lowest(x, 3.0 + (x - 1.7) ** 2) == pytest.approx(1.7)
    assert lowest(x, x) is None
    assert lowest(x, x * np.nan) is None


def test_windows_find_the_rest_of_the_drive(drive):
    windows = windows_of(signal_of(drive.imu))
    assert np.flatnonzero(windows.at_rest)[:12].tolist() == list(range(12))
    assert np.count_nonzero(windows.at_rest) < 16
    k = int(windows.first[3])
    np.testing.assert_allclose(windows.accel[3], drive.imu.accel[k : k + 100].mean(axis=0))


def test_an_increment_after_lost_ones_is_the_rate_of_its_own_interval(drive):
    imu = drive.imu
    sums = dataclasses.replace(imu, gyro=imu.gyro * 0.01, accel=imu.accel * 0.01, kind="increment")
    keep = np.delete(np.arange(len(imu)), [500, 900, 901, 902])
    signal = signal_of(rows_of(sums, keep))
    np.testing.assert_allclose(signal.accel, imu.accel[keep], atol=1e-9)
    np.testing.assert_allclose(signal.gyro, imu.gyro[keep], atol=1e-9)
