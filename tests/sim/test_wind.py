"""Wind: what is drawn by its distribution, what is carried against an integrator of SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.integrate import solve_ivp

from robins.sim import wind as of_wind
from robins.sim.random import Component, stream
from robins.sim.wind import gusts, wind_at

KEY = stream(5, 0, Component.WIND)
rng = np.random.default_rng(3)

carry, carried_at = jax.jit(of_wind.move_in_wind), jax.jit(of_wind.wind_motion_at)

# ------------------------------------------------------------------------------------ the draw


def polar(wind):
    wind = np.asarray(wind)
    return np.hypot(*wind.T), np.arctan2(wind[:, 1], wind[:, 0])


def test_gusts_have_their_speeds_and_directions():
    n = 20_000
    # Over the south, where directions wrap.
    speed, direction = polar(gusts(KEY, n, 0.0, np.inf, 2.0, (5.0, 10.0), (3.0, 0.5)))
    assert stats.kstest(speed, stats.uniform(5.0, 5.0).cdf).pvalue > 1e-3
    off = np.mod(direction - 3.0 + np.pi, 2.0 * np.pi) - np.pi
    assert stats.kstest(off, stats.uniform(-0.5, 1.0).cdf).pvalue > 1e-3
    assert abs(np.corrcoef(speed, off)[0, 1]) < 4.0 / np.sqrt(n)
    assert abs(np.corrcoef(speed[1:], speed[:-1])[0, 1]) < 4.0 / np.sqrt(n)


def test_gusts_blow_towards_the_east_unless_told():
    speed, direction = polar(gusts(KEY, 1000, 0.0, 1e4, 10.0))
    assert np.all((speed >= 5.0) & (speed < 10.0))
    assert np.all(np.abs(direction - np.pi / 2.0) <= np.pi / 4.0)


def test_gusts_blow_between_begin_and_end():
    # 0.1 is no binary number: k every_s falls on either side of begin and end.
    for begin, end, every, first, last in (
        (200.0, 800.0, 10.0, 20, 79),
        (0.3, 0.7, 0.1, 3, 6),
        (4.0, 19.0, 10.0, 0, 1),  # not at steps: those whose middle is inside
        (6.0, 14.0, 10.0, 9, 8),  # none
        (5.0, 5.0, 1.0, 9, 8),
    ):
        blows = np.any(np.asarray(gusts(KEY, 100, begin, end, every)) != 0.0, axis=1)
        np.testing.assert_array_equal(np.flatnonzero(blows), np.arange(first, last + 1))


def test_a_gust_depends_on_its_number_alone():
    whole = np.asarray(gusts(KEY, 100, 0.0, 1000.0, 10.0))
    np.testing.assert_array_equal(gusts(KEY, 37, 0.0, 1000.0, 10.0), whole[:37])
    np.testing.assert_array_equal(gusts(KEY, 100, 200.0, 800.0, 10.0)[20:80], whole[20:80])
    keys = jax.vmap(lambda run: stream(5, run, Component.WIND))(jnp.arange(3))
    batch = jax.jit(jax.vmap(lambda key: gusts(key, 100, 0.0, 1000.0, 10.0)))(keys)
    np.testing.assert_allclose(batch[0], whole, rtol=1e-15)
    assert not np.any(batch[0] == batch[1])


# ------------------------------------------------------------------------------- the carried mass

STEP, TAU, M = 0.7, 5.0, 12
WIND = rng.normal(size=(M, 2)) * 8.0
COMMANDED, START = np.array([1.0, 10.0]), np.array([-3.0, 4.0])
MOTION = carry(WIND, STEP, COMMANDED, TAU, START)


def integrated(times):
    """Velocity, displacement and acceleration by a Runge-Kutta method of high order."""
    out = np.empty((len(times), 3, 2))
    state = np.concatenate([START, np.zeros(2)])
    for k in range(M):

        def rate(_, x, k=k):
            return np.concatenate([-(x[:2] - WIND[k] - COMMANDED) / TAU, x[:2]])

        step = solve_ivp(rate, (0.0, STEP), state, "DOP853", dense_output=True, rtol=1e-12)
        inside = (times >= k * STEP) & ((times < (k + 1) * STEP) | (k == M - 1))
        x = step.sol(times[inside] - k * STEP).T
        out[inside] = np.stack([x[:, :2], x[:, 2:], -(x[:, :2] - WIND[k] - COMMANDED) / TAU], 1)
        state = step.y[:, -1]
    return out


def test_the_mass_moves_as_the_equation_says():
    times = np.sort(rng.uniform(0.0, M * STEP, 200))
    got = np.stack(carried_at(MOTION, times), 1)
    np.testing.assert_allclose(got, integrated(times), rtol=0.0, atol=1e-10)


def test_at_the_steps_it_is_what_was_carried():
    nodes = np.arange(M + 1) * STEP
    velocity, displacement, _ = carried_at(MOTION, nodes)
    # Equal bit for bit where the instant is the step, to its rounding elsewhere.
    np.testing.assert_array_equal(velocity[0], START)
    np.testing.assert_array_equal(displacement[0], 0.0)
    np.testing.assert_allclose(velocity, MOTION.velocity, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(displacement, MOTION.displacement, rtol=0.0, atol=1e-13)
    before = carried_at(MOTION, nodes[1:] - 1e-8)
    np.testing.assert_allclose(before[0], velocity[1:], rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(before[1], displacement[1:], rtol=0.0, atol=1e-6)


def test_the_acceleration_integrates_to_the_velocity():
    roots, weights = np.polynomial.legendre.leggauss(12)
    times = STEP * (np.arange(M)[:, None] + 0.5 * (roots + 1.0))
    _, _, acceleration = carried_at(MOTION, times)
    gained = 0.5 * STEP * np.einsum("j,kjx->kx", weights, acceleration)
    np.testing.assert_allclose(gained, np.diff(MOTION.velocity, axis=0), rtol=0.0, atol=1e-13)


def test_where_two_winds_meet_the_later_one_counts():
    wind = np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0], [4.0, 0.0]])
    # 0.3 / 0.1 is 2.9999999999999996
    np.testing.assert_array_equal(wind_at(wind, 0.1, 0.3), [4.0, 0.0])
    several = wind_at(wind, 0.1, np.array([[0.0, 0.05], [0.1, 9.0]]))
    np.testing.assert_array_equal(several[..., 0], [[1, 1], [2, 4]])
    calm = carry(wind, 0.1, np.zeros(2), TAU, wind[3])
    at = carried_at(calm, 0.3)
    np.testing.assert_allclose(at[2], (wind[3] - at[0]) / TAU)
    before = carried_at(calm, 0.3 - 1e-6)
    np.testing.assert_allclose(before[2], (wind[2] - before[0]) / TAU)


def test_beyond_the_last_step_its_wind_is_held():
    end = M * STEP
    velocity, displacement, _ = carried_at(MOTION, end + 3.0)
    longer = carry(np.concatenate([WIND, WIND[-1:]]), STEP, COMMANDED, TAU, START)
    soon, same = (carried_at(motion, end + 0.5)[1] for motion in (MOTION, longer))
    np.testing.assert_allclose(soon, same, rtol=1e-13)
    target = WIND[-1] + COMMANDED
    wanted = target + (MOTION.velocity[-1] - target) * np.exp(-3.0 / TAU)
    np.testing.assert_allclose(velocity, wanted)
    assert np.all(np.isfinite(displacement))


def test_a_mass_in_a_steady_wind_keeps_its_place_in_it():
    total = COMMANDED + np.array([3.0, -2.0])
    steady = carry(np.tile([3.0, -2.0], (5, 1)), 100.0, COMMANDED, TAU, total)
    velocity, displacement, acceleration = carried_at(steady, np.array([0.0, 123.0, 499.0]))
    np.testing.assert_array_equal(velocity, np.tile(total, (3, 1)))
    np.testing.assert_array_equal(acceleration, 0.0)
    np.testing.assert_allclose(displacement[2], 499.0 * total, rtol=1e-14)


def test_it_runs_inside_a_batch_and_has_gradients():
    times = np.linspace(0.0, M * STEP, 9)
    keys = jax.vmap(lambda run: stream(5, run, Component.WIND))(jnp.arange(2))

    def moved(key, tau):
        wind = gusts(key, M, 0.0, 1e3, STEP)
        return of_wind.wind_motion_at(
            of_wind.move_in_wind(wind, STEP, COMMANDED, tau, START), times
        )

    alone = jax.jit(moved)

    def end(tau):
        return alone(keys[1], tau)[1][-1, 0]

    batch = jax.jit(jax.vmap(moved, (0, None)))(keys, TAU)
    for got, wanted in zip(batch, alone(keys[1], TAU), strict=True):
        np.testing.assert_allclose(got[1], wanted, rtol=1e-12, atol=1e-12)
    slope = float(end(TAU + 1e-4) - end(TAU - 1e-4)) / 2e-4
    assert float(jax.jit(jax.grad(end))(TAU)) == pytest.approx(slope, rel=1e-6)


def carried_by(**wrong):
    good = {"wind": WIND, "step_s": STEP, "commanded_m_s": COMMANDED}
    return of_wind.move_in_wind(**{**good, "tau_s": TAU, "start_m_s": START, **wrong})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gusts(KEY, 0, 0.0, 1.0, 1.0), "count is 0"),
        (lambda: gusts(KEY, 3, 2.0, 1.0, 1.0), "the end comes first"),
        (lambda: gusts(KEY, 3, np.nan, 1.0, 1.0), "begin_s must be a finite number"),
        (lambda: gusts(KEY, 3, 0.0, 1.0, 0.0), "every_s must be a finite number above 0"),
        (lambda: gusts(KEY, 3, 0.0, 1.0, 1.0, (-1.0, 2.0)), "speed_m_s must be"),
        (lambda: gusts(KEY, 3, 0.0, 1.0, 1.0, (3.0, 2.0)), "the least speed comes first"),
        (lambda: gusts(KEY, 3, 0.0, 1.0, 1.0, (1.0, 2.0), (0.0, -0.1)), "half width"),
        (lambda: carried_by(step_s=0.0), "step_s must be"),
        (lambda: carried_by(tau_s=-1.0), "tau_s must be a finite number above 0, got -1.0"),
        (lambda: carried_by(wind=WIND[:, :1]), "wind must have shape"),
        (lambda: carried_by(wind=WIND[:0]), "M at least one"),
        (lambda: carried_by(commanded_m_s=COMMANDED[:1]), "commanded_m_s must have shape"),
        (lambda: carried_by(start_m_s=np.zeros(3)), "start_m_s must have shape"),
        (lambda: of_wind.wind_motion_at(MOTION, -0.1), "time_s must be a finite number from 0"),
        (lambda: wind_at(WIND, -1.0, 0.0), "step_s must be"),
    ],
)
def test_what_cannot_be_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
