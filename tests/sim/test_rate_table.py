"""A rate table against an integration of its lag and limits, and what a data sheet would say."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn import rotation
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from robins.sim.rate_table import rate_table, step, table_state

LAG = 0.02
FAST = rate_table()
LIMITED = rate_table([0.02, 0.03, 0.05], [0.5, 1.0, 2.0], [4.0, 2.0, 1.0])
Q0 = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_quat(scalar_first=True)
RATE0 = np.array([0.1, -0.3, 0.2])
STEPS = 64


@jax.jit
def _run(table, state, commands, dt):
    def body(state, command):
        after, q = step(table, state, command, dt)
        return after, (after, q)

    return jax.lax.scan(body, state, commands)[1]


def run(table, commands, dt, start=None):
    """Attitudes and rates after each of STEPS steps."""
    start = table_state(Q0, RATE0) if start is None else start
    states, q = _run(table, start, jnp.asarray(commands), dt)
    np.testing.assert_array_equal(q, states.q_ib)
    return np.array(states.q_ib), np.array(states.rate_b)


def held(goals, dt):
    """Commands that change every 0.16 s."""
    block = np.minimum((dt * np.arange(STEPS) / 0.16 + 1e-9).astype(int), len(goals) - 1)
    return goals[block]


GOALS = np.array([[0.4, 0.9, -0.5], [-3.0, 0.2, 0.8], [0.0, -5.0, 0.1], [0.45, 0.0, 0.0]])


def integrated(table, goals):
    """Attitude by SciPy as nine direction cosines, in pieces on which the command is the same."""
    lag, most_rate, most = (np.array(x) for x in table)
    y = np.concatenate([rotation(Q0).as_matrix().ravel(), RATE0])

    def slope(_, y, goal):
        x, y_, z = w = y[9:]
        skew = np.array([[0.0, -z, y_], [z, 0.0, -x], [-y_, x, 0.0]])
        pull = np.clip((goal - w) / lag, -most, most)
        return np.concatenate([(y[:9].reshape(3, 3) @ skew).ravel(), pull])

    for goal in goals:
        given = {"args": (np.clip(goal, -most_rate, most_rate),), "rtol": 1e-9, "atol": 1e-11}
        # Small steps, for the slope has corners where the limits end.
        y = solve_ivp(slope, (0.0, 0.16), y, max_step=1e-3, **given).y[:, -1]
    return y[:9].reshape(3, 3), y[9:]


@pytest.mark.parametrize("table", [FAST, LIMITED], ids=["lag", "limits"])
def test_it_turns_as_its_lag_and_limits_say(table):
    C, rate = integrated(table, GOALS)
    q, rates = run(table, held(GOALS, 0.01), 0.01)
    np.testing.assert_allclose(rates[-1], rate, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(rotation(q[-1]).as_matrix(), C, rtol=0.0, atol=1e-6)


def test_it_is_its_own_at_any_step():
    goal = np.array([[0.4, 0.9, -0.5]])
    _, fine = run(LIMITED, held(goal, 0.005), 0.005)
    _, coarse = run(LIMITED, held(goal, 0.08), 0.08)
    np.testing.assert_allclose(fine[15::16], coarse[:4], rtol=0.0, atol=1e-15)


def test_about_one_axis_the_attitude_is_exact_at_any_step():
    goal, start = np.array([[0.0, 0.9, 0.0]]), table_state(Q0)
    fine, _ = run(LIMITED, held(goal, 0.005), 0.005, start)
    coarse, _ = run(LIMITED, held(goal, 0.08), 0.08, start)
    np.testing.assert_allclose(fine[15::16], coarse[:4], rtol=0.0, atol=1e-14)


def test_the_attitude_is_of_the_fourth_order_where_the_axis_wanders():
    goal = 5.0 * np.array([[1.0, 0.0, -0.5]])
    start = table_state(Q0, [0.0, 5.0, 0.0])
    truth = rotation(run(FAST, held(goal, 0.00125), 0.00125, start)[0][-1])

    def miss(dt):
        at = round(STEPS * 0.00125 / dt) - 1
        q = run(FAST, held(goal, dt), dt, start)[0][at]
        return (rotation(q).inv() * truth).magnitude()

    coarse, fine = miss(0.02), miss(0.01)
    assert coarse > 1e-6
    assert 12.0 < coarse / fine < 20.0


def test_a_step_of_the_command_is_63_percent_there_after_the_lag():
    goal, start = np.array([[0.3, 0.0, 0.0]]), table_state()
    _, rates = run(FAST, held(goal, LAG), LAG, start)
    np.testing.assert_allclose(rates[:3, 0], 0.3 * (1.0 - np.exp([-1.0, -2.0, -3.0])), rtol=1e-14)
    # A constant rate is followed late by the lag: the angle is short of it by rate times lag.
    q, _ = run(FAST, held(goal, 0.1), 0.1, start)
    angle = 2.0 * np.arctan2(q[9, 1], q[9, 0])
    np.testing.assert_allclose(angle, 0.3 * (1.0 - LAG), rtol=1e-13)


def test_neither_rate_nor_acceleration_passes_its_limit():
    _, rates = run(LIMITED, np.tile([9.0, -9.0, 9.0], (STEPS, 1)), 0.05, table_state())
    np.testing.assert_allclose(rates[-1], [0.5, -1.0, 2.0], rtol=1e-6)
    assert np.all(np.abs(rates) <= [0.5, 1.0, 2.0])
    change = np.diff(rates, axis=0, prepend=np.zeros((1, 3))) / 0.05
    np.testing.assert_allclose(change[0], [4.0, -2.0, 1.0], rtol=1e-13)
    assert np.all(np.abs(change) <= np.array([4.0, 2.0, 1.0]) * (1.0 + 1e-12))


def test_derivatives_are_those_of_differences():
    def turned(scale):
        after, q = step(LIMITED, table_state(Q0, RATE0), scale * jnp.asarray(GOALS[0]), 0.05)
        return q @ jnp.arange(1.0, 5.0) + after.rate_b @ jnp.ones(3)

    both = jax.jit(jax.vmap(jax.value_and_grad(turned)))
    values, slopes = both(jnp.array([0.89999, 0.9, 0.90001]))
    np.testing.assert_allclose(slopes[1], (values[2] - values[0]) / 2e-5, rtol=1e-7)

    def free(rate):
        return jnp.sum(step(FAST, table_state(Q0), rate * jnp.ones(3), 0.01)[0].rate_b)

    np.testing.assert_allclose(jax.jit(jax.grad(free))(0.0), 3.0 * (1.0 - np.exp(-0.5)), rtol=1e-13)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: rate_table(0.0), "lag_s must be"),
        (lambda: rate_table(np.inf), "lag_s must be"),
        (lambda: rate_table(LAG, -1.0), "rate_limit_rad_s must be"),
        (lambda: rate_table(LAG, np.nan), "rate_limit_rad_s must be"),
        (lambda: rate_table(LAG, 1.0, 0.0), "acceleration_limit_rad_s2 must be"),
        (lambda: rate_table(LAG, 1.0, [1.0, 2.0]), "acceleration_limit_rad_s2 must be a number or"),
        (lambda: table_state(np.ones(4)), "unit quaternion"),
        (lambda: table_state(Q0, np.nan), "rate_b must be"),
    ],
)
def test_what_is_no_table_or_state_is_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()
