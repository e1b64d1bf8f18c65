"""The mechanisation against other integrations and closed forms; alone, in batches, in pieces."""

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation as SciRotation

from robins.dataset import ImuTable
from robins.earth import OMEGA_E, Geodetic, dcm_en, gravity, gravity_n
from robins.ins import mechanise as strap
from robins.ins.increments import Increments, from_imu
from robins.ins.mechanise import (
    Nav,
    as_trajectory,
    mechanise,
    mechanise_chunked,
    nav_at,
    refuse_polar,
    step,
    step_each,
)
from robins.rotation import Rotation
from robins.sim.ideal_imu import true_increments
from robins.sim.trajectory import from_velocity, sine_velocity

ARCSEC = np.deg2rad(1.0) / 3600.0
START = Geodetic.from_degrees(55.0, 37.0, 1000.0)


def nav(lat_deg=55.0, lon_deg=37.0, alt=1000.0, v=(100.0, -50.0, 5.0), angles=(0.1, -0.2, 2.0)):
    place = Geodetic.from_degrees(lat_deg, lon_deg, alt)
    return Nav(Rotation.from_euler(*angles), jnp.asarray(v, float), place)


def shaken(n=500, dt=0.01, seed=0):
    """Increments of a body that turns and accelerates at random."""
    rng = np.random.default_rng(seed)
    theta = rng.normal([0.0, 0.0, 0.1 * dt], 0.2 * dt, (n, 3))
    dv = rng.normal([0.0, 0.0, -9.8 * dt], 1.0 * dt, (n, 3))
    return Increments(np.full(n, dt), theta, dv)


def navigate(start, inc):
    """`mechanise_chunked` with the one length compiled for this file."""
    return mechanise_chunked(start, inc, chunk=500)


@jax.jit
def errors(path, truth):
    """Largest errors: position [m], velocity [m/s], attitude [rad]."""
    dp = jax.vmap(lambda a, b: a.local(b))(truth.position, path.position)
    phi = jax.vmap(lambda a, b: a.local(b))(truth.q_nb, path.q_nb)
    dv = path.v_n - truth.v_n
    return jnp.stack([jnp.max(jnp.linalg.norm(e, axis=1)) for e in (dp, dv, phi)])


def run(motion, hz):
    time_ns = motion.times_ns(hz)
    truth = motion.trajectory(time_ns)
    inc, _ = from_imu(true_increments(motion, time_ns))
    return np.asarray(errors(navigate(nav_at(truth), inc), nav_at(truth, slice(1, None))))


# ------------------------------------------------------------------------- accuracy on a known path


@pytest.fixture(scope="module")
def sine_errors():
    motion = sine_velocity(START, mean_mps=10.0, amplitude_mps=60.0, period_s=30.0)
    return {hz: run(motion, hz) for hz in (25.0, 50.0, 100.0)}


def test_sine_velocity_motion_of_600_s(sine_errors):
    """pyins is allowed 0.77 m and 0.03 arcsec here; the motion dives and climbs at 50 deg."""
    assert np.all(sine_errors[100.0] < [0.01, 5e-5, 0.0035 * ARCSEC])


def test_order_in_the_interval(sine_errors):
    table = np.array([sine_errors[hz] for hz in (25.0, 50.0, 100.0)])
    observed = np.log2(table[:-1] / table[1:])
    assert (observed > 2.0).all(), observed


def test_against_an_integration_in_the_earth_frame():
    """The same specific force and rate, integrated in ECEF by an eighth-order rule."""

    def omega_b(t):
        return np.stack([0.3 * np.sin(0.9 * t), 0.2 * np.cos(0.7 * t), 0.25 + 0.0 * t], -1)

    def f_b(t):
        columns = [2.0 * np.sin(0.5 * t), 3.0 * np.cos(0.8 * t), 2.0 * np.sin(0.3 * t) - 9.8]
        return np.stack(columns, -1)

    spin = np.array([0.0, 0.0, OMEGA_E])

    @jax.jit
    def place(r):
        p = Geodetic.from_ecef(r)
        C = dcm_en(p.lat, p.lon)
        return C @ gravity_n(p.lat, p.alt), C, jnp.stack([p.lat, p.lon, p.alt])

    def rates(t, y):
        r, v, q = y[:3], y[3:6], y[6:]
        C = SciRotation.from_quat(q, scalar_first=True).as_matrix()
        g = np.asarray(place(r)[0])
        # of the body relative to the Earth
        turn = omega_b(t) - C.T @ spin
        w, u = q[0], q[1:]
        q_dot = 0.5 * np.append(-u @ turn, w * turn + np.cross(u, turn))
        return np.concatenate([v, C @ f_b(t) + g - 2.0 * np.cross(spin, v), q_dot])

    start, seconds = nav(60.0, 20.0, 3000.0), 60.0
    r0 = np.asarray(start.position.as_ecef())
    C_en = np.asarray(place(r0)[1])
    q0 = np.asarray((Rotation.from_dcm(C_en) @ start.q_nb).wxyz)
    y0 = np.concatenate([r0, C_en @ np.asarray(start.v_n), q0])
    end = solve_ivp(rates, (0.0, seconds), y0, "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    _, C_end, lla = (np.asarray(a) for a in place(end[:3]))

    nodes, weights = np.polynomial.legendre.leggauss(6)
    miss = []
    for hz in (25, 50, 100):
        t = np.arange(-1, int(seconds * hz) + 1) / hz
        at = (t - 0.5 / hz)[:, None] + 0.5 / hz * nodes
        raw = [0.5 / hz * np.einsum("nkj,k->nj", f(at), weights) for f in (omega_b, f_b)]
        imu = ImuTable(np.round((t + 1.0) * 1e9).astype(np.int64), *raw, "increment")
        inc, _ = from_imu(imu)
        path = navigate(start, jax.tree.map(lambda a: a[1:], inc))
        last = jax.tree.map(lambda a: jnp.asarray(a[-1]), path)
        q_eb = Rotation.from_dcm(C_end) @ last.q_nb
        truth = Geodetic(*(jnp.asarray(a) for a in lla))
        miss.append(
            [
                float(jnp.linalg.norm(truth.local(last.position))),
                float(np.linalg.norm(C_end @ np.asarray(last.v_n) - end[3:6])),
                float(jnp.linalg.norm(Rotation(jnp.asarray(end[6:])).local(q_eb))),
            ]
        )
    miss = np.array(miss)
    assert (miss[-1] < [1e-4, 3e-6, 1e-8]).all(), miss
    assert (np.log2(miss[:-1] / miss[1:]) > 2.9).all(), miss


@pytest.mark.filterwarnings("ignore:The copy keyword")  # inside pyins
def test_against_pyins_on_the_same_increments():
    """pyins takes gravity along the ellipsoid's normal and Coriolis at the interval's start.

    At sea level and for ten seconds the first hardly counts; the second falls with the interval, so
    halving that must close half of what is left.
    """
    from pyins import strapdown  # with Numba

    apart = []
    for dt in (0.01, 0.005):
        n = round(10.0 / dt)
        rng = np.random.default_rng(1)
        rate, force = rng.normal(0.0, 0.2, 3), np.array([0.5, -0.3, -9.8])
        inc = Increments(np.full(n, dt), np.tile(rate * dt, (n, 1)), np.tile(force * dt, (n, 1)))
        start = nav(50.0, 45.0, 0.0, v=(30.0, -20.0, 0.0))
        angles = np.rad2deg([float(a) for a in start.q_nb.as_euler()])
        columns = ["lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading"]
        pva = pd.Series([50.0, 45.0, 0.0, 30.0, -20.0, 0.0, *angles], index=columns)
        frame = pd.DataFrame(
            np.column_stack([inc.dt, inc.theta, inc.dv]),
            index=dt * np.arange(1, n + 1),
            columns=["dt", "theta_x", "theta_y", "theta_z", "dv_x", "dv_y", "dv_z"],
        )
        theirs = strapdown.Integrator(pva).integrate(frame).iloc[-1]
        q = Rotation.from_euler(*np.deg2rad(theirs[["roll", "pitch", "heading"]].to_numpy()))
        v = jnp.asarray(theirs[["VN", "VE", "VD"]].to_numpy())
        p = Geodetic.from_degrees(*theirs[["lat", "lon", "alt"]])
        last = jax.tree.map(lambda a: jnp.asarray(a[-1]), navigate(start, inc))
        apart.append(
            [
                float(jnp.linalg.norm(p.local(last.position))),
                float(jnp.linalg.norm(v - last.v_n)),
                float(jnp.linalg.norm(q.local(last.q_nb))),
            ]
        )
    coarse, fine = np.array(apart)
    assert (fine < [1e-4, 4e-5, 3e-11]).all(), apart
    assert (fine[:2] < 0.6 * coarse[:2]).all(), apart


# ------------------------------------------------------------------------------------ closed forms


def at_rest(lat_deg, n, dt, v=(0.0, 0.0, 0.0), alt=0.0):
    """A body level at rest, and the increments its sensors give there."""
    start = nav(lat_deg, 10.0, alt, v=v, angles=(0.0, 0.0, 0.0))
    earth = OMEGA_E * np.array([np.cos(np.deg2rad(lat_deg)), 0.0, -np.sin(np.deg2rad(lat_deg))])
    g = np.asarray(gravity_n(np.deg2rad(lat_deg), alt))
    time_ns = np.round(np.arange(n + 1) * dt * 1e9).astype(np.int64)
    imu = ImuTable(time_ns, np.tile(earth, (n + 1, 1)), np.tile(-g, (n + 1, 1)), "rate")
    return start, from_imu(imu)[0]


def test_schuler_oscillation_after_an_hour_without_aids():
    """A north velocity error at the equator swings with omega^2 = g / R (Groves 2013, 14.2)."""
    dt, hour = 0.1, 36000
    start, inc = at_rest(0.0, hour, dt, v=(0.1, 0.0, 0.0))
    path = navigate(start, inc)
    t = dt * np.arange(1, hour + 1)
    rate = np.sqrt(float(gravity(0.0, 0.0)) / 6335439.327)  # meridian radius at the equator
    north = np.asarray(path.position.lat) * 6335439.327
    expected = 0.1 / rate * np.sin(rate * t)
    assert np.abs(north - expected).max() < 0.01 * np.abs(expected).max()
    np.testing.assert_allclose(path.v_n[:, 0], 0.1 * np.cos(rate * t), atol=0.01 * 0.1)


def test_height_error_grows_as_gravity_falls():
    """Ten minutes: cosh with rate^2 = -dg/dh, the instability of the vertical channel."""
    n, dt, miss = 6000, 0.1, 1.0
    start, inc = at_rest(45.0, n, dt)
    high = start._replace(position=start.position.retract(jnp.array([0.0, 0.0, -miss])))
    path = navigate(high, inc)
    lat = np.deg2rad(45.0)
    rate = np.sqrt(float(gravity(lat, -50.0) - gravity(lat, 50.0)) / 100.0)
    t = dt * np.arange(1, n + 1)
    np.testing.assert_allclose(path.position.alt, miss * np.cosh(rate * t), rtol=1e-3)


def test_a_body_at_rest_stays_there():
    start, inc = at_rest(60.0, 6000, 0.01, alt=300.0)
    path = navigate(start, inc)
    assert np.abs(path.v_n).max() < 1e-9
    assert np.abs(path.position.alt - 300.0).max() < 1e-8
    assert np.abs(np.asarray(path.position.lat) - np.deg2rad(60.0)).max() < 1e-14


@pytest.mark.parametrize("turns", [0.0, 12.0])
def test_attitude_through_and_at_the_vertical(turns):
    """Pitch tumbling through +-90 deg a dozen times, and held there, for a minute."""
    t = np.linspace(0.0, 60.0, 6001)
    pitch = np.pi / 2.0 + 2.0 * np.pi * turns * t / 60.0
    half = 0.5 * pitch[:, None]
    q = np.hstack([np.cos(half), 0.0 * half, np.sin(half), 0.0 * half])
    motion = from_velocity(t, np.zeros((len(t), 3)), START, q)
    assert run(motion, 100.0)[2] < 1e-9


def test_longitude_runs_on_across_180_degrees():
    inc = shaken(2000)
    for v in ((10.0, 300.0, 0.0), (10.0, -300.0, 0.0)):
        lon0 = 179.98 * np.sign(v[1])
        there = navigate(nav(lon_deg=lon0, v=v), inc)
        here = navigate(nav(lon_deg=0.0, v=v), inc)
        lon = np.asarray(there.position.lon)
        assert (lon >= -np.pi).all()
        assert (lon < np.pi).all()
        assert np.abs(np.diff(lon)).max() > 6.0  # it did cross
        moved = (lon - np.deg2rad(lon0) + np.pi) % (2.0 * np.pi) - np.pi
        # each of 2000 sums is rounded at pi, half an ulp of which is 2e-16
        np.testing.assert_allclose(moved, here.position.lon, rtol=0, atol=2000**0.5 * 4e-16)
        np.testing.assert_array_equal(there.v_n, here.v_n)


# ------------------------------------------------------------------------- one, many, whole, pieces


@pytest.fixture(scope="module")
def whole():
    inc = shaken()
    return inc, mechanise(nav(), inc)


def test_streams_pieces_and_batches_give_the_same_numbers(whole):
    inc, path = whole
    one = jax.jit(step)
    state = nav()
    for k in range(50):
        state = one(state, jax.tree.map(lambda a, k=k: jnp.asarray(a[k]), inc))
    pieces = mechanise_chunked(nav(), inc, chunk=128)
    many = jax.tree.map(lambda a: jnp.stack([a, jnp.roll(a, 7, 0), a]), inc)
    batch = jax.vmap(mechanise, (None, 0))(nav(), many)
    found = (jax.tree.leaves(x) for x in (path, state, pieces, batch))
    for want, streamed, piece, several in zip(*found, strict=True):
        np.testing.assert_allclose(streamed, want[49], rtol=1e-14)
        assert isinstance(piece, np.ndarray)
        np.testing.assert_allclose(piece, want, rtol=1e-14)
        np.testing.assert_allclose(several[2], want, rtol=1e-13)
        assert not np.array_equal(several[1], several[0])


def test_numpy_takes_the_step_of_jax(whole):
    inc, path = whole
    before = jax.tree.map(lambda a, b: np.asarray([a, *b[:-1]]), nav(), path)
    for reached, want in zip(*map(jax.tree.leaves, (step_each(before, inc), path)), strict=True):
        assert type(reached) is np.ndarray
        np.testing.assert_allclose(reached, want, rtol=1e-14, atol=1e-16)


def test_no_increments_make_an_empty_path():
    path = navigate(nav(), shaken(0))
    assert path.v_n.shape == (0, 3)
    with pytest.raises(ValueError, match="chunk = 0"):
        mechanise_chunked(nav(), shaken(3), chunk=0)


def test_one_kernel_is_the_plain_function():
    x = strap.vector(nav())
    row = strap.rows(jax.tree.map(lambda a: jnp.asarray(a[3]), shaken()))
    plain = jax.jit(strap.advance.__wrapped__)(x, row)
    np.testing.assert_allclose(jax.jit(strap.advance)(x, row), plain, rtol=1e-15)
    # a batch large enough for threads
    wide = jax.jit(jax.vmap(strap.advance, (None, 0)))(x, jnp.tile(row, (100_000, 1)))
    np.testing.assert_allclose(wide, jnp.tile(plain, (100_000, 1)), rtol=1e-15)


def test_zero_increments_change_no_bit():
    start = nav(lon_deg=179.9999)._replace(q_nb=Rotation(nav().q_nb.wxyz * (1.0 + 3e-16)))
    zeros = Increments(np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3)))
    for a, b in zip(jax.tree.leaves(mechanise(start, zeros)), jax.tree.leaves(start), strict=True):
        assert np.asarray(a[-1]).tobytes() == np.asarray(b).tobytes()


def test_the_quaternion_stays_a_rotation_for_a_million_steps():
    one = jax.tree.map(lambda a: jnp.asarray(a[0]), shaken(1, dt=1e-4))
    row, x = strap.rows(one._replace(theta=300.0 * one.theta)), strap.vector(nav())
    x = x.at[:4].multiply(1.0 + 1e-9)
    last = jax.jit(lambda x: jax.lax.fori_loop(0, 1_000_000, lambda _, x: strap.advance(x, row), x))
    assert abs(float(jnp.linalg.norm(last(x)[:4])) - 1.0) < 1e-15


def test_gradients_against_differences():
    inc = jax.tree.map(jnp.asarray, shaken(20))

    @jax.jit
    def end(shift):
        moved = inc._replace(theta=inc.theta + shift[:1], dv=inc.dv + shift[1:])
        last = jax.tree.map(lambda a: a[-1], mechanise(nav(), moved))
        return jnp.sum(last.v_n**2) + last.position.alt + jnp.sum(last.q_nb.wxyz[1:3])

    zero = jnp.zeros((2, 3))
    slopes = jax.grad(end)(zero)
    for i in range(2):
        for j in range(3):
            h = zero.at[i, j].set(1e-6)
            slope = float(end(h) - end(-h)) / 2e-6
            assert float(slopes[i, j]) == pytest.approx(slope, rel=1e-5, abs=1e-3)


# ------------------------------------------------------------------------------------- boundaries


@pytest.mark.parametrize("lat_deg", [89.91, 89.9999, 90.0, -89.95])
def test_poles_are_refused_with_the_reason(lat_deg):
    with pytest.raises(ValueError, match=f"latitude {lat_deg:.4f}.*local level"):
        refuse_polar(np.deg2rad([0.0, lat_deg]))
    with pytest.raises(ValueError, match="not defined there"):
        mechanise_chunked(nav(lat_deg), shaken(3))


def test_near_the_pole_it_still_works():
    refuse_polar(np.deg2rad([89.899, -89.899]))
    t = np.linspace(0.0, 20.0, 401)
    v = np.tile([20.0, 30.0, 0.0], (len(t), 1))
    q = np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
    motion = from_velocity(t, v, Geodetic.from_degrees(89.8, 10.0, 0.0), q)
    assert np.all(run(motion, 100.0)[[0, 2]] < [1e-3, 1e-7])


def test_tables_and_states_go_both_ways(whole):
    _, path = whole
    time_ns = np.arange(len(path.v_n), dtype=np.int64)
    table = as_trajectory(time_ns, path, "run")
    back = nav_at(table, slice(None))
    for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(path), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(nav_at(table, 0).v_n, path.v_n[0])
