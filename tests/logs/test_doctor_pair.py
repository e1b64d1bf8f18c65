"""The doctor on a master and its slave: signs and delays of the records, by gyros and forces."""

import dataclasses

import numpy as np
import pytest
from made_logs import START_NS, TOTAL_S, ideal_imu, motion, velocity_ned
from scipy.spatial.transform import Rotation

from robins.dataset import Dataset, ImuTable, Trajectory
from robins.logs import examine

ARM = np.array([-6.0, 3.0, -1.5])
MOUNT = Rotation.from_rotvec(np.deg2rad([0.6, -0.4, 0.8]))
ARCMIN = np.deg2rad(1.0 / 60.0)


def attitudes(roll, pitch, heading):
    return Rotation.from_euler("ZYX", np.stack([heading, pitch, roll], -1)).as_quat(
        scalar_first=True
    )


def make_pair(seed, kind="rate"):
    """Figures of eight over hills: a slave off its mark and metres away, a noisy master."""
    rng = np.random.default_rng(seed)
    t = np.arange(100 * TOTAL_S + 1) / 100.0
    h = 1e-3
    (gyro, force), (before, _), (after, _) = (ideal_imu(t + k * h) for k in (0, -1, 1))
    force = force + np.cross((after - before) / (2 * h), ARM)
    force += np.cross(gyro, np.cross(gyro, ARM))
    gyro, force = MOUNT.inv().apply(gyro), MOUNT.inv().apply(force)
    gyro = gyro + [1e-4, -2e-4, 1e-4] + 1e-3 * rng.standard_normal(gyro.shape)
    force = force + [0.02, -0.03, 0.01] + 0.02 * rng.standard_normal(force.shape)
    ns = START_NS + np.round(t * 1e9).astype(np.int64)
    slave = ImuTable(ns, gyro, force, kind="rate", source="slave.csv")
    if kind == "increment":
        means = (np.concatenate([a[:1], 0.5 * (a[1:] + a[:-1])]) * 0.01 for a in (gyro, force))
        slave = ImuTable(ns, *means, kind="increment", source="slave.csv")
    at = np.arange(10 * TOTAL_S) / 10.0
    _, roll, pitch, heading = motion(at)
    v_n = velocity_ned(at)
    way = np.cumsum(v_n, axis=0) / 10.0 + 2.0 * rng.standard_normal(v_n.shape)
    q = Rotation.from_quat(attitudes(roll, pitch, heading), scalar_first=True)
    q = q * Rotation.from_rotvec(ARCMIN * rng.standard_normal(v_n.shape))
    master = Trajectory(
        START_NS + np.round(at * 1e9).astype(np.int64),
        0.82 + way[:, 0] / 6.37e6,
        0.14 + way[:, 1] / 6.39e6 / np.cos(0.82),
        430.0 - way[:, 2],
        v_n + 0.03 * rng.standard_normal(v_n.shape),
        q.as_quat(scalar_first=True),
        source="master.csv",
    )
    return Dataset("pair", slave, master=master)


@pytest.fixture(scope="module")
def pair():
    return make_pair(1)


def spoilt(pair, **columns):
    return dataclasses.replace(pair, master=dataclasses.replace(pair.master, **columns))


def late(pair, delay_s, stated_s=0.0):
    time_ns = pair.master.time_ns + round(1e9 * delay_s)
    return dataclasses.replace(spoilt(pair, time_ns=time_ns), meta={"master_delay_s": stated_s})


def errors(data):
    return [f for f in examine(data) if f.severity != "note"]


@pytest.mark.parametrize("kind", ["rate", "increment"])
def test_a_healthy_pair_is_silent(kind):
    for seed in range(3):
        pair = make_pair(seed, kind)
        assert errors(pair) == []
        assert errors(late(pair, 0.1, stated_s=0.1)) == []


@pytest.mark.parametrize("delay_s", [0.03, 0.08, 0.2, -0.05])
@pytest.mark.parametrize("stated_s", [0.0, 0.04])
def test_a_delay_is_measured_by_the_gyros(pair, delay_s, stated_s):
    (told,) = errors(late(pair, delay_s + stated_s, stated_s))
    assert (told.severity, told.code, told.file) == ("error", "master_late", "master.csv")
    assert told.value == pytest.approx(delay_s, abs=0.004)
    total = told.value + stated_s
    mend = f'master.delay = "{total:.3f} s"' if total >= 0.0 else f"Add {-total:.3f} s to their"
    assert mend in told.sentence


def test_a_small_delay_is_a_warning_and_a_smaller_one_nothing(pair):
    (told,) = errors(late(pair, 0.015))
    assert (told.severity, told.code) == ("warning", "master_late")
    assert errors(late(pair, 0.004)) == []


@pytest.mark.parametrize(
    ("axis", "name", "other"), [(0, "north", "south"), (1, "east", "west"), (2, "down", "up")]
)
def test_a_velocity_of_the_other_sign_is_named(pair, axis, name, other):
    v_n = pair.master.v_n * np.where(np.arange(3) == axis, -1.0, 1.0)
    (told,) = errors(spoilt(pair, v_n=v_n))
    assert (told.severity, told.code, told.value) == ("error", "velocity_sign", name)
    assert f"It is probably positive {other}: turn its sign" in told.sentence


@pytest.mark.parametrize(
    ("signs", "words"),
    [
        ((1, 1, -1), "Heading is probably counted counterclockwise: count it clockwise"),
        ((1, -1, 1), "Pitch is probably positive with the nose down: turn its sign"),
        ((-1, 1, 1), "Roll is probably positive with the right wing up: turn its sign"),
    ],
)
def test_an_angle_of_the_other_sign_is_named(pair, signs, words):
    heading, pitch, roll = Rotation.from_quat(pair.master.q_nb, scalar_first=True).as_euler("ZYX").T
    q_nb = attitudes(signs[0] * roll, signs[1] * pitch, signs[2] * heading)
    (told,) = errors(spoilt(pair, q_nb=q_nb))
    assert (told.severity, told.code) == ("error", "attitude_sign")
    assert words in told.sentence


def test_the_inverse_attitude_is_named(pair):
    (told,) = errors(spoilt(pair, q_nb=pair.master.q_nb * [1, -1, -1, -1]))
    assert told.code == "attitude_sign"
    assert "navigation to body axes: give their conjugates" in told.sentence
