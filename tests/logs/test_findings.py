"""The laws of the doctor's table: each finding has a way to be caused; a healthy log has none."""

import ast
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import made_binary
import pytest
from finding_tables import findings as documented
from log_samples import EUROC_TRUTH, KFGINS_IMU, RTKLIB
from made_spoilt import tumble
from made_ulog import flight
from made_wild import INSPVA, OXTS
from spoilt import HEALTHY, SPOILT

import robins.logs
from robins.logs import clean, examine, open_log
from robins.logs.doctor import ALONE, OF_READERS, REFUSALS, TOGETHER
from robins.logs.findings import SEVERITIES
from robins.logs.librsf import read_librsf

CHECKS = (*ALONE, *TOGETHER)


class Spoilt(NamedTuple):
    """A row of SPOILT, with the check that finds it."""

    check: str
    code: str
    log: Callable[..., Any]
    says: str  # "severity where: parts of ... the sentence"
    value: Any = None
    others: str = ""  # codes of all other findings in the same log
    count: int = 1  # findings with this code

    @property
    def severity(self) -> str:
        return re.split("[: ]", self.says)[0]


ROWS = [
    Spoilt(check, code, *row)
    for check, codes in SPOILT.items()
    for code, rows in codes.items()
    for row in rows
]
PARTS = ("", " (magnetic field)", " (attitude)")
HEADER, FIX, *_ = RTKLIB.split("\n")
PATH = "time_s,lat_deg,lon_deg,height_m,v_north_m_s,v_east_m_s,v_down_m_s,"
STEPS = "time,dt,theta_x,theta_y,theta_z,dv_x,dv_y,dv_z\n"

# What readers tell: code, what is found, the file.
FILES = (
    ("ends_early", "warning line 20: the last line has no line end", KFGINS_IMU[:-5]),
    ("begins_midway", "warning line 1: has fewer fields than the next", KFGINS_IMU[15:]),
    ("no_place", "note: positions are local metres", EUROC_TRUTH),
    (
        "no_velocity",
        "note: RTKLIB did not solve for them; they are left out",
        f"{HEADER} vn ve vu sdvn sdve sdvu sdvne sdveu sdvun\n{FIX}{' 0' * 9}\n",
    ),
    (
        "height_above_geoid",
        "warning header: heights are above the geoid",
        f"% (lat/lon/height=WGS84/geodetic,Q=1:fix,2:float,ns=# of satellites)\n{HEADER}\n{FIX}\n",
    ),
    (
        "dt_disagrees",
        "warning line 4: dt is 0.01 s but the time has grown by 0.02 s (1 such rows)",
        STEPS + "".join(f"{t},0.01,0,0,0,0,0,-0.098\n" for t in (1.0, 1.01, 1.03, 1.04)),
    ),
    (
        "several_instances",
        "note: sensor_combined was logged of 2 sensors; the first",
        flight(0.1)[0],
    ),
    (
        "angle_range",
        "warning line 4: heading_deg is 10000, beyond +-400 deg",
        f"{PATH}roll_deg,pitch_deg,heading_deg\n"
        + "".join(f"{t},48,11,0,1,2,3,0,0,{1e4 if t == 2 else 30}\n" for t in range(5)),
    ),
    (
        "quaternion_length",
        "warning line 3: the quaternion q_w .. q_z has length",
        f"{PATH}q_w,q_x,q_y,q_z\n"
        + "".join(f"{t},48,11,0,1,2,3,{7 if t == 1 else 0.8},0,0.6,0\n" for t in range(4)),
    ),
    (
        "other_kinds",
        "note: lines of other kinds were left out: 1 of 'imu3'",
        "point3 0 3785108 899901 5037234\nimu3 1 2 3\n",
    ),
    (
        "damaged_frames",
        "warning: 1 messages have a wrong length or checksum; they are left out",
        made_binary.ubx(inertial=False).replace(b"\x1c\x11", b"\x1c\x12", 1),
    ),
    (
        "undated",
        "note: 4 messages NAV-PVT have no date yet",
        made_binary.ubx(inertial=False, validDate=0),
    ),
    (
        "sigma_assumed",
        "note velocity: 4 of 4 fixes state no sigma of velocity",
        made_binary.nmea(),
    ),
    (
        "height_assumed",
        "warning: no fix states a height; 0 m is assumed, with a sigma of 1000 m",
        b"".join(
            made_binary.changed(x, f7="", f8="") if b"RMC" in x else x
            for x in made_binary.nmea().splitlines(True)
            if b"GGA" not in x
        ),
    ),
    ("clock_aligned", "note: stamps of the samples are put on GPS time", made_binary.ubx()),
    (
        "sensors_merged",
        "note: rates and specific forces were recorded apart",
        made_binary.content(made_binary.folder, "drive", apart=True, velocity="base"),
    ),
    (
        "velocity_taken",
        "note: velocities of 4 of 4 fixes are those of /vel",
        made_binary.content(made_binary.folder, "drive"),
    ),
    (
        "lines_left_out",
        "warning: 1 INSPVA lines are cut or fail their checksum and are left out",
        INSPVA + INSPVA.replace("108", "109"),
    ),
    (
        "fixes_of_truth",
        "note: fixes and path are both the solution of the OXTS unit",
        {"data/0.txt": OXTS, "timestamps.txt": "2011-09-26 13:02:25.964389445\n"},
    ),
)


def outcomes(codes):
    """Each code with each of the severities that its row declares."""
    return {(c.name, severity) for c in codes for severity in SEVERITIES if severity in c.severity}


def test_every_finding_has_a_way_to_be_caused():
    """One row of SPOILT for each code and severity that a check declares, and for no other."""
    assert list(SPOILT) == [check.find.__name__ for check in CHECKS]
    for check in CHECKS:
        spoilt = {(row.code, row.severity) for row in ROWS if row.check == check.find.__name__}
        assert spoilt == outcomes(check.codes)
    alone = {(code, says.split()[0].strip(":")) for code, says, _ in FILES}
    several = {("table_replaced", "note")}  # see test_log_registry
    assert alone | several == outcomes(OF_READERS)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.check}-{row.code}")
def test_a_spoilt_log_has_its_finding(row, told):
    findings = examine(row.log())
    kind, _, words = row.says.partition(": ")
    where = kind.removeprefix(row.severity).strip()
    caused = [
        f for by, f in told if (by, f.code, f.severity) == (row.check, row.code, row.severity)
    ]
    assert len(caused) == row.count
    assert set(caused) <= set(findings)
    values = [f.value for f in caused]
    assert row.value is None or (values if row.count > 1 else values[0]) == row.value
    assert caused[0].where.startswith(where)
    for f in caused:
        assert all(part in f.sentence for part in words.split(" ... "))
        # a whole sentence that begins with file and place
        assert f.sentence.split(": ")[0] in [f"{f.file}{part} {f.where}".rstrip() for part in PARTS]
        assert f.sentence.endswith((".", "?"))
        assert len(f.sentence) > 60
        assert "\n" not in f.sentence
    # nothing else is blamed; how the sensor lies is told of all logs that tumble
    others = {g.code for g in findings if g not in caused} - {"sensor_axes"}
    assert others == set(row.others.split())


@pytest.mark.parametrize("name", HEALTHY)
def test_a_healthy_log_has_none(name):
    assert examine(HEALTHY[name]()) == []


@pytest.mark.parametrize(("code", "says", "content"), FILES, ids=[code for code, *_ in FILES])
def test_what_a_reader_leaves_out_is_found(tmp_path, code, says, content):
    if code == "several_instances":
        pytest.importorskip("pyulog", reason="the extra `logs` is not installed")
    path = tmp_path / "log.txt"
    for name, text in content.items() if isinstance(content, dict) else [("", content)]:
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    found = []
    (read_librsf if code == "other_kinds" else open_log)(path, findings=found)
    (f,) = found
    kind, _, words = says.partition(": ")
    assert (f.code, f"{f.severity} {f.where}".strip()) == (code, kind)
    assert f.file == str(path)
    assert f.sentence.startswith("log.txt")
    assert words in f.sentence
    assert f.sentence.endswith(".")


def test_every_code_in_the_source_is_declared():
    declared = {c.name for codes in (OF_READERS, *(c.codes for c in CHECKS)) for c in codes}
    makers = {"Finding", "told", "finding", *SEVERITIES}
    said = set()
    for path in Path(robins.logs.__file__).parent.glob("*.py"):
        for call in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(call, ast.Call) and getattr(call.func, "id", "") in makers:
                code = call.args[2 if call.func.id == "finding" else 1]
                said |= {node.value for node in ast.walk(code) if is_text(node)}
    assert len(said) > 60
    assert said <= declared


def is_text(node):
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def test_every_finding_and_refusal_is_documented():
    rows = re.findall(r"^\| `(\w+)` \| ([\w, ]+) \| ([^|]+) \|$", documented(), re.MULTILINE)
    codes = (code for codes in (OF_READERS, *(check.codes for check in CHECKS)) for code in codes)
    assert sorted(rows) == sorted(codes)
    assert {key.partition("_")[2] for key in clean(tumble()).counts} <= set(REFUSALS)


def test_what_is_asked_beside_what():
    """Two sensors are compared only where neither is known to be wrong, and by the better judge."""

    def asked(things, *found):
        asked = [c for c in TOGETHER if c.applies(dict.fromkeys(things.split()), set(found))]
        return [c.find.__name__.removeprefix("check_") for c in asked]

    whole = "imu gnss mag attitude others"
    assert asked(whole) == ["span", "motion", "mag_axes", "attitude"]
    assert asked(f"{whole} master delay_s") == ["span", "master"]
    assert asked("imu others master delay_s") == ["span", "master"]
    assert asked("imu others") == ["span", "turning"]
    assert asked("imu gnss others", "motion_not_checked") == ["span", "motion", "turning"]
    for code in ("gyro_unit", "gyro_axes", "gyro_reversed", "left_handed"):
        assert asked(whole, code) == ["span", "motion"]
    for code in ("field_unit", "field_stuck"):
        assert asked(whole, code) == ["span", "motion", "attitude"]
    for code in (
        *("no_overlap", "rates_as_increments", "increments_as_rates", "time_unit", "time_slow"),
        *("velocity_axes", "velocity_unit", "velocity_sign", "position_unit", "no_fix_as_zero"),
    ):
        assert asked(whole, code) == asked("imu others", code) == ["span"]
    _, master, motion, turning, *_ = TOGETHER
    for check, judged in ((motion, {"leap_seconds"}), (turning, set())):
        assert check.outdated({"gyro_unit"}) == {"gyro_unit"} | judged
        assert check.outdated({"left_handed"}) == judged
    assert motion.outdated({"motion_not_checked"}) == set()
    by_rest = {
        *("gravity_unit", "gravity_unknown", "gravity_bias", "gravity_not_seen", "not_level"),
        *("gravity_missing", "z_axis_reversed", "rates_as_increments", "increments_as_rates"),
    }
    assert master.outdated({"gyro_unit"}) == by_rest
    assert master.outdated({"force_not_checked"}) == set()
