"""The satellite in closed loop: what it does, also when something fails, and what it refuses."""

import sys

import jax
import numpy as np
import pytest
from interpreted import run
from satellite_runs import ARCSEC, flown, parsed, problem

from robins.campaign import worlds
from robins.campaign.bound import bound
from robins.filters import run_closed
from robins.scenario import ScenarioError
from robins.systems.satellite import SYSTEM
from robins.systems.satellite.design import axis_design

SHORT = ('duration="120 s"', 'counted_from="60 s"')


@pytest.fixture(scope="module")
def mekf():
    return flown("s1", "mekf", 4, SHORT)


def test_it_settles_and_points(mekf):
    assert np.max(np.abs(mekf.error[:, mekf.counted, :2])) < 25.0
    end = mekf.pointing[:, -200:]
    assert np.sqrt(np.mean(end**2)) < 40.0  # arcsec; begun with 60 unknown to it
    assert np.max(np.abs(mekf.wheel_momentum)) < 0.02
    used = mekf.used[0].reshape(-1, 5)  # 2 Hz of 10
    assert not np.any(used[:, :4])
    assert np.all(used[:, 4])


def test_the_additive_filter_is_the_multiplicative_one(mekf):
    other = flown("s1", "ekf-quaternion", 4, SHORT)
    # to a few counts of the gyro, 0.05 arcsec, for in a loop a count may fall on either side
    np.testing.assert_allclose(other.error, mekf.error, atol=0.15)
    np.testing.assert_allclose(other.pointing, mekf.pointing, atol=0.15)


def closed_loop(p):
    """One run of a problem in closed loop: contender, world, case, and what came of it."""
    ((batch, _),) = worlds(p, 1)
    c, world = p.contenders["mekf"], jax.tree.map(lambda x: x[0], batch)
    it = c.case(world)
    return c, world, it, run_closed(c.filter, c.model, it.start, it.loop, _mean)


def _mean(step):
    return step.posterior.mean


def test_a_run_over_its_measurements_gives_the_same_estimates():
    c, _, it, closed = closed_loop(problem("s1", ("mekf",), SHORT))
    again = run(c.filter, c.model, it.start, closed.readings.y, closed.readings.u)
    for a, b in zip(*map(jax.tree.leaves, (closed.steps, again.mean)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_a_star_sensor_that_is_stuck_reports_one_attitude_again_and_again():
    stuck = 'star.faults=[{kind="stuck", begin="20.2 s", end="39.8 s"}]'
    *_, closed = closed_loop(problem("s1", ("mekf",), (*SHORT, stuck)))
    (frames,) = jax.tree.leaves(closed.readings.y["star"])
    heard = frames[4::5]  # every half second
    again = np.all(heard[1:] == heard[:-1], axis=1)
    np.testing.assert_array_equal(0.5 * (np.flatnonzero(again) + 2), np.arange(20.5, 39.6, 0.5))


def test_momentum_is_conserved_without_environment():
    # no field, so no torque of the magnetorquers; no gravity: the orbit is far away
    given = parsed("s2", (*SHORT, 'craft.disturbance="0 N m"'))
    far = given.orbit.model_copy(update={"altitude": 1e12})  # beyond what a scenario may say
    given = given.model_copy(update={"orbit": far})
    p = SYSTEM.studies["attitude-loop"].problem(given, ("mekf",), 0)
    _, world, _, closed = closed_loop(p)
    moved = np.asarray(closed.world.craft.momentum_i - world.craft.momentum_i)
    assert np.max(np.abs(moved)) < 1e-15
    assert np.max(np.abs(closed.world.craft.wheel_h)) > 1e-3  # and yet it slews


def test_stars_are_tracked_and_say_how_sure_they_are():
    """A camera with false stars and missed ones; the covariance of each frame is the filter's R."""
    stars = flown("stars", "mekf", 4, SHORT)
    assert np.all(stars.used[:, 4::5])
    at = slice(700, None)
    assert abs(np.mean(stars.nees[:, at]) - 1.0) < 0.35
    assert np.sqrt(np.mean(stars.error[:, at, :2] ** 2)) < 4.0  # a star is off by 20
    # fewer stars, another sigma: what is stated is not the same from frame to frame
    assert np.ptp(stars.sigma[:, at, 2]) > 0.5


# ------------------------------------------------------------------------------------- what fails


def test_without_stars_it_goes_on_by_gyro(mekf):
    lost = flown("s1", "mekf", 4, (*SHORT, 'star.lost=[{begin="60 s", end="110 s"}]'))
    before, away = slice(0, 599), slice(600, 1099)
    np.testing.assert_allclose(lost.error[:, before], mekf.error[:, before], atol=1e-6)
    assert not np.any(lost.used[:, away])
    assert np.all(np.diff(lost.sigma[0, away, 0]) > 0.0)  # it knows
    assert np.max(np.abs(lost.error[:, away] / lost.sigma[:, away])) < 5.0
    assert np.sqrt(np.mean(lost.error[:, 1195:] ** 2)) < 15.0  # and finds back


def test_a_lost_wheel(mekf):
    known = flown("s1", "mekf", 4, (*SHORT, "wheels.lost=[0]"))
    assert np.all(known.wheel_momentum[:, :, 0] == 0.0)
    assert known.points < 1.5 * mekf.points
    unknown = (*SHORT, "wheels.lost=[0]", "wheels.loss_known=false")
    unknown = flown("s1", "mekf", 4, unknown)
    assert np.all(unknown.wheel_momentum[:, :, 0] == 0.0)
    assert unknown.points > known.points  # a quarter of the torque about x is missing


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (('star.period="0.25 s"',), "must be a multiple of step"),
        (('counted_from="1500 s"',), "leaves nothing to count of a run of 1500 s"),
        (("wheels.lost=[4]",), "there is no wheel 4, only 0 to 3"),
        (('wheels.start="0.2 N m s"',), "is beyond what a wheel holds, 0.1 N m s"),
        (("wheels.axes=[[0,0,0]]",), "wheel 0 has none"),
        (('gyro.rate_walk="5 deg/h"',), "arcsec/s/sqrt"),
    ],
)
def test_parameters_that_cannot_be(settings, words):
    with pytest.raises(ScenarioError, match=words):
        parsed("s1", settings)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (('craft.moments=["1 kg m^2","1 kg m^2","3 kg m^2"]',), "none is greater than the sum"),
        (("wheels.lost=[0, 1]",), "2 independent axes, and three are needed"),
    ],
)
def test_craft_that_cannot_be(settings, words):
    with pytest.raises(ValueError, match=words):
        problem("s1", ("mekf",), settings)


def test_unknown_filter():
    with pytest.raises(
        ValueError, match=r"no filter 'ekf' in this study; did you mean 'mekf'\? It has raw, mekf,"
    ):
        problem("s1", ("ekf",))


def test_a_design_without_its_solver(monkeypatch):
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    axis_design.cache_clear()
    with pytest.raises(
        ValueError, match=r"'mixed-lmi': .* pip install 'robins\[design\]'.*--filters"
    ):
        problem("s1", ("mixed-lmi",), SHORT)


def test_the_covariance_bound_of_the_loop(mekf):
    found = bound(problem("s1", ("mekf",), SHORT), "mekf")
    sigma = np.asarray(found["bound_attitude"])[-5:] / ARCSEC
    # what a steady Kalman filter states at its frames and between them
    np.testing.assert_allclose(sigma, mekf.sigma[0, -5:], rtol=1e-3)
