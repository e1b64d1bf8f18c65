"""The example of the documents, fed by UDP on this machine, tells the motion that was sent."""

import re
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from marg_logs import hand, log_of
from scipy.spatial.transform import Rotation

EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "live_orientation.py"


def test_what_is_sent_by_udp_is_printed_as_angles(tmp_path):
    q, p = hand(13.0, 1)
    log = log_of(q, p, gyro_noise=2e-3, accel_noise=0.02, field_noise=5e-7)
    state = tmp_path / "unit.live"
    command = [sys.executable, str(EXAMPLE), "--rate", "100", "--port", "0", "--silence", "5",
               "--state", str(state)]  # fmt: skip
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as told:
        try:
            assert told.stdout is not None
            # in time: everything was compiled before the port was opened
            port = int(re.fullmatch(r"# listening at port (\d+)\n", told.stdout.readline())[1])
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                for k, seconds in enumerate(log.imu.time_ns * 1e-9):
                    row = [seconds, *log.imu.gyro[k], *log.imu.accel[k], *1e6 * log.mag.field_t[k]]
                    line = "torn,1.0" if k == 500 else ",".join(f"{x:.7g}" for x in row)
                    sender.sendto(line.encode(), ("127.0.0.1", port))
                    time.sleep(0.002)  # the kernel keeps some hundred
            out, wrong = told.communicate(timeout=60)
        finally:
            told.kill()
    lines = out.splitlines()
    assert told.returncode == 0, wrong
    assert "line 'torn,1.0'" in wrong
    found = re.compile(r" *([\d.]+) s  roll +(\S+)  pitch +(\S+)  heading +(\S+) \+- (\S+) deg(.*)")
    rows = [match.groups() for line in lines if (match := found.fullmatch(line))]
    assert lines[0].endswith("starting")
    assert len(rows) > 100
    assert any("REST" in row[5] for row in rows)
    told_at = np.array([[float(x) for x in row[:5]] for row in rows])
    at = np.round(told_at[:, 0] * 100.0).astype(int)
    got = Rotation.from_euler("ZYX", told_at[:, [3, 2, 1]], degrees=True)
    assert np.degrees(np.max((q[at].inv() * got).magnitude())) < 3.0
    assert state.stat().st_size > 1000
