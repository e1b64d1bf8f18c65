"""One scan, many at once, onwards from where it ended, and backwards for gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import SPLIT_W, kalman_filter, random_system, simulate, split, times
from jax.tree_util import Partial

from robins.filters import Belief, Code, Model, Motion, OnlineFilter, Sensor, kalman, run, unscented

T = 20
EKF, UKF = kalman(), kalman(unscented())
SYSTEM = random_system(1)
MODEL, START = SYSTEM.model(), SYSTEM.start()
Y = simulate(SYSTEM, 1, T, 0.3)[1]


def same(one, other, rtol=0.0):
    """Every leaf alike: bit for bit, or to a share of the largest of the leaf."""
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        size = np.max(np.abs(np.nan_to_num(np.asarray(b, dtype=float))), initial=0.0)
        np.testing.assert_allclose(a, b, rtol=0.0, atol=rtol * float(size))


# ------------------------------------------------------------------------------- batch and go on


def test_a_batch_is_its_runs():
    systems = [random_system(seed) for seed in range(4)]
    series = [simulate(s, seed, T, 0.3)[1] for seed, s in enumerate(systems)]
    alone = [run(UKF, s.model(), s.start(), y) for s, y in zip(systems, series, strict=True)]
    models, starts, ys = (
        jax.tree.map(lambda *x: jnp.stack(x), *parts)
        for parts in (
            [s.model() for s in systems],
            [s.start() for s in systems],
            [jnp.array(y) for y in series],
        )
    )
    together = jax.vmap(lambda m, s, y: run(UKF, m, s, y))(models, starts, ys)
    # LAPACK and a batched product may sum in another order
    for k in range(4):
        # what `doubts` looks at is added outside of compiled code
        one = alone[k]._replace(tally=alone[k].tally._replace(looks=together.tally.looks))
        same(jax.tree.map(lambda x, k=k: x[k], together), one, 1e-13)


def test_a_run_can_go_on():
    whole = run(EKF, MODEL, START, Y)
    first = run(EKF, MODEL, START, Y[: T // 2])
    second = run(EKF, MODEL, first.final, Y[T // 2 :])
    same(second.final, whole.final)
    same(second.mean, whole.mean[T // 2 :])
    both = float(first.log_likelihood + second.log_likelihood)
    assert both == pytest.approx(float(whole.log_likelihood), rel=1e-14)


def test_a_filter_is_compiled_once_for_equal_shapes():
    traced = []

    def counted(A, x, u):
        traced.append(x)
        return A @ x

    def model(seed):
        s = random_system(seed)
        sensor = Sensor(Partial(times, jnp.array(s.H)), jnp.array(s.W), 3)
        return Model(Motion(Partial(counted, jnp.array(s.F)), jnp.array(s.G)), (sensor,)), s

    for seed in range(3):
        m, s = model(seed)
        run(EKF, m, s.start(), simulate(s, seed, T)[1])
        after = len(traced)
        if seed == 0:
            once = after
    assert 0 < once == after
    run(kalman(), m, s.start(), simulate(s, 2, T)[1])
    assert len(traced) == after  # made again, it is the same
    start = s.start()
    jax.eval_shape(lambda y: run(kalman(form="joseph"), m, start, y), Y)
    assert len(traced) > after  # the count does count


def test_what_is_kept_is_what_was_asked_for():
    kept = run(EKF, MODEL, START, Y, keep=lambda step: step.posterior.mean[0])
    np.testing.assert_array_equal(kept.steps, run(EKF, MODEL, START, Y).mean[:, 0])


def test_no_steps_at_all():
    empty = run(EKF, MODEL, START, Y[:0])
    assert empty.mean.shape == (0, 4)
    assert float(empty.log_likelihood) == 0.0
    same(empty.final.belief, START)


# --------------------------------------------------------------------------------- several sensors


def test_sensors_one_after_the_other_are_one_of_independent_noise():
    y = Y.copy()
    y[:, 2] = np.where(np.arange(T) % 4 == 0, 1.5, np.nan)  # at a quarter of the rate
    solution = run(EKF, split(SYSTEM), START, {"near": y[:, :2], "far": y[:, 2:]})
    means, covariances, log_likelihood, _ = kalman_filter(SYSTEM._replace(W=SPLIT_W), y)
    np.testing.assert_allclose(solution.mean, means, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(solution.covariance, covariances, rtol=1e-8, atol=1e-10)
    assert float(solution.log_likelihood) == pytest.approx(log_likelihood.sum(), rel=1e-11)
    codes = np.asarray(solution.steps.info["far"].code)
    np.testing.assert_array_equal(codes == Code.MISSING, np.arange(T) % 4 != 0)
    other = run(EKF, split(SYSTEM), START, {"far": y[:, 2:], "near": y[:, :2]})
    same(other, solution)  # the model's order holds, not that of the dict


def test_a_sensor_that_is_not_named_is_not_used():
    y = Y[:, :2]
    only = run(EKF, split(SYSTEM), START, {"near": y})
    assert set(only.steps.info) == {"near"}
    silent = run(EKF, split(SYSTEM), START, {"near": y, "far": np.full((T, 1), np.nan)})
    same(only.mean, silent.mean)
    same(only.log_likelihood, silent.log_likelihood)


def test_a_run_without_measurements_only_predicts():
    F = jnp.array(SYSTEM.F)
    model = Model(Motion(lambda x, u: F @ x + u, jnp.array(SYSTEM.G)), ())
    solution = run(EKF, model, START, None, np.zeros((T, 4)))
    want = np.linalg.matrix_power(SYSTEM.F, T) @ SYSTEM.m0
    np.testing.assert_allclose(solution.mean[-1], want, rtol=1e-12)
    assert solution.steps.info == {}


# ------------------------------------------------------------------------------------ at the edge


@pytest.mark.parametrize(
    ("y", "more", "error", "message"),
    [
        ({"gps": Y}, {}, ValueError, r"no sensor \['gps'\]; this model has \['y'\]"),
        ({"y": Y}, {"aux": {"gps": Y}}, ValueError, r"no sensor \['gps'\]; this model has \['y'\]"),
        (Y, {"u": Y[1:]}, ValueError, r"one length, got \{'u': 19, \"y\['y'\]\": 20\}"),
        (Y, {"u": 1.0}, ValueError, "u holds a single number: a leading axis of time is wanted"),
        (None, {}, ValueError, "nothing to run over: neither a measurement nor an input"),
        ({}, {}, ValueError, "nothing to run over"),
        (Y[:, :2], {}, ValueError, r"sensor 'y' reads shape \(3,\), but was given \(2,\)"),
        (Y[:, 0], {}, ValueError, r"sensor 'y' reads shape \(3,\), but was given \(\)"),
        (Y + 0j, {}, TypeError, "measurements of 'y' hold complex128: real numbers are wanted"),
        (Y.astype(str), {}, TypeError, r"measurements of 'y' hold <U\d+"),
        (Y > 0, {}, TypeError, "measurements of 'y' hold bool"),
        ([[1.0, None, 2.0]] * T, {}, TypeError, "hold object: .* NaN where one is missing"),
    ],
)
def test_a_measurement_that_does_not_fit_is_named(y, more, error, message):
    with pytest.raises(error, match=message):
        run(EKF, MODEL, START, y, **more)


def test_several_sensors_want_names():
    with pytest.raises(ValueError, match=r"has \['far', 'near'\]: give measurements as a dict"):
        run(EKF, split(SYSTEM), START, Y)


# ---------------------------------------------------------------------------------------- streaming


def test_one_sample_at_a_time_gives_the_numbers_of_the_run():
    y = Y.copy()
    y[3] = np.nan
    whole = run(UKF, MODEL, START, y)
    live = OnlineFilter(UKF, MODEL, START)
    for k in range(T):
        prediction = live.predict()
        info = live.update(y[k])
        row = jax.tree.map(lambda x, k=k: x[k], whole.steps)
        same(prediction, row.prediction, 1e-14)
        same(info, row.info["y"], 1e-13)
        same(live.belief, row.posterior, 1e-14)
    codes = np.asarray(whole.steps.info["y"].code)
    names = {Code(code).name: int(np.sum(codes == code)) for code in np.unique(codes)}
    assert live.counts == names


def test_a_saved_state_can_be_restored():
    live = OnlineFilter(EKF, MODEL, START)
    for row in Y[:5]:
        live.predict()
        live.update(row)
    saved = jax.tree.map(np.asarray, live.state)  # as it might come back from a file
    live.predict()
    live.update(Y[5])
    again = OnlineFilter(EKF, MODEL, saved)
    again.predict()
    again.update(Y[5])
    same(again.state, live.state)
    live.state = saved
    live.predict()
    live.update(Y[5], sensor="y")
    same(again.state, live.state)


def test_streaming_compiles_once_however_its_start_was_written():
    loose = Belief(START.mean, jnp.diag(jnp.full(len(START.factor), 1.0)))  # of a weak type
    assert loose.factor.weak_type
    live = OnlineFilter(EKF, MODEL, loose)
    compiled = []

    def hear(event, seconds, **told):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(told["fun_name"])

    live.predict()
    live.update(Y[0])
    jax.monitoring.register_event_duration_secs_listener(hear)
    try:
        for y in Y[1:5]:
            live.predict()
            live.update(y)
        assert compiled == []
        jax.jit(lambda x: x + 1)(1.0)
        assert len(compiled) == 1  # it would have been heard
    finally:
        jax.monitoring.unregister_event_duration_listener(hear)


def test_streaming_takes_lists_and_names_its_sensors():
    live = OnlineFilter(EKF, split(SYSTEM), START)
    live.predict()
    live.update([0.1, 0.2], "near")
    live.update(np.array([3], dtype=np.int32), "far")
    assert live.counts == {"DONE": 2}
    with pytest.raises(ValueError, match=r"name one of the sensors \['far', 'near'\]"):
        live.update([0.1])
    with pytest.raises(KeyError, match="no sensor 'gps'"):
        live.update([0.1], "gps")
    with pytest.raises(TypeError, match="measurements of 'far' hold <U4"):
        live.update(["fast"], "far")
    assert live.counts == {"DONE": 2}


def test_streaming_counts_predictions_that_were_not_taken():
    live = OnlineFilter(EKF, SYSTEM._replace(F=np.full((4, 4), np.nan)).model(), START)
    assert int(live.predict().code) == Code.NOT_FINITE
    live.update(np.full(3, 1e308))
    assert live.counts == {"NOT_FINITE": 1, "NOT_PREDICTED": 1}
    same(live.belief, START)


# ---------------------------------------------------------------------------------------- gradients


def log_likelihood(one, log_r, log_q, damping):
    """Log-likelihood of a pendulum, by its noise and a parameter of its motion."""

    def swing(damping, x, u):
        return x + 0.1 * jnp.stack([x[1], -9.8 * jnp.sin(x[0]) - damping * x[1]])

    motion = Motion(Partial(swing, damping), jnp.exp(log_q) * jnp.array([0.01, 0.1]))
    sensor = Sensor(lambda x, aux: jnp.stack([jnp.sin(x[0]), x[1]]), jnp.exp(log_r), 2)
    start = Belief(jnp.array([0.5, 0.0]), jnp.array([[0.3, 0.0], [0.1, 0.5]]))
    y = np.stack([0.5 * np.sin(np.arange(15.0)), np.cos(np.arange(15.0))], axis=1)
    y[4], y[7, 0], y[9, 1] = np.nan, np.nan, np.inf
    return run(one, Model(motion, (sensor,)), start, y).log_likelihood


def forward(at):
    """The value and the slopes by forward derivatives."""
    along = jax.vmap(lambda x, d: jax.jvp(at, (x,), (d,)), (None, 0), (None, 0))
    return lambda x: along(x, jnp.eye(len(x)))


@pytest.mark.parametrize(
    ("one", "both"), [(EKF, forward), (UKF, jax.value_and_grad)], ids=["taylor", "unscented"]
)
def test_gradients_of_the_log_likelihood(one, both):
    point = np.array([np.log(0.1), np.log(0.2), 0.3, 0.2])
    at = jax.jit(both(lambda x: log_likelihood(one, x[:2], x[2], x[3])))
    steps = 1e-5 * np.concatenate([np.eye(4), -np.eye(4)])
    values = np.array([at(point + step)[0] for step in steps])
    want = (values[:4] - values[4:]) / 2e-5
    np.testing.assert_allclose(at(point)[1], want, rtol=1e-7, atol=1e-7)


def test_gradients_with_a_singular_start_and_noise_of_rank_one():
    # No position error at the start and none put in: the first predicted covariance is singular.
    def at(log_q, log_r):
        motion = Motion(
            lambda x, u: jnp.stack([x[0] + 0.1 * x[1], x[1]]),
            jnp.exp(log_q) * jnp.array([[0.005], [0.1]]),
        )
        model = Model(motion, (Sensor(lambda x, aux: x[:1], jnp.exp(log_r)[None], 1),))
        start = Belief(jnp.zeros(2), jnp.zeros((2, 2)))
        y = np.sin(np.arange(12.0))[:, None]
        y[3] = np.nan
        return run(EKF, model, start, y).log_likelihood

    found, q, r, h = jax.jit(jax.value_and_grad(at, argnums=(0, 1))), 0.2, -1.0, 1e-5
    slope = found(q, r)[1]
    moved = ((h, 0.0), (-h, 0.0), (0.0, h), (0.0, -h))
    values = [float(found(q + a, r + b)[0]) for a, b in moved]
    assert float(slope[0]) == pytest.approx((values[0] - values[1]) / (2 * h), rel=1e-7)
    assert float(slope[1]) == pytest.approx((values[2] - values[3]) / (2 * h), rel=1e-7)
