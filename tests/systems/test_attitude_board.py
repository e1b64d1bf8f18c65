"""The board of attitude reads what it says it reads: references laid over the unit's own axes."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from marg_logs import FIELD_NED, GRAVITY, scalar_first
from scipy.spatial.transform import Rotation

BOARD = Path(__file__).parents[2] / "benchmarks" / "attitude_board.py"
RATE_HZ, COUNT = 100.0, 3000
TIME = np.arange(COUNT) / RATE_HZ


@pytest.fixture(scope="module")
def board():
    spec = importlib.util.spec_from_file_location("attitude_board", BOARD)
    module = importlib.util.module_from_spec(spec)
    sys.modules["attitude_board"] = module
    spec.loader.exec_module(module)
    return module


def turned_about():
    """Attitudes of a unit, body to NED, and what it reads without an acceleration."""
    moving = np.clip(TIME - 3.0, 0.0, 1.0)[:, None]
    angle = moving * np.stack([np.sin(k * TIME + k) for k in (1.1, 0.7, 1.9)], axis=1)
    q = Rotation.from_euler("ZYX", angle)
    step = (q[:-1].inv() * q[1:]).as_rotvec() * RATE_HZ
    gyro = np.concatenate([step[:1], 0.5 * (step[1:] + step[:-1]), step[-1:]])
    return q, gyro, q.inv().apply([0.0, 0.0, -GRAVITY]), q.inv().apply(FIELD_NED)


def written(path, columns):
    rows = [";".join(f"{x:.9f}" for x in row) for row in np.hstack(columns)]
    path.write_text("\n".join(["Time;Vicon", ";W;X;Y;Z", *rows]))


@pytest.mark.parametrize("jump", [False, True])
def test_the_frames_and_the_clock_of_the_cameras_are_solved(board, tmp_path, jump):
    q, gyro, accel, field = turned_about()
    frame = Rotation.from_euler("ZYX", [1.0, 0.4, -0.7])
    body = Rotation.from_euler("ZYX", [-0.3, 0.2, 2.0])
    late = 7  # samples that the cameras' stamps are early by
    seen = (frame * q * body)[np.minimum(np.arange(COUNT) + late, COUNT - 1)]
    if jump:
        lost = np.arange(COUNT)[:, None] > 2700
        seen = seen * Rotation.from_rotvec(np.where(lost, [0.5, 0.0, 0.0], 0.0))
    field = field / np.linalg.norm(FIELD_NED)
    written(
        tmp_path / "TStick_Test02_Trial1.csv",
        (TIME[:, None], scalar_first(seen), accel, gyro, field),
    )
    (trial,) = board.repoimu(tmp_path)
    assert trial.development
    true = trial.log.attitude
    there = np.all(np.isfinite(true.q_nb), axis=1)
    error = (Rotation.from_quat(np.roll(true.q_nb[there], -1, axis=1)) * q[there].inv()).magnitude()
    assert there.sum() > (2600 if jump else 2900)
    assert not jump or not there[2750:].any()
    assert np.degrees(np.median(error)) < 0.1
    assert not true.moving[:290].any()
    assert true.moving[1000]


def test_a_flight_finds_its_truth_by_time(board, tmp_path):
    q, gyro, accel, _ = turned_about()
    begin = 1_400_000_000
    for name, shift, attitude in (("a", 0, q), ("b", 10_000, q.inv())):
        time_ns = ((begin + shift) * 10**9 + np.round(TIME * 1e9)).astype(np.int64)
        lines = ["#t,w,w,w,a,a,a"]
        lines += [
            ",".join([str(t), *(f"{x:.9f}" for x in row)])
            for t, row in zip(time_ns, np.hstack([gyro, accel]), strict=True)
        ]
        (tmp_path / f"{name}.txt").write_text("\n".join(lines))
        seen = np.hstack([TIME[:, None] + begin + shift, np.zeros((COUNT, 3)), attitude.as_quat()])
        np.savetxt(tmp_path / f"truth_{name}.txt", seen, fmt="%.6f", header="t x y z qx qy qz qw")
    trials = {trial.name: trial for trial in board.euroc(tmp_path)}
    assert set(trials) == {"a", "b"}
    for name, attitude in (("a", q), ("b", q.inv())):
        assert trials[name].tilt_only
        found = trials[name].log.attitude.q_nb[5:-5]
        same = np.abs(np.sum(found * scalar_first(attitude)[5:-5], axis=1))
        assert same.min() > 1.0 - 1e-6


def test_the_reference_itself_has_no_error(board, tmp_path):
    q, gyro, accel, field = turned_about()
    field = field / np.linalg.norm(FIELD_NED)
    written(
        tmp_path / "TStick_Test02_Trial1.csv",
        (TIME[:, None], scalar_first(q), accel, gyro, field),
    )
    (trial,) = board.repoimu(tmp_path)
    row = board.scored(trial, trial.log.attitude.q_nb)
    assert row.total == pytest.approx(0.0, abs=1e-6)
    tilted = Rotation.from_rotvec([0.02, 0.0, 0.0]) * Rotation.from_quat(
        np.roll(np.nan_to_num(trial.log.attitude.q_nb, nan=0.5), -1, axis=1)
    )
    row = board.scored(trial, scalar_first(tilted))
    assert row.inclination == pytest.approx(np.degrees(0.02), rel=1e-6)
    assert row.heading == pytest.approx(0.0, abs=0.05)
