"""Master and slave: what the slave feels is what it does, and errors are as large as stated."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation as SciRotation

from robins import scenario
from robins.ins.mechanise import mechanise
from robins.manifold import local, retract
from robins.rotation import conjugate, multiply, to_rotvec
from robins.scenario import ScenarioError
from robins.systems.study import Scenario
from robins.systems.transfer_alignment.product.parameters import PairParameters
from robins.systems.transfer_alignment.product.world import (
    lay_out,
    motion_of,
    simulate_pair,
    start_estimate,
)

ARCMIN, DEG, DEG_H = np.pi / 10800.0, np.pi / 180.0, np.pi / 648000.0
PLACE = 'latitude = "32 deg"\nlongitude = "118 deg"\nheight = "3000 m"\n'
SENSORS = """
[slave]
gyro_noise = "0.05 deg/sqrt(h)"
accel_noise = "50 ug/sqrt(Hz)"
gyro_bias = "5 deg/h"
accel_bias = "1 mg"
[master]
attitude_noise = ["1 arcmin", "2 arcmin", "3 arcmin"]
velocity_noise = ["0.05 m/s", "0.06 m/s", "0.07 m/s"]
position_noise = ["2 m", "3 m", "4 m"]
[start]
attitude = ["0.5 deg", "0.4 deg", "1 deg"]
velocity = ["0.3 m/s", "0.2 m/s", "0.1 m/s"]
position = ["10 m", "0 m", "5 m"]
"""
S_TURN = f"""
[manoeuvre]
kind = "aircraft"
{PLACE}
speed = "100 m/s"
pitch = "2 deg"
legs = [
  {{bank = "0 deg", seconds = "10 s"}}, {{bank = "30 deg", seconds = "31 s"}},
  {{bank = "-30 deg", seconds = "30 s"}}, {{bank = "0 deg", seconds = "49 s"}},
]
"""
LEVEL = f"""
[manoeuvre]
kind = "aircraft"
{PLACE}
speed = "100 m/s"
legs = [{{bank = "0 deg", seconds = "120 s"}}]
"""  # as long as the S-turn, to share its compilations
NOMINAL = np.array([10.0, -20.0, 70.0]) * DEG
LEVER = np.array([-1.0, 3.5, 0.5])
FLEXURE = np.array([8.0, 5.6, 2.4]) * ARCMIN
TAU, BENDING = 1.0, 30.0 * ARCMIN
QUIET = (
    'slave.gyro_noise="0 deg/sqrt(h)"',
    'slave.accel_noise="0 ug/sqrt(Hz)"',
    'slave.gyro_bias="0 deg/h"',
    'slave.accel_bias="0 mg"',
    'lever_arm=["-1 m", "3.5 m", "0.5 m"]',
    'mounting={nominal=["10 deg", "-20 deg", "70 deg"], error=["0.3 deg", "0 deg", "-0.2 deg"],'
    ' sigma="0.1 deg"}',
    'flexure={sigma=["8 arcmin", "5.6 arcmin", "2.4 arcmin"], time="1 s",'
    ' bending=["30 arcmin", "0 arcmin", "0 arcmin"]}',
)
SHARE, FACTOR, STEP = 0.05, 20.0, np.array([200.0, -100.0, 0.0]) * DEG_H
DISTURBED = (
    f"disturbance={{outlier_share={SHARE}, gyro_noise_factor={FACTOR},"
    ' gyro_noise_window={begin="5 s", end="12 s"},'
    ' drift_step=["200 deg/h", "-100 deg/h", "0 deg/h"], drift_step_time="8 s",'
    ' dropouts=[{begin="3 s", end="4 s"}, {begin="15 s", end="15.05 s"}]}',
)
RUNS = 100


def parsed(text, *settings, cls=PairParameters):
    return scenario.parse(cls, text, settings)


def compiled(pair, course, what=lambda run: run):
    """Some part of many runs, from their numbers; what is not asked for is not compiled."""
    return jax.jit(jax.vmap(lambda i: what(simulate_pair(pair, course, 3, i))))


def many(pair, course, what, runs=RUNS):
    return compiled(pair, course, what)(jnp.arange(runs))


def records(run):
    return run.master.v_n, run.master.q_nb.wxyz


@pytest.fixture(scope="module")
def quiet():
    """An S-turn of 120 s without sensor errors; flexure, mounting error and lever arm are on."""
    pair = parsed(S_TURN + SENSORS, *QUIET)
    course = lay_out(pair)
    runs = many(pair, course, lambda run: (run.start, run.increments, run.truth), runs=40)
    return course, runs


@pytest.fixture(scope="module")
def disturbed():
    """Straight and level, every sensor error and disturbance on, a stiff structure."""
    pair = parsed(LEVEL + SENSORS, *DISTURBED)
    course = lay_out(pair)
    simulate = compiled(pair, course)
    return pair, course, simulate(jnp.arange(RUNS)), simulate


def in_one_row(increments):
    return jax.tree.map(lambda x: x.reshape(x.shape[0], -1, *x.shape[3:]), increments)


def test_error_free_increments_navigate_to_the_truth_whatever_the_flexure(quiet):
    course, (start, increments, truth) = quiet
    paths = [
        mechanise(*jax.tree.map(lambda x, i=i: x[i], (start, in_one_row(increments))))
        for i in range(3)
    ]
    path = jax.tree.map(lambda *x: jnp.stack(x)[:, course.each - 1 :: course.each], *paths)
    q_nb, v_n, position = path
    truth = jax.tree.map(lambda x: x[:3], truth.ins)
    miss = to_rotvec(multiply(truth.q_nb.wxyz, conjugate(q_nb.wxyz)))
    # to rounding over 120 s; the bound wanted is 0.01 arcsec, 5e-8 rad
    assert np.abs(miss).max() < 1e-11
    assert np.abs(v_n - truth.v_n).max() < 1e-8
    north = (position.lat - truth.position.lat) * 6.37e6
    assert max(np.abs(north).max(), np.abs(position.alt - truth.position.alt).max()) < 1e-4


def test_the_slave_sits_where_flexure_mounting_and_lever_arm_put_it(quiet):
    course, (_, _, truths) = quiet
    truth = jax.tree.map(lambda x: np.array(x[7]), truths)
    k = course.motion.at(course.epoch_s)

    def turn(rotvec):
        return SciRotation.from_rotvec(rotvec)

    q_nm = SciRotation.from_quat(k.q_nb, scalar_first=True)
    nominal = SciRotation.from_euler("ZYX", NOMINAL[::-1])
    expected = q_nm * turn(truth.flexure[:, :3]) * nominal * turn(truth.mounting_rad)
    q_ns = SciRotation.from_quat(truth.ins.q_nb.wxyz, scalar_first=True)
    # north at the slave is turned by the lever arm over the radius of the Earth
    tilt = 2.0 * np.linalg.norm(LEVER) / 6.37e6
    assert np.linalg.norm((expected.inv() * q_ns).as_rotvec(), axis=1).max() < tilt

    arm = q_nm.apply(LEVER)
    at = truth.ins.position
    np.testing.assert_allclose((at.lat - k.lat) * 6.3573e6, arm[:, 0], atol=0.01)
    # true positions are the mechanisation's, which integrates the roll-in in steps of 20 ms
    np.testing.assert_allclose(k.alt - at.alt, arm[:, 2], rtol=0, atol=3e-4)
    # the vertical velocity needs neither Coriolis nor curvature at this size
    omega = np.cross(k.omega_nb_b, LEVER)
    np.testing.assert_allclose(truth.ins.v_n - k.v_n, q_nm.apply(omega), rtol=0, atol=2e-4)


def test_flexure_and_mounting_are_as_large_as_stated(quiet):
    course, (_, _, truth) = quiet
    angle, rate = np.split(np.asarray(truth.flexure), 2, axis=-1)
    load = np.linalg.norm(course.motion.at(course.epoch_s).rates()[1], axis=1) / 9.786
    assert load[300] == pytest.approx(1.0 / np.cos(30.0 * DEG), abs=2e-3)
    assert load[1000] == pytest.approx(1.0, abs=3e-3)
    swing = angle - (load - 1.0)[:, None] * np.array([BENDING, 0.0, 0.0])
    calm = np.abs(np.gradient(load)) < 1e-3  # where bending has no rate
    for x, sigma in ((swing, FLEXURE), (rate[:, calm], FLEXURE * 2.146 / TAU)):
        variance = np.mean(x**2, axis=1)  # of each run
        scatter = variance.std(0) / np.sqrt(len(variance))
        assert np.all(np.abs(variance.mean(0) - sigma**2) < 4.0 * scatter)
        assert np.all(scatter < 0.1 * sigma**2)  # or the test would see nothing
    mean = angle[:, 200:400].mean((0, 1))
    assert mean[0] == pytest.approx((load[300] - 1.0) * BENDING, abs=0.5 * ARCMIN)

    mounting = np.asarray(truth.mounting_rad)
    assert np.all(mounting == mounting[:, :1])
    drawn = mounting[:, 0] - np.array([0.3, 0.0, -0.2]) * DEG
    assert np.abs(drawn.mean(0)).max() < 4.0 * 0.1 * DEG / np.sqrt(40)
    np.testing.assert_allclose(drawn.std(), 0.1 * DEG, rtol=4.0 / np.sqrt(2 * 120))


def test_gyro_noise_steps_and_drift_appears(disturbed):
    _, course, runs, _ = disturbed
    bias = np.asarray(runs.truth.ins.gyro_bias)
    t = course.epoch_s
    np.testing.assert_allclose(
        bias[:, t > 7.95] - bias[:, :1], np.broadcast_to(STEP, (RUNS, 1121, 3))
    )
    assert np.all(bias[:, t < 7.95] == bias[:, :1])
    np.testing.assert_allclose(bias[:, 0].std(0), 5.0 * DEG_H, rtol=4.0 / np.sqrt(2 * RUNS))

    rows = in_one_row(runs.increments)
    begin = course.begin_s
    here = np.where(begin[:, None] > 7.99, STEP, 0.0) + bias[:, :1]
    noise = np.asarray(rows.theta) - course.nominal.theta - here * course.dt[:, None]
    sigma = 0.05 * DEG / 60.0 * np.sqrt(course.dt[0])
    loud = (begin > 4.99) & (begin < 11.99)
    for where, factor in ((loud, FACTOR), (~loud, 1.0)):
        x = noise[:, where]
        np.testing.assert_allclose(
            x.std((0, 1)), factor * sigma, rtol=4.0 / np.sqrt(2 * x[..., 0].size)
        )
    # the first and the last sample of the window are loud, their neighbours are not
    edges = [np.searchsorted(begin, s - 1e-6) + k for s in (5.0, 12.0) for k in (-1, 0)]
    ratio = noise[:, edges].std((0, 2)) / sigma
    np.testing.assert_allclose(ratio, [1.0, FACTOR, FACTOR, 1.0], rtol=4.0 / np.sqrt(2 * 3 * RUNS))


def test_accelerometer_errors_are_as_stated(disturbed):
    _, course, runs, _ = disturbed
    bias = np.asarray(runs.truth.ins.accel_bias)
    mg = 9.80665e-3
    np.testing.assert_allclose(bias[:, 0].std(0), mg, rtol=4.0 / np.sqrt(2 * RUNS))
    dv = np.asarray(in_one_row(runs.increments).dv)
    noise = dv - course.nominal.dv - bias[:, :1] * course.dt[:, None]
    sigma = 0.05 * mg * np.sqrt(course.dt[0])
    np.testing.assert_allclose(noise.std((0, 1)), sigma, rtol=4.0 / np.sqrt(2 * RUNS * 6000))


def test_records_are_noisy_struck_and_lost_as_stated(disturbed):
    pair, course, runs, _ = disturbed
    t, m = course.epoch_s, pair.master
    lost = ((t > 2.95) & (t < 3.95)) | (np.abs(t - 15.0) < 0.01)
    k = course.motion.at(t[~lost])
    for x in (runs.master.v_n, runs.master.q_nb.wxyz, runs.master.position.lat[..., None]):
        missing = np.isnan(np.asarray(x))
        assert np.all(missing == lost[:, None])

    # the same numbers without outliers: a struck record is ten times off, no other has changed
    calm = pair.disturbance.model_copy(update={"outlier_share": 0.0})
    v_calm, q_calm = many(pair.model_copy(update={"disturbance": calm}), course, records)

    def errors(v_n, q_nb):
        q_true = SciRotation.from_quat(np.tile(k.q_nb, (RUNS, 1)), scalar_first=True)
        q = SciRotation.from_quat(np.asarray(q_nb)[:, ~lost].reshape(-1, 4), scalar_first=True)
        phi = (q * q_true.inv()).as_rotvec().reshape(RUNS, -1, 3)
        return np.asarray(v_n)[:, ~lost] - k.v_n, phi

    quiet, struck = errors(v_calm, q_calm), errors(*records(runs))
    factors = []
    for (x, y), sigma in zip(
        zip(quiet, struck, strict=True), (m.velocity_noise, m.attitude_noise), strict=True
    ):
        count = x[..., 0].size
        np.testing.assert_allclose(x.std((0, 1)), sigma, rtol=4.0 / np.sqrt(2 * count))
        size = np.linalg.norm(y, axis=2) / np.linalg.norm(x, axis=2)
        factors.append(np.round(size))
        np.testing.assert_allclose(size, factors[-1], rtol=1e-6)
        assert set(np.unique(factors[-1])) == {1.0, 10.0}
    assert np.all(factors[0] == factors[1])  # a record is struck as a whole
    share = np.mean(factors[0] == 10.0)
    assert share == pytest.approx(SHARE, abs=4.0 * np.sqrt(SHARE * (1 - SHARE) / factors[0].size))

    down = k.alt - np.asarray(runs.master.position.alt)[:, ~lost]
    assert down.std() == pytest.approx(4.0, rel=4.0 / np.sqrt(2 * down.size))
    north = (np.asarray(runs.master.position.lat)[:, ~lost] - k.lat) * 6.3573e6
    assert north.std() == pytest.approx(2.0, rel=4.0 / np.sqrt(2 * north.size))
    np.testing.assert_allclose(runs.master_omega_b[0][~lost], k.rates()[0], rtol=0, atol=1e-12)


def test_heavy_tails_keep_the_sigma(disturbed):
    _, course, _, _ = disturbed
    pair = parsed(LEVEL + SENSORS, "disturbance.tail_dof=5.0")
    course = course._replace(there=np.full(1200, True))
    v_n = np.asarray(many(pair, course, lambda run: run.master.v_n))
    x = (v_n - course.motion.at(course.epoch_s).v_n) / np.array(pair.master.velocity_noise)
    assert np.mean(x**2) == pytest.approx(1.0, abs=4.0 * np.sqrt(8.0 / x.size))
    assert np.mean(np.abs(x) > 4.0) > 10.0 * 6.3e-5  # of a normal distribution


def test_a_record_describes_the_time_before_its_delay():
    free = ('master.attitude_noise="0 deg"', 'master.velocity_noise="0 m/s"')
    pair = parsed(S_TURN + SENSORS, *free, 'master.delay="0.25 s"')
    course = lay_out(pair)
    v_n, q_nb = (np.asarray(x[0]) for x in many(pair, course, records, runs=1))
    k = course.motion.at(course.epoch_s - 0.25)
    assert np.all(np.isnan(v_n[:2]))  # nothing was recorded before time zero
    np.testing.assert_allclose(v_n[2:], k.v_n[2:], rtol=0, atol=1e-7)
    np.testing.assert_allclose(np.abs(np.sum(q_nb[2:] * k.q_nb[2:], 1)), 1.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(course.master_omega_b[2:], k.rates()[0][2:], rtol=0, atol=1e-7)


def test_initial_errors_are_drawn_as_told(disturbed):
    pair, course, runs, _ = disturbed
    sigma = np.array([0.5 * DEG, 0.4 * DEG, DEG, 0.3, 0.2, 0.1, 10.0, 0.0, 5.0])
    error = np.asarray(runs.initial_error)
    np.testing.assert_allclose(error.std(0), sigma, rtol=4.0 / np.sqrt(2 * RUNS))
    for draw in ("plus-sigma", "random-sign"):
        start = pair.start.model_copy(update={"draw": draw})
        other = pair.model_copy(update={"start": start})
        fixed = np.asarray(many(other, course, lambda run: run.initial_error))
        np.testing.assert_allclose(np.abs(fixed), np.tile(sigma, (RUNS, 1)))
        plus = np.mean(fixed[:, sigma > 0] > 0.0)
        assert plus == (1.0 if draw == "plus-sigma" else pytest.approx(0.5, abs=0.06))

    one = jax.tree.map(lambda x: x[5], runs)

    @jax.jit
    def misses(one):
        estimate = start_estimate(one)
        back = local(retract(estimate, one.initial_error), one.start)
        return back, local(estimate, one.start) - one.initial_error

    back, ahead = misses(one)
    assert np.abs(back).max() < 2e-5
    assert np.abs(ahead)[:6].max() < 1e-12


def test_a_run_is_named_by_its_number_alone(disturbed):
    _, _, runs, simulate = disturbed
    backwards = simulate(jnp.arange(RUNS)[::-1])
    pairs = zip(jax.tree.leaves(runs), jax.tree.leaves(backwards), strict=True)
    assert all(np.array_equal(x, y[::-1], equal_nan=True) for x, y in pairs)
    assert not np.any(np.asarray(runs.increments.theta[0] == runs.increments.theta[1]))


@pytest.mark.parametrize(
    ("manoeuvre", "slowest", "fastest"),
    [
        (f'kind = "ship"\n{PLACE}\nspeed = "6 m/s"\nseconds = "120 s"', 6.0, 6.1),
        (
            f'kind = "ship"\n{PLACE}\nseconds = "120 s"\n'
            'roll = [{amplitude = "5 deg", period = "9 s"}]',
            0.0,
            1e-6,
        ),
        (
            f'kind = "vehicle"\n{PLACE}\nroll = [{{amplitude = "0.5 deg", period = "1 s"}}]\n'
            'legs = [{do = "accelerate", speed = "9 m/s", seconds = "5 s"},'
            ' {do = "straight", seconds = "115 s"}]',
            8.999,
            9.001,
        ),
    ],
)
def test_ships_and_vehicles_make_pairs_too(manoeuvre, slowest, fastest):
    course = lay_out(parsed(f"[manoeuvre]\n{manoeuvre}\n{SENSORS}"))
    assert len(course.epoch_s) == 1200
    assert course.epoch_s[-1] == pytest.approx(120.0)
    speed = np.linalg.norm(course.motion.at(course.epoch_s).v_n, axis=1)
    assert slowest <= speed.max() <= fastest
    np.testing.assert_allclose(course.path.v_n, course.motion.at(course.epoch_s).v_n, atol=1e-8)


def test_a_scenario_class_takes_the_pieces_by_inheritance():
    class Product(Scenario, PairParameters):
        """A scenario of its own with the pieces of a pair."""

    product = parsed("runs = 7\n" + LEVEL + SENSORS, cls=Product)
    assert product.runs == 7
    assert motion_of(product.manoeuvre).duration_s == pytest.approx(120.0)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ('slave.rate="55 Hz"', r"slave.rate is 55 Hz, not a multiple of master.rate, 10 Hz"),
        ('slave.rate="5 Hz"', "slave.rate is 5 Hz, not a multiple"),
        ('master.rate="0.001 Hz"', "lasts 120 s, less than an epoch of the master at 0.001 Hz"),
        (
            'disturbance.gyro_noise_window={begin="9 s", end="121 s"}',
            r"gyro_noise_window from 9 s to 121 s must lie within the run, 0 s to 120 s",
        ),
        (
            'disturbance.dropouts=[{begin="9 s", end="9 s"}]',
            r"dropouts.0 .* end \(9 s\) must come after begin \(9 s\)",
        ),
        ("disturbance.gyro_noise_factor=3.0", "without a gyro_noise_window"),
        ('disturbance.drift_step="9 deg/h"', "drift_step and drift_step_time belong together"),
        ('disturbance.drift_step_time="9 s"', "drift_step and drift_step_time belong together"),
        (
            'disturbance={drift_step="9 deg/h", drift_step_time="120 s"}',
            "drift_step_time is 120 s, the run ends at 120 s",
        ),
        ('manoeuvre.roll_time="130 s"', "bank 0 lasts 120 s, less than the 130 s it takes to roll"),
    ],
)
def test_pieces_that_do_not_fit_are_refused(setting, message):
    with pytest.raises(ValueError, match=message):
        lay_out(parsed(LEVEL + SENSORS, setting))


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ('master.delay="-1 ms"', 'master.delay = "-1 ms": must be at least 0 s'),
        ('slave.gyro_bias="5 deg"', "deg is an angle"),
        ('slave.gyro_bias="-5 deg/h"', "must be at least 0 deg/h"),
        ("disturbance.outlier_share=1.2", "less than or equal to 1"),
        ("disturbance.tail_dof=2.0", "greater than 2"),
        ('flexure.time="0 s"', "must be above 0 s"),
        ('manoeuvre.kind="aircaft"', "did you mean 'aircraft'"),
        ('manoeuvre.sped="9 m/s"', "did you mean speed"),
        ('start.draw="plus"', "should be 'normal', 'plus-sigma' or 'random-sign'"),
    ],
)
def test_values_that_cannot_be_are_refused_with_their_path(setting, message):
    with pytest.raises(ScenarioError, match=message):
        parsed(LEVEL + SENSORS, setting)
