"""The laboratory: the satellite with its plant in two halves and a sky before its star sensor."""

import shutil
import subprocess

import numpy as np
import pytest
import stations
from flights import in_order
from scipy.spatial.transform import Rotation

from robins.bench.rigs import rig_of, satellite
from robins.bench.rigs.laboratory import RIG, TAKES, WIRE
from robins.bench.rigs.laboratory.parts import MARGIN_RAD, STARS
from robins.bench.rigs.satellite import judging, messages
from robins.bench.run.session import Session
from robins.bench.run.setup import changed, read
from robins.bench.wire.c_header import firmware
from robins.earth.stars import synthetic
from robins.scenario import ScenarioError
from robins.workbench import bench_replay

ARCSEC = np.pi / 648e3
STEPS = 300  # 30 s
SETTINGS = ("duration=30 s", "counted_from=10 s")


@pytest.fixture(scope="module")
def flight():
    return read("laboratory", SETTINGS)


@pytest.fixture(scope="module")
def config(flight):
    return RIG.prepare(flight.setup, flight.given)


@pytest.fixture(scope="module")
def inside(config):
    return RIG.inside(config)


@pytest.fixture(scope="module")
def parts(config):
    return {part.name: part for part in in_order(RIG, stations.parts(config, RIG))}


@pytest.fixture(scope="module")
def fly(parts):
    """Parts one after the other; what they say by message, a row a step, None where nothing."""

    def of(steps=STEPS, meddle=lambda name, k, said: said, off=lambda part, k: False):
        states = {name: part.begin() for name, part in parts.items()}
        said = {message.name: [None] * steps for message in WIRE.data}
        heard = {name: [None] * steps for name in said}
        for k in range(steps):
            for name, part in parts.items():
                if off(name, k):
                    states[name] = part.begin()
                    continue
                inputs = {
                    m: heard[m][k - lag] if k >= lag and not (lag and off(name, k - 1)) else None
                    for m, lag in part.takes.items()
                }
                states[name], sent = part.act(states[name], k, inputs)
                for message, values in sent:
                    payload = WIRE.encode(message, values)
                    assert WIRE.unsound(message, payload) is None
                    said[message][k] = WIRE.decode(message, payload)
                    heard[message][k] = meddle(message, k, WIRE.decode(message, payload))
        return said

    return of


@pytest.fixture(scope="module")
def series(fly):
    return fly()


def rows(series, message, field):
    return np.array([said[field] for said in series[message] if said is not None])


def error_arcsec(series):
    off = judging.turn(rows(series, "estimate", "q_ib"), rows(series, "motion", "q_ib"))
    return np.linalg.norm(off, axis=1) / ARCSEC


def test_it_has_all_that_the_satellite_has():
    assert set(messages.WIRE.messages) < set(WIRE.messages)
    assert WIRE.numbers.keys() - messages.WIRE.numbers.keys() == {"turn", "stars"}
    assert WIRE.parts[1:4] == ("dynamics", "kinematics", "table")
    assert set(RIG.fault.table.kinds) > set(satellite.RIG.fault.table.kinds)
    assert rig_of("laboratory") is RIG
    assert "laboratory/stars" in RIG.flies()
    offered = [
        RIG.fault.model_validate({**one["fault"], "begin": 1.0}) for one in RIG.shown.offered
    ]
    assert {"dark", "hidden", "stuck"} <= {one.kind for one in offered}
    # the scenarios of the satellite are still flown by its own rig
    assert read("satellite/stars").rig is satellite.RIG


def test_what_parts_take_is_what_the_links_carry(parts):
    for name, part in parts.items():
        assert set(part.takes) <= set(TAKES[name])


def test_without_a_camera_there_is_nothing_to_show_a_sky():
    of = read("laboratory")
    blind = of.given.model_copy(update={"star": of.given.star.model_copy(update={"camera": None})})
    with pytest.raises(ScenarioError, match="this satellite has none: fly laboratory/stars"):
        RIG.prepare(of.setup, blind)


# ------------------------------------------------------------------------------ equality


def test_the_parts_have_the_bits_of_one_program(inside, series):
    for name in ("motion.q_ib", "estimate.q_ib", "estimate.gyro_bias", "wheels.momentum"):
        np.testing.assert_array_equal(rows(series, *name.split(".")), inside[name][:STEPS])


def test_it_is_the_run_of_the_satellite(config, inside):
    theirs = satellite.RIG.inside(config)
    assert inside.keys() == theirs.keys()
    for name, values in inside.items():
        np.testing.assert_array_equal(values, theirs[name], err_msg=name)


def test_kinematics_turns_as_dynamics_says(series):
    """SciPy composes the turns: a Gibbs vector g is the quaternion (1, g) but for its length."""
    q, gibbs = rows(series, "motion", "q_ib"), rows(series, "turn", "gibbs_b")
    turns = Rotation.from_quat(np.c_[np.ones(STEPS), gibbs], scalar_first=True)
    now = Rotation.from_quat(q[0], scalar_first=True)
    for k in range(1, STEPS):
        now = now * turns[k]
    off = now.inv() * Rotation.from_quat(q[-1], scalar_first=True)
    assert off.magnitude() < 1e-13
    # and the rate is that with which it turns, as the mean of a step's beginning and end
    omega = rows(series, "turn", "omega_b")
    mean = turns[1:].as_rotvec() / 0.1
    np.testing.assert_allclose(mean, 0.5 * (omega[1:] + omega[:-1]), atol=1e-8)


# ------------------------------------------------------------------------------ the sky


def test_stars_are_where_the_true_attitude_puts_them(series, flight):
    camera, sky = flight.given.star.camera, synthetic(flight.given.star.camera.magnitude)
    edge = 0.5 * camera.field + MARGIN_RAD
    frames = [k for k in range(STEPS) if series["stars"][k] is not None]
    assert len(frames) == STEPS // 5
    counts = set()
    for k in frames[::7]:
        said, q = series["stars"][k], series["motion"][k]["q_ib"]
        unit_s = Rotation.from_quat(q, scalar_first=True).inv().apply(sky.unit_i)
        seen = np.flatnonzero(np.arccos(unit_s[:, 2]) < edge)[:STARS]
        count = len(seen)
        counts.add(count)
        np.testing.assert_allclose(
            said["vectors_s"].reshape(-1, 3)[:count], unit_s[seen], rtol=0.0, atol=1e-15
        )
        np.testing.assert_array_equal(said["magnitude"][:count], sky.magnitude[seen])
        assert np.all(np.isnan(said["magnitude"][count:]))
        assert np.all(np.isnan(said["vectors_s"][3 * count :]))
        assert series["star"][k]["stars"] <= count
    assert min(counts) > 5


def test_an_error_of_all_stars_is_the_sensors():
    """The sky is shown as it is; the sensor, warped by 100 arcsec, sees it as the satellite's.

    Directions are turned and not the attitude, which rounds otherwise: numbers of 1 have an ulp of
    2e-16, and each of 200 steps rounds a few times. A gyro's count that fell the other way would be
    seen.
    """
    settings = ("duration=20 s", "counted_from=10 s", "star.low_frequency=100 arcsec")
    of = read("laboratory/stars", settings)
    config = RIG.prepare(of.setup, of.given)
    ours, theirs = RIG.inside(config), satellite.RIG.inside(config)
    error = judging.turn(ours["estimate.q_ib"], ours["motion.q_ib"])
    assert np.max(np.linalg.norm(error, axis=1)) > 50.0 * ARCSEC
    for name, values in ours.items():
        np.testing.assert_allclose(values, theirs[name], rtol=0.0, atol=1e-12, err_msg=name)


# ------------------------------------------------------------------------------ what goes wrong


def fault(kind, **more):
    one = RIG.fault(kind=kind, begin=0.0, **more)
    act = RIG.device_faults()[0][kind].act
    return lambda name, k, said: act(said, one, 0) if name == "stars" and k >= 100 else said


def test_under_a_dark_sky_the_gyro_carries_on(fly):
    dark = fly(200, fault("dark"))
    told = [said for said in dark["star"][100:] if said is not None]
    assert len(told) == 20
    assert all(np.all(np.isnan(said["q_ib"])) and said["stars"] == 0 for said in told)
    sigma = rows(dark, "estimate", "sigma")[:, :3]
    assert np.linalg.norm(sigma[-1]) > 1.2 * np.linalg.norm(sigma[99])
    assert error_arcsec(dark)[-1] < 60.0


def test_a_hidden_star_is_one_star_less(fly, series):
    without = fly(200, fault("hidden", stars=3))
    before, after = ([f["stars"] for f in x["star"][100:200] if f] for x in (series, without))
    # some of the three are missed anyway, and the camera misses others in their place
    assert 2.0 < np.mean(np.array(before) - after) < 4.0
    assert error_arcsec(without)[-1] < 60.0


def test_parts_go_on_without_a_message(fly):
    lost = {"turn": 50, "motion": 120, "stars": 134}
    gone = fly(200, lambda name, k, said: None if lost.get(name) == k else said)
    q = rows(gone, "motion", "q_ib")
    turns = np.linalg.norm(judging.turn(q[:-1], q[1:]), axis=1)
    assert np.max(np.abs(np.diff(turns[20:]))) < 1e-5  # rad: it keeps its rate
    assert len([said for said in gone["star"] if said is not None]) == 39
    assert error_arcsec(gone)[-1] < 60.0


def test_a_determination_that_lost_its_state_comes_back_with_the_next_star_frame(fly):
    gone = fly(250, off=lambda part, k: part == "adm" and 102 <= k < 172)
    assert all(said is None for said in gone["estimate"][102:172])
    safe = [k for k in range(172, 250) if gone["estimate"][k]["flags"] & messages.SAFE]
    assert safe == [172, 173]  # the next star frame ends step 174
    # the sensor has gone on by itself, and control has rested until it heard an estimate
    solved = [np.all(np.isfinite(said["q_ib"])) for said in gone["star"] if said is not None]
    assert len(solved) == 50
    assert all(solved)
    torque = rows(gone, "command", "wheel_torque")
    assert np.all(torque[104:175] == 0.0)
    assert np.all(np.any(torque[175:] != 0.0, axis=1))
    moved = judging.turn(gone["motion"][0]["q_ib"], gone["motion"][174]["q_ib"])
    assert np.linalg.norm(moved) > 1000.0 * ARCSEC  # from where the lost state would have it
    for k in range(174, 250):
        q_ib = gone["estimate"][k]["q_ib"]
        assert np.linalg.norm(judging.turn(q_ib, gone["motion"][k]["q_ib"])) < 120.0 * ARCSEC


def test_a_control_that_lost_its_state_rests_until_it_hears_an_estimate(fly):
    gone = fly(160, off=lambda part, k: part == "acm" and 100 <= k < 130)
    assert np.all(gone["command"][130]["wheel_torque"] == 0.0)
    assert np.any(gone["command"][131]["wheel_torque"] != 0.0)


# ------------------------------------------------------------------------------ power


def test_a_part_without_power_has_lost_its_state_and_its_history(
    flight, fly, tmp_path, monkeypatch
):
    """Off for 2 s, killed 2 s later and told all again, which is what came since it was on."""
    stations.on_threads(monkeypatch)
    faults = (
        RIG.fault(kind="power", link="adm", begin=4.0, end=6.0),
        RIG.fault(kind="killed", link="adm", begin=8.0),
    )
    of = changed(flight, {"seconds": 10.0, "faults": faults, "on_death": "restart"})
    result = Session(of, tmp_path / "r.mcap").run()
    assert (result.failure, result.steps, result.deaths) == ("", 100, 1)
    assert result.injected == {("power", "adm"): 1, ("killed", "adm"): 1}
    assert [e.text for e in result.events if e.kind == "power"] == [
        "'adm' is switched off, as a fault",
        "'adm' is switched on, and begins anew",
    ]
    wanted = fly(100, off=lambda part, k: part == "adm" and 39 <= k < 59)
    for message, field in (("motion", "q_ib"), ("estimate", "q_ib"), ("estimate", "flags")):
        there = [k for k in range(100) if wanted[message][k] is not None]
        assert len(there) == (100 if message == "motion" else 80)
        values = result.series[f"{message}.{field}"][there]
        np.testing.assert_array_equal(values, rows(wanted, message, field))
    again = bench_replay(tmp_path / "r.mcap", node="adm")
    assert (again.same, again.complete) == (True, True)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_header_of_its_wire_compiles_and_knows_long_messages(tmp_path):
    """The magnitudes begin far beyond the 255 bytes that a byte can count."""
    for name, text in firmware(WIRE).items():
        (tmp_path / name).write_text(text, "utf-8")
    at = 24 * STARS
    (tmp_path / "sound.c").write_text(
        f"""
#include "robins_wire.h"
int main(void) {{
  static robins_stars sky;
  unsigned char *bytes = (unsigned char *)&sky;
  if (!robins_sound(ROBINS_STARS, bytes)) return 1;
  double off = 60.0;
  memcpy(bytes + {at}, &off, sizeof off);
  if (robins_sound(ROBINS_STARS, bytes)) return 2;
  off = 0.0;
  memcpy(bytes + {at}, &off, sizeof off);
  off = -2.5;
  memcpy(bytes + {at - 8}, &off, sizeof off);
  return robins_sound(ROBINS_STARS, bytes) ? 3 : 0;
}}
"""
    )
    flags = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror"]
    built = subprocess.run(
        ["cc", *flags, "sound.c", "-o", "sound"], cwd=tmp_path, capture_output=True, text=True
    )
    assert built.returncode == 0, built.stderr
    assert subprocess.run([tmp_path / "sound"]).returncode == 0
