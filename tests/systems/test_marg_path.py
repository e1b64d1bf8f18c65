"""The path from samples to steps of the MARG filter: any chunks give the same bits."""

import jax
import numpy as np
import pytest
from marg_logs import hand, log_of
from scipy.spatial.transform import Rotation
from test_live_marg import PARAMETERS, RATE_HZ, made_log

from robins.systems.marg.log import earth_field
from robins.systems.marg.path import SamplePath, joined
from robins.systems.marg.saturation import levels


def samples():
    """Stamps and rows of a hand whose gyro is cut off at 4 rad/s; gaps, a sample without field."""
    log = made_log(20.0, 2)
    gyro = log.imu.gyro.copy()
    peaks = np.array([900, 1005, 1104, 1317, 1500])
    peak = np.exp(-(((np.arange(len(gyro))[:, None] - peaks) / 5.0) ** 2))
    gyro[:, 1] = np.clip(gyro[:, 1] + 9.0 * peak.sum(axis=1), -4.0, 4.0)
    whole = np.all(np.isfinite(gyro), axis=1)
    for first, last in ((520, 640), (700, 770), (1840, 1920)):  # too long to be bridged by rates
        whole[first:last] = False
    at = np.searchsorted(log.mag.time_ns, log.imu.time_ns[whole])
    return log.imu.time_ns[whole], np.hstack([gyro, log.imu.accel])[whole], log.mag.field_t[at]


def taken(path, time_ns, rows, size):
    """Steps, start and counts of a path whose samples come in chunks of a size."""
    made = []
    for at in range(0, len(rows), size):
        made += path.push(time_ns[at : at + size], rows[at : at + size])
    return joined([*made, *path.finish()]), path.start(is_complete=True), dict(path.counts)


@pytest.mark.parametrize("kind", ["rate", "increment"])
@pytest.mark.parametrize("of", ["means", "instants"])
@pytest.mark.parametrize("known", [True, False])
def test_chunks_of_any_size_give_the_same_bits(kind, of, known):
    time_ns, inertial, field = samples()
    rows = np.hstack([inertial if kind == "rate" else inertial / RATE_HZ, field])
    update = PARAMETERS.update.model_copy(update={"samples": of})
    parameters = PARAMETERS.model_copy(update={"update": update})
    ends = levels(rows[:, :3], 1.0 / RATE_HZ) if known else None
    whole, *others = (
        taken(SamplePath(parameters, 1.0 / RATE_HZ, kind, ends), time_ns, rows, size)
        for size in (len(rows), 1000, 7, 1)
    )
    assert kind != "rate" or whole[2]["imu_bridged"] > 20
    for other in others:
        jax.tree_util.tree_map(np.testing.assert_array_equal, other, whole)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("seen", [True, False])
def test_a_turn_over_a_gap_is_that_of_gravity_and_field_on_both_sides(seed, seen):
    q_nb, p_n = hand(24.0, seed)
    log = log_of(q_nb, p_n, gyro_noise=2e-3, accel_noise=0.02, field_noise=5e-7, seed=seed)
    first, last = round(15.0 * RATE_HZ), round(17.0 * RATE_HZ)  # samples, the last before a gap
    rows = np.hstack([log.imu.gyro, log.imu.accel, log.mag.field_t * (1.0 if seen else np.nan)])
    keep = np.r_[0 : first + 1, last : len(rows)]
    path = SamplePath(PARAMETERS, 1.0 / RATE_HZ)
    steps = joined([*path.push(log.imu.time_ns[keep], rows[keep]), *path.finish()])
    block, at = np.unravel_index(np.argmax(steps.samples.dt_s), steps.samples.dt_s.shape)
    turn = Rotation.from_rotvec(steps.samples.theta[block, at])
    found, true = q_nb[first + 1] * turn, q_nb[last + 1]
    spread = float(np.max(steps.u.lost_turn[block]))
    assert spread < np.radians(60.0) if seen else spread > np.radians(110.0)
    tilt = true.inv().apply([0.0, 0.0, 1.0]) @ found.inv().apply([0.0, 0.0, 1.0])
    assert np.arccos(tilt) < np.radians(10.0)
    assert not seen or (found * true.inv()).magnitude() < min(np.radians(15.0), spread)
    # without the gap the unit would have felt gravity alone, but for what it was shaken by
    mean = steps.samples.dv[block, at] / steps.samples.dt_s[block, at]
    up_b = q_nb[first + 1].inv().apply([0.0, 0.0, -1.0])
    assert mean @ up_b > 9.81 * np.cos(np.radians(10.0))


def test_a_field_is_calibrated_to_the_same_bits_alone_and_in_a_log():
    """A product of matrices rounds a row alone in another way; the size decides by its bits."""
    skewed = [[1.1, 0.02, -0.03], [0.01, 0.93, 0.04], [-0.02, 0.05, 1.02]]
    unit = PARAMETERS.magnetometer.model_copy(
        update={"matrix": skewed, "offset": (3e-6, -4e-6, 5e-6)}
    )
    raw = np.random.default_rng(0).normal(size=(1001, 3)) * 8e-5
    raw[[3, 500], 1] = np.nan
    whole = earth_field(raw, unit)
    assert np.sum(whole[1]) == 2
    assert 50 < np.sum(whole[2]) < 950
    np.testing.assert_allclose(
        whole[0][0], np.array(skewed) @ (raw[0] - np.array(unit.offset)), rtol=1e-14
    )
    for size in (1, 7, 1000):
        parts = [earth_field(raw[at : at + size], unit) for at in range(0, len(raw), size)]
        for one, other in zip(whole, zip(*parts, strict=True), strict=True):
            np.testing.assert_array_equal(one, np.concatenate(other))
