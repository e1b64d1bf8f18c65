"""The airship's motion and sensors against what they state, and its models against differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from airship_runs import flights, parsed
from in_lanes import each
from scipy.linalg import expm

from robins.earth import Geodetic
from robins.filters import Belief, taylor
from robins.ins.increments import Increments
from robins.ins.mechanise import Nav, mechanise
from robins.ins.state import InsNoise, InsState
from robins.manifold import local, retract
from robins.rotation import Rotation, from_euler
from robins.scenario import ScenarioError
from robins.systems.airship.instruments import (
    INSTRUMENTS,
    SAR,
    STAR,
    STAR_EARLY,
    WIND,
    EarlySights,
    level,
    read_early,
    read_wind,
)
from robins.systems.airship.model import (
    PRODUCT,
    WIND_STATES,
    WithWind,
    white_noise_factor,
)
from robins.systems.airship.world import lay_out, sampled_at, simulate
from robins.workbench import InputError
from robins.workbench import run as run_scenario

ARCSEC = np.pi / 180.0 / 3600.0
RUNS, EPOCHS = 24, 24
SHORT = (
    'imu.rate="10 Hz"',
    'duration="24 s"',
    'counted={begin="0 s", end="24 s"}',
    'wind.span={begin="6 s", end="20 s"}',
)
GUSTS = ('wind.gusts.every="2 s"',)
NO_IMU_ERRORS = (
    'imu.gyro_bias="0 deg/h"',
    'imu.gyro_noise="0 deg/sqrt(h)"',
    'imu.accel_bias="0 mg"',
    'imu.accel_noise="0 m/s/sqrt(s)"',
)
LOST = (
    'sar.lost=[{begin="5 s", end="9 s"}]',
    'barometer.lost=[{begin="3 s", end="4 s"}, {begin="20 s", end="24 s"}]',
    'star.lost=[{begin="2.5 s", end="4 s"}]',
    'air_data.lost=[{begin="1 s", end="2 s"}]',
)


@pytest.fixture(scope="module")
def windy():
    return flights("s1", (*SHORT, *GUSTS), RUNS)


@pytest.fixture(scope="module")
def seen_or_not():
    """Without errors of the inertial unit, sensors lost at times; the wind felt, and not felt."""
    exact = (*NO_IMU_ERRORS, 'star.attitude="0.001 arcsec"')
    given = parsed("s1", (*SHORT, *GUSTS, *exact, *LOST))
    course = lay_out(given)

    @each
    def fly(one):
        unsensed, index = one
        imu = given.imu.model_copy(update={"unsensed": unsensed})
        return simulate(INSTRUMENTS, given.model_copy(update={"imu": imu}), course, 0, index)

    both = jax.device_put(fly((np.array([0.0, 0.0, 1.0, 1.0]), np.array([0, 1, 0, 1]))))
    return [jax.tree.map(lambda x, at=at: x[at], both) for at in (slice(2), slice(2, 4))]


@pytest.fixture(scope="module")
def perfect(seen_or_not):
    return seen_or_not[0]


def as_ins(nav: Nav, gyro_bias, accel_bias) -> InsState:
    return InsState(nav.q_nb, nav.v_n, nav.position, gyro_bias, accel_bias)


def one(batch, run=0):
    return jax.tree.map(lambda x: x[run], batch)


# --------------------------------------------------------------------------------------- the world


def test_a_unit_without_errors_navigates_to_the_truth(perfect):
    world = one(perfect)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), world.parts)
    pieces = flat.dt.shape[0] // EPOCHS
    assert pieces > 1
    # in pieces there is nothing but rounding; in one step an epoch, what a second's step leaves out
    for increments, every, metres, m_s in (
        (flat, pieces, 1e-4, 1e-5),
        (world.epoch_increments, 1, 5e-3, 5e-4),
    ):
        path = mechanise(world.start, increments)
        ends = jax.tree.map(lambda x, every=every: x[every - 1 :: every], path)
        off = np.asarray(jax.vmap(local)(world.truth, ends))
        assert np.max(np.abs(off[:, :3])) < 1e-8
        assert np.max(np.abs(off[:, 3:6])) < m_s
        assert np.max(np.abs(off[:, 6:])) < metres
    np.testing.assert_array_equal(world.gyro_bias, 0.0)


def test_wind_changes_nothing_of_what_the_sensors_get_wrong(windy):
    """S0 and S1 are pairs: the same numbers, with gusts and without."""
    calm, gusty = flights("s0", SHORT, RUNS).batch, windy.batch
    assert np.max(np.abs(calm.wind - gusty.wind)) > 4.0
    for name in ("initial_error", "gyro_bias", "accel_bias", "wind_error"):
        np.testing.assert_array_equal(getattr(calm, name), getattr(gusty, name), err_msg=name)
    pair = (calm, gusty)
    datum = lay_out(parsed("s0", SHORT)).datum
    for noise, rounding in (
        ([w.readings[SAR][2][..., 0] - w.truth.position.alt for w in pair], 1e-10),
        ([(w.readings[SAR][0] - level(datum, w.truth.position))[..., 0] for w in pair], 1e-7),
        ([w.readings[WIND] - w.air_b for w in pair], 1e-12),
    ):
        np.testing.assert_allclose(noise[0], noise[1], atol=rounding)
        assert np.std(noise[0]) > 1e3 * rounding


def specific_force(batch):
    """Velocity gained by what the accelerometers felt in each epoch, NED without gravity (runs)."""
    before = jnp.concatenate([batch.start.q_nb.wxyz[:, None], batch.truth.q_nb.wxyz[:, :-1]], 1)
    felt = jax.vmap(jax.vmap(lambda q, dv: Rotation(q).apply(dv)))(
        before, batch.epoch_increments.dv
    )
    v = np.concatenate([batch.start.v_n[:, None], batch.truth.v_n], 1)
    return np.asarray(felt)[..., :2], np.diff(v, axis=1)[..., :2]


def test_gusts_are_felt_unless_they_are_not_to_be(seen_or_not):
    perfect, blind = seen_or_not
    felt, gained = specific_force(perfect)
    assert np.max(np.abs(gained)) > 0.2
    # Coriolis of 20 m/s and the turn of the body within an epoch are what they differ by
    np.testing.assert_allclose(felt, gained, atol=0.02)
    felt, gained = specific_force(blind)
    assert np.max(np.abs(gained)) > 0.2
    np.testing.assert_allclose(felt, 0.0, atol=0.02)


def test_gyros_carry_the_star_sights_of_an_epoch_to_its_end(perfect):
    world = one(perfect)
    age = jnp.full((EPOCHS, 1), 0.5)
    zero = jnp.zeros((EPOCHS, 3))
    states = WithWind(as_ins(world.truth, zero, zero), world.wind_error)
    read = jax.vmap(lambda x, turned, age: read_early(x, EarlySights(turned, age)))
    angles = np.stack([a.rad for a in read(states, world.since, age)], 1)
    euler = world.readings[STAR]
    there = np.isfinite(euler[:, 0, 0])
    assert there.sum() == EPOCHS - 2  # those of 2.5 s and 3.5 s are lost
    turned = np.abs(euler[:, 1] - euler[:, 0])[there]
    assert np.nanmax(turned) > 100 * ARCSEC
    np.testing.assert_allclose(angles[there], euler[there, 0], atol=0.01 * ARCSEC)


def test_the_reading_of_the_wind_errs_by_the_air_data_alone(windy):
    batch = windy.batch
    thought = batch.wind + batch.wind_error
    nothing = jnp.zeros((RUNS, EPOCHS, 2))
    read = jax.vmap(jax.vmap(read_wind))
    ideal = read(WithWind(batch.truth, nothing), batch.air_b)
    np.testing.assert_allclose(ideal, batch.wind, atol=1e-12)
    measured = read(WithWind(batch.truth, batch.wind_error), batch.readings[WIND])
    noise = np.asarray(batch.readings[WIND] - batch.air_b)
    along = [np.asarray(Rotation(q).apply(n))[:2] for q, n in _pairs(batch, noise)]
    np.testing.assert_allclose(np.reshape(thought - measured, (-1, 2)), np.array(along), atol=1e-12)
    count = noise.size
    assert abs(np.std(noise) / 0.3 - 1.0) < 4.0 / np.sqrt(2 * count)
    assert 0.2 < np.std(batch.wind_error[:, 0]) < 0.42  # 48 independent numbers of sigma 0.3


def _pairs(batch, noise):
    return zip(
        jnp.reshape(batch.truth.q_nb.wxyz, (-1, 4)), jnp.reshape(noise, (-1, 3)), strict=True
    )


def test_sensors_are_missing_where_they_are_lost_and_nowhere_else(perfect):
    world, time = one(perfect), np.arange(1, EPOCHS + 1)
    place, heading, height = world.readings[SAR]
    assert set(time[np.isnan(heading.rad)]) == {5, 6, 7, 8}
    assert set(time[np.isnan(place[:, 0])]) == {5, 6, 7, 8}
    assert set(time[np.isnan(height[:, 0])]) == {3, 20, 21, 22, 23}
    assert set(time[np.isnan(world.readings[WIND][:, 0])]) == {1}
    sights = 0.5 * np.arange(1, 2 * EPOCHS + 1)
    gone = np.isnan(world.readings[STAR][..., 0]).reshape(-1)
    assert set(sights[gone]) == {2.5, 3.0, 3.5}
    assert np.all(np.isfinite(world.wind_error))


def test_slower_sensors_read_at_the_end_of_their_own_intervals():
    given = parsed("s0", (*SHORT, 'sar.rate="0.25 Hz"', 'star.rate="5 Hz"'))
    course = lay_out(given)
    there = sampled_at(course.epoch_s, given.sar)
    np.testing.assert_array_equal(np.flatnonzero(there) + 1, np.arange(4, EPOCHS + 1, 4))
    assert course.sights == 5
    assert np.all(sampled_at(course.sight_s, given.star))
    assert (course.samples, course.parts) == (2, 2)


# ------------------------------------------------------------------------------------ the filters


def test_heading_south_is_as_good_as_heading_east(windy):
    """The heading then swings across +-180 deg, and here the longitude of fixes does as well."""
    course = ('hull.course="180 deg"', 'wind.towards="180 deg"', 'place.longitude="180 deg"')
    south = flights("s1", (*SHORT, *GUSTS, *course), RUNS)
    longitude = np.asarray(south.batch.truth.position.lon)
    assert np.min(longitude) < -3.1 < 3.1 < np.max(longitude)
    assert np.nanmax(np.abs(south.batch.readings[SAR][0][..., 1])) < 1e3  # m east
    heading = np.asarray(south.batch.readings[STAR][..., 2])
    assert np.any(heading > 3.1)
    assert np.any(heading < -3.1)
    ways = [of.found("ekf") for of in (windy, south)]
    for way in ways:
        assert np.all(np.isfinite(way.error))
    # the same errors turned: what was along the wind is again
    size = [np.sqrt(np.mean(way.error[:, 5:] ** 2, axis=(0, 1))) for way in ways]
    np.testing.assert_allclose(size[1][2], size[0][2], rtol=0.05)  # of heading
    level = [np.hypot(s[6], s[7]) for s in size]
    assert abs(level[1] / level[0] - 1.0) < 0.1


# -------------------------------------------------------------------------------------- the models

NAV = Nav(
    Rotation(from_euler(*jnp.asarray([0.02, -0.03, 1.7]))),
    jnp.array([3.0, 21.0, -0.5]),
    Geodetic(*(jnp.asarray(x) for x in (0.6, 1.9, 2.0e4))),
)
GIVEN = parsed("s1", ("believed.accel_noise_factor=2.0",))
COURSE = lay_out(GIVEN)
SENSORS = [i.believed(GIVEN, COURSE) for i in INSTRUMENTS]
ONE = Increments(jnp.asarray(1.0), jnp.array([0.02, -0.01, 0.03]), jnp.array([0.3, -0.5, -9.8]))
PARTS = Increments(
    jnp.full(4, 0.25), ONE.theta[None] / 4 * jnp.ones((4, 1)), ONE.dv[None] / 4 * jnp.ones((4, 1))
)
WIND_ERROR = jnp.array([0.3, -0.2])
INS = as_ins(NAV, jnp.array([1e-6, -2e-6, 3e-6]), jnp.array([0.01, -0.01, 0.02]))
MODELS = {  # the slope of the nine states is a part of the first
    "wind": (WIND_STATES, WithWind(NAV, WIND_ERROR), ONE),
    "product": (PRODUCT, WithWind(INS, WIND_ERROR), PARTS),
}
# what a change of each state is measured in: rad, m/s, m, m/s of wind or rad/s, m/s^2
SIZES = {"wind": [0.3] * 2, "product": [1e-6] * 3 + [1e-2] * 3 + [0.3] * 2}


@pytest.mark.parametrize("name", list(MODELS))
def test_the_slope_of_a_step_is_its_slope(name):
    states, x, u = MODELS[name]
    motion = states.motion(GIVEN, COURSE)
    size = np.array([1e-3] * 3 + [1.0] * 3 + [10.0] * 3 + SIZES[name])

    @jax.jit
    def both(x, u):
        new, F, L = motion.linear(x, u)

        def from_(d):
            moved = motion.step(retract(x, d), u)
            return local(new, moved), moved

        slope, moved = jax.jacfwd(from_, has_aux=True)(jnp.zeros(len(size)))
        return local(moved, new), F, slope, L @ L.T

    off, F, slope, Q = both(x, u)
    np.testing.assert_allclose(np.asarray(off) / size, 0.0, atol=1e-12)
    scaled = (np.asarray(F) - np.asarray(slope)) * size / size[:, None]
    np.testing.assert_allclose(scaled, 0.0, atol=1e-4)
    assert np.max(np.abs(np.asarray(slope) * size / size[:, None])) > 1e-3
    # The error of the wind keeps its sigma, as a process in its steady state does.
    of_wind = np.asarray(F)[-2:, -2:]
    np.testing.assert_allclose(of_wind, np.exp(-1.0 / 50.0) * np.eye(2), rtol=1e-12)
    kept = 0.09 * of_wind @ of_wind.T + np.asarray(Q)[-2:, -2:]
    np.testing.assert_allclose(kept, 0.09 * np.eye(2), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("at", range(len(SENSORS)), ids=[s.name for s in SENSORS])
def test_sensors_read_with_the_slope_of_differences(at):
    sensor, x = SENSORS[at], MODELS["product"][1]
    sigma = jnp.asarray([1e-4] * 3 + [0.1] * 3 + [10.0] * 3 + SIZES["product"])
    aux = None
    if sensor.name == STAR_EARLY:
        aux = EarlySights(jnp.array([[0.01, -0.02, 0.015]]), jnp.array([0.5]))
    if sensor.name.startswith("wind"):
        aux = jnp.array([9.0, 1.0, -0.5])
    y = sensor.read(x, aux)
    belief = Belief(x, jnp.diag(sigma))
    spread = jax.jit(lambda b, y: taylor().observation(b, sensor, y, aux).spread)(belief, y)

    @jax.jit
    def difference(d):
        ahead, behind = (sensor.read(retract(x, s * d), aux) for s in (1.0, -1.0))
        return 0.5 * local(behind, ahead)

    columns = np.stack([difference(row) for row in jnp.diag(sigma)], 1)
    size = np.max(np.abs(columns), axis=1, keepdims=True)
    np.testing.assert_allclose(np.asarray(spread) / size, columns / size, atol=2e-6)


def test_noise_of_a_step_is_that_of_a_random_walk():
    gyro, accel, dt = 3e-6, 0.07, 0.8
    L = np.asarray(white_noise_factor(InsNoise(gyro, accel), dt))
    A, G = np.zeros((9, 9)), np.zeros((9, 6))
    A[6:, 3:6] = np.eye(3)
    G[:3, :3], G[3:6, 3:] = gyro * np.eye(3), accel * np.eye(3)
    block = expm(dt * np.block([[-A, G @ G.T], [np.zeros((9, 9)), A.T]]))  # van Loan (1978)
    Q = block[9:, 9:].T @ block[:9, 9:]
    np.testing.assert_allclose(L @ L.T, Q, rtol=1e-12, atol=1e-24)


# --------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ('imu.rate="3 Hz"', "imu.rate must be a multiple of star.rate"),
        ('star.rate="1.5 Hz"', "star"),
        ('sar.rate="3 Hz"', "sar.rate must divide that of the epochs"),
        ('barometer.rate="0.3 Hz"', "barometer.rate must divide"),
        ('counted={begin="0 s", end="2000 s"}', "counted.end is 2000 s, after the end"),
        ('counted={begin="30 s", end="20 s"}', "must come after begin"),
        ('sar.position="-25 m"', "sar.position"),
        ('star.attitude="0 arcsec"', "star.attitude"),
        ('sar.position="25 s"', "sar.position"),
        ("sar.position=25", "sar.position"),
        ("sar.outlier_share=1.5", "sar.outlier_share"),
        ('sar.positon="25 m"', "positon"),
        ('place.latitude="90 deg"', "place.latitude"),
        ('sar.lost=[{begin="9 s", end="5 s"}]', "must come after begin"),
    ],
)
def test_what_makes_no_sense_is_refused_by_its_name(setting, message):
    with pytest.raises(ScenarioError, match=message):
        parsed("s0", (setting,))


def test_a_flight_of_one_epoch_is_refused():
    given = parsed("s0", ('duration="1.5 s"', 'counted={begin="0 s", end="1 s"}'))
    with pytest.raises(ValueError, match=r"duration 1.5 s holds 1 epoch\(s\)"):
        lay_out(given)


def test_an_unknown_filter_is_named_with_those_there_are():
    with pytest.raises(InputError, match=r"no filter 'rukf'.*did you mean 'r?a?ukf'.*product"):
        run_scenario("airship/s0", runs=1, filters=("rukf",))
