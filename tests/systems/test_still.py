"""Standstill and the start of a replay, on motion that is known."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from robins import rotation
from robins.dataset import GnssTable
from robins.earth.magnetic import elements, field_n, wmm
from robins.ins.increments import Increments
from robins.ins.rest import moving_statistics, standstill
from robins.systems.ins_gnss.parameters import Aids, InsGnssReplay, InsGnssStart
from robins.systems.ins_gnss.path import InsGnssPath, row_of
from robins.systems.ins_gnss.positions import heading_of
from robins.systems.ins_gnss.recording import Log
from robins.systems.ins_gnss.rest import UsualIntervals
from robins.systems.ins_gnss.start import find_start, with_heading

G = 9.80
DT = 0.01
HEADED = InsGnssReplay.model_validate({"start": {"known_heading": 1.2}})


def test_moving_statistics_are_those_of_the_windows():
    x = np.random.default_rng(1).normal(1e3, 1.0, (200, 2))
    mean, spread = moving_statistics(x, 25)
    for k in (0, 3, 24, 25, 199):
        window = x[max(0, k - 24) : k + 1]
        np.testing.assert_allclose(mean[k], window.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(spread[k], window.std(axis=0), atol=1e-9)


def test_another_heading_leaves_the_tilt():
    rng = np.random.default_rng(2)
    for roll, pitch, heading in rng.uniform([-3.1, -1.5, -3.1], [3.1, 1.5, 3.1], (30, 3)):
        turned = with_heading(np.asarray(rotation.from_euler(roll, pitch, heading)), heading + 1.0)
        expected = rotation.from_euler(roll, pitch, heading + 1.0)
        np.testing.assert_allclose(
            np.asarray(rotation.to_dcm(jnp.asarray(turned))),
            np.asarray(rotation.to_dcm(expected)),
            atol=1e-12,
        )


def _walk(rest_s, go_s, roll, pitch, heading_rest, course):
    """Rest at one heading, then turn to the course at a constant rate and move off along it."""
    rng = np.random.default_rng(5)
    n0, n1 = round(rest_s / DT), round(go_s / DT)
    rate = (course - heading_rest) / go_s
    theta = rng.normal(0, 1e-5, (n0 + n1, 3))
    C_rest = np.asarray(rotation.to_dcm(rotation.from_euler(roll, pitch, heading_rest)))
    # a turn about the vertical, seen in the body
    theta[n0:] += C_rest.T @ [0.0, 0.0, rate * DT]
    dv = np.tile(C_rest.T @ [0.0, 0.0, -G] * DT, (n0 + n1, 1)) + rng.normal(0, 1e-4, (n0 + n1, 3))
    shake = np.zeros_like(dv)
    shake[n0:] = 0.02 * rng.normal(size=(n1, 3))
    dt = np.full(n0 + n1, DT)
    time = np.cumsum(dt)
    gnss_s = np.arange(0.25, time[-1], 0.25)
    speed = np.where(gnss_s > rest_s + go_s - 0.5, 1.5, 0.0)
    v_n = np.c_[speed * np.cos(course), speed * np.sin(course), 0 * speed]
    each, one = np.ones(len(gnss_s)), np.ones((len(gnss_s), 3))
    stamps = np.round(gnss_s * 1e9).astype(np.int64)
    gnss = GnssTable(stamps, 0.7 * each, 0.2 * each, 100.0 * each, one, v_n, 0.1 * one)
    increments = Increments(dt, theta, dv + shake)
    return Log(increments, time, gnss, gnss_s, one, None, None, np.zeros(len(gnss_s), bool))


def test_rest_sought_in_parts_is_that_of_the_whole(monkeypatch):
    increments = _walk(8.0, 4.0, 0.2, -0.1, 0.5, 2.0).increments
    together = standstill(increments, *Aids().quiet)
    monkeypatch.setattr("robins.ins.rest._ROWS", 90)
    for part, whole in zip(standstill(increments, *Aids().quiet), together, strict=True):
        np.testing.assert_array_equal(part, whole)


def test_start_carries_the_tilt_by_gyro_and_takes_the_heading_from_the_course():
    roll, pitch, course = 0.2, -0.1, 2.0
    log = _walk(8.0, 4.0, roll, pitch, 0.5, course)
    still, *_ = standstill(log.increments, *Aids().quiet)
    assert np.all(still[100:790])
    assert not np.any(still[900:])
    found = find_start(log, InsGnssStart(), Aids())
    assert log.gnss_s[found.fix] == pytest.approx(11.75, abs=0.3)
    _, _, heading = (float(a) for a in rotation.to_euler(jnp.asarray(found.q_nb)))
    assert heading == pytest.approx(course, abs=1e-9)
    # turning about the vertical keeps roll and pitch
    roll_found, pitch_found, _ = (float(a) for a in rotation.to_euler(jnp.asarray(found.q_nb)))
    assert roll_found == pytest.approx(roll, abs=2e-3)
    assert pitch_found == pytest.approx(pitch, abs=2e-3)
    assert "at rest" in found.sentence


def test_start_says_why_it_cannot():
    log = _walk(4.0, 2.0, 0.0, 0.0, 0.0, 1.0)
    with_velocity = lambda v_n: log._replace(gnss=replace(log.gnss, v_n=v_n))  # noqa: E731
    with pytest.raises(ValueError, match=r"fastest fix moves at 0\.00 m/s.*start\.known_heading"):
        find_start(with_velocity(0.0 * log.gnss.v_n), InsGnssStart(), Aids())
    with pytest.raises(ValueError, match="no GNSS velocity"):
        find_start(with_velocity(None), InsGnssStart(), Aids())
    falling = log.increments._replace(dv=0.01 * log.increments.dv)
    with pytest.raises(ValueError, match="cannot level"):
        find_start(log._replace(increments=falling), InsGnssStart(), Aids())
    lost = replace(log.gnss, alt_m=np.nan * log.gnss.alt_m)
    with pytest.raises(ValueError, match="no whole GNSS fix"):
        find_start(log._replace(gnss=lost), InsGnssStart(), Aids())
    found = find_start(with_velocity(None), InsGnssStart(known_heading=1.25), Aids())
    # as given at the first sample, carried by gyros of 1e-5 rad a sample
    assert float(rotation.to_euler(jnp.asarray(found.q_nb))[2]) == pytest.approx(1.25, abs=5e-4)


def test_a_magnetometer_tells_the_heading_where_no_course_does():
    """A field made at a known attitude; true north, so with the declination of the place."""
    log = _walk(4.0, 2.0, 0.1, -0.05, 0.0, 1.0)
    slow = log._replace(gnss=replace(log.gnss, v_n=0.0 * log.gnss.v_n))
    roll, pitch, heading = 0.1, -0.05, 2.2
    north, east, down = 21e-6, 0.0, 43e-6  # along magnetic north
    declination = float(elements(field_n(wmm(2025), 0.7, 0.2, 100.0, 2025.0)).declination_rad)
    along = np.array([np.cos(declination) * north, np.sin(declination) * north + east, down])
    C = np.asarray(rotation.to_dcm(rotation.from_euler(roll, pitch, heading)))
    field = np.tile(C.T @ along, (60, 1))
    seen = slow._replace(field_s=np.arange(60) * 0.1, field_b=field)
    found = find_start(seen, InsGnssStart(), Aids())
    assert float(rotation.to_euler(jnp.asarray(found.q_nb))[2]) == pytest.approx(heading, abs=2e-3)
    assert "from the magnetometer" in found.sentence
    # a course is better than a magnetometer in a vehicle of steel
    moving = log._replace(field_s=seen.field_s, field_b=field)
    assert "from the course" in find_start(moving, InsGnssStart(), Aids()).sentence
    with pytest.raises(ValueError, match=r"reads 0\.1 of the Earth's field"):
        find_start(seen._replace(field_b=0.1 * field), InsGnssStart(), Aids())


def standing(parameters, turn_s=0.0, field_t=None, fixes_s=0.0):
    """Path of a unit at 50 Hz and its start, if it finds one; it turns by 30 deg/s from 1 s on.

    The first of its fixes, which do not move, comes after a time.
    """
    path, noise = InsGnssPath(parameters, UsualIntervals(0.02, 0.5), 1.0), np.random.default_rng(0)
    for k in range(600):
        row = [0.0, 0.0, np.pi / 6.0 * (50 < k <= 50 * (1.0 + turn_s)), 0.0, 0.0, -9.8]
        path.push(np.array([20_000_000 * k]), row + noise.normal(size=(1, 6)) * 1e-4)
        if field_t is not None:
            path.push_field(20_000_000 * k, field_t)
        if k % 25 == 0 and 0.02 * k > fixes_s:
            velocity = np.zeros(3), np.full(3, 0.05)
            path.push_fix(row_of(0.02 * k - 0.1, (0.7, 0.1, 100.0), np.ones(3), *velocity, 1))
        if found := path.start():
            return found[1]
    return None


@pytest.mark.parametrize("most_s", [600.0, 6.0, 2.0])
def test_a_given_heading_is_that_of_the_first_sample_also_where_it_is_dropped(monkeypatch, most_s):
    monkeypatch.setattr("robins.systems.ins_gnss.path._MOST_START_S", most_s)
    start = standing(HEADED, turn_s=3.0, fixes_s=9.0)
    turned = heading_of(start.q_nb) - 1.2
    assert np.degrees(turned) == pytest.approx(90.0, abs=0.01)


def test_a_magnetometer_that_is_refused_is_asked_ever_more_rarely(monkeypatch):
    asked = []

    def counted(*of):
        asked.append(float(of[0].time_s[-1]))
        return find_start(*of)

    monkeypatch.setattr("robins.systems.ins_gnss.path.find_start", counted)
    monkeypatch.setattr("robins.systems.ins_gnss.path._COURSE_S", 2.0)
    assert standing(InsGnssReplay(), field_t=np.array([3e-4, 0.0, 0.0])) is None
    assert 10 < len(asked) < 25  # of 98 times that the start is looked for
    assert np.all(np.diff(asked)[-3:] > 0.7)
