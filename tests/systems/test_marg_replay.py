"""Replays of simulated nine-axis logs: closed forms, learned errors, bad input."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from marg_logs import RATE_HZ, hand, log_of, scalar_first, with_field, with_imu
from scipy.spatial.transform import Rotation

from robins.dataset import ImuTable
from robins.filters import OnlineFilter
from robins.ins.increments import from_imu
from robins.systems.marg import MargReplay, filter_of, model_of, prepare, replay
from robins.systems.marg.log import at_samples
from robins.systems.marg.model import MAGNETOMETER, TRAVEL
from robins.systems.marg.path import MeasurementPace, as_increments

GAIN = 0.01 * np.array([[0.6, -0.4, 0.2], [0.3, -0.7, 0.5], [-0.2, 0.4, 0.5]])
PARAMETERS = MargReplay()
CAUSAL = ("marg",)


def noisy(seed=0, **wrong):
    q, p = hand(seed=seed)
    return log_of(
        q, p, gyro_noise=2e-3, accel_noise=0.02, field_noise=5e-7, seed=seed,
        **{"gyro_bias": np.radians([0.8, -0.5, 0.6]), "gyro_gain": GAIN, **wrong},
    )  # fmt: skip


pytestmark = pytest.mark.usefixtures("unchecked")  # long runs, traced again for each filter


@pytest.fixture(scope="module")
def moved():
    """A log of a hand with gyro errors, and what a replay makes of it."""
    log = noisy()
    return log, replay(log, PARAMETERS)


def finite(outcome):
    """All that must be a number is one."""
    for name in ("estimate_euler", "estimate_gyro_bias", "sigma_attitude", "sigma_field"):
        assert np.all(np.isfinite(outcome.solution[name].values)), name
    assert outcome.counts["steps_not_taken"] == 0
    return outcome


def test_static_attitude_is_that_of_gravity_and_field():
    turn = Rotation.from_euler("ZYX", [2.0, -0.4, 0.7])
    still = log_of(Rotation.concatenate([turn] * 6001), np.zeros((6001, 3)))
    found = replay(still, PARAMETERS, CAUSAL)
    np.testing.assert_allclose(
        found.solution["estimate_euler"].values,
        np.broadcast_to([0.7, -0.4, 2.0], found.solution["estimate_euler"].shape),
        atol=1e-6,
    )
    assert found.solution["rest"].values[-1] == 1
    assert found.metrics["marg"]["total_rmse_deg"] < 1e-4


def test_constant_turning_is_carried_by_the_gyros():
    time = np.arange(6001) / RATE_HZ
    turn = Rotation.from_rotvec(np.outer(time, [0.0, 0.0, 0.7]))
    found = replay(log_of(turn, np.zeros((6001, 3))), PARAMETERS, CAUSAL)
    heading = np.unwrap(found.solution["estimate_euler"].sel(filter="marg").values[:, 2])
    np.testing.assert_allclose(heading, 0.7 * found.solution["time"].values, atol=2e-4)


def test_bias_and_gain_of_the_gyros_are_learned(moved):
    _, outcome = moved
    last = outcome.solution.isel(time=-1).sel(filter="marg-smoothed")
    np.testing.assert_allclose(
        np.degrees(last["estimate_gyro_bias"].values), [0.8, -0.5, 0.6], atol=0.06
    )
    gain = last["estimate_gyro_gain"].values.reshape(3, 3)
    sigma = last["sigma_gyro_gain"].values.reshape(3, 3)
    assert np.all(sigma < 0.7 * PARAMETERS.gyro.gain)
    assert np.sqrt(np.mean((gain - GAIN) ** 2)) < 0.5 * np.sqrt(np.mean(GAIN**2))


def test_errors_are_small_and_as_large_as_stated(moved):
    _, outcome = moved
    causal, smoothed = outcome.metrics["marg"], outcome.metrics["marg-smoothed"]
    assert causal["total_rmse_deg"] < 1.5
    assert smoothed["total_rmse_deg"] < causal["total_rmse_deg"]
    for name in ("marg", "marg-smoothed"):
        one = outcome.solution.sel(filter=name)
        for block in ("heading", "inclination"):
            ratio = one[f"error_{block}"].values / one[f"sigma_{block}"].values
            assert np.mean(np.abs(ratio) < 3.0) > 0.98, (name, block)


def test_without_gain_states_the_heading_drifts_further(moved):
    log, outcome = moved
    gyro = PARAMETERS.gyro.model_copy(update={"gain": 0.0, "bare_gain": 0.0})
    poor = replay(log, PARAMETERS.model_copy(update={"gyro": gyro}))
    # what the states are for: with them the heading is better, smoothed, by half
    better = outcome.metrics["marg-smoothed"]["heading_rmse_deg"]
    assert poor.metrics["marg-smoothed"]["heading_rmse_deg"] > 2.0 * better


def test_orientation_of_the_sensor_does_not_matter(moved):
    log, outcome = moved
    mount = Rotation.from_euler("ZYX", [1.0, 0.7, -2.0])
    turned = replace(
        with_field(
            with_imu(log, gyro=mount.apply(log.imu.gyro), accel=mount.apply(log.imu.accel)),
            mount.apply(log.mag.field_t),
        ),
        attitude=replace(
            log.attitude,
            q_nb=scalar_first(
                Rotation.from_quat(np.roll(log.attitude.q_nb, -1, axis=1)) * mount.inv()
            ),
        ),
    )
    found = replay(turned, PARAMETERS, CAUSAL).metrics["marg"]
    assert found["total_rmse_deg"] == pytest.approx(
        outcome.metrics["marg"]["total_rmse_deg"], rel=1e-4
    )


def test_an_attached_magnet_is_refused_and_a_field_that_stays_is_taken_up(moved):
    log, _ = moved
    seconds = log.mag.time_ns * 1e-9
    stuck = log.mag.field_t + np.where((seconds > 20.0)[:, None], [3e-5, -2e-5, 1e-5], 0.0)
    found = finite(replay(with_field(log, stuck), PARAMETERS, CAUSAL))
    assert found.metrics["marg"]["refused_magnetometer"] > 20
    assert found.metrics["marg"]["total_rmse_deg"] < 3.0
    assert np.any(found.solution["magnetic_disturbance"].sel(filter="marg").values)
    # the whole field turned by 90 deg for good: the heading stays, the declination says it
    q = Rotation.from_quat(np.roll(log.attitude.q_nb, -1, axis=1))
    other = q.inv().apply([0.0, 3e-5, 2e-5])
    moved_on = np.where((seconds > 12.0)[:, None], other, log.mag.field_t)
    new = finite(replay(with_field(log, moved_on), PARAMETERS, CAUSAL)).solution.sel(filter="marg")
    time = new["time"].values
    disturbed = new["magnetic_disturbance"].values[time < 30.0]
    assert np.sum(disturbed) >= 18
    assert not np.any(new["magnetic_disturbance"].values[time > 35.0])
    at = int(np.searchsorted(time, 36.0))
    assert np.degrees(new["estimate_declination"].values[at, 0]) == pytest.approx(90.0, abs=15.0)
    field = new["estimate_field"].values[at]
    np.testing.assert_allclose(field, [3e-5, 2e-5], atol=1e-6)
    error = np.degrees(np.abs(new["error_heading"].values[:, 0]))
    assert error[at] < 8.0
    # in the long run north is where the field points
    assert error[-1] > error[at]


def test_always_undisturbed_never(moved):
    log, _ = moved
    use = lambda how: PARAMETERS.model_copy(update={"use_magnetometer": how})  # noqa: E731
    late = (log.mag.time_ns > 10e9)[:, None]
    wrong = with_field(log, log.mag.field_t + np.where(late, [4e-5, 0.0, 0.0], 0.0))
    found = {
        how: replay(wrong, use(how), CAUSAL).metrics["marg"] for how in ("always", "undisturbed")
    }
    assert found["always"]["refused_magnetometer"] == 0
    assert found["always"]["nis_magnetometer"] > 10.0
    assert found["undisturbed"]["refused_magnetometer"] > 40
    assert found["undisturbed"]["nis_magnetometer"] < 1.0
    never = prepare(log, use("never"))
    assert MAGNETOMETER not in never.world.y
    assert [s.name for s in model_of(use("never")).sensors] == ["travel", "rest"]
    assert never.look.heading_rad == pytest.approx(np.pi)


@pytest.mark.parametrize(
    "fault", ["nan", "zero field", "no field", "free fall", "drop-out", "full"]
)
def test_bad_input_leaves_the_state_finite_and_is_counted(moved, fault):
    log, _ = moved
    gyro, accel = log.imu.gyro.copy(), log.imu.accel.copy()
    field = log.mag.field_t.copy()
    hurt = slice(2500, 2800)
    if fault == "nan":
        gyro[hurt.start : hurt.start + 20, 1] = np.nan
        accel[4000, 2] = np.inf
        field[3000:3100] = np.nan
        found = finite(replay(with_field(with_imu(log, gyro=gyro, accel=accel), field), PARAMETERS))
        assert found.counts["imu_missing"] == 21
        assert found.counts["imu_gaps"] == 1
        assert found.counts["field_missing"] == 100
        assert found.metrics["marg"]["total_rmse_deg"] < 4.0
    elif fault in ("zero field", "no field"):
        field[1000:] = 0.0 if fault == "zero field" else np.nan
        found = finite(replay(with_field(log, field), PARAMETERS, CAUSAL))
        kind = "field_implausible" if fault == "zero field" else "field_missing"
        assert found.counts[kind] == len(field) - 1000
        assert "nis_magnetometer" in found.metrics["marg"] or fault == "no field"
    elif fault == "free fall":
        accel[hurt] = 0.0
        found = finite(replay(with_imu(log, accel=accel), PARAMETERS, CAUSAL))
        assert found.counts["blocks_in_free_fall"] == 30
        assert found.metrics["marg"]["inclination_rmse_deg"] < 3.0
    elif fault == "drop-out":
        keep = np.ones(len(gyro), dtype=bool)
        keep[2500:2560] = False
        imu = replace(log.imu, time_ns=log.imu.time_ns[keep], gyro=gyro[keep], accel=accel[keep])
        found = finite(replay(replace(log, imu=imu), PARAMETERS))
        assert found.counts["imu_gaps"] == 1
        before, after = (found.solution["sigma_attitude"].values[0, k, 0] for k in (248, 252))
        assert after > 3.0 * before
    else:
        gyro[hurt, 2] = np.radians(2000.0)
        found = finite(replay(with_imu(log, gyro=gyro), PARAMETERS, CAUSAL))
        assert found.counts["imu_saturated"] == 300
    assert any(sentence.startswith("At rest for") for sentence in found.notes)


def test_a_start_without_gravity_or_rest_says_so(moved):
    log, _ = moved
    accel = log.imu.accel.copy()
    accel[:400] = 0.0
    found = finite(replay(with_imu(log, accel=accel), PARAMETERS, CAUSAL))
    assert "the tilt is hardly known" in found.notes[0]
    middle = slice(2000, None)
    part = replace(
        with_field(
            replace(log, imu=replace(log.imu, time_ns=log.imu.time_ns[middle],
                                     gyro=log.imu.gyro[middle], accel=log.imu.accel[middle])),
            log.mag.field_t,
        ),
    )  # fmt: skip
    look = prepare(part, PARAMETERS).look
    assert not look.still
    assert "in motion" in look.sentence


def test_a_log_without_truth_or_magnetometer_has_no_errors_but_consistency(moved):
    log, _ = moved
    found = finite(replay(replace(log, attitude=None, mag=None), PARAMETERS))
    assert "total_rmse_deg" not in found.metrics["marg"]
    assert found.metrics["marg"]["nis_travel"] > 0.0
    assert any("no magnetometer" in note for note in found.notes)


def test_a_causal_replay_alone_gives_the_same(moved):
    log, outcome = moved
    alone = finite(replay(log, PARAMETERS, CAUSAL))
    both = outcome.solution["sigma_attitude"].sel(filter="marg").values
    np.testing.assert_allclose(alone.solution["sigma_attitude"].values[0], both, rtol=1e-9)


def test_a_live_filter_gives_the_numbers_of_the_replay(moved):
    dataset, outcome = moved
    log = prepare(dataset, PARAMETERS).world
    online = OnlineFilter(filter_of(PARAMETERS), model := model_of(PARAMETERS), log.start)
    row = lambda tree, k: jax.tree_util.tree_map(lambda a: a[k], tree)  # noqa: E731
    for k in range(120):
        online.predict(row(log.u, k))
        for sensor in model.dims:
            online.update(row(log.y[sensor], k), sensor, row(log.aux.get(sensor), k))
    sigma = outcome.solution["sigma_attitude"].sel(filter="marg").values[119]
    # what is stated holds, beside what the filter knows, what no state carries
    stated, samples = PARAMETERS.stated, log.u.samples
    late = stated.delay * samples.angle[119] / samples.dt_s[119]
    floor = np.hypot([stated.tilt, stated.tilt, stated.heading], late)
    own = np.hypot(np.asarray(online.belief.sigma)[:3], floor)
    np.testing.assert_allclose(own, sigma, rtol=1e-6)


def test_too_short_a_log_is_refused():
    log = noisy()
    short = with_imu(
        log, time_ns=log.imu.time_ns[:1], gyro=log.imu.gyro[:1], accel=log.imu.accel[:1]
    )
    with pytest.raises(ValueError, match="two whole inertial samples; this log has 1"):
        replay(short, PARAMETERS)


def test_readings_go_to_the_interval_they_fall_in_and_looks_are_spaced():
    found = at_samples(np.array([0, 10, 20, 30]), np.array([0, 4, 9, 20, 31]), np.eye(5)[:, :3])
    np.testing.assert_array_equal(found[0], np.eye(5)[2, :3])
    np.testing.assert_array_equal(found[1], np.eye(5)[3, :3])
    assert np.isnan(found[2]).all()
    taken = MeasurementPace().take(TRAVEL, np.arange(1, 31) * 0.1, np.arange(30) > 4, 1.0)
    assert np.flatnonzero(taken).tolist() == [5, 15, 25]


def test_lost_means_are_bridged_by_a_straight_line():
    """A rate that rises evenly is met exactly over the gap, where the last mean would overshoot."""
    end = np.delete(np.arange(1, 101), np.arange(40, 70)) * 0.01
    ramp = np.outer(end - 0.005, [0.0, 0.0, 2.0])  # mean over the interval before each stamp
    log = ImuTable(np.round(end * 1e9).astype(np.int64), ramp, ramp - [0.0, 0.0, 9.8], "rate")
    inc, _ = from_imu(as_increments(log))
    np.testing.assert_allclose(inc.theta.sum(0)[2], end[-1] ** 2 - end[0] ** 2, rtol=1e-9)


def test_the_attitude_stands_at_every_sample(moved):
    """And at the ends of blocks it is the one that the angles tell."""
    log, outcome = moved
    solution = outcome.solution
    assert solution.attrs["origin_ns"] == log.imu.time_ns[0]
    q_nb, at_s = solution["q_nb"], solution["sample_time"].values
    assert q_nb.dims == ("filter", "sample_time", "axis_q_nb")
    np.testing.assert_allclose(at_s, (log.imu.time_ns - log.imu.time_ns[0]) * 1e-9, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(q_nb.values, axis=-1), 1.0, atol=1e-12)
    ends = np.searchsorted(at_s, solution["time"].values - 1e-6)
    for name in ("marg", "marg-smoothed"):
        q = Rotation.from_quat(q_nb.sel(filter=name).values, scalar_first=True)
        angles = solution["estimate_euler"].sel(filter=name).values[:, ::-1]
        turned = (q[ends].inv() * Rotation.from_euler("ZYX", angles)).magnitude()
        assert turned.max() < 1e-9
        # between them it goes on as smoothly as the hand
        away = (q[:-1].inv() * q[1:]).magnitude()
        assert away.max() < 0.1
