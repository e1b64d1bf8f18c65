"""The files that command lines in the documents name, made small."""

import subprocess
from dataclasses import replace
from pathlib import Path

import gnss_logs
import numpy as np
from short_drive import write_pos
from simulated_pair import pair_dataset

from robins import logs, scenario
from robins.bench.rigs import rig_of
from robins.bench.wire.c_header import firmware
from robins.dataset import ImuTable
from robins.results import Outcome
from robins.systems import SYSTEMS
from robins.systems.catalogue import replay_files
from robins.systems.ins_gnss import Drive, drive_dataset
from robins.systems.transfer_alignment.product.parameters import PairReplay
from robins.workbench import campaign_work, plan_campaign, publish

ROOT = Path(__file__).resolve().parents[1]


def write_nine_axes(path, seconds=40.0, hz=50.0, level=False):
    """A unit that is turned about all its axes, or level about its vertical one, in CSV of x-io."""
    rng = np.random.default_rng(3)
    t = np.arange(round(seconds * hz)) / hz
    s = np.maximum(t - 5.0, 0.0)
    tilts = not level
    roll, pitch, yaw = 1.3 * tilts * s, 1.2 * tilts * np.sin(0.6 * s), 0.9 * s
    rate = np.gradient(np.stack([roll, pitch, yaw]), 1.0 / hz, axis=1)
    sr, cr, sp, cp, sy, cy = (f(a) for a in (roll, pitch, yaw) for f in (np.sin, np.cos))
    gyro = [
        rate[0] - sp * rate[2],
        cr * rate[1] + sr * cp * rate[2],
        cr * cp * rate[2] - sr * rate[1],
    ]
    down = np.stack([-sp, sr * cp, cr * cp])
    north = np.stack([cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy])
    columns = [
        *np.rad2deg(gyro),
        *-down,
        *(20.0 * north + 43.0 * down + np.array([[12.0], [-8.0], [5.0]])),
    ]
    noise = np.repeat([0.05, 0.002, 0.2], 3)[:, None] * rng.standard_normal((9, len(t)))
    head = [
        f"{kind} {axis} ({unit})"
        for kind, unit in (("Gyroscope", "deg/s"), ("Accelerometer", "g"), ("Magnetometer", "uT"))
        for axis in "XYZ"
    ]
    rows = np.column_stack([t, *(np.array(columns) + noise)])
    np.savetxt(path, rows, "%.6f", ",", header=",".join(["Time (s)", *head]), comments="")


def write_files(here):
    """Write all of them into a folder."""
    text = SYSTEMS["ins-gnss"].scenarios["drive"].read_text()
    head, *legs = text.split("[[legs]]")
    car = "[[legs]]".join([head, *legs[:4]])
    car = car.replace('settle = "60 s"', 'settle = "5 s"')
    (here / "my.toml").write_text(car)
    drive = drive_dataset(scenario.parse(Drive, car), seed=1)
    imu, gnss = (
        replace(t, time_ns=t.time_ns + 1_700_000_000_000_000_000) for t in (drive.imu, drive.gnss)
    )
    logs.write_log(here / "imu.csv", imu)
    write_pos(here / "gnss.pos", gnss)
    lever_arm = 'lever_arm = ["0.5 m", "-0.2 m", "-1 m"]'
    unit = car[car.index("[imu]") : car.index("[gnss]")]
    (here / "unit.toml").write_text(f'system = "ins-gnss"\n{unit}[gnss]\n{lever_arm}\n')
    write_nine_axes(here / "turned.csv")
    write_nine_axes(here / "circle.csv", level=True)
    for name in ("nine_axes.csv", "flight.csv"):
        (here / name).write_bytes((here / "turned.csv").read_bytes())
    page = (ROOT / "docs" / "logs.md").read_text("utf-8").split("### A format of your own")[1]
    (here / "logger.toml").write_text(page.split("```toml\n")[1].split("```")[0])
    turned = logs.open_log(here / "turned.csv")
    logs.write_log(here / "my.csv", turned, logs.columns_from(here / "logger.toml"))
    for name, text in zip(("ranges", "places"), gnss_logs.as_text(*gnss_logs.drive()), strict=True):
        (here / f"{name}.txt").write_text(text)
    rng = np.random.default_rng(2)
    still = rng.normal(size=(2, 3000, 3)) * [[[1e-3]], [[5e-3]]] + [[[0, 0, 0]], [[0, 0, -9.81]]]
    stamps = np.arange(3000) * 10_000_000
    logs.write_log(here / "still.csv", ImuTable(stamps, still[0], still[1], "rate"))
    pair = replay_files("transfer-alignment")["replay"].read_text()
    (here / "my-pair.toml").write_text(pair)
    dataset = pair_dataset(scenario.parse(PairReplay, pair, ["slave.rate=20 Hz"]), seed=3)
    logs.write_log(here / "master.csv", dataset.master)
    logs.write_log(here / "slave.csv", dataset.imu)
    (here / "my_system.py").write_bytes((ROOT / "docs/examples/balloon.py").read_bytes())
    (here / "first.py").write_bytes((ROOT / "docs/examples/first.py").read_bytes())
    (here / "my_rig.py").write_bytes((ROOT / "docs/examples/pendulum.py").read_bytes())
    problem = ROOT / "src/robins/workbench/problems/baro-height.toml"
    (here / "my-problem.toml").write_text(problem.read_text())
    balloon = f"{here}/my_system.py:study"
    plan_campaign(here / "small-campaign", balloon, runs=2, settings=["duration=10 s"])
    list(campaign_work(here / "small-campaign"))
    (here / "gyro").mkdir()
    for name, text in firmware(rig_of("satellite").wire).items():
        (here / "gyro" / name).write_text(text)
    subprocess.run(["make", "-s", "-C", here / "gyro", "-f", "board.mk", "gyro_board"], check=True)
    for name in ("before", "after"):
        publish(Outcome(metrics={"kf": {"nees": 1.0}}, scenario="x"), here / "results" / name)
