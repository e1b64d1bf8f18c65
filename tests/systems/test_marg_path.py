"""The path from samples to steps of the MARG filter: any chunks give the same bits."""

import jax
import numpy as np
import pytest
from test_live_marg import PARAMETERS, RATE_HZ, made_log

from robins.systems.marg.path import SamplePath, joined
from robins.systems.marg.saturation import levels


def samples():
    """Stamps and rows of a hand whose gyro is cut off at 4 rad/s; a gap, a sample without field."""
    log = made_log(20.0, 2)
    gyro = log.imu.gyro.copy()
    peaks = np.array([900, 1005, 1104, 1317, 1500])
    peak = np.exp(-(((np.arange(len(gyro))[:, None] - peaks) / 5.0) ** 2))
    gyro[:, 1] = np.clip(gyro[:, 1] + 9.0 * peak.sum(axis=1), -4.0, 4.0)
    whole = np.all(np.isfinite(gyro), axis=1)
    at = np.searchsorted(log.mag.time_ns, log.imu.time_ns[whole])
    return log.imu.time_ns[whole], np.hstack([gyro, log.imu.accel])[whole], log.mag.field_t[at]


def taken(path, time_ns, rows, size):
    """Steps, start and counts of a path whose samples come in chunks of a size."""
    made = []
    for at in range(0, len(rows), size):
        made += path.push(time_ns[at : at + size], rows[at : at + size])
    return joined([*made, *path.finish()]), path.start(is_whole=True), dict(path.counts)


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
