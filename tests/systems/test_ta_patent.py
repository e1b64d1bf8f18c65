"""The velocity-attitude study against reference figures, losses of the published filter included.

The references come from another implementation; each is met within 15 %, as are bands of ratios
between filters of the same runs.
"""

import math
from functools import cache, partial
from pathlib import Path

import jax
import numpy as np
import pytest
from in_lanes import each
from numpy.testing import assert_allclose
from scipy import integrate

from robins import scenario
from robins.campaign.statistics import Statistics
from robins.filters import Code, run
from robins.systems import transfer_alignment
from robins.systems.judgement import claim_judge
from robins.systems.tables import SensorUpdates
from robins.systems.transfer_alignment.product.world import _slave_errors
from robins.systems.transfer_alignment.velocity_attitude import model as va
from robins.systems.transfer_alignment.velocity_attitude import study
from robins.systems.transfer_alignment.velocity_attitude.study import CLAIMS, STUDY, lay_out

FOLDER = Path(transfer_alignment.__file__).parent / "scenarios"
RUNS = 100
COUNT_FROM = 300  # t > 30 s

# RMS of attitude errors over all axes ['], t > 30 s, 100 runs
REFERENCE = {
    "kf": (0.29, 3.66, 10.97, 11.45, 17.7),
    "kf-told-r": (0.73, 2.11, 25.9, 25.7, 15.0),
    "kf-told-q": (0.49, 6.01, 2.97, 6.65, 18.0),
    "kf-told-both": (0.37, 5.41, 2.65, 5.98, 18.0),
    "hinf-fixed": (0.31, 4.57, 4.03, 6.01, 17.7),
    "adaptive-hinf": (0.33, 5.28, 3.05, 6.03, 17.7),
}


def parsed(name, *settings):
    return scenario.parse(study.VelocityAttitude, (FOLDER / f"{name}.toml").read_text(), settings)


SIZES = {  # what the scenarios below differ in, by table
    "mounting": ("error",),
    "disturbance": ("gyro_noise_factor", "drift_step"),
    "start": ("attitude",),
    "slave": ("accel_bias", "gyro_slow", "gyro_slow_time"),
}


@cache
def simulator_of(name):
    """Simulates scenarios that differ from this one in `SIZES`; traced once for all."""
    given = parsed(name)
    course = course_of(name)

    @each
    def batch(given_run):
        sizes, index = given_run
        parts = {t: getattr(given, t).model_copy(update=size) for t, size in sizes.items()}
        return study.simulate(given.model_copy(update=parts), course, 0, index)

    def of(other):
        sizes = {t: {k: getattr(getattr(other, t), k) for k in keys} for t, keys in SIZES.items()}
        alike = jax.tree.map(lambda x: np.repeat(np.asarray(x)[None], RUNS, axis=0), sizes)
        return jax.device_put(batch((alike, np.arange(RUNS))))

    return of


def kept(step):
    return step.posterior.mean, step.posterior.sigma, step.prediction.code


def solved(contender, world):
    case = contender.case(world)
    return run(contender.filter, va.MODEL, case.start, case.y, case.u, case.aux, kept).steps


def errors_of(contender, world):
    """Errors and sigmas as reported, and the codes of predictions."""
    mean, sigma, code = each(partial(solved, contender))(world)
    error = np.asarray(world.error - mean) @ contender.reported.T
    return error, np.asarray(sigma) @ contender.reported.T, np.asarray(code)


@cache
def course_of(name):
    return lay_out(parsed(name))


@cache
def flights(name, *settings):
    """Runs of a scenario, from one program for those of a stiff structure and one for bent ones."""
    return simulator_of("d" if name in "bd" else "c")(parsed(name, *settings))


@cache
def reached(name, filter_):
    """RMS of attitude over all axes ['], and the codes that predictions gave."""
    contender = study.contender(parsed(name), course_of(name), filter_)
    error, _, code = errors_of(contender, flights(name))
    rms = math.sqrt(np.mean(error[:, COUNT_FROM:, :3] ** 2)) / study.ARCMIN
    return rms, np.unique(code).tolist()


def test_least_gamma_is_that_of_the_first_measurement():
    # R nominal seen through H1 at a pitch of 2 deg, next to 30' and more of initial uncertainty
    assert course_of("a").least_gamma == pytest.approx(1.0173, rel=1e-4)


@pytest.mark.parametrize("filter_", REFERENCE)
@pytest.mark.parametrize("name", "abcde")
def test_errors_are_those_of_the_reference(name, filter_):
    expected = REFERENCE[filter_]["abcde".index(name)]
    rms, codes = reached(name, filter_)
    assert rms == pytest.approx(expected, rel=0.15)
    assert codes == [int(Code.DONE)]  # no filter ever ceases to exist


@pytest.mark.parametrize(
    ("name", "ours", "theirs", "low", "high"),
    [
        ("a", "adaptive-hinf", "kf", 1.0, 1.3),
        ("b", "adaptive-hinf", "kf", 1.35, 1.6),  # it must lose
        ("b", "kf-told-r", "kf", 0.49, 0.65),
        ("c", "adaptive-hinf", "kf", 0.22, 0.34),
        ("c", "adaptive-hinf", "kf-told-q", 0.85, 1.2),
        ("c", "adaptive-hinf", "hinf-fixed", 0.6, 0.9),
        ("d", "adaptive-hinf", "kf", 0.47, 0.59),
        ("e", "adaptive-hinf", "kf", 0.95, 1.05),  # no gain repairs a missing state
    ],
)
def test_filters_win_and_lose_where_the_reference_does(name, ours, theirs, low, high):
    assert low <= reached(name, ours)[0] / reached(name, theirs)[0] <= high


SMALL = (  # errors for which the linear model is good
    'start.attitude=["0.05 deg", "0.05 deg", "0.1 deg"]',
    'slave.accel_bias=["1 mg", "1 mg", "0 mg"]',
)
SLOW = (*SMALL, 'slave.gyro_slow="20 deg/h"', 'slave.gyro_slow_time="40 s"')


def test_the_kalman_filter_is_consistent_where_errors_are_small():
    problem = STUDY.problem(parsed("a", *SMALL), ("kf",), 0)
    contender = problem.contenders["kf"]
    error, sigma, code = errors_of(contender, flights("a", *SMALL))
    late = slice(COUNT_FROM, None)
    ratio = np.sqrt(np.mean(error[:, late] ** 2, (0, 1)) / np.mean(sigma[:, late] ** 2, (0, 1)))
    # the attitude; biases are constants of a run, so that a hundred runs say them to 7 % only
    assert np.all((ratio[:3] >= 0.9) & (ratio[:3] <= 1.1)), ratio
    assert np.all((ratio[3:] >= 0.7) & (ratio[3:] <= 1.3)), ratio

    statistics = Statistics(problem.blocks, problem.count_from, problem.limits)
    none = np.zeros((RUNS, 1))
    blank = SensorUpdates(none, none, none, none.astype(int), none.astype(int))
    statistics.add(
        {
            "error": error,
            "sigma": sigma,
            "nees": np.zeros(error.shape[:2]),
            "block_nees": {},
            "updates": {"velocity_matching": blank, "attitude_matching": blank},
            "dim": np.full(RUNS, 12),
        }
    )
    metrics = study.metrics_of(problem.epoch_s, statistics)
    rms = np.sqrt(np.mean(error[:, late] ** 2, (0, 1)))
    assert_allclose(metrics["attitude_rms_arcmin"], rms[:3] / np.deg2rad(1 / 60), rtol=1e-12)
    assert_allclose(metrics["gyro_bias_rms_deg_per_h"], np.rad2deg(rms[5:8]) * 3600, rtol=1e-12)
    assert_allclose(metrics["error_over_sigma"], ratio, rtol=1e-12)
    assert metrics["share_below_5_arcmin"].share == 1.0
    assert metrics["settled_share_5_arcmin"].share == 1.0
    assert metrics["settled_share_5_arcmin"].of == RUNS
    assert metrics["settled_median_1_arcmin_s"] < 5.0
    assert not code.any()


# ------------------------------------------------------------------------------ what is believed


def test_what_filters_are_told():
    given = parsed("a")
    epoch_s = np.arange(1, 1201) * 0.1
    minute = np.deg2rad(1.0 / 60.0)
    plain, r, q, both = (study.believed_noise(given, n, epoch_s) for n in study.TOLD)
    assert_allclose(plain.attitude, minute)
    assert_allclose(plain.velocity, 0.05)
    walk = np.deg2rad(0.05) / 60.0 * math.sqrt(0.1)
    assert_allclose(plain.process[:, va.PHI], walk)
    # heading, pitch, roll: 1' with 5 % of outliers of ten times the size, and flexure
    spread = 0.95 + 0.05 * 100.0
    expected = np.sqrt(spread + np.array([2.4, 5.6, 8.0]) ** 2)
    assert_allclose(r.attitude[17], expected * minute)
    assert_allclose(r.velocity[17], 0.05 * math.sqrt(spread))
    assert_allclose(r.process, plain.process)
    # twenty times the noise over the intervals from 40 s to 80 s
    assert_allclose(q.process[:400, va.PHI], walk)
    assert_allclose(q.process[400:800, va.PHI], 20.0 * walk)
    assert_allclose(q.process[800:, va.PHI], walk)
    # a drift that walks from 50 s on, as far by the end as it stepped
    assert not q.process[:500, va.EPS].any()
    total = np.sqrt(np.sum(q.process[:, va.EPS] ** 2, 0))
    assert_allclose(total, np.deg2rad(200.0) / 3600.0)
    assert_allclose(both.process, q.process)
    assert_allclose(both.attitude, r.attitude)
    identity = study.believed_noise(given, "hinf-patent-weights", epoch_s)
    assert_allclose(identity.attitude, 1.0)
    assert_allclose(identity.velocity, 1.0)


def test_initial_sigmas_are_those_of_the_scenario_in_the_frames_of_the_model():
    given = parsed(
        "a",
        'start.attitude=["1 deg", "2 deg", "3 deg"]',
        'start.velocity=["1 m/s", "2 m/s", "0 m/s"]',
    )
    sigma = study.start_sigma(given)
    assert_allclose(sigma[va.PHI], np.deg2rad([2.0, 1.0, 3.0]))
    assert_allclose(sigma[va.VELOCITY], [2.0, 1.0])
    assert_allclose(sigma[va.LAT] * 6.356e6, 10.0, rtol=0.01)
    assert sigma[va.LON] == 0.0
    assert_allclose(sigma[va.EPS], np.deg2rad(5.0) / 3600.0)
    assert_allclose(sigma[va.NABLA], 9.80665e-3)


# ------------------------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (['manoeuvre.pitch="-86 deg"'], "pitch"),
        (['settle="200 s"'], "settle = 200 s leaves nothing"),
        (['lever_arm="1 m"'], "must be zero in the study 'velocity-attitude'"),
        (['master.delay="0.1 s"'], "the study 'product' knows them"),
    ],
)
def test_scenarios_that_cannot_be(settings, message):
    with pytest.raises((ValueError, scenario.ScenarioError), match=message):
        STUDY.problem(parsed("a", *settings), ("kf",), 0)


def test_a_filter_nobody_knows_is_refused():
    with pytest.raises(
        ValueError, match=r"no filter 'kalmann' in this study\. It has kf, kf-told-r"
    ):
        STUDY.problem(parsed("a"), ("kalmann",), 0)


def test_errors_too_large_for_a_linear_model_are_said():
    given = parsed("a", 'start.attitude=["0.5 deg", "0.5 deg", "6 deg"]')
    with pytest.warns(UserWarning, match=r"start.attitude may reach 18.0 deg.*good below 5 deg"):
        STUDY.problem(given, ("kf",), 0)


# --------------------------------------------------------------------------------------- claims


def test_claims_are_judged_by_ratios_of_the_same_runs():
    rms = {
        "kf": 10.0,
        "kf-told-both": 5.0,
        "adaptive-hinf": 9.7,
        "hinf-fixed": 9.75,
        "adaptive-hinf-compensated": 4.85,
    }
    metrics = {name: {"attitude_rms_all_arcmin": value} for name, value in rms.items()}
    ids = ("beats-kf", "kf-suffers", "beats-fixed", "compensation")
    found = {c["id"]: (c["verdict"], c["value"]) for c in claim_judge(CLAIMS, ids)(metrics)}
    assert found["beats-kf"] == ("partly", pytest.approx(0.97))
    assert found["kf-suffers"] == ("reproduced", pytest.approx(2.0))
    assert found["beats-fixed"] == ("not", pytest.approx(9.7 / 9.75))
    assert found["compensation"] == ("reproduced", pytest.approx(0.5))
    del metrics["kf"]
    assert [c["id"] for c in claim_judge(CLAIMS, ids)(metrics)] == ["beats-fixed", "compensation"]
    assert claim_judge(CLAIMS, ())(metrics) == []


# ----------------------------------------------------------- what compensation leaves of errors

COMPENSATED = (
    'slave.gyro_slow=["3 deg/h", "6 deg/h", "9 deg/h"]',
    'slave.gyro_slow_time=["5 s", "10 s", "60 s"]',
    'slave.gyro_calibration="2 deg/h"',
    'slave.accel_calibration="0.1 mg"',
)
DEG_H = np.deg2rad(1.0) / 3600.0


def test_compensated_errors_have_the_moments_of_their_parts():
    """Constant + slow + fast - calibrated, (6) and (7), by integrals of their autocovariances."""
    short = (
        'manoeuvre.legs=[{bank="0 deg", seconds="40 s"}]',
        'settle="0 s"',
        'slave.rate="10 Hz"',
    )
    given = parsed("a", *short, *COMPENSATED)
    course, runs, T = lay_out(given).pair, 3000, 40.0
    keys = jax.random.split(jax.random.key(5), runs)
    draw = jax.jit(jax.vmap(lambda key: _slave_errors(given, course, key)))
    theta, dv, drift, bias = (np.asarray(a) for a in draw(keys))
    sigma, tau = np.array([3.0, 6.0, 9.0]) * DEG_H, np.array([5.0, 10.0, 60.0])
    left, white = 2.0 * DEG_H, np.deg2rad(0.05) / 60.0
    near = 4.0 * math.sqrt(2.0 / runs)  # four sigma of a variance

    def slow(axis, lag):
        return sigma[axis] ** 2 * math.exp(-abs(lag) / tau[axis])

    for axis in range(3):
        seen = np.mean(theta[:, :, axis].sum(1) ** 2) / T**2
        mean = integrate.quad(lambda s, i=axis: 2.0 * (T - s) * slow(i, s) / T**2, 0.0, T)[0]
        assert_allclose(seen, left**2 + mean + white**2 / T, rtol=near)
        for lag_s in (0.0, 8.0):
            ends = drift[:, 99, axis] * drift[:, 99 + round(10 * lag_s), axis]
            total = left**2 + slow(axis, 0.0)
            assert_allclose(np.mean(ends), left**2 + slow(axis, lag_s), atol=near * total)
    g = 9.80665e-3  # m/s^2 a mg
    assert_allclose(np.std(bias[:, 0], axis=0), 0.1 * g, rtol=near)
    assert np.ptp(bias, axis=1).max() < 1e-15  # (7) has no slow part
    fast = 50e-6 * 9.80665
    seen = np.mean(dv.sum(1) ** 2, axis=0) / T**2
    assert_allclose(seen, (0.1 * g) ** 2 + fast**2 / T, rtol=near)


def test_filters_are_told_of_what_compensation_leaves():
    given = parsed("a", *COMPENSATED)
    sigma = study.start_sigma(given)
    # right, forward, up of what is forward, right, down
    slow, tau = np.array([6.0, 3.0, 9.0]) * DEG_H, np.array([10.0, 5.0, 60.0])
    assert_allclose(sigma[va.EPS], np.sqrt(slow**2 + (2.0 * DEG_H) ** 2))
    assert_allclose(sigma[va.NABLA], 9.80665e-4)
    plain, _, q, _ = (study.believed_noise(given, n, np.arange(1, 1201) * 0.1) for n in study.TOLD)
    walk = slow * np.sqrt(2.0 * 0.1 / tau)
    assert_allclose(plain.process[7, va.EPS], walk)
    assert_allclose(q.process[:500, va.EPS], np.tile(walk, (500, 1)))
    assert np.all(q.process[500:, va.EPS] > walk)


@pytest.mark.parametrize("told", [True, False])
def test_a_slow_drift_that_is_told_leaves_the_kalman_filter_consistent(told):
    """Its own sigma against 100 runs, where errors are small enough for the linear model."""
    given = parsed("a", *SLOW)
    course = lay_out(given)
    if not told:  # eps' = 0, as the patent's equation stands
        slave = given.slave.model_copy(update={"gyro_slow_time": (1e12,) * 3})
        given = given.model_copy(update={"slave": slave})
    error, sigma, _ = errors_of(study.contender(given, course, "kf"), flights("a", *SLOW))
    late = slice(COUNT_FROM, None)
    ratio = np.sqrt(np.mean(error[:, late] ** 2, (0, 1)) / np.mean(sigma[:, late] ** 2, (0, 1)))
    if told:
        assert np.all((ratio[:3] >= 0.9) & (ratio[:3] <= 1.1)), ratio
        assert np.all((ratio[5:8] >= 0.85) & (ratio[5:8] <= 1.15)), ratio
    else:
        assert np.all(ratio[:3] > 1.5), ratio
        assert np.all(ratio[5:8] > 1.5), ratio
