"""Sites that a unit comes back to, scales that nobody calibrated, gyros that hang."""

import numpy as np
import pytest
from marg_logs import RATE_HZ, hand, log_of, with_field, with_imu
from scipy.spatial.transform import Rotation

from robins.systems.marg import MargReplay, replay
from robins.systems.marg.saturation import GyroRange
from robins.systems.marg.sites import NONE, Sites

BLOCK_S = 0.1
DOWN = np.array([0.0, 0.0, -9.81])
HOME, OTHER = np.array([18e-6, 0.0, 44e-6]), np.array([17e-6, 4e-6, 47e-6])


def visits(*rests, starts_at_rest=True, apart_s=10.0, count=4):
    """Sites read at rests of 3 s: of each its field in body axes, or the field and the force."""
    sites, out = Sites(count), []
    for rest in rests:
        field, force = rest if isinstance(rest, tuple) else (rest, DOWN)
        looks = [
            sites.process_block(BLOCK_S, True, starts_at_rest, force, field) for _ in range(30)
        ]
        out.append([look for look in looks if look is not NONE])
        for _ in range(round(apart_s / BLOCK_S)):
            assert sites.process_block(BLOCK_S, False, starts_at_rest, DOWN, field) is NONE
    return out


def turned(*deg):
    """Field and specific force of the first site in another attitude."""
    q = Rotation.from_euler("ZYX", deg, degrees=True)
    return q.apply(HOME), q.apply(DOWN)


def test_the_first_site_is_read_from_the_second_rest_on_whatever_the_attitude():
    found = visits(HOME, turned(70.0, -30.0, 160.0), OTHER, OTHER)
    assert [[site for site, *_ in one] for one in found] == [[], [0], [1], [1]]
    _, field_b, dip = found[1][0]
    np.testing.assert_allclose(field_b, turned(70.0, -30.0, 160.0)[0], rtol=1e-12)
    assert dip == pytest.approx(np.arctan2(44.0, 18.0))


def test_a_field_as_strong_with_another_dip_is_another_site():
    steeper = Rotation.from_euler("Y", -2.0, degrees=True).apply(HOME)
    assert [[site for site, *_ in one] for one in visits(HOME, steeper)] == [[], [1]]


def test_a_log_that_begins_in_motion_has_no_first_site():
    found = visits(HOME, HOME, starts_at_rest=False)
    assert [[site for site, *_ in one] for one in found] == [[1], [1]]


def test_a_first_rest_too_short_to_be_read_leaves_no_first_site():
    sites = Sites(4)
    for _ in range(5):
        assert sites.process_block(BLOCK_S, True, True, DOWN, HOME) is NONE
    seen = []
    for still in [False] * 60 + [True] * 20 + [False] * 60 + [True] * 20:
        seen.append(sites.process_block(BLOCK_S, still, True, DOWN, OTHER)[0])
    assert [site for site in seen if site >= 0] == [1, 1]


def test_a_unit_that_hardly_moved_is_not_read_again_and_no_more_sites_than_there_is_room_for():
    assert visits(HOME, HOME, apart_s=3.0) == [[], []]
    fields = [HOME * (1.0 + 0.05 * k) for k in range(6)]
    found = visits(*fields, count=3)
    assert [[site for site, *_ in one] for one in found] == [[], [1], [2], [], [], []]
    found = visits((HOME, 0.01 * DOWN), HOME)  # nothing holds the unit up at first
    assert [[site for site, *_ in one] for one in found] == [[], [1]]


def back_home(alike=0.0):
    """A hand that lays the unit back after 50 s, and the field of that site turned by an angle."""
    q, p = hand(50.0, seed=3)
    time = np.arange(len(q)) / RATE_HZ
    end = np.clip((time - 44.0) / 2.0, 0.0, 1.0)[:, None]
    vector = q.as_rotvec() * (1.0 - end)
    log = log_of(
        Rotation.from_rotvec(vector), p * (1.0 - end), gyro_noise=2e-3, accel_noise=0.02,
        field_noise=3e-7, gyro_gain=np.diag([0.004, -0.005, 0.006]),
    )  # fmt: skip
    field = log.mag.field_t.copy()
    # fields of a room while it moves, and of the last site
    away = ((time > 10.0) & (time < 44.0))[:, None]
    field += np.where(away, 4e-6 * np.sin(0.7 * time[:, None] + [0.0, 1.0, 2.0]), 0.0)
    rest = time > 46.0
    field[rest] = Rotation.from_euler("Z", alike).apply(field[rest])
    return with_field(log, field)


def test_the_heading_comes_home_with_the_unit():
    metrics, parameters = {}, MargReplay()
    blind = parameters.magnetometer.model_copy(update={"site": np.pi})
    for name, p in (
        ("site", parameters),
        ("none", parameters.model_copy(update={"magnetometer": blind})),
    ):
        found = replay(back_home(), p)
        one = found.solution.isel(time=-1).sel(filter="marg")
        metrics[name] = abs(one["error_heading"].item()), one["sigma_heading"].item()
        metrics[name] += (found.metrics["marg-smoothed"]["heading_rmse_deg"],)
    assert metrics["site"][0] < 0.5 * metrics["none"][0]
    assert metrics["site"][0] < 3.0 * metrics["site"][1]
    assert metrics["site"][2] < metrics["none"][2]


def test_a_site_that_looks_alike_and_points_elsewhere_does_not_turn_the_heading():
    found = replay(back_home(np.radians(40.0)), MargReplay(), ("marg",))
    one = found.solution.isel(time=-1).sel(filter="marg")
    assert abs(np.degrees(one["error_heading"].item())) < 4.0


def test_gyros_of_a_bare_chip_are_found_and_no_others():
    q, p = hand(60.0, seed=2)
    noise = {"gyro_noise": 2e-3, "accel_noise": 0.02, "field_noise": 5e-7}
    off = np.diag([0.07, -0.05, 0.06])
    sold = MargReplay(gyro={"bare_gain": "0 ppm"})
    found = {
        name: replay(log_of(q, p, gyro_gain=gain, **noise), parameters)
        for name, gain, parameters in (
            ("bare", off, MargReplay()),
            ("not asked", off, sold),
            ("good", 0.05 * off, MargReplay()),
        )
    }
    for name, one in found.items():
        assert one.solution["wrong"].sel(filter="marg").values[-1, 0] == (name == "bare")
    error = {
        name: np.array([one.metrics[f]["total_rmse_deg"] for f in ("marg", "marg-smoothed")])
        for name, one in found.items()
    }
    assert np.all(error["bare"] < 0.5 * error["not asked"])
    assert np.all(error["good"] < 1.5)
    seen = found["bare"].solution["estimate_gyro_gain"].sel(filter="marg-smoothed").values[-1]
    # what axes are turned by against each other, not what they are turned by together
    np.testing.assert_allclose(np.diag(seen.reshape(3, 3)), np.diag(off), atol=0.01)
    assert sum("finds gyro gain wrong" in note for note in found["bare"].notes) == 2
    # those gains are no contradiction any more
    assert not any("marg-smoothed" in w and "a gain" in w for w in found["bare"].warnings)


def test_a_wrong_scale_of_the_accelerometers_is_read_at_the_first_rest():
    q, p = hand(40.0, seed=2)
    log = log_of(q, p, gyro_noise=2e-3, accel_noise=0.02, field_noise=5e-7)
    scaled = replay(with_imu(log, accel=0.96 * log.imu.accel), MargReplay(), ("marg",))
    gravity = scaled.solution["estimate_gravity"].values[0, 0, 0]
    assert gravity == pytest.approx(0.96 * 9.81, rel=1e-3)
    assert scaled.metrics["marg"]["inclination_rmse_deg"] < 0.6


def test_a_magnetometer_that_nobody_calibrated_is_not_refused_and_holds_the_first_north():
    q, p = hand(60.0, seed=4)
    log = log_of(q, p, gyro_noise=2e-3, accel_noise=0.02, field_noise=5e-7)
    soft, hard = np.diag([1.1, 0.9, 1.05]), np.array([6e-6, -7e-6, 5e-6])
    found = replay(with_field(log, log.mag.field_t @ soft + hard), MargReplay(), ("marg",))
    assert found.metrics["marg"]["refused_magnetometer"] < 10  # of 50; by a constant noise 33
    error = found.solution["error_heading"].sel(filter="marg").values
    assert np.degrees(np.max(np.abs(error - error[0]))) < 3.0


def hanging(rate, accel, before):
    """Blocks in which gyros hang: samples before, then blocks of ten."""
    watch, found = GyroRange(), []
    for k in range(0, len(before) - 10, 10):
        assert watch.hanging(before[k : k + 11], np.tile(accel[:11], 1)) == 0
    for k in range(0, len(rate) - 10, 10):
        found.append(watch.hanging(rate[k : k + 11], accel[k : k + 11]))
    return found


def test_gyros_that_hang_are_found_by_blocks_and_what_only_looks_so_is_not():
    rng = np.random.default_rng(0)
    step = np.radians(1.0)
    noisy = step * np.round(rng.normal(0.0, 3.0, (101, 3)))
    shaken, quiet = rng.normal(0.0, 0.5, (31, 3)), rng.normal(0.0, 0.05, (31, 3))
    hung = np.tile(step * np.array([12.0, -9.0, 4.0]), (31, 1))
    hung[::4] += step  # the least digit still moves
    assert hanging(hung, shaken, noisy) == [1, 2, 3]
    assert hanging(hung, quiet, noisy) == [0, 0, 0]
    # a unit that does not turn, and one whose noise is less than a step
    assert hanging(hung * 0.0, shaken, noisy) == [0, 0, 0]
    assert hanging(
        hung, shaken, np.tile(hung[:1], (101, 1)) + step * (np.arange(101) > 50)[:, None]
    ) == [0, 0, 0]


def test_gyros_that_hang_for_a_while_are_not_believed():
    q, p = hand(40.0, seed=5)
    log = log_of(q, p, gyro_noise=4e-3, accel_noise=0.05, field_noise=5e-7)
    step = np.radians(0.1)
    gyro = step * np.round(log.imu.gyro / step)
    gyro[2000:2040] = gyro[2000]
    found = replay(with_imu(log, gyro=gyro), MargReplay(), ("marg",))
    assert 30 <= found.counts["imu_frozen"] <= 60
    one = found.solution.sel(filter="marg")
    ratio = one["error_inclination"].values / one["sigma_inclination"].values
    assert np.mean(np.abs(ratio) < 3.0) > 0.98
    assert any("as if they hang" in warning for warning in found.warnings)
