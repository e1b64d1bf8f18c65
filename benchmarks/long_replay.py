"""Replay hours (default 1) of a 200 Hz log from files: time and memory of the whole command."""

import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from robins import logs, scenario
from robins.systems.ins_gnss import SYSTEM, Drive, drive_dataset

HOURS = float(sys.argv[1]) if len(sys.argv) > 1 else 1.0
CONFIGURATION = """
system = "ins-gnss"
filters = ["ekf", "ekf+rts"]
[gnss]
lever_arm = ["0.5 m", "-0.2 m", "-1 m"]
[start]
known_heading = "30 deg"
tilt = "0.5 deg"
heading = "3 deg"
[aids]
zero_velocity = false
[update]
longest_block = "1 s"
"""


def write_log(folder: Path) -> list[Path]:
    """The packaged drive again and again until the hours are full, as KF-GINS text."""
    text = SYSTEM.scenarios["drive"].read_text()
    head, legs = text[: text.index("[[legs]]")], text[text.index("[[legs]]") :]
    one = scenario.parse(Drive, text, ['imu_rate="200 Hz"'])
    seconds = drive_dataset(one, seed=0).imu.time_ns[-1] * 1e-9
    count = int(HOURS * 3600.0 / seconds) + 1
    drive = scenario.parse(Drive, head + legs * count, ['imu_rate="200 Hz"'])
    log = drive_dataset(drive, seed=0)
    files = [folder / "imu.txt", folder / "gnss.txt", folder / "replay.toml"]
    logs.write_log(files[0], log.imu, "kfgins-imu")
    logs.write_log(files[1], log.gnss, "kfgins-gnss")
    sensors = text[text.index("[imu]") : text.index("[gnss]")]
    files[2].write_text(CONFIGURATION + sensors)
    print(f"{len(log.imu)} samples, {log.imu.time_ns[-1] * 1e-9:.0f} s, ", end="")
    print(f"{os.path.getsize(files[0]) / 1e6:.0f} MB")
    return files


def main() -> int:
    robins = Path(sys.executable).parent / "robins"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # by another process: a child begins with the peak memory of this one
        with ProcessPoolExecutor(1) as writer:
            files = writer.submit(write_log, folder).result()
        command = [str(robins), "replay", *map(str, files), "--out", str(folder / "out")]
        start = time.perf_counter()
        with subprocess.Popen(command) as process:
            _, status, used = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
        wall = time.perf_counter() - start
    cpu = used.ru_utime + used.ru_stime
    print(f"replay of {HOURS:g} h at 200 Hz: {wall:.1f} s wall, {cpu:.1f} s processor, ", end="")
    print(f"{used.ru_maxrss / 1e6:.2f} GB")
    return process.returncode


if __name__ == "__main__":
    sys.exit(main())
