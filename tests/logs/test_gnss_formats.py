import numpy as np
import pytest

from robins.logs import LogError, open_log
from robins.logs.rtklib import read_rtklib

HEADER = (
    "%  GPST latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) "
    "sdun(m) age(s) ratio"
)
VELOCITY = " vn(m/s) ve(m/s) vu(m/s) sdvn sdve sdvu sdvne sdveu sdvun"
FIX = "2025/08/28 17:30:39.749 40.5 -105.25 1601.435 {q} 25 0.01 0.02 0.03 0 0 0 0 9.9"
PLACES = "% GPST latitude(deg) longitude(deg) height(m) Q ns"
SPEED = " 1.5 -2.5 0.25 0.04 0.05 0.06 0 0 0"
CLOCK, GPST_NS = "17:30:39.749", 1756402239749000000
FLOAT = FIX.format(q=2)
IN_WEEKS = FLOAT.replace(f"2025/08/28 {CLOCK}", "2381 408639.749")


@pytest.fixture
def pos(tmp_path):
    def write(*lines):
        path = tmp_path / "rover.pos"
        path.write_text("".join(f"{line}\n" for line in lines))
        return path

    return write


def test_rtklib_in_north_east_down(pos):
    path = pos("% program : RTKLIB", HEADER + VELOCITY, FIX.format(q=1) + SPEED)
    gnss = open_log(path, findings=[])
    assert gnss.time_ns.tolist() == [GPST_NS]
    assert np.rad2deg([gnss.lat_rad[0], gnss.lon_rad[0]]) == pytest.approx([40.5, -105.25], 1e-15)
    assert gnss.alt_m.tolist() == [1601.435]
    assert gnss.sigma_m.tolist() == [[0.01, 0.02, 0.03]]
    assert gnss.v_n.tolist() == [[1.5, -2.5, -0.25]]  # up became down
    assert gnss.sigma_v.tolist() == [[0.04, 0.05, 0.06]]
    assert (gnss.quality.tolist(), gnss.nav, gnss.rows.tolist()) == ([1], "NED", [3])


@pytest.mark.parametrize(
    ("header", "line", "codes"),
    [(HEADER, "", []), (HEADER + VELOCITY, " 0 0 0 0 0 0 0 0 0", ["no_velocity"])],
)
def test_rtklib_without_velocities_or_with_none_that_were_solved(pos, header, line, codes):
    findings = []
    gnss = read_rtklib(pos(header, FIX.format(q=5) + line), findings)
    assert (gnss.v_n, gnss.sigma_v, gnss.quality.tolist()) == (None, None, [5])
    assert [f.code for f in findings] == codes
    assert read_rtklib(pos(HEADER, FIX.format(q="nan"))).quality.tolist() == [0]  # unknown


@pytest.mark.parametrize(
    ("header", "line"),
    [
        (HEADER, FLOAT.replace(" ", ",", 20).replace("28,17", "28 17")),
        (HEADER, IN_WEEKS),
        (HEADER, IN_WEEKS.replace(" ", ",")),
        (HEADER.replace("GPST", "UTC"), FLOAT.replace(CLOCK, "17:30:21.749")),
        ("% no names of columns", FLOAT),
        ("% no names of columns", FLOAT + SPEED),
    ],
    ids=["commas", "week", "week with commas", "utc", "nameless", "nameless with velocity"],
)
def test_rtklib_in_its_other_forms(pos, header, line):
    gnss = open_log(pos(header, line), "rtklib-pos", findings=[])
    assert gnss.time_ns.tolist() == [GPST_NS]
    assert np.rad2deg(gnss.lon_rad) == pytest.approx([-105.25], 1e-15)
    assert gnss.sigma_m.tolist() == [[0.01, 0.02, 0.03]]
    assert gnss.quality.tolist() == [2]


def test_columns_are_found_by_name(pos):
    header = "% GPST height(m) latitude(deg) longitude(deg) sdu(m) sdn(m) sde(m) Q ns"
    gnss = read_rtklib(pos(header, "2025/08/28 17:30:39.749 1601 40.5 -105.25 3 1 2 1 25"))
    assert gnss.alt_m.tolist() == [1601.0]
    assert gnss.sigma_m.tolist() == [[1.0, 2.0, 3.0]]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["% GPST x-ecef(m) y-ecef(m) z-ecef(m) Q ns", "2381 1 1 2 3 1 25"], r"line 1: .* X, Y, Z"),
        (["% GPST e-baseline(m) n-baseline(m) u-baseline(m) Q ns", "2381 1 1 2"], r"baselines"),
        ([PLACES.replace("deg", "d'\""), "2381 1 40 30 0"], "degrees, min"),
        ([PLACES.replace("GPST", "JST"), "2381 1 40 30 0"], "Japan standard"),
        ([HEADER], r"holds no solution: header only; was any epoch solved"),
        ([PLACES, "2381 1 40 30 0 1 5"], "no column sdn"),
        ([HEADER, FIX.replace(CLOCK, "25:30:39")], r"line 2: time = '2025/08/28 25:30:39': is"),
        ([HEADER, FIX.replace("-105.25", "W105")], r"line 2: longitude = 'W105': is not a number"),
    ],
)
def test_rtklib_files_that_are_refused(pos, lines, message):
    with pytest.raises(LogError, match=message):
        read_rtklib(pos(*(line.format(q=1) if "Q" not in line else line for line in lines)), [])
