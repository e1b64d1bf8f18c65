"""A filter in the loop: the same as a run over what the world answered, and the world answers."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from interpreted import run

from robins.filters import (
    Belief,
    Code,
    Loop,
    Model,
    Motion,
    Reading,
    Sensor,
    adaptive,
    kalman,
    run_closed,
)
from robins.filters.rules import Infeasible, constant_gain, gate, h_infinity, with_gains

DT, STEPS, EVERY = 0.1, 500, 5
F = jnp.array([[1.0, DT], [0.0, 1.0]])
G = jnp.array([0.5 * DT * DT, DT])
MODEL = Model(
    Motion(lambda x, u: F @ x + G * u, jnp.array([0.0, 0.02])),
    (Sensor(lambda x, aux: x[:1], jnp.array([0.3]), 1, "seen"),),
)
START = Belief.of(jnp.array([0.0, 0.0]), np.diag([1.0, 0.25]))


class Row(NamedTuple):
    push: jax.Array  # () noise of the motion
    noise: jax.Array  # (1,) of the sensor


def react(target, x, belief, row):
    """A cart that is steered to the target by what is believed of it."""
    u = -0.5 * (belief.mean[0] - target) - 1.0 * belief.mean[1]
    x = F @ x + G * u + jnp.stack([0.0 * row.push, 0.02 * row.push])
    return x, Reading(u, {"seen": x[:1] + 0.3 * row.noise}, x, outputs={"push": u})


def loop(target=3.0, due=True):
    rng = np.random.default_rng(4)
    rows = Row(rng.normal(size=STEPS), rng.normal(size=(STEPS, 1)))
    when = {"seen": np.arange(1, STEPS + 1) % EVERY == 0} if due else {}
    return Loop(jax.tree_util.Partial(react, target), jnp.array([1.0, 0.0]), rows, when)


@pytest.fixture(scope="module")
def closed():
    return run_closed(kalman(), MODEL, START, loop())


def test_a_bank_states_what_is_wrong_where_no_sensor_is_due():
    """As a run over the same readings, which are missing there."""
    bank = adaptive((1.0, 8.0))
    closed = run_closed(bank, MODEL, START, loop())
    due = np.arange(1, STEPS + 1) % EVERY == 0
    y = jnp.where(jnp.asarray(due)[:, None], closed.readings.y["seen"], jnp.nan)
    found = run(bank, MODEL, START, y, closed.readings.u)
    noted, wanted = (steps.info["seen"].notes["imm.wrong"] for steps in (closed.steps, found.steps))
    np.testing.assert_allclose(noted, wanted, rtol=1e-9, atol=1e-14)
    assert np.all(np.asarray(noted) > 0.0)


def test_equals_a_run_over_what_the_world_answered(closed):
    due = np.arange(1, STEPS + 1) % EVERY == 0
    y = jnp.where(jnp.asarray(due)[:, None], closed.readings.y["seen"], jnp.nan)
    again = run(kalman(), MODEL, START, y, closed.readings.u)
    np.testing.assert_allclose(closed.steps.posterior.mean, again.mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(closed.steps.posterior.covariance, again.covariance, atol=1e-13)
    info, other = closed.steps.info["seen"], again.steps.info["seen"]
    for name in ("innovation", "nis", "dof", "used", "code", "factor", "gain"):
        np.testing.assert_allclose(
            getattr(info, name), getattr(other, name), atol=1e-12, err_msg=name
        )
    assert np.sum(info.code == Code.DONE) == STEPS // EVERY


def test_the_estimate_steers(closed):
    assert abs(closed.readings.truth[-1, 0] - 3.0) < 0.5
    assert abs(closed.world[0] - closed.readings.truth[-1, 0]) == 0.0
    elsewhere = run_closed(kalman(), MODEL, START, loop(target=-3.0))
    assert abs(elsewhere.readings.truth[-1, 0] + 3.0) < 0.5
    # by hand, in NumPy
    x, rows = np.array([1.0, 0.0]), loop().rows
    believed = np.concatenate([[START.mean], closed.steps.posterior.mean[:-1]])
    for k in range(STEPS):
        u = -0.5 * (believed[k, 0] - 3.0) - believed[k, 1]
        x = np.asarray(F) @ x + np.asarray(G) * u + [0.0, 0.02 * rows.push[k]]
        np.testing.assert_allclose(closed.readings.truth[k], x, atol=1e-12)
        np.testing.assert_allclose(closed.readings.outputs["push"][k], u, atol=1e-12)


def test_runs_batch():
    targets = jnp.array([3.0, -3.0])
    batch = jax.vmap(lambda t: run_closed(kalman(), MODEL, START, loop(t)).readings.truth)(targets)
    alone = run_closed(kalman(), MODEL, START, loop(-3.0)).readings.truth
    np.testing.assert_allclose(batch[1], alone, atol=1e-12)


def test_what_does_not_fit_is_named():
    with pytest.raises(ValueError, match=r"no sensor \['heard'\]; this model has \['seen'\]"):
        run_closed(kalman(), MODEL, START, loop()._replace(due={"heard": np.ones(STEPS, bool)}))
    with pytest.raises(ValueError, match="must have one length, got"):
        run_closed(kalman(), MODEL, START, loop()._replace(due={"seen": np.ones(3, bool)}))

    def heard(x, belief, row):
        return x, Reading(jnp.zeros(()), {"heard": x[:1]}, x)

    with pytest.raises(ValueError, match=r"no sensor \['heard'\]; this model has \['seen'\]"):
        run_closed(kalman(), MODEL, START, loop()._replace(react=heard))


def test_rules_report_as_in_a_run():
    """An H-infinity bound that cannot be met is an error, with the time, and not a silent code."""
    strict = kalman(rules=[h_infinity(0.05, jnp.eye(2), policy="raise")])
    time_s = DT * np.arange(1, STEPS + 1)
    with pytest.raises(Infeasible, match="gamma") as of_loop:
        run_closed(strict, MODEL, START, loop(due=False), time_s=time_s)
    readings = run_closed(kalman(), MODEL, START, loop(due=False)).readings
    with pytest.raises(Infeasible) as of_run:
        run(strict, MODEL, START, readings.y, readings.u, time_s=time_s)
    assert str(of_loop.value) == str(of_run.value)


# ------------------------------------------------------------------------------ a constant gain

GAIN = np.array([[0.2], [0.07]])
FIXED = kalman(rules=[constant_gain({"seen": GAIN})])


def fixed(gain, y):
    """A run of the one filter begun with another gain, which is data."""
    begun = with_gains(FIXED.init(START, MODEL.dims), {"seen": jnp.asarray(gain)})
    return run(FIXED, MODEL, begun, y, np.zeros(STEPS))


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_a_constant_gain_states_its_own_covariance(share):
    y = np.random.default_rng(1).normal(size=(STEPS, 1))
    y[7] = np.nan
    found = run(FIXED, MODEL, START, y, np.zeros(STEPS)) if share == 1.0 else fixed(share * GAIN, y)
    x, P = np.zeros(2), np.diag([1.0, 0.25])
    Q, H, A = np.diag([0.0, 0.02**2]), np.array([[1.0, 0.0]]), np.asarray(F)
    for k in range(STEPS):
        x, P = A @ x, A @ P @ A.T + Q
        if np.isfinite(y[k, 0]):
            x = x + share * GAIN @ (y[k] - H @ x)
            I_KH = np.eye(2) - share * GAIN @ H
            P = I_KH @ P @ I_KH.T + 0.09 * share**2 * GAIN @ GAIN.T
        np.testing.assert_allclose(found.mean[k], x, atol=1e-13)
        np.testing.assert_allclose(found.covariance[k], P, atol=1e-13)
    np.testing.assert_allclose(found.steps.info["seen"].gain[8], share * GAIN)


def test_a_steady_kalman_gain_is_the_kalman_filter():
    y = np.random.default_rng(2).normal(size=(STEPS, 1))
    best = run(kalman(), MODEL, START, y, np.zeros(STEPS))
    same = fixed(best.steps.info["seen"].gain[-1], y)
    np.testing.assert_allclose(same.mean[-1], best.mean[-1], atol=1e-6)
    np.testing.assert_allclose(same.covariance[-1], best.covariance[-1], rtol=1e-6)


def test_a_gate_before_it_refuses():
    y = np.zeros((3, 1))
    y[1] = 50.0
    guarded = kalman(rules=[gate(), constant_gain({"seen": GAIN})])
    found = run(guarded, MODEL, START, y, np.zeros(3))
    assert found.steps.info["seen"].code.tolist() == [Code.DONE, Code.REFUSED, Code.DONE]
    assert np.max(np.abs(found.mean)) == 0.0


def test_gains_are_data():
    y = np.ones((STEPS, 1))
    assert jax.eval_shape(lambda gain: fixed(gain, y).mean, GAIN).shape == (STEPS, 2)
    assert np.max(np.abs(fixed(np.zeros((2, 1)), y).mean)) == 0.0
    with pytest.raises(ValueError, match="the filter was begun with"):
        with_gains(FIXED.init(START, MODEL.dims), {"seen": np.zeros((3, 1))})
    with pytest.raises(ValueError, match="no constant_gain rule"):
        with_gains(kalman().init(START, MODEL.dims), {"seen": GAIN})
