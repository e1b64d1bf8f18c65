"""The invariant filter: its error law without approximation, and what that is worth."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation as Turn
from scipy.stats import chi2

from robins import manifold
from robins.filters import Belief, Model, Motion, Sensor, kalman, run, taylor
from robins.ins.extended_pose import ExtendedPose
from robins.ins.increments import Increments
from robins.ins.invariant import (
    GRAVITY,
    InvariantState,
    direction_sensor,
    invariant_motion,
    landmark_sensor,
    position_sensor,
    propagate,
    transition,
    velocity_sensor,
)
from robins.ins.state import InsNoise
from robins.rotation import Rotation, skew

SIDES = pytest.mark.parametrize("side", ["right", "left"])
NOISE = InsNoise(2e-4, 2e-3, 1e-6, 1e-5)
INCREMENT = Increments(
    *map(jnp.array, (0.2, [0.3, -0.2, 0.5], [1.0, 0.4, -2.1], [0.09, 0.05, -0.22]))
)


def pose(seed: int, side: str) -> ExtendedPose:
    rng = np.random.default_rng(seed)
    v, p = 20.0 * rng.normal(size=3), 100.0 * rng.normal(size=3)
    turn = Rotation.from_rotvec(rng.normal(size=3))
    return ExtendedPose(turn, jnp.array(v), jnp.array(p), side)


def state(seed: int, side: str) -> InvariantState:
    rng = np.random.default_rng(seed)
    return InvariantState(pose(seed, side), *(0.1 * jnp.array(rng.normal(size=(2, 3)))))


def test_free_motion_is_that_of_an_integrator():
    rate, force = np.array([0.4, -0.3, 0.9]), np.array([2.0, -1.0, -9.0])  # constant in the body
    x = state(1, "right")
    start = Turn.from_matrix(np.asarray(x.pose.rotation.as_dcm()))

    def slope(t, s):
        C = (start * Turn.from_rotvec(rate * t)).as_matrix()
        return np.concatenate([C @ force + [0, 0, GRAVITY], s[:3]])

    def seen(t, s):
        return np.concatenate([Turn.from_rotvec(rate * t).as_matrix() @ force, s[:3]])

    tight = {"rtol": 1e-12, "atol": 1e-12}
    s0 = np.concatenate([x.pose.velocity, x.pose.position])
    want = solve_ivp(slope, (0.0, 2.0), s0, **tight).y[:, -1]
    dv_dr = solve_ivp(seen, (0.0, 2.0), np.zeros(6), **tight).y[:, -1]
    true = (rate * 2.0, dv_dr[:3], dv_dr[3:])
    bias = (x.gyro_bias, x.accel_bias, x.accel_bias)
    biased = Increments(2.0, *(a + 2.0 * b for a, b in zip(true, bias, strict=True)))
    move = jax.jit(propagate)
    found = move(x, biased).pose
    np.testing.assert_allclose(found.velocity, want[:3], atol=1e-9)
    np.testing.assert_allclose(found.position, want[3:], atol=1e-9)
    turned = (start * Turn.from_rotvec(rate * 2.0)).as_matrix()
    np.testing.assert_allclose(found.rotation.as_dcm(), turned, atol=1e-13)
    plain = move(x, biased._replace(dr=None)).pose  # then half of dv dt
    np.testing.assert_allclose(plain.velocity, want[:3], atol=1e-9)
    gap = x.pose.rotation.apply(true[1] - true[2])
    np.testing.assert_allclose(plain.position - found.position, gap, atol=1e-9)


@SIDES
def test_transition_is_the_slope_of_propagate(side):
    x = state(2, side)
    motion = invariant_motion(NOISE)

    @jax.jit
    def ways(x, u):
        return transition(x, u), propagate(x, u), motion.linear(x, u), motion.noise_factor(x, u)

    (new, F, G), plain, (_, again, L), alone = ways(x, INCREMENT)
    for a, b in zip(jax.tree.leaves(new), jax.tree.leaves(plain), strict=True):
        np.testing.assert_array_equal(a, b)

    def moved(d):
        """State moved by its errors and by those of the sensors."""
        dv = INCREMENT.dv + d[18:]
        dr = INCREMENT.dr + 0.5 * INCREMENT.dt * d[18:]
        u = INCREMENT._replace(theta=INCREMENT.theta + d[15:18], dv=dv, dr=dr)
        return manifold.local(new, propagate(manifold.retract(x, d[:15]), u))

    slopes = jax.jit(jax.jacfwd(moved))(jnp.zeros(21))
    np.testing.assert_allclose(F, slopes[:, :15], atol=2e-12)
    np.testing.assert_allclose(G, slopes[:, 15:], atol=1e-11)
    # the filter is given the same, with the noise of the sensors and of their biases
    np.testing.assert_array_equal(again, F)
    Q = 0.2 * (G[:, :3] @ G[:, :3].T * 4e-8 + G[:, 3:] @ G[:, 3:].T * 4e-6)
    Q = Q + 0.2 * np.diag(np.repeat([0.0, 1e-12, 1e-10], [9, 3, 3]))
    np.testing.assert_allclose(L @ L.T, Q, atol=1e-16)
    np.testing.assert_allclose(alone, L, rtol=1e-15)


def test_the_error_law_of_the_right_side_knows_neither_path_nor_increments():
    law = jax.jit(lambda x, u: transition(x, u)[1])
    F = [law(InvariantState.start(pose(seed, "right")), INCREMENT) for seed in range(3)]
    other = INCREMENT._replace(theta=-2.0 * INCREMENT.theta, dv=5.0 * INCREMENT.dv)
    F.append(law(InvariantState.start(pose(4, "right")), other))
    for one in F[1:]:
        np.testing.assert_array_equal(one[:9, :9], F[0][:9, :9])
    left = [law(InvariantState.start(pose(seed, "left")), INCREMENT) for seed in (5, 6)]
    np.testing.assert_array_equal(left[0][:, :9], left[1][:, :9])
    np.testing.assert_allclose(left[0], left[1], atol=1e-15)  # of the biases too


@SIDES
def test_large_errors_move_by_the_linear_law_exactly(side):
    rng = np.random.default_rng(7)
    step = jax.jit(lambda x, u: transition(x, u)[:2])
    estimate = InvariantState.start(pose(8, side))
    way = rng.normal(size=3)
    xi = jnp.array(np.concatenate([2.8 * way / np.linalg.norm(way), 30.0 * rng.normal(size=6)]))
    truth = estimate._replace(pose=estimate.pose.retract(xi))  # off by 160 deg
    for _ in range(50):
        u = Increments(0.1, *(jnp.array(rng.normal(size=3)) * s for s in (0.2, 1.0, 0.05)))
        (estimate, F), (truth, _) = step(estimate, u), step(truth, u)
        xi = F[:9, :9] @ xi
    np.testing.assert_allclose(estimate.pose.local(truth.pose), xi, rtol=1e-9, atol=1e-9)
    assert np.linalg.norm(xi[:3]) == pytest.approx(2.8, rel=1e-12)


def test_gains_do_not_depend_on_the_attitude_believed_where_the_side_fits():
    # Left error and fixes in n; right error and a landmark seen in b: the posterior covariance is
    # that of any other estimate (for the landmark, of the same place).
    root = np.tril(np.random.default_rng(9).normal(size=(15, 15)))
    for side, sensor, y in (
        ("left", velocity_sensor(0.3), jnp.zeros(3)),
        ("left", position_sensor(2.0, (1.0, -2.0, 0.5)), jnp.zeros(3)),
        ("right", landmark_sensor(0.2, (40.0, 5.0, -3.0)), jnp.ones(3)),
        ("right", direction_sensor(0.05, (1.0, 0.0, 0.0)), jnp.ones(3)),
    ):
        spread = jax.jit(lambda x, s=sensor, y=y: taylor().observation(x, s, y, None).spread)
        seen = [np.asarray(spread(Belief(state(k, side), jnp.array(root)))) for k in (10, 11)]
        S = [h @ h.T + np.asarray(sensor.noise[0]) ** 2 * np.eye(3) for h in seen]
        gone = [h.T @ np.linalg.solve(s, h) for h, s in zip(seen, S, strict=True)]
        found = [root @ (np.eye(15) - part) @ root.T for part in gone]
        np.testing.assert_allclose(found[0], found[1], atol=1e-10)


def test_what_the_sensors_read():
    x = state(12, "right")
    C = np.asarray(x.pose.rotation.as_dcm())
    p = np.asarray(x.pose.position)
    for sensor, want in (
        (position_sensor(1.0, (1.0, 2.0, 3.0)), p + C @ [1.0, 2.0, 3.0]),
        (velocity_sensor(1.0), x.pose.velocity),
        (landmark_sensor(1.0, (7.0, 8.0, 9.0)), C.T @ ([7.0, 8.0, 9.0] - p)),
        (direction_sensor(1.0, (0.0, 1.0, 0.0)), C[1]),
    ):
        np.testing.assert_allclose(sensor.read(x, None), want, atol=1e-12)
    with pytest.raises(ValueError, match="gravity must be three numbers"):
        invariant_motion(NOISE, 9.8)


# ------------------------------------------------------- sixty to a hundred and twenty degrees off

RUNS, T, DT = 40, 160, 0.25
SIGMA = jnp.array([0.03, 0.03, 1.6, *[0.1] * 3, *[1.0] * 3, *[2e-4] * 3, *[1e-2] * 3])


class Plain(NamedTuple):
    """The same state with an ordinary error: attitude by `Rotation`, the rest by differences."""

    q_nb: Rotation
    v_n: Any
    p_n: Any
    gyro_bias: Any
    accel_bias: Any


def plain_step(x, u):
    at = ExtendedPose(x.q_nb, x.v_n, x.p_n)
    new = propagate(InvariantState(at, x.gyro_bias, x.accel_bias), u)
    return Plain(*(getattr(new.pose, k) for k in ("rotation", "velocity", "position")), *new[1:])


def plain_noise(x, u):
    C, zero = x.q_nb.as_dcm(), jnp.zeros((3, 3))
    nav = [[2e-4 * C, zero], [zero, 2e-3 * C], [zero, 1e-3 * u.dt * C]]
    walk = jnp.diag(jnp.repeat(jnp.array([1e-6, 1e-5]), 3))
    blocks = [[jnp.block(nav), jnp.zeros((9, 6))], [jnp.zeros((6, 6)), walk]]
    return jnp.sqrt(u.dt) * jnp.block(blocks)


PLAIN = Model(
    Motion(plain_step, plain_noise),
    (
        Sensor(lambda x, aux: x.p_n, jnp.ones(3), 3, "position"),
        Sensor(lambda x, aux: x.v_n, 0.1 * jnp.ones(3), 3, "velocity"),
    ),
)
INVARIANT = Model(invariant_motion(NOISE), (position_sensor(1.0), velocity_sensor(0.1)))


def drive(seed: int):
    """A vehicle that speeds up and turns, its IMU, and a first guess far off in heading."""
    rng = np.random.default_rng(seed)
    t, phase = np.arange(T) * DT, rng.uniform(0, 2 * np.pi, 3)
    push = np.stack([np.sin(0.3 * t + phase[0]), 0.5 * np.sin(0.2 * t + phase[1]), 0 * t], 1)
    rate = np.stack([0 * t, 0 * t, 0.1 * np.sin(0.15 * t + phase[2])], 1)
    q = Rotation.from_euler(*(0.05 * rng.normal(size=2)), rng.uniform(-np.pi, np.pi))
    v = np.asarray(q.apply(jnp.array([5.0, 0.0, 0.0])))
    off = rng.choice([-1, 1]) * np.deg2rad(rng.uniform(60.0, 120.0))
    wrong = q.retract(jnp.array([*(0.03 * rng.normal(size=2)), off]))
    noise = rng.normal(size=(6, T, 3))
    first = rng.normal(size=(4, 3))
    bg, ba = 2e-4 * first[0], 1e-2 * first[1]
    dv = (push - [0.0, 0.0, GRAVITY]) * DT
    true = (np.full(T, DT), rate * DT, dv, 0.5 * dv * DT)
    more = (2e-4 * np.sqrt(DT) * noise[0] + bg * DT, 2e-3 * np.sqrt(DT) * noise[1] + ba * DT)
    seen = (true[0], true[1] + more[0], dv + more[1], true[3] + 0.5 * more[1] * DT)
    guess = ExtendedPose(wrong, jnp.array(v + 0.1 * first[2]), jnp.array(first[3]))
    start = InvariantState.start(ExtendedPose(q, jnp.array(v), jnp.zeros(3)))
    numbers = jax.tree.map(jnp.asarray, (Increments(*true), Increments(*seen), noise[2:4]))
    return start, guess, *numbers


def attitude(kind, start, guess, true, seen, noise):
    """Attitude errors [rad] in n over a run, and their NEES."""
    path = jax.lax.scan(lambda x, u: (propagate(x, u),) * 2, start, true)[1].pose
    y = {"position": path.position + noise[0], "velocity": path.velocity + 0.1 * noise[1]}
    if kind == "plain":
        mean = Plain(guess.rotation, guess.velocity, guess.position, jnp.zeros(3), jnp.zeros(3))
        model, S = PLAIN, jnp.diag(SIGMA)
    else:  # the same belief, to first order, in the coordinates of the side
        pose = ExtendedPose(guess.rotation, guess.velocity, guess.position, kind)
        mean, model = InvariantState.start(pose), INVARIANT
        back = guess.rotation.inverse().as_dcm()
        across = jnp.eye(9).at[3:6, :3].set(skew(guess.velocity))
        across = across.at[6:9, :3].set(skew(guess.position))
        A = jnp.kron(jnp.eye(3), back) if kind == "left" else across
        S = jnp.eye(15).at[:9, :9].set(A) @ jnp.diag(SIGMA)

    def keep(step):
        x = step.posterior.mean
        return x.q_nb if kind == "plain" else x.pose.rotation, step.posterior.factor[:3]

    q, S = run(kalman(), model, Belief(mean, S), y, seen, keep=keep).steps
    error = jax.vmap(lambda a, b: a.local(b))(q, path.rotation)
    own = jax.vmap(lambda a, e: a.inverse().apply(e))(q, error) if kind == "left" else error
    nees = jax.vmap(lambda e, s: e @ jnp.linalg.solve(s @ s.T, e))(own, S)
    return jnp.linalg.norm(error, axis=1), nees


@pytest.fixture(scope="module")
def compared():
    drives = jax.tree.map(lambda *x: jnp.stack(x), *[drive(seed) for seed in range(RUNS)])
    return {
        kind: jax.jit(jax.vmap(lambda *d, kind=kind: attitude(kind, *d)))(*drives)
        for kind in ("plain", "left")
    }


def test_from_a_wrong_heading_it_converges_and_knows_how_far_it_is(compared):
    error, nees = (np.asarray(a) for a in compared["left"])
    assert np.all(error[:, 40] < np.deg2rad(10.0))  # 10 s
    assert np.all(error[:, -1] < np.deg2rad(1.5))
    beyond = np.mean(nees > chi2.ppf(0.999, 3))
    assert beyond < 0.01
    low, high = chi2.ppf([5e-4, 1 - 5e-4], 3 * RUNS) / RUNS
    inside = (np.mean(nees, axis=0) > low) & (np.mean(nees, axis=0) < high)
    assert np.mean(inside[8:]) > 0.95


def test_the_ordinary_filter_from_there_is_slow_and_sure_of_itself(compared):
    error, nees = (np.asarray(a) for a in compared["plain"])
    assert np.mean(nees > chi2.ppf(0.999, 3)) > 0.15
    assert np.max(error[:, 40]) > np.deg2rad(60.0)
    other = np.asarray(compared["left"][0])
    assert np.linalg.norm(error[:, 40]) > 5.0 * np.linalg.norm(other[:, 40])
