"""A replay that says what contradicts its own assumptions, and true north from a place."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from marg_logs import hand, log_of
from test_marg_model import some_state

from robins.dataset import GnssTable
from robins.earth.magnetic import field_n, wmm
from robins.filters import Code
from robins.systems.marg import MargReplay
from robins.systems.marg.model import MAGNETOMETER, TRAVEL
from robins.systems.marg.monitor import doubts_of, of_samples, sentences
from robins.systems.marg.replay import _to_true_north, true_north
from robins.systems.tables import SensorUpdates

BLOCKS = 600
DT = np.full(BLOCKS, 0.1)
PARAMETERS = MargReplay()


def states(declination=0.0, gain=0.0):
    """600 blocks of one state."""
    one = some_state()._replace(
        declination=jnp.asarray(declination), gyro_gain=gain * jnp.asarray(np.eye(3))
    )
    return one._replace(
        declination=jnp.full(BLOCKS, declination),
        gyro_gain=jnp.broadcast_to(one.gyro_gain, (BLOCKS, 3, 3)),
    )


def looks(nis=6.0, dof=6, refused=()):
    """A look each tenth block, with a NIS of all its components."""
    seen = np.arange(BLOCKS) % 10 == 9
    code = np.where(seen, int(Code.DONE), int(Code.MISSING))
    code[list(refused)] = int(Code.REFUSED)
    zero = np.zeros((BLOCKS, dof))
    return SensorUpdates(zero, zero, np.where(seen, nis, 0.0), np.where(seen, dof, 0), code)


def said(mean, updates):
    gain = np.asarray(mean.gyro_gain)
    doubt = doubts_of(np.asarray(mean.declination), gain, updates, PARAMETERS)
    return sentences("marg", doubt, mean, DT), doubt


def test_what_is_within_its_assumptions_is_not_doubted():
    p = PARAMETERS
    mean = states(2.9 * p.magnetometer.declination, 2.9 * p.gyro.gain)
    found, doubt = said(mean, {TRAVEL: looks(), MAGNETOMETER: looks(3.0, 3)})
    assert found == []
    assert not doubt.any.any()


@pytest.mark.parametrize(
    ("mean", "updates", "word"),
    [
        (states(declination=3.1 * PARAMETERS.magnetometer.declination), {}, "the field is turned"),
        (states(gain=3.1 * PARAMETERS.gyro.gain), {}, "a gain of the gyros is 0.9 %"),
        (states(), {TRAVEL: looks(nis=19.0)}, "velocity and place do not stay"),
        (states(), {MAGNETOMETER: looks(3.0, 3, range(9, 209, 10))}, "the field was refused"),
    ],
)
def test_each_contradiction_is_said_once(mean, updates, word):
    found, doubt = said(mean, updates)
    assert len(found) == 1
    assert found[0].startswith("marg: for ")
    assert word in found[0]
    assert doubt.any.any()


def test_a_moment_is_no_contradiction():
    mean = states()
    short = np.zeros(BLOCKS)
    short[100:140] = 1.0  # rad, for 4 s
    found, doubt = said(mean._replace(declination=jnp.asarray(short)), {})
    assert found == []
    assert doubt.declination.sum() == 40
    assert said(mean, {MAGNETOMETER: looks(3.0, 3, range(9, 98, 10))})[0] == []


def test_samples_lost_at_the_end_of_a_range_are_said():
    good = {"imu_saturated": 100, "imu_bridged": 100, "imu_frozen": 2}
    assert of_samples(good, 1000) == []
    lost, hung = of_samples(good | {"imu_saturated": 150, "imu_frozen": 30}, 1000)
    assert lost.startswith("50 samples")
    assert "over 30 samples" in hung


def test_north_is_true_north_where_a_place_and_a_date_are_known():
    q, p_n = hand(20.0)
    log = log_of(q, p_n)
    assert true_north(log) is None
    moment = np.datetime64("2026-07-02T12:00", "ns").astype(np.int64)
    lat, lon = np.radians([64.1, -21.9])  # a place of large declination
    fix = GnssTable(
        np.array([moment, moment + 10**9]), np.array([np.nan, lat]), np.array([lon, lon]),
        np.array([20.0, 20.0]), np.ones((2, 3)),
    )  # fmt: skip
    found = true_north(replace(log, gnss=fix))
    north, east, _ = np.asarray(field_n(wmm(2025), lat, lon, 20.0, 2026.5))
    assert found == pytest.approx(np.arctan2(east, north), abs=1e-4)
    assert np.degrees(found) < -8.0
    # a unit that points along the field points west of true north there
    heading = 2.0 * np.arctan2(*_to_true_north(np.array([[1.0, 0.0, 0.0, 0.0]]), found)[0, [3, 0]])
    assert heading == pytest.approx(found)
    # stamps that count from the start have no date
    early = replace(fix, time_ns=np.array([0, 10**9]))
    assert true_north(replace(log, gnss=early)) is None
