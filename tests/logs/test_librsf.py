"""Text of libRSF: what a line says, which way its axes point, and what is refused."""

import lzma

import numpy as np
import pytest

from robins.logs import LogError, load_ranges
from robins.logs.librsf import read_librsf

RANGE = "pseudorange3 0.2 2.1e7 25 1.5e7 2.8e6 2.1e7 12 1 30 49\n"
ODOM = "odom3 0.29999995231628 5.85 0 0 0 0 -0.25 0.0025 0.0009 0.0009 4e-06 4e-06 9e-06   \n"
POINT = "point3 0.2 3785108.1 899901.4 5037234.4 0 0 0 0 0 0 0 0 0\n"


def test_what_a_line_says(tmp_path):
    path = tmp_path / "drive.txt.xz"
    path.write_bytes(lzma.compress((ODOM + RANGE + POINT + "imu3 1 2 3\n").encode()))
    findings = []
    log = load_ranges([path], findings)
    r, o = log.ranges, log.odometry
    assert (r.time_ns[0], r.range_m[0], r.sigma_m[0], r.cn0_dbhz[0]) == (2 * 10**8, 2.1e7, 5.0, 49)
    assert (r.satellite[0], r.system[0], r.rows[0]) == (12, 1, 2)
    assert r.elevation_rad[0] == pytest.approx(np.pi / 6.0)
    np.testing.assert_array_equal(r.satellite_e, [[1.5e7, 2.8e6, 2.1e7]])
    assert o.time_ns[0] == 299999952  # digits below a nanosecond are rounded
    # a turn against the clock seen from above, negative about down
    assert (o.speed_mps[0], o.yaw_rate[0]) == (5.85, 0.25)
    assert (o.sigma_speed[0], o.sigma_yaw[0]) == pytest.approx((0.05, 0.003))
    assert log.truth.r_e.tolist() == [[3785108.1, 899901.4, 5037234.4]]
    (finding,) = findings
    assert "1 of 'imu3'" in finding.sentence
    assert log.findings == findings


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (ODOM + RANGE.replace("2.1e7 25", "2.1e7 x"), "line 2.*no number"),
        (ODOM + RANGE.replace("2.1e7 25", "nan 25"), "line 2.*not finite"),
        (ODOM + RANGE.replace("2.1e7 25", "2.1e7 0"), "line 2.*not positive"),
        (ODOM + RANGE[:40] + "\n", "line 2.*needs 10"),
        (ODOM + RANGE + RANGE.replace(" 0.2 ", " 0.1 "), "line 3.*earlier"),
        (ODOM + RANGE.replace(" 0.2 ", " two "), "line 2"),
        ("imu3 1 2 3\n", "holds no pseudorange3"),
        (RANGE, "no odometry"),
        (ODOM, "no pseudoranges"),
    ],
)
def test_what_is_refused(tmp_path, text, match):
    path = tmp_path / "drive.txt"
    path.write_text(text)
    with pytest.raises(LogError, match=match):
        load_ranges([path], [])


def test_two_files_of_one_kind_are_refused(tmp_path):
    for name in "ab":
        (tmp_path / name).write_text(ODOM)
    with pytest.raises(LogError, match="second file"):
        load_ranges([tmp_path / "a", tmp_path / "b"], [])
    assert set(read_librsf(tmp_path / "a")) == {"odometry"}
