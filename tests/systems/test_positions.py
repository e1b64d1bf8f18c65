"""Velocity, course and sigmas of logs whose receiver states none; the verdict on a replay."""

import io
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from short_drive import DRIVE

from robins import scenario
from robins.dataset import Dataset, GnssTable, ImuTable
from robins.earth import Geodetic
from robins.filters import Code
from robins.ins.increments import Increments
from robins.systems.ins_gnss import Drive, drive_dataset, replay
from robins.systems.ins_gnss.model import POSITION
from robins.systems.ins_gnss.parameters import Aids, Gnss, InsGnssReplay, InsGnssStart
from robins.systems.ins_gnss.positions import _lines, course_fix, fitted, heading_of
from robins.systems.ins_gnss.recording import Log, on_one_clock
from robins.systems.ins_gnss.reported import DIVERGED, verdict
from robins.systems.ins_gnss.start import UNKNOWN_SPEED, find_start
from robins.systems.replaying import FilterEstimates

G, LAT, DT = 9.81, 0.8, 0.005
NORTH = 6378137.0 * (1 - 0.00669437999014) / (1 - 0.00669437999014 * np.sin(LAT) ** 2) ** 1.5
EAST = 6378137.0 / np.sqrt(1 - 0.00669437999014 * np.sin(LAT) ** 2) * np.cos(LAT)


def arc(t, v0=5.0, push=1.5, heading=0.7, turn=0.3):
    """Place (n, 2) and velocity (n, 2) of a speed v0 + push t on a heading that turns, closed."""
    c, v = heading + turn * np.asarray(t), v0 + push * np.asarray(t)
    sides = np.stack([np.sin(c), -np.cos(c)], axis=-1), np.stack([np.cos(c), np.sin(c)], axis=-1)
    place = v[..., None] / turn * sides[0] + push / turn**2 * sides[1]
    return place, v[..., None] * sides[1]


def log_of(lasts=8.0, rate_hz=2.0, sigma=0.02, noise=0.0, arm=(0.0, 0.0), late=0.0, **motion):
    """A level vehicle on an arc; nothing but the shake tells it from rest."""
    motion = {"v0": 5.0, "push": 1.5, "heading": 0.7, "turn": 0.3} | motion
    rng = np.random.default_rng(3)
    n = round(lasts / DT)
    t = DT * np.arange(1, n + 1)
    speed, turn = motion["v0"] + motion["push"] * (t - DT / 2), motion["turn"]
    force = np.stack([np.full(n, motion["push"]), speed * turn, np.full(n, -G)], axis=1)
    # in the axes at the start of each interval: half a turn before its middle
    force[:, :2] += 0.5 * turn * DT * np.stack([-force[:, 1], force[:, 0]], axis=1)
    force += np.diff(rng.normal(0.0, 0.3, (n + 1, 3)), axis=0) if noise else 0.0
    theta = np.tile([0.0, 0.0, turn * DT], (n, 1))
    gnss_s = np.arange(0.3, t[-1], 1.0 / rate_hz)
    place, _ = arc(gnss_s - late, **motion)
    c = motion["heading"] + turn * (gnss_s - late)
    ahead, right = np.array(arm)
    place = place + np.stack([np.cos(c), np.sin(c)], 1) * ahead
    place = place + np.stack([-np.sin(c), np.cos(c)], 1) * right
    place = place + noise * rng.normal(size=place.shape)
    table = GnssTable(
        np.round(gnss_s * 1e9).astype(np.int64),
        LAT + place[:, 0] / NORTH,
        0.2 + place[:, 1] / EAST,
        np.full(len(gnss_s), 0.0),
        np.full((len(gnss_s), 3), sigma),
    )
    increments = Increments(np.full(n, DT), theta, force * DT)
    none = np.zeros(len(gnss_s), bool)
    return Log(increments, t, table, gnss_s, table.sigma_m, None, None, none), place, motion


def test_a_line_is_that_of_least_squares_with_the_sigmas_of_its_misfit():
    rng = np.random.default_rng(1)
    t, sigma = np.sort(rng.uniform(-8.0, 0.0, (5, 9)), axis=1), rng.uniform(0.5, 2.0, (5, 9, 3))
    y = rng.normal(0.0, 3.0, (5, 9, 3))
    t[3, 2:] = np.nan
    t[4, 3:6] = np.nan
    p, v, spread = _lines(t, y, sigma)
    assert np.all(np.isnan(v[3]))
    assert np.all(np.isinf(spread[3]))
    for k in (0, 1, 2, 4):
        here, left, covariances = np.isfinite(t[k]), 0.0, []
        for axis in range(3):
            w = 1.0 / sigma[k, here, axis]
            A = np.stack([np.ones(here.sum()), t[k, here]], axis=1) * w[:, None]
            found, misfit, *_ = np.linalg.lstsq(A, y[k, here, axis] * w, rcond=None)
            np.testing.assert_allclose([p[k, axis], v[k, axis]], found, rtol=1e-9)
            left += misfit[0]
            covariances.append(np.linalg.inv(A.T @ A)[::-1, ::-1])
        grown = max(left / (3 * (here.sum() - 2)), 1.0)
        np.testing.assert_allclose(spread[k], grown * np.array(covariances), rtol=1e-9)


@pytest.mark.parametrize("known", [True, False], ids=["heading known", "heading by course"])
@pytest.mark.parametrize("late", [0.0, 0.2])
def test_velocity_and_place_at_a_fix_are_those_of_the_closed_form(known, late):
    """On an arc that is driven ever faster, with a lever arm: a line alone is off by metres."""
    arm = (1.2, -0.7)
    log, place, motion = log_of(arm=arm, late=late)
    k = 8
    at = log.gnss_s[k]
    c = motion["heading"] + motion["turn"] * at
    begun = c if known else c + 2.0
    q = np.array([np.cos(begun / 2), 0.0, 0.0, np.sin(begun / 2)])
    gnss = Gnss(lever_arm=("1.2 m", "-0.7 m", "0 m"), latency=f"{late} s")
    q, offset, v, spread = fitted(log, k, q, 1e-4, gnss, np.zeros(3), known)
    true_place, true_v = arc(at, **motion)
    np.testing.assert_allclose(v, [*true_v, 0.0], atol=0.01)
    np.testing.assert_allclose(offset, [*(true_place - place[k]), 0.0], atol=0.01)
    assert abs(heading_of(q) - c) < 1e-3
    assert 0.0 < np.sqrt(spread[0, 0, 0]) < 0.05


@pytest.mark.parametrize(
    ("change", "row"),
    [
        ({}, 2),
        ({"sigma": 1.0, "noise": 1.0}, None),  # in a few seconds
        ({"sigma": 3.0, "noise": 3.0, "v0": 0.01, "push": 0.0, "lasts": 40.0}, "none"),
        ({"v0": 0.9, "push": 0.0}, "none"),
    ],
    ids=["centimetres", "metres", "at rest", "slower than course_speed"],
)
def test_a_course_is_taken_where_positions_prove_the_speed(change, row):
    found = course_fix(log_of(**change)[0], InsGnssStart())
    if row is None:
        assert 2 < found < 12
    else:
        assert found == (None if row == "none" else row)


def test_a_position_that_is_far_off_makes_no_course():
    log, *_ = log_of(v0=0.01, push=0.0, sigma=1.0, noise=1.0)
    lat = log.gnss.lat_rad.copy()
    lat[6] += 60.0 / NORTH
    assert course_fix(log._replace(gnss=replace(log.gnss, lat_rad=lat)), InsGnssStart()) is None


@pytest.mark.parametrize("given", [True, False], ids=["heading given", "by course"])
def test_a_log_that_begins_in_motion_starts_with_its_velocity(given):
    log, _, motion = log_of(noise=0.3, sigma=0.3, push=0.3)
    start = InsGnssStart(known_heading=0.7) if given else InsGnssStart()  # that at the first sample
    found = find_start(log, start, Aids())
    at = log.gnss_s[found.fix]
    assert at < 4.0
    away = (found.v_n[:2] - arc(at, **motion)[1]) / np.sqrt(found.spread[:2, 0, 0])
    assert np.max(np.abs(away)) < 3.0
    off = heading_of(found.q_nb) - (motion["heading"] + motion["turn"] * at)
    assert abs(off) < (0.01 if given else 3.0 * found.heading_sigma_rad)
    assert "positions" in found.sentence
    assert "moving" in found.sentence


def test_a_velocity_is_zero_only_where_rest_is_proved_and_unknown_without_positions():
    rest, *_ = log_of(v0=0.01, push=0.0, turn=1e-9, sigma=0.02, rate_hz=4.0)
    known = InsGnssStart(known_heading=0.3)
    found = find_start(rest, known, Aids())
    assert np.all(found.v_n == 0.0)
    np.testing.assert_allclose(np.sqrt(found.spread[:, 0, 0]), known.velocity)
    few, *_ = log_of(rate_hz=0.05, lasts=45.0)
    with pytest.raises(ValueError, match="velocity at the start is not known"):
        find_start(few._replace(time_s=few.time_s[:4000], increments=Increments(
            *(a[:4000] for a in few.increments[:3]))), known, Aids())  # fmt: skip
    assert np.sqrt(find_start(few, known, Aids()).spread[0, 0, 0]) == UNKNOWN_SPEED


def test_a_missing_component_of_a_velocity_comes_from_positions():
    log, *_ = log_of(noise=0.1, sigma=0.1)
    v = np.stack([*arc(log.gnss_s)[1].T, np.full(len(log.gnss_s), np.nan)], axis=1)
    log = log._replace(
        gnss=replace(log.gnss, v_n=v, sigma_v=0.0 * v + 0.1), v_n=v, sigma_v=0.1 + 0 * v
    )
    found = find_start(log, InsGnssStart(), Aids())
    np.testing.assert_array_equal(found.v_n[:2], v[found.fix, :2])
    assert abs(found.v_n[2]) < 4.0 * np.sqrt(found.spread[2, 0, 0])


# ------------------------------------------------------------------------- sigmas and the verdict


@pytest.mark.parametrize(
    ("settings", "assumed", "sigmas"),
    [
        ({}, None, [0.5, 1.5, 1.5, 0.5]),
        ({}, [False] * 4, [0.5, 1.5, 1.5, 0.5]),
        ({}, [True] * 4, [0.5, 0.5, 0.5, 0.5]),
        ({}, [False, False, True, False], [0.5, 1.5, 0.5, 0.5]),
        ({"sigma": "2 m", "velocity_sigma": "2 m/s"}, [True] * 4, [2.0, 6.0, 6.0, 2.0]),
        ({"sigma": "2 m", "velocity_sigma": "2 m/s", "sigma_factor": {}}, None, [2.0] * 4),
    ],
    ids=[
        "stated, by quality",
        "all stated",
        "assumed, by quality already",
        "one assumed",
        "given",
        "given, no factor",
    ],
)
def test_sigmas_are_stated_assumed_or_given(settings, assumed, sigmas):
    """Each component of each fix by itself: marked are places east and velocities down."""
    time, half = np.arange(4) * 10**9, np.full((4, 3), 0.5)
    marks = {} if assumed is None else {
        "assumed_m": np.outer(assumed, [False, True, False]),
        "assumed_v": np.outer(assumed, [False, False, True]),
    }  # fmt: skip
    gnss = GnssTable(time, *half.T, half, half, half, np.array([1, 2, 5, 0]), **marks)
    imu = ImuTable(np.arange(400) * 10**7, np.zeros((400, 3)), np.zeros((400, 3)), "rate")
    log = on_one_clock(Dataset("f", imu, gnss), InsGnssReplay.model_validate({"gnss": settings}))
    np.testing.assert_allclose(log.sigma_m[:, 1], sigmas)
    np.testing.assert_allclose(log.sigma_v[:, 2], sigmas)
    stated = [2.0, 6.0, 6.0, 2.0] if "sigma" in settings else [0.5, 1.5, 1.5, 0.5]
    stated = [2.0] * 4 if "sigma_factor" in settings else stated
    np.testing.assert_allclose(log.sigma_m[:, [0, 2]].T, [stated] * 2)
    np.testing.assert_allclose(log.sigma_v[:, :2].T, [stated] * 2)


@pytest.mark.parametrize(
    ("nis", "refused", "apart_m", "doubts", "begins"),
    [
        (1.01, 0, 1.0, [], "Consistent: ekf, position NIS 1.01 (0.37 to 1.94 is consistent), 0 of"),
        (1.01, 0, None, [], "Consistent: ekf"),
        (1.3, 0, 1.0, [], "Consistent"),
        (2.2, 0, 1.0, [], "With care"),
        (0.2, 0, 1.0, [], "With care"),
        (1.01, 0, 1.0, ["ekf: beware."], "With care"),
        (1.01, 0, 1.0, ["robust: of another filter."], "Consistent"),
        (4.2, 0, 1.0, [], "Do not trust"),
        (
            1.01,
            14,
            1.0,
            [],
            "Do not trust: ekf, position NIS 1.01 (0.24 to 2.29",
        ),
        (1.01, 0, 14.0, [], "Do not trust"),
        (1.01, 0, 1.0, [f"ekf: {DIVERGED}: 3 s."], "Do not trust"),
    ],
)
def test_a_verdict_says_whether_a_replay_is_good(nis, refused, apart_m, doubts, begins):
    count = np.arange(40)
    code = np.where(count < refused, int(Code.REFUSED), int(Code.DONE))
    update = SimpleNamespace(dof=np.full(40, 3), code=code)

    def answer(off_m):
        place = Geodetic(LAT + np.full(40, off_m) / NORTH, np.full(40, 0.2), np.zeros(40))
        updates = {POSITION: update} if off_m == 0.0 else {}
        mean, sigma = SimpleNamespace(position=place), np.full((40, 15), 2.0)
        return FilterEstimates("", mean, sigma, updates, None, 0.0, None, bounds=False)

    answers = {"ekf": answer(0.0)} | ({} if apart_m is None else {"ekf+rts": answer(apart_m)})
    key = f"nis_{POSITION}"
    independent = 3 * (40 - refused) // 10
    band = chi2.ppf([0.025, 0.975], independent) / independent
    of = {key: nis, f"{key}_band": band.tolist(), f"refused_{POSITION}": refused}
    said = verdict(answers, {"ekf": of, "ekf+rts": {}}, doubts)
    assert said.startswith(begins)
    assert f"{refused} of 40 fixes refused" in said
    assert ("sigmas away from the smoothed path" in said) == (apart_m is not None)
    assert verdict({"ekf+rts": answer(1.0)}, {"ekf+rts": {}}, []) == ""


# ----------------------------------------------------------------------------------- every sample


def test_states_at_every_sample_are_those_of_the_epochs_carried_on():
    """Against Euler steps from epoch to epoch, with the biases of the epoch."""
    log = drive_dataset(scenario.parse(Drive, DRIVE), seed=4)
    found = replay(log, InsGnssReplay(every_sample=True), ("ekf", "ekf+rts"))
    assert set(found.files) == {"exports/ekf-sample.npz", "exports/ekf+rts-sample.npz"}
    for name in ("ekf", "ekf+rts"):
        with np.load(io.BytesIO(found.files[f"exports/{name}-sample.npz"])) as file:
            x = {key: file[key] for key in file.files}
        s = found.solution.sel(filter=name)
        epoch = np.round(s["time"].values * 1e9).astype(np.int64) + log.imu.time_ns[0]
        assert np.all(np.diff(x["time_ns"]) == 20_000_000)
        assert x["time_ns"][-1] == epoch[-1]
        there = np.isin(x["time_ns"], epoch)
        epochs = np.isin(epoch, x["time_ns"])
        assert np.sum(there) > 30
        for key, of in (("v_n", "estimate_velocity"), ("q_nb", "q_nb")):
            np.testing.assert_allclose(x[key][there], s[of].values[epochs], atol=1e-12)
        bias_g, bias_f = s["estimate_gyro_bias"].values, s["estimate_accel_bias"].values
        imu, first = log.imu, int(np.searchsorted(log.imu.time_ns, x["time_ns"][0]))
        for k in range(0, len(epoch) - 1, 7):
            at = int(np.searchsorted(x["time_ns"], epoch[k]))
            if not epochs[k] or x["time_ns"][at + 1] in epoch:
                continue
            q = Rotation.from_quat(np.roll(x["q_nb"][at], -1))
            v = x["v_n"][at] + q.apply(imu.accel[first + at + 1] - 0.02 * bias_f[k])
            v[2] += 0.02 * 9.807
            q = q * Rotation.from_rotvec(imu.gyro[first + at + 1] - 0.02 * bias_g[k])
            np.testing.assert_allclose(x["v_n"][at + 1], v, atol=2e-3)
            turned = (q.inv() * Rotation.from_quat(np.roll(x["q_nb"][at + 1], -1))).magnitude()
            assert turned < 1e-4
            north = (x["lat_rad"][at + 1] - x["lat_rad"][at]) * 6.37e6
            assert abs(north - 0.02 * v[0]) < 5e-3
