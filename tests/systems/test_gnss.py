"""Tight GNSS against closed forms, differences, dense least squares and another package."""

from functools import cache, partial

import gnss_logs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares, minimize

from robins.earth import OMEGA_E
from robins.filters import Belief, Model, Motion, Sensor, kalman, rts_smoother, run
from robins.manifold import local, retract
from robins.systems.gnss import model
from robins.systems.gnss.filters import contender
from robins.systems.gnss.model import (
    LIGHT,
    RANGES,
    GnssModelKind,
    GnssState,
    LocalFrame,
    MotionStep,
    Sky,
    first_fix,
    pseudoranges,
    sagnac_m,
)
from robins.systems.gnss.parameters import Delays, GnssReplay
from robins.systems.gnss.weights import by_component, huber_weight, student_weight, switch_weight
from robins.workbench.errors import InputError
from robins.workbench.replay import replay

BERLIN = LocalFrame.at(np.array([3785108.0, 899901.0, 5037234.0]))
RNG = np.random.default_rng(5)


def sky_of(n, place=BERLIN):
    """Satellites of a GPS orbit above a place."""
    azimuth, elevation = np.arange(n) * 2.4, np.radians(15.0 + 70.0 * np.arange(n) / n)
    flat = np.cos(elevation)
    line = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), -np.sin(elevation)], 1)
    return np.asarray(place.origin_e) + 2.2e7 * line @ np.asarray(place.C_en).T


# ------------------------------------------------------------------------------------ the model


def test_light_that_travels_while_the_earth_turns():
    """Reception in inertial axes: the receiver meets the signal where the Earth has carried it."""
    q, most = np.asarray(BERLIN.origin_e), 0.0
    for satellite in sky_of(8):
        length = np.linalg.norm(satellite - q)
        for _ in range(6):
            turn = OMEGA_E * length / LIGHT
            s, c = np.sin(turn), np.cos(turn)
            carried = np.array([c * q[0] - s * q[1], s * q[0] + c * q[1], q[2]])
            length = np.linalg.norm(satellite - carried)
        straight = np.linalg.norm(satellite - q)
        most = max(most, abs(length - straight))
        found = straight + float(sagnac_m(jnp.asarray(satellite), jnp.asarray(q)))
        # what is left is of second order: the receiver moves by 30 m in 2e7 m
        assert found == pytest.approx(length, abs=1e-3)
    assert most > 10.0


def state(delays):
    return GnssState(
        position=jnp.array([30.0, -20.0, 5.0]),
        direction=jnp.array([0.6, 0.8]),
        yaw_bias=jnp.asarray(0.002),
        clock=jnp.array([2e5, -40.0]),
        systems=jnp.array([7.0]),
        delay=jnp.arange(6.0) if delays else jnp.zeros(0),
    )


@pytest.mark.parametrize("delays", [False, True])
def test_derivatives_by_differences(delays):
    member = (np.arange(6) % 2)[:, None]
    built = model.gnss_model(GnssReplay(), GnssModelKind(delays=delays), BERLIN, member)
    x, sky = state(delays), Sky(jnp.asarray(sky_of(6)), jnp.ones(6))
    u = MotionStep(0.5, 8.0, 0.3, 0.05, 0.002, jnp.full(6, 9.0), jnp.full(6, 20.0))
    n = len(local(x, x))
    sensor = built.sensor(RANGES)
    for f, unit in (
        (lambda e: sensor.read(retract(x, e), sky), 1.0),
        (lambda e: local(x, built.motion.step(retract(x, e), u)), 1.0),
    ):
        found = jax.jacfwd(f)(jnp.zeros(n))
        steps = 1e-4 * np.eye(n)
        books = np.stack([(f(jnp.asarray(d)) - f(jnp.asarray(-d))) / 2e-4 for d in steps], 1)
        np.testing.assert_allclose(found, books, rtol=0.0, atol=1e-4 * unit)
    # along the line of sight, against the satellite
    H = jax.jacfwd(lambda e: sensor.read(retract(x, e), sky))(jnp.zeros(n))[:, :3]
    away = np.asarray(BERLIN.ecef(x.position)) - sky_of(6)
    books = away / np.linalg.norm(away, axis=1)[:, None] @ np.asarray(BERLIN.C_en)
    np.testing.assert_allclose(H, books, atol=1e-5)  # the turn of the Earth is 2e-6 of it


def test_a_turn_goes_to_the_right_and_along_the_arc():
    built = model.gnss_model(GnssReplay(), GnssModelKind(), BERLIN, np.zeros((4, 1)))
    x = state(False)._replace(yaw_bias=jnp.asarray(0.0), direction=jnp.array([1.0, 0.0]))
    u = MotionStep(0.1, 10.0, np.pi / 10.0, 0.05, 0.002, jnp.zeros(4), jnp.zeros(4))
    for _ in range(50):  # a quarter turn of radius 10 / (pi / 10)
        x = built.motion.step(x, u)
    radius = 100.0 / np.pi
    np.testing.assert_allclose(x.direction, [0.0, 1.0], atol=1e-12)
    moved = np.asarray(x.position) - np.asarray(state(False).position)
    np.testing.assert_allclose(moved, [radius, radius, 0.0], rtol=1e-3)


def test_the_law_of_delays_is_that_of_its_mixture():
    d = Delays()
    elevation, cn0 = np.radians(35.0), 36.0
    mean, sigma = model.delay_law(d, elevation, cn0)
    blocked = RNG.uniform(size=400_000) < (45.0 - 36.0) / 20.0
    late = 2.0 * RNG.exponential(d.reflector, len(blocked)) * np.cos(elevation)
    drawn = np.where(blocked, late, 0.0) + d.multipath * RNG.standard_normal(len(blocked))
    assert float(mean) == pytest.approx(np.mean(drawn), rel=0.01)
    assert float(sigma) == pytest.approx(np.std(drawn), rel=0.01)


def test_a_first_fix_from_the_centre_of_the_earth():
    member = (np.arange(7) % 2)[:, None].astype(float)
    x = state(False)._replace(systems=jnp.zeros(1))
    sky = Sky(jnp.asarray(sky_of(7)), jnp.full(7, 5.0))
    y = np.array(pseudoranges(BERLIN, jnp.asarray(member), x, sky))
    y[2] = np.nan
    fix = first_fix(y, sky, member, 10.0)
    np.testing.assert_allclose(fix[:3], BERLIN.ecef(x.position), atol=1e-4)
    np.testing.assert_allclose(fix[3:], [2e5, 0.0], atol=1e-4)


# ---------------------------------------------------------------------------------- the weights


def updated(rule, y, H, R, P):
    n, P = len(P), jnp.asarray(P)
    sensor = Sensor(lambda x, aux: jnp.asarray(H) @ x, jnp.sqrt(jnp.asarray(R)), len(y))
    still = Model(Motion(lambda x, u: x, jnp.zeros(n)), (sensor,))
    start = Belief.of(jnp.zeros(n), P)
    return run(kalman(rules=[rule] if rule else []), still, start, np.asarray(y)[None])


COSTS = {
    "huber": (
        huber_weight(1.345),
        lambda e: np.where(np.abs(e) < 1.345, 0.5 * e**2, 1.345 * (np.abs(e) - 0.5 * 1.345)),
    ),
    "student-t": (student_weight(5.0), lambda e: 3.0 * np.log1p(e**2 / 5.0)),
}


@pytest.mark.parametrize("name", COSTS)
def test_weights_minimise_the_cost_of_their_author(name):
    weight, cost = COSTS[name]
    H, R, P = RNG.standard_normal((9, 3)), RNG.uniform(1.0, 4.0, 9), np.diag([4.0, 9.0, 100.0])
    y = H @ [1.0, -2.0, 6.0] + np.sqrt(R) * RNG.standard_normal(9)
    y[4] += 40.0

    def whole(x):
        return 0.5 * x @ np.linalg.solve(P, x) + np.sum(cost((y - H @ x) / np.sqrt(R)))

    found = updated(by_component(weight, "w", 200), y, H, R, P)
    book = minimize(whole, np.zeros(3), tol=1e-14).x
    np.testing.assert_allclose(found.mean[0], book, atol=1e-5)
    plain = updated(None, y, H, R, P).mean[0]
    assert np.linalg.norm(plain - np.array([1.0, -2.0, 6.0])) > 2.0 * np.linalg.norm(
        found.mean[0] - np.array([1.0, -2.0, 6.0])
    )


def test_a_switch_is_that_of_dynamic_covariance_scaling():
    e = np.array([0.0, 0.9, 1.0, 3.0, 30.0])
    s = np.minimum(1.0, 2.0 / (1.0 + e**2))
    np.testing.assert_allclose(switch_weight(1.0)(jnp.asarray(e)), s**2)


def test_one_satellite_far_off_costs_the_others_nothing():
    H, R, P = np.c_[np.eye(4), np.ones(4)], np.ones(4), np.diag([1.0, 1.0, 1.0, 1.0, 1e8])
    y = np.array([0.1, -0.2, 0.2, 500.0])
    rule = by_component(student_weight(3.0), "w", 50)
    found = updated(rule, y, H, R, P)
    told = found.steps.info["y"].notes
    assert float(told["w.least"][0]) < 1e-4
    without = updated(rule, [*y[:3], np.nan], H, R, P)
    np.testing.assert_allclose(found.mean[0][:3], without.mean[0][:3], atol=0.02)
    assert abs(float(updated(None, y, H, R, P).mean[0][0])) > 50.0


# ------------------------------------------------------------------------------ whole solutions


@cache
def few():
    """Five epochs of the short drive, of those where every step moves."""
    course, world = gnss_logs.drive()
    rows = slice(16, 21)
    cut = partial(jax.tree_util.tree_map, lambda a: a[rows])
    course = course._replace(epoch_s=course.epoch_s[rows])
    y = {RANGES: world.y[RANGES][rows]}
    fix = first_fix(
        y[RANGES][0],
        cut(world.sky)._replace(satellite_e=world.sky.satellite_e[16], sigma=world.sky.sigma[16]),
        course.member,
        10.0,
    )
    return course, world._replace(fix=fix, u=cut(world.u), y=y, sky=cut(world.sky), truth=None)


def test_filter_and_smoother_are_dense_least_squares_on_the_same_graph():
    course, world = few()
    c = contender(gnss_logs.short_city(), course.place, course.member, "ekf")
    case = c.case(world)
    found = run(c.filter, c.model, case.start, case.y, case.u, case.aux)
    smoothed = rts_smoother(found)
    member = jnp.asarray(course.member)
    start, u, y = case.start, world.u, world.y[RANGES]
    n, e = len(start.sigma), len(y)
    there = [np.flatnonzero(row) for row in np.isfinite(np.asarray(y))]

    def along(tree, k):
        return jax.tree_util.tree_map(lambda a: a[k], tree)

    moved = np.array([c.model.motion.noise_factor(start.mean, along(u, k)) for k in range(e)])
    noise = np.sqrt(np.sum(moved**2, axis=2))
    free = noise > 0.0  # the clocks of the systems stand still, and so does the bias of the gyro

    def residuals(flat):
        """Whitened; the state at the start, then what each step adds to the motion's."""
        x = retract(start.mean, start.sigma * flat[:n])
        out, at = [flat[:n]], n
        for k in range(e):
            x = c.model.motion.step(x, along(u, k))
            width = free[k].sum()
            w = flat[at : at + width]
            at += width
            push = jnp.zeros(n).at[np.flatnonzero(free[k])].set(noise[k][free[k]] * w)
            x = retract(x, push)
            r = y[k] - pseudoranges(course.place, member, x, along(world.sky, k))
            out += [w, (r / world.sky.sigma[k])[there[k]]]
        return jnp.concatenate(out), x

    value = jax.jit(lambda flat: residuals(flat)[0])
    jacobian = jax.jit(jax.jacfwd(value))
    zero = np.zeros(n + int(free.sum()))
    best = least_squares(value, zero, jac=jacobian, xtol=1e-15, ftol=1e-15, gtol=1e-12).x
    last = residuals(best)[1]
    np.testing.assert_allclose(local(last, along(found.mean, -1))[:3], 0.0, atol=2e-3)
    first = retract(start.mean, start.sigma * best[:n])
    step = c.model.motion.step(first, along(u, 0))
    push = (
        jnp.zeros(n)
        .at[np.flatnonzero(free[0])]
        .set(noise[0][free[0]] * best[n : n + free[0].sum()])
    )
    book = retract(step, push)
    np.testing.assert_allclose(local(book, along(smoothed.mean, 0))[:3], 0.0, atol=2e-3)


def test_a_fix_is_that_of_gtsam():
    gtsam = pytest.importorskip("gtsam", reason="gtsam is not installed")
    n = 8
    sky = Sky(jnp.asarray(sky_of(n)), jnp.asarray(RNG.uniform(3.0, 9.0, n)))
    truth = state(False)._replace(systems=jnp.zeros(0))
    member = np.zeros((n, 0))
    y = pseudoranges(BERLIN, jnp.asarray(member), truth, sky)
    y = y + sky.sigma * RNG.standard_normal(n)
    fix = np.asarray(first_fix(y, sky, member, 10.0))
    # gtsam's factor turns the Earth by itself, as RTKLIB does
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(n):
        noise = gtsam.noiseModel.Isotropic.Sigma(1, float(sky.sigma[k]))
        at = np.asarray(sky.satellite_e[k])
        graph.add(gtsam.PseudorangeFactor(1, 2, float(y[k]), at, 0.0, noise))
    values.insert(1, np.asarray(BERLIN.origin_e) + 50.0)
    values.insert(2, 0.0)
    settings = gtsam.LevenbergMarquardtParams()
    settings.setRelativeErrorTol(1e-15)
    settings.setAbsoluteErrorTol(1e-15)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values, settings).optimize()
    np.testing.assert_allclose(found.atPoint3(1), fix[:3], atol=0.02)
    assert found.atDouble(2) * LIGHT == pytest.approx(fix[3], abs=0.02)


def test_a_log_of_a_city(tmp_path):
    text, truth = gnss_logs.as_text(*gnss_logs.drive())
    (tmp_path / "in.txt").write_text(text)
    (tmp_path / "gt.txt").write_text(truth)
    files = [tmp_path / "in.txt", tmp_path / "gt.txt"]
    found = replay(files, system="gnss", filters=["ls", "delays", "delays+rts"])
    metrics = found.metrics
    assert metrics["delays"]["horizontal_mean_m"] < 0.7 * metrics["ls"]["horizontal_mean_m"]
    for name in ("delays", "delays+rts"):
        assert metrics[name]["nees"] < 3.0
        assert metrics[name]["beyond_3_sigma"] < 0.05
    course, world = gnss_logs.drive()
    assert metrics["ls"]["epochs_compared"] == len(course.epoch_s)
    assert found.counts["pseudoranges"] == int(np.isfinite(world.y[RANGES]).sum())
    assert found.solution["error_position"].shape == (3, len(course.epoch_s), 3)
    assert set(found.metrics) == {"ls", "delays", "delays+rts"}
    line = next(row for row in text.splitlines() if row.startswith("pseudorange3"))
    (tmp_path / "in.txt").write_text(line + "\n" + text)
    with pytest.raises(InputError, match="two pseudoranges at one time"):
        replay(files[:1], system="gnss")
