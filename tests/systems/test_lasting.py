"""Errors of positions that last from fix to fix: found from a log, and carried as a state."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from short_drive import DRIVE

from robins import logs, scenario
from robins.dataset import GnssTable
from robins.earth import curvature_radii
from robins.manifold import local, retract
from robins.results import ignore_progress
from robins.systems.ins_gnss import Drive, InsGnssReplay, drive_dataset
from robins.systems.ins_gnss.correlated_errors import MOST, scatter, with_correlated_share
from robins.systems.ins_gnss.log import WEIGHED, prepare, recorded
from robins.systems.ins_gnss.model import POSITION, Fix, ins_gnss_model
from robins.systems.ins_gnss.recording import on_one_clock
from robins.systems.ins_gnss.robust import AS_TOLD, augmented_belief, hypothesis_model
from robins.systems.replaying import run_filters

SIGMA_M, STEP_S, SHARE, TIME_S = 2.0, 0.25, 0.95, 50.0


@pytest.fixture(scope="module")
def log():
    return logs.clean(drive_dataset(scenario.parse(Drive, DRIVE), seed=3, run=0))


def errors(share, count=2000):
    """(count, 3) of unit variance, of which a share is first-order Gauss-Markov."""
    z, white = np.random.default_rng(2).normal(size=(2, count, 3))
    left = np.exp(-STEP_S / TIME_S)
    for k in range(1, count):
        z[k] = left * z[k - 1] + np.sqrt(1.0 - left**2) * z[k]
    return np.sqrt(share) * z + np.sqrt(1.0 - share) * white


def driven(log, share, velocities):
    """A log of a bend at 10 m/s, with such errors of its positions."""
    off = SIGMA_M * errors(share)
    t = STEP_S * np.arange(1, len(off) + 1)
    v_n = 10.0 * np.stack([np.cos(t / 20.0), np.sin(t / 20.0), np.zeros_like(t)], -1)
    r_n = 200.0 * np.stack([np.sin(t / 20.0), -np.cos(t / 20.0), 0.0 * t], -1) + off
    meridian, transverse = (float(r) for r in curvature_radii(np.array(0.8)))
    lat = 0.8 + r_n[:, 0] / meridian
    lon = 0.2 + r_n[:, 1] / (transverse * np.cos(lat))
    sigma = np.full_like(r_n, SIGMA_M)
    gnss = GnssTable(np.round(t * 1e9).astype(np.int64), lat, lon, -r_n[:, 2], sigma)
    shown = on_one_clock(log, InsGnssReplay())
    v = v_n if velocities else None
    return shown._replace(
        gnss=gnss, gnss_s=t, sigma_m=sigma, v_n=v, sigma_v=v, withheld=np.zeros(len(t), bool)
    )


@pytest.mark.parametrize("velocities", [False, True], ids=["positions", "velocities"])
@pytest.mark.parametrize("share", [0.0, 0.5, SHARE])
def test_the_scatter_is_that_of_the_white_part(log, share, velocities):
    made = driven(log, share, velocities)
    white = np.sqrt(1.0 - share)
    found = scatter(made)
    np.testing.assert_allclose(found, np.hypot(white, np.sqrt(share) * 0.03), rtol=0.08)
    told, notes = with_correlated_share(InsGnssReplay(), made)
    expected = 0.0 if share == 0.0 else share
    assert told.gnss.lasting_share == pytest.approx(expected, abs=0.09)
    assert len(notes) == (share > 0.0)


def test_few_fixes_and_a_stated_share_are_left_alone(log):
    made = driven(log, MOST, velocities=False)
    few = made._replace(withheld=np.arange(2000) > 100)
    assert scatter(few) is None
    assert with_correlated_share(InsGnssReplay(), few)[0].gnss.lasting_share == 0.0
    stated = scenario.parse(InsGnssReplay, "[gnss]\nlasting_share = 0.2\n")
    assert with_correlated_share(stated, made) == (stated, [])


def test_the_start_shares_the_error_of_its_fix(log):
    """The fix that the start is taken from reads with the white part of its variance alone."""
    parameters = InsGnssReplay()
    whole = on_one_clock(log, parameters)
    start = prepare(whole, parameters, slice(0, len(whole.time_s))).world.start
    own_m, fix_m = parameters.start.position, whole.sigma_m[0]
    belief = augmented_belief(start, True, jnp.array([SHARE, TIME_S]), own_m)
    P, n = np.asarray(belief.factor @ belief.factor.T), len(start.factor)
    np.testing.assert_allclose(np.diag(P)[n : n + 3], 1.0, rtol=1e-12)
    H = np.zeros((3, len(P)))
    H[:, 6:9], H[:, n : n + 3] = np.eye(3), np.sqrt(SHARE) * np.diag(fix_m)
    read = own_m**2 + (1.0 - SHARE) * fix_m**2
    np.testing.assert_allclose(H @ P @ H.T, np.diag(read), rtol=1e-9, atol=1e-12)


def test_motion_and_reading_have_the_slopes_of_finite_differences(log):
    parameters = InsGnssReplay()
    own = ins_gnss_model(parameters.imu, parameters.gnss, parameters.aids)
    whole = on_one_clock(log, parameters)
    world = prepare(whole, parameters, slice(0, len(whole.time_s))).world
    u = jax.tree_util.tree_map(lambda a: jnp.asarray(a)[3], world.u)
    lasting = jnp.array([SHARE, TIME_S])
    model = hypothesis_model(own, AS_TOLD, lasting)
    belief = augmented_belief(world.start, True, lasting, parameters.start.position)
    x = belief.mean._replace(lasting=jnp.array([1.0, -2.0, 0.5]))
    n = len(world.start.factor)
    assert model.motion.linear is not None
    new, Phi, noise = model.motion.linear(x, u)
    left = np.exp(-float(np.sum(u.increments.dt)) / TIME_S)
    np.testing.assert_allclose(new.lasting, left * np.asarray(x.lasting), rtol=1e-12)
    z = slice(n, n + 3)
    P = (
        np.asarray(Phi)[z, z] @ np.asarray(Phi)[z, z].T
        + np.asarray(noise)[z] @ np.asarray(noise)[z].T
    )
    np.testing.assert_allclose(P, np.eye(3), atol=1e-12)
    (sensor,) = [s for s in model.sensors if s.name == POSITION]
    fix = Fix(jnp.array([1.0, 2.0, 3.0]), jnp.zeros(3))
    moved = retract(x, jnp.zeros(len(Phi)).at[n + 1].set(0.1))
    slope = np.asarray(local(sensor.read(x, fix), sensor.read(moved, fix))) / 0.1
    np.testing.assert_allclose(slope, [0.0, 2.0 * np.sqrt(SHARE), 0.0], atol=1e-6)
    white = np.asarray(sensor.noise(x, fix))
    np.testing.assert_allclose(white, np.sqrt(1.0 - SHARE) * np.array([1.0, 2.0, 3.0]), rtol=1e-12)


def test_the_stated_sigma_does_not_fall_below_what_lasts(log):
    """One error for the whole drive: the sigma of a filter that averages it away does not hold."""
    g = log.gnss
    off = replace(log, gnss=replace(g, lat_rad=g.lat_rad + 1.0 / 6.3644e6))
    sigma, away = [], []
    for share in (0.0, SHARE):
        parameters = scenario.parse(InsGnssReplay, f"[gnss]\nlasting_share = {share}\n")
        (piece,), of = recorded(off, parameters)
        answer = run_filters([piece], [WEIGHED], of, {}, ignore_progress)[WEIGHED]
        sigma.append(float(answer.sigma[-1, 6]))
        truth = np.interp(piece.epoch_s[-1], log.truth.time_ns * 1e-9, log.truth.lat_rad)
        away.append(abs(float(answer.mean.ins.position.lat[-1]) - truth) * 6.3644e6 / sigma[-1])
    assert sigma[0] < 0.25
    assert 0.35 < sigma[1] < 0.6
    assert away[1] < 3.0 < away[0]
