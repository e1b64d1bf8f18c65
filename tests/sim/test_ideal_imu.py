"""Ideal sensors: the mechanisation inverted, and integrals of what is really felt."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad_vec

from robins.dataset import ImuTable
from robins.earth import Geodetic
from robins.ins.frames import to_enu_rfu
from robins.ins.increments import from_imu
from robins.ins.mechanise import mechanise_chunked, nav_at
from robins.sim import commands as do
from robins.sim.commands import from_commands
from robins.sim.ideal_imu import ideal_increments, true_increments
from robins.sim.trajectory import sine_velocity

START = Geodetic.from_degrees(55.0, 37.0, 1000.0)


@jax.jit
def largest(path, truth):
    dp = jax.vmap(lambda a, b: a.local(b))(truth.position, path.position)
    phi = jax.vmap(lambda a, b: a.local(b))(truth.q_nb, path.q_nb)
    dv = path.v_n - truth.v_n
    return jnp.stack([jnp.max(jnp.linalg.norm(e, axis=1)) for e in (dp, dv, phi)])


def errors(truth, imu):
    """Largest errors in position [m], velocity [m/s] and attitude [rad] of a run over `imu`."""
    inc, _ = from_imu(imu)
    path = mechanise_chunked(nav_at(truth), inc, chunk=2000)
    return np.asarray(largest(path, nav_at(truth, slice(1, None))))


def rows(truth, count):
    """The first rows of a trajectory."""
    names = ("time_ns", "lat_rad", "lon_rad", "alt_m", "v_n", "q_nb")
    return replace(truth, **{name: getattr(truth, name)[:count] for name in names})


@pytest.fixture(scope="module")
def motion():
    return sine_velocity(START, duration_s=600.0)


@pytest.fixture(scope="module")
def truth(motion):
    return motion.trajectory(motion.times_ns(100.0))


@pytest.fixture(scope="module")
def inverted(truth):
    return ideal_increments(truth)


def test_the_mechanisation_returns_the_trajectory(truth, inverted):
    """600 s of 50 deg dives; position is off by the discretisation of its double integral only."""
    assert np.all(errors(truth, inverted) < [1.2e-5, 1e-8, 1e-12])


def test_position_error_of_the_round_trip_falls_with_the_cube_of_the_interval(
    motion, truth, inverted
):
    coarse = motion.trajectory(motion.times_ns(50.0))
    halved = errors(coarse, ideal_increments(coarse))[0] / errors(truth, inverted)[0]
    assert np.log2(halved) > 2.8


def test_ideal_increments_approach_the_true_ones(motion, truth, inverted):
    true = true_increments(motion, truth.time_ns)
    assert np.abs(inverted.gyro[2:] - true.gyro[2:]).max() < 1e-9
    assert np.abs(inverted.accel[2:] - true.accel[2:]).max() < 1e-7


def test_a_stop_and_go_drive_goes_round_too():
    manoeuvres = [do.stand(3.0), do.accelerate(20.0, 6.0), do.turn(2.0, 0.5), do.stop(5.0)]
    drive = from_commands(START, manoeuvres, vehicle="aircraft")
    truth = drive.trajectory(drive.times_ns(200.0))
    assert np.all(errors(truth, ideal_increments(truth)) < [1e-6, 1e-9, 1e-12])


def test_body_axes_are_those_of_the_trajectory(truth, inverted):
    rfu = ideal_increments(to_enu_rfu(rows(truth, 50)))
    assert rfu.body == "RFU"
    np.testing.assert_allclose(rfu.gyro[:, [1, 0]], inverted.gyro[:50, :2], atol=1e-13)
    np.testing.assert_allclose(-rfu.accel[:, 2], inverted.accel[:50, 2], atol=1e-13)


def test_true_increments_are_integrals_of_the_ideal_rates(motion):
    time_ns = np.array([0, 10_000_000, 30_000_000, 35_000_000]) + 7 * 10**9
    table = true_increments(motion, time_ns)
    for k in range(4):
        end = time_ns[k] * 1e-9
        begin = end - 0.01 if k == 0 else time_ns[k - 1] * 1e-9

        def felt(t):
            rates = motion.at(np.array([t])).rates()
            return np.concatenate([rates[0][0], rates[1][0]])

        total, _ = quad_vec(felt, begin, end, epsabs=1e-13, epsrel=1e-13)
        np.testing.assert_allclose(table.gyro[k], total[:3], atol=1e-13)
        np.testing.assert_allclose(table.accel[k], total[3:], atol=1e-11)


def test_samples_of_rate_navigate_too(motion, truth):
    """Samples of rate and force, at the fourth order of their interpolation."""
    sampled = ImuTable(truth.time_ns, *motion.at(truth.time_ns * 1e-9).rates(), "rate")
    assert np.all(errors(truth, sampled) < [1e-4, 2e-7, 1e-10])


def test_what_cannot_be_inverted_is_refused(truth):
    with pytest.raises(ValueError, match=r"1 row\(s\): an increment needs two"):
        ideal_increments(rows(truth, 1))
    few = rows(truth, 6)
    with pytest.raises(ValueError, match=r"latitude 89\.99.*local level"):
        ideal_increments(replace(few, lat_rad=few.lat_rad * 0.0 + np.deg2rad(89.99)))
    with pytest.raises(ValueError, match=r"after 2 rounds .*sample it more densely"):
        ideal_increments(few, iterations=2)
