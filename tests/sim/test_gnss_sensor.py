"""Simulated GNSS: the antenna against pyproj and finite differences, errors by their statistics."""

import jax
import jax.numpy as jnp
import numpy as np
import pyproj
import pytest
from drawn import assert_variance
from scipy.spatial.transform import Rotation
from scipy.stats import binom

from robins.earth import Geodetic
from robins.sim.gnss_sensor import GnssErrorModel, as_table, fix_times, observe
from robins.sim.gnss_sensor import antenna as antenna_of_arrays
from robins.sim.random import Component, stream

GEODETIC = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
LEVER = np.array([1.2, -0.7, -15.0])
SPIN = np.array([0.0, 0.0, 7.292115e-5])


def geodetic(r_e):
    lon, lat, alt = GEODETIC.transform(*r_e)
    return np.deg2rad(lat), np.deg2rad(lon), alt


def axes(lat, lon):
    """C_en, columns north, east, down."""
    down = -np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    return np.column_stack([np.cross(east, down), east, down])


def vehicle(t):
    """Earth-fixed position and attitude of a vehicle that turns and flies; analytic in t."""
    r_e = np.array([4.2e6, 0.9e6, 4.7e6]) + t * np.array([-150.0, 220.0, 90.0])
    turn = Rotation.from_rotvec(t * np.array([0.3, -0.5, 0.9]))
    return r_e, turn * Rotation.from_euler("xyz", [0.3, -1.0, 2.0])


def truth_at(t):
    """Arguments of `antenna`, from the path alone."""
    r_e, eb = vehicle(t)
    lat, lon, alt = geodetic(r_e)
    C_en = axes(lat, lon)
    step = 1e-3
    v_e = (vehicle(t + step)[0] - vehicle(t - step)[0]) / (2.0 * step)
    x, y, z, w = Rotation.from_matrix(C_en.T @ eb.as_matrix()).as_quat()
    omega_eb_b = eb.inv().apply([0.3, -0.5, 0.9])
    omega_ib_b = omega_eb_b + eb.inv().apply(SPIN)
    return lat, lon, alt, C_en.T @ v_e, np.array([w, x, y, z]), omega_ib_b


def antenna(*truth_and_lever):
    return [np.asarray(x) for x in antenna_of_arrays(*map(jnp.asarray, truth_and_lever))]


def test_the_antenna_is_where_the_lever_puts_it_and_moves_as_it_does():
    def antenna_e(t):
        r_e, eb = vehicle(t)
        return r_e + eb.apply(LEVER)

    for t in (0.0, 2.0):
        lat, lon, alt, v = antenna(*truth_at(t), LEVER)
        wanted = geodetic(antenna_e(t))
        np.testing.assert_allclose([lat, lon], wanted[:2], rtol=0.0, atol=2e-15)
        np.testing.assert_allclose(alt, wanted[2], rtol=0.0, atol=5e-9)
        step = 1e-3
        rate = (antenna_e(t + step) - antenna_e(t - step)) / (2.0 * step)
        # The central difference of a turning lever errs by |lever| |omega|^3 step^2 / 6.
        np.testing.assert_allclose(v, axes(*wanted[:2]).T @ rate, rtol=0.0, atol=1e-5)


M, RUNS = 120, 500
rng = np.random.default_rng(0)
TIME = np.cumsum(rng.uniform(0.5, 1.5, M))
TRUTH = (
    0.9 + 1e-6 * TIME,
    np.mod(-2e-6 * TIME + 1e-4, 2 * np.pi) - np.pi,  # over the date line
    100.0 + TIME,
    rng.normal(size=(M, 3)),
    np.tile([1.0, 0.0, 0.0, 0.0], (M, 1)),
    np.zeros((M, 3)),
)
KEY = stream(1, 2, Component.GNSS)
GAPS = [(TIME[10], 30.0), (25.0, TIME[40]), (1e3, 1e4)]  # from a fix, to another
FULL = GnssErrorModel(
    sigma_m=[1.0, 2.0, 4.0],
    sigma_v=[0.1, 0.2, 0.3],
    markov_sigma_m=[3.0, 1.0, 2.0],
    markov_tau_s=[20.0, 5.0, 60.0],
    outages_s=GAPS,
    drop_share=0.1,
    outlier_share=0.05,
    outlier_size=30.0,
)

observe_jit = jax.jit(observe)


@pytest.fixture(scope="module")
def batch():
    keys = jax.vmap(lambda run: stream(8, run, Component.GNSS))(jnp.arange(RUNS))
    fixes = jax.jit(jax.vmap(lambda key: observe(FULL, key, TIME, *TRUTH)))(keys)
    return jax.tree.map(np.asarray, fixes)


def error_of(fixes):
    """Measured less true position in metres north, east, down; NaN where missing."""
    true = Geodetic(*(jnp.broadcast_to(x, fixes.lat_rad.shape) for x in TRUTH[:3]))
    return np.asarray(true.local(Geodetic(*(jnp.asarray(x) for x in fixes[:3]))))


def test_a_perfect_receiver_on_the_imu_tells_the_truth():
    fixes = observe_jit(GnssErrorModel(sigma_m=0.0, sigma_v=0.0), KEY, TIME, *TRUTH)
    for got, true in zip(fixes[:4], TRUTH[:4], strict=True):
        np.testing.assert_array_equal(got, true)
    assert not np.any(fixes.missing)
    assert not np.any(fixes.outlier)
    assert not np.any(fixes.error_m)


def test_no_velocity_unless_there_is_a_sigma():
    fixes = observe_jit(GnssErrorModel(sigma_m=1.0), KEY, TIME, *TRUTH)
    assert fixes.v_n is None
    assert fixes.sigma_v is None
    assert as_table(fixes, TIME).v_n is None


def test_the_error_told_is_the_error_made(batch):
    made = error_of(batch)
    there = ~batch.missing
    np.testing.assert_allclose(made[there], batch.error_m[there], atol=2e-8)
    assert np.all(np.isnan(made[~there]))


def test_white_and_markov_errors_have_their_sigmas(batch):
    good = np.where(batch.outlier[..., None], np.nan, batch.error_m)
    total = FULL.sigma_m**2 + FULL.markov_sigma_m**2
    for k in (0, M // 2, M - 1):
        assert_variance(good[:, k][~np.isnan(good[:, k, 0])], total)
    for i, j in ((50, 51), (50, 60)):
        fade = np.exp(-(TIME[j] - TIME[i]) / FULL.markov_tau_s)
        change = good[:, j] - good[:, i]
        change = change[~np.isnan(change[:, 0])]
        assert_variance(change, 2.0 * (total - FULL.markov_sigma_m**2 * fade))


def test_velocities_have_their_sigmas_and_go_missing_with_the_positions(batch):
    np.testing.assert_array_equal(np.isnan(batch.v_n).all(-1), batch.missing)
    np.testing.assert_array_equal(np.isnan(batch.lat_rad), batch.missing)
    good = ~batch.missing & ~batch.outlier
    error = (batch.v_n - TRUTH[3])[good]
    assert_variance(error, FULL.sigma_v**2)
    position = (batch.error_m / np.sqrt(FULL.sigma_m**2 + FULL.markov_sigma_m**2))[good]
    cross = position.T @ (error / FULL.sigma_v) / len(error)
    assert np.abs(cross).max() < 5.0 / np.sqrt(len(error))


def test_sigmas_as_stated(batch):
    np.testing.assert_allclose(
        batch.sigma_m[3, 7], np.sqrt(FULL.sigma_m**2 + FULL.markov_sigma_m**2)
    )
    np.testing.assert_allclose(batch.sigma_v[3, 7], FULL.sigma_v)
    boast = GnssErrorModel(sigma_m=5.0, sigma_v=1.0, stated_sigma_m=0.5, stated_sigma_v=[1, 2, 3])
    fixes = observe_jit(boast, KEY, TIME, *TRUTH)
    np.testing.assert_array_equal(fixes.sigma_m, np.full((M, 3), 0.5))
    np.testing.assert_array_equal(fixes.sigma_v, np.tile([1.0, 2.0, 3.0], (M, 1)))
    assert np.std(fixes.error_m) > 4.0


def test_outages_and_losses(batch):
    out = np.any([(a <= TIME) & (b > TIME) for a, b in GAPS], axis=0)
    assert 20 < out.sum() < 40
    assert np.all(batch.missing[:, out])
    lost = batch.missing[:, ~out]
    low, high = binom.ppf([1e-4, 1 - 1e-4], lost.size, 0.1)
    assert low <= lost.sum() <= high
    # One by one: the counts of the runs spread like a binomial.
    assert_variance((lost.sum(1) - 0.1 * lost.shape[1])[:, None], 0.09 * lost.shape[1])


def test_gross_errors_have_their_share_and_size(batch):
    low, high = binom.ppf([1e-4, 1 - 1e-4], batch.outlier.size, 0.05)
    assert low <= batch.outlier.sum() <= high
    size = np.linalg.norm((batch.v_n - TRUTH[3]) / FULL.sigma_v, axis=-1)
    hit = batch.outlier & ~batch.missing
    # White noise in three axes about a point at 30 sigma: mean of the squares 30^2 + 3.
    mean, sigma = 903.0, np.sqrt(4.0 * 900.0 + 6.0)
    assert abs(np.mean(size[hit] ** 2) - mean) < 4.0 * sigma / np.sqrt(hit.sum())
    assert size[~batch.outlier & ~batch.missing].max() < 6.5
    direction = ((batch.v_n - TRUTH[3]) / FULL.sigma_v / size[..., None])[hit]
    assert np.abs(direction.mean(0)).max() < 5.0 / np.sqrt(3.0 * hit.sum())
    assert_variance(direction, 1.0 / 3.0)
    assert np.all(np.linalg.norm(batch.error_m / FULL.sigma_m, axis=-1)[hit] > 10.0)


def test_a_run_alone_is_that_of_the_batch(batch):
    alone = observe_jit(FULL, stream(8, 9, Component.GNSS), TIME, *TRUTH)
    for name, got in alone._asdict().items():
        np.testing.assert_allclose(
            got, getattr(batch, name)[9], rtol=1e-12, atol=1e-9, equal_nan=True, err_msg=name
        )


def test_losses_and_length_leave_the_other_fixes_as_they_are():
    whole = observe_jit(GnssErrorModel(sigma_m=2.0, sigma_v=1.0), KEY, TIME, *TRUTH)
    lossy = GnssErrorModel(sigma_m=2.0, sigma_v=1.0, drop_share=0.5, outages_s=[(20.0, 50.0)])
    some = observe_jit(lossy, KEY, TIME, *TRUTH)
    there = ~np.asarray(some.missing)
    assert 10 < there.sum() < 80
    np.testing.assert_array_equal(np.asarray(some.v_n)[there], np.asarray(whole.v_n)[there])
    np.testing.assert_array_equal(np.asarray(some.lat_rad)[there], np.asarray(whole.lat_rad)[there])
    short = observe_jit(lossy, KEY, TIME[:40], *(x[:40] for x in TRUTH))
    np.testing.assert_array_equal(short.error_m, np.asarray(some.error_m)[:40])
    np.testing.assert_array_equal(short.missing, np.asarray(some.missing)[:40])


def test_the_lever_arm_is_used():
    t = 1.0
    truth = [np.asarray(x)[None] for x in truth_at(t)]
    model = GnssErrorModel(sigma_m=0.0, sigma_v=0.0, lever_b_m=LEVER)
    fixes = observe_jit(model, KEY, np.array([t]), *truth)
    wanted = antenna(*truth, LEVER)
    for got, true, tolerance in zip(fixes[:4], wanted, (1e-15, 1e-15, 3e-9, 1e-12), strict=True):
        np.testing.assert_allclose(got, true, rtol=0.0, atol=tolerance)
    moved = Geodetic(*map(jnp.asarray, truth[:3])).local(Geodetic(*wanted[:3]))
    np.testing.assert_allclose(np.linalg.norm(moved), np.linalg.norm(LEVER), rtol=1e-5)


def test_times_of_the_fixes():
    model = GnssErrorModel(sigma_m=1.0, rate_hz=5.0, time_offset_s=0.07, latency_s=0.3)
    times = fix_times(model, 0.3, 1.4)
    np.testing.assert_allclose(times.stamp_s, [0.4, 0.6, 0.8, 1.0, 1.2, 1.4])
    np.testing.assert_allclose(times.stamp_s - times.valid_s, 0.07)
    np.testing.assert_allclose(times.arrival_s - times.stamp_s, 0.3)
    hour = fix_times(GnssErrorModel(sigma_m=1.0, rate_hz=10.0), 0.0, 3600.0)
    assert len(hour.stamp_s) == 36001
    with pytest.raises(ValueError, match="the end is before the start"):
        fix_times(model, 2.0, 1.0)


def test_a_table_holds_the_fixes_there_are(batch):
    one = jax.tree.map(lambda x: x[4], batch)
    table = as_table(one, TIME, start_ns=10**18)
    there = ~one.missing
    assert len(table) == there.sum()
    assert table.time_ns.dtype == np.int64
    np.testing.assert_array_equal(table.time_ns - 10**18, np.rint(TIME[there] * 1e9))
    np.testing.assert_array_equal(table.alt_m, one.alt_m[there])
    np.testing.assert_array_equal(table.sigma_v, one.sigma_v[there])
    assert not np.isnan(table.v_n).any()
    with pytest.raises(ValueError, match="give those of one run"):
        as_table(batch, TIME)


def test_no_fixes_are_no_fixes():
    fixes = observe(FULL, KEY, TIME[:0], *(x[:0] for x in TRUTH))
    assert fixes.lat_rad.shape == (0,)
    assert len(as_table(fixes, TIME[:0])) == 0


@pytest.mark.parametrize(
    ("errors", "message"),
    [
        ({"sigma_m": [1.0, 2.0]}, r"sigma_m must be a number or of shape \(3,\)"),
        ({"sigma_m": -1.0}, "sigma_m must be a finite number from 0, got -1.0"),
        ({"sigma_m": np.nan}, "sigma_m must be a finite number"),
        ({"sigma_v": np.inf}, "sigma_v must be a finite number"),
        ({"markov_sigma_m": 1.0}, "belong together"),
        (
            {"markov_sigma_m": 1.0, "markov_tau_s": 0.0},
            "markov_tau_s must be a finite number",
        ),
        ({"stated_sigma_v": 1.0}, "stated_sigma_v without sigma_v"),
        ({"lever_b_m": [0.0, np.nan, 0.0]}, "lever_b_m must be a finite number"),
        ({"drop_share": 1.5}, "drop_share must be a finite number from 0 to 1, got 1.5"),
        ({"outlier_share": -0.1}, "outlier_share must be a finite number from 0 to 1"),
        ({"outlier_size": np.nan}, "outlier_size must be a finite number"),
        ({"latency_s": -0.1}, "latency_s must be a finite number from 0"),
        ({"rate_hz": 0.0}, "rate_hz must be a finite number above 0"),
        ({"outages_s": [(3.0, 3.0)]}, "an outage from 3 s to 3 s ends too early"),
        ({"outages_s": [(3.0, 4.0, 5.0)]}, "outages_s must be pairs"),
    ],
)
def test_bad_models_are_refused(errors, message):
    with pytest.raises(ValueError, match=message):
        GnssErrorModel(**({"sigma_m": 1.0} | errors))


def test_models_without_outages():
    assert GnssErrorModel(sigma_m=1.0, outages_s=[]).outages_s is None


@pytest.mark.parametrize("which", range(7))
def test_shapes_that_do_not_fit_are_refused(which):
    given = [TIME, *TRUTH]
    given[which] = given[which][:, None] if which == 0 else given[which][:-1]
    name = ("valid_s", "lat_rad", "lon_rad", "alt_m", "v_n", "q_nb", "omega_ib_b")[which]
    with pytest.raises(ValueError, match=f"{name} must have shape"):
        observe(FULL, KEY, *given)
