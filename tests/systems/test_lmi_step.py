"""The filter that solves its LMI at every star frame: its gains, what it tells, what it cannot."""

import math
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from satellite_runs import problem
from scipy.spatial.transform import Rotation as Scipy

from robins.campaign import worlds
from robins.campaign.machine import JaxMachine, machine_for
from robins.errors import RobinsError
from robins.filters import OnlineFilter, StepWarning, run_closed
from robins.filters.synthesis import EveryStep, NotCertified, current_form, kalman_design, observer
from robins.program import ProgramError
from robins.systems import SYSTEMS
from robins.systems.satellite import SYSTEM, design, stepwise
from robins.systems.satellite.design import GainSpec, SensorNoise
from robins.systems.satellite.nodes import STAR
from robins.workbench import InputError
from robins.workbench.export import export_filter
from robins.workbench.scenarios import read_scenario

ARCSEC = math.pi / 648000.0
NAME = "mixed-lmi-step"
T, DT, WALK, RATE_WALK = 0.5, 0.1, 1.2, 0.025
SIGMA = (10.0, 10.0, 40.0)
BELIEVED = SensorNoise(
    WALK * ARCSEC, RATE_WALK * ARCSEC, T, (SIGMA[0] * ARCSEC, SIGMA[1] * ARCSEC, SIGMA[2] * ARCSEC)
)
SPEC = GainSpec("lmi", 0.5)
RATES = ([0.0, 0.0, 0.0], [0.01, -0.02, 0.005], [0.4, 0.3, -0.5])
SOLVER = 2e-6  # what its answer differs by where the last digit of the plant does
SHORT = ('duration="12 s"', 'counted_from="5 s"')
SLEWS = (
    'slew.angle=["40 deg", "30 deg", "20 deg"]',
    'slew.period=["30 s", "25 s", "20 s"]',
    'slew.grows="0 s"',
)
FRAMES = np.arange(4, 120, 5)


def blocks(rate_b, share):
    """The plant written down once more: transition, noise, error over its bound, star noise."""
    A = np.eye(6)
    A[:3, :3] = Scipy.from_rotvec(-T * np.array(rate_b)).as_matrix()
    A[:3, 3:] = -T * np.eye(3)
    a, r = WALK**2, RATE_WALK**2
    axis = np.array([[a * T + r * T**3 / 3, -r * T**2 / 2], [-r * T**2 / 2, r * T]])
    error = np.zeros((6, 3))
    for i, star in enumerate(SIGMA):
        one = current_form(
            [[1.0, -T], [0.0, 1.0]],
            scipy.linalg.cholesky(axis, lower=True),
            [[T], [0.0]],
            [[1.0, 0.0]],
            [[star]],
            L=[[1.0, 0.0]],
        )
        error[i, i] = T / (share * kalman_design(one).hinf)
    return A, np.kron(axis, np.eye(3)), error, np.diag(SIGMA)


def close(gain, wanted, share):
    """Equality to a share of the largest, of the attitude's gains and of those of the bias."""
    for rows in (slice(0, 3), slice(3, 6)):
        size = np.max(np.abs(wanted[rows]))
        np.testing.assert_allclose(gain[rows], wanted[rows], rtol=0, atol=share * size)


def gain_at(rate_b, spec=SPEC):
    gain, passed = stepwise.gain_at(np.array(rate_b), stepwise.frozen(BELIEVED, spec, DT))
    assert passed
    return gain


def test_at_rest_it_is_the_design_of_each_axis():
    close(gain_at(RATES[0]), design.gain(BELIEVED, SPEC), 2e-3)


@pytest.mark.parametrize("rate_b", RATES)
def test_a_gain_is_that_of_a_design_beforehand_for_the_plant_of_the_step(rate_b):
    A, Q, error, star = blocks(rate_b, 0.5)
    seen = np.eye(3, 6)
    plant = current_form(A, np.linalg.cholesky(Q), error, seen, star, L=seen)
    close(gain_at(rate_b), observer(plant, 1.0).gain, 2e-3)


@pytest.mark.parametrize("rate_b", RATES)
def test_without_a_bound_it_is_the_kalman_gain(rate_b):
    A, Q, _, star = blocks(rate_b, 1.0)
    C, R = np.eye(3, 6), star @ star
    P = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R)
    wanted = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
    close(gain_at(rate_b, GainSpec("lmi", 1e3)), wanted, 5e-3)


@pytest.mark.parametrize("rate_b", RATES)
def test_the_worst_case_is_within_its_bound(rate_b):
    A, _, error, _ = blocks(rate_b, 0.5)
    left = np.eye(6) - gain_at(rate_b) @ np.eye(3, 6)
    z = np.exp(1j * np.concatenate([np.geomspace(1e-5, 0.1, 400), np.linspace(0.1, np.pi, 200)]))
    answers = np.linalg.solve(z[:, None, None] * np.eye(6) - left @ A, left @ error)
    peak = np.max(np.linalg.svd(answers[:, :3], compute_uv=False))
    assert 0.5 < peak <= 1.0 + 1e-6


def test_a_gain_depends_on_its_arguments_alone():
    first = gain_at(RATES[1]).tobytes()
    gain_at(RATES[2])
    assert gain_at(RATES[1]).tobytes() == first
    stepwise._designer.cache_clear()
    gain_at(RATES[2], GainSpec("lmi", 0.7))
    assert gain_at(RATES[1]).tobytes() == first


# ------------------------------------------------------------------------------------- in the loop


def kept(step):
    star = step.info[STAR]
    q = [of.mean.attitude.wxyz for of in (step.prediction.belief, step.posterior)]
    return star.gain, star.notes["lmi_step.failed"], *q, step.posterior.mean.gyro_bias


class Flown(NamedTuple):
    contender: Any
    case: Any
    gains: np.ndarray
    failed: np.ndarray
    predicted: np.ndarray
    q_ib: np.ndarray
    bias: np.ndarray
    closed: Any


@cache
def prepared():
    """A problem that slews, its filter, two cases; no cache keeps a program that calls Python."""
    p = problem("s2", (NAME,), (*SHORT, *SLEWS))
    ((batch, _),) = worlds(p, 2)
    c = p.contenders[NAME]
    return p, c, [c.case(jax.tree.map(lambda x, i=i: x[i], batch)) for i in range(2)]


def flown():
    """One run: gains and notes of its steps, attitude before and after the update."""
    _, c, (case, _) = prepared()
    closed = run_closed(c.filter, c.model, case.start, case.loop, kept)
    return Flown(c, case, *map(np.asarray, closed.steps), closed)


def test_every_frame_is_used_with_the_gain_of_the_rate_just_measured():
    it = flown()
    assert not np.any(it.failed)
    assert np.all(np.any(it.gains[FRAMES] != 0.0, axis=(1, 2)))
    assert not np.any(np.delete(it.gains, FRAMES, axis=0))
    of = it.case.start.memory[0].of
    for k in FRAMES[1::6]:
        before = Scipy.from_quat(it.q_ib[k - 1], scalar_first=True)
        rate = (before.inv() * Scipy.from_quat(it.predicted[k], scalar_first=True)).as_rotvec() / DT
        assert np.linalg.norm(rate) > 1e-3
        wanted, _ = stepwise.gain_at(rate, of)
        np.testing.assert_allclose(it.gains[k], wanted, rtol=0, atol=SOLVER)
    apart = np.max(np.abs(it.gains[FRAMES] - it.gains[FRAMES[0]]))
    assert apart > 1e3 * SOLVER  # it follows the rate


def failing(monkeypatch, frames):
    """Let designs of some frames, by their number, not pass."""
    asked, real = [0], EveryStep.__call__

    def call(self, plant):
        asked[0] += 1
        if asked[0] - 1 in frames:
            raise NotCertified("not this one")
        return real(self, plant)

    monkeypatch.setattr(EveryStep, "__call__", call)
    return asked


def test_a_design_that_does_not_pass_leaves_the_last_gain_and_is_told(monkeypatch):
    asked = failing(monkeypatch, {0, 5, 6})
    with pytest.warns(StepWarning, match="3 designs at a star frame did not pass"):
        it = flown()
    assert asked[0] == len(FRAMES)
    assert list(np.flatnonzero(it.failed)) == list(FRAMES[[0, 5, 6]])
    first, *_, fourth, fifth, sixth = it.gains[FRAMES[:7]]
    np.testing.assert_array_equal(first, it.case.start.memory[0].gain)  # the constant one
    np.testing.assert_array_equal(fifth, fourth)
    np.testing.assert_array_equal(sixth, fourth)
    assert int(it.closed.final.memory[0].failed) == 3
    # a sample at a time, with the same failures, it has the same bits
    asked[0] = 0
    online = OnlineFilter(it.contender.filter, it.contender.model, it.case.start)
    given = it.closed.readings
    for k in range(50):
        online.predict(given.u[k])
        if k in FRAMES:
            told = online.update(jax.tree.map(lambda x, k=k: x[k], given.y[STAR]), STAR)
            assert bool(told.notes["lmi_step.failed"]) == it.failed[k]
        np.testing.assert_array_equal(online.belief.mean.attitude.wxyz, it.q_ib[k])
        np.testing.assert_array_equal(online.belief.mean.gyro_bias, it.bias[k])


def test_in_a_batch_each_run_has_its_own_gain():
    _, c, cases = prepared()
    sensor = c.model.sensor(STAR)
    moved = [
        c.filter.predict(case.start, c.model.motion, DT * jnp.array(rate))[0]
        for case, rate in zip(cases, RATES[1:], strict=True)
    ]
    y = [case.start.belief.mean.attitude for case in cases]
    alone = [c.filter.update(*of, None) for of in zip(moved, [sensor] * 2, y, strict=True)]
    both = [jax.tree.map(lambda *x: jnp.stack(x), *of) for of in (moved, y)]
    _, info = jax.vmap(lambda state, y: c.filter.update(state, sensor, y, None))(*both)
    for k, (_, one) in enumerate(alone):
        np.testing.assert_allclose(info.gain[k], one.gain, rtol=0, atol=SOLVER)
    assert np.max(np.abs(info.gain[0] - info.gain[1])) > 1e3 * SOLVER


# -------------------------------------------------------------------------------- what it cannot do


def test_it_is_refused_where_no_python_is(tmp_path):
    p, c, (case, _) = prepared()
    assert isinstance(machine_for(p), JaxMachine)
    with pytest.raises(RobinsError, match=rf"--machine c: filter '{NAME}' .* an LMI in Python"):
        machine_for(p, "c")
    with pytest.raises(InputError, match=rf"filter '{NAME}' cannot be exported: it solves an LMI"):
        export_filter("satellite/s1", tmp_path / "out", filter_name=NAME, settings=SHORT)
    assert not (tmp_path / "out").exists()
    live = OnlineFilter(c.filter, c.model, case.start, "c")
    with pytest.raises(ProgramError, match="'pure_callback' has no place in a program"):
        live.update(case.start.belief.mean.attitude, STAR)


def test_it_runs_only_where_it_is_named():
    study = SYSTEM.studies["attitude-loop"]
    assert study.on_request == (NAME,)
    assert set(study.filters) - set(study.usual) == {NAME}
    for name in SYSTEM.scenarios:
        assert NAME not in read_scenario(f"satellite/{name}", ()).own
    assert NAME in SYSTEMS["satellite"].filters
    one = read_scenario("satellite/s1", ())
    unnamed = one._replace(parameters=one.parameters.model_copy(update={"filters": ()}))
    assert set(unnamed.own) == set(study.filters) - {NAME}
