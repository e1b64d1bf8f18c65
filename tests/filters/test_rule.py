"""Promises of the hooks of a rule, with rules made for the purpose."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import kalman_filter, random_system, simulate
from interpreted import run

from robins import filters
from robins.filters import (
    Belief,
    Code,
    Model,
    Motion,
    Rule,
    Sensor,
    kalman,
    normalised,
    taylor,
    unscented,
)

T = 20
SYSTEM = random_system(2)
MODEL, START = SYSTEM.model(), SYSTEM.start()
Y = simulate(SYSTEM, 2, T, 0.2)[1]
WAYS = pytest.mark.parametrize("way", [taylor(), unscented()], ids=["taylor", "unscented"])


def by_the_book(solution, system, y, rtol=1e-9):
    means, covariances, log_likelihood, _ = kalman_filter(system, y)
    np.testing.assert_allclose(solution.mean, means, rtol=rtol, atol=1e-10)
    np.testing.assert_allclose(solution.covariance, covariances, rtol=rtol, atol=1e-9)
    assert float(solution.log_likelihood) == pytest.approx(log_likelihood.sum(), rel=1e-9)


# ------------------------------------------------------------------------------------- each hook


@pytest.mark.parametrize(
    ("way", "form"), [(taylor(), "sqrt"), (unscented(), "joseph")], ids=["taylor", "unscented"]
)
def test_process_and_before_scale_the_noise_and_before_refuses_components(way, form):
    def double(memory, transition):
        return memory, transition._replace(noise=2.0 * transition.noise)

    def weigh(memory, prior, o):
        return (
            memory,
            prior,
            o._replace(noise=3.0 * o.noise, accepted=o.accepted & jnp.array([True, True, False])),
        )

    rules = [Rule(process=double), Rule(before=weigh)]
    solution = run(kalman(way, rules, form), MODEL, START, Y)
    without = Y.copy()
    without[:, 2] = np.nan
    by_the_book(solution, SYSTEM._replace(G=2.0 * SYSTEM.G, W=3.0 * SYSTEM.W), without)
    info = solution.steps.info["y"]
    seen = np.isfinite(info.innovation)
    np.testing.assert_array_equal(seen, np.isfinite(Y))  # those refused are shown, but not used
    assert not np.any(info.used[:, 2])
    assert Code.DONE not in info.code.tolist()


def test_what_a_rule_refuses_whole_is_refused_and_what_is_missing_is_missing():
    def nothing(memory, prior, o):
        return memory, prior, o._replace(accepted=jnp.zeros_like(o.accepted))

    y = Y.copy()
    y[4] = np.nan
    solution = run(kalman(rules=[Rule(before=nothing)]), MODEL, START, y)
    predicted = solution.steps.prediction.belief
    np.testing.assert_array_equal(solution.mean, predicted.mean)
    np.testing.assert_array_equal(solution.steps.posterior.factor, predicted.factor)
    code = np.asarray(solution.steps.info["y"].code)
    gone = np.all(np.isnan(y), axis=1)
    assert gone[4]
    np.testing.assert_array_equal(code, np.where(gone, Code.MISSING, Code.REFUSED))


def test_a_rule_cannot_use_what_was_not_measured():
    def everything(memory, prior, o):
        return memory, prior, o._replace(accepted=jnp.ones_like(o.accepted))

    by_the_book(run(kalman(rules=[Rule(before=everything)]), MODEL, START, Y), SYSTEM, Y)


@WAYS
def test_another_prior_has_the_measurement_seen_again(way):
    # Fading a prior must move the sigma points too: h is curved, so its mean and its excess change.
    def fade(memory, prior, o):
        return memory, prior._replace(factor=2.0 * prior.factor), o._replace(noise=0.5 * o.noise)

    read = lambda x, aux: jnp.stack([x[0] ** 2, jnp.sin(x[1])])  # noqa: E731
    sensor = Sensor(read, jnp.array([0.3, 0.2]), 2)
    prior = Belief(jnp.array([0.7, -0.4]), jnp.array([[0.3, 0.0], [0.1, 0.2]]))
    y = jnp.array([1.1, jnp.nan])
    faded, plain = kalman(way, [Rule(before=fade)]), kalman(way)
    got, seen = faded.update(faded.init(prior, {"y": 2}), sensor, y)
    wide = Belief(prior.mean, 2.0 * prior.factor)
    half = Sensor(read, jnp.array([0.15, 0.1]), 2)
    want, expected = plain.update(plain.init(wide, {"y": 2}), half, y)
    np.testing.assert_array_equal(got.belief.mean, want.belief.mean)
    np.testing.assert_array_equal(got.belief.factor, want.belief.factor)
    np.testing.assert_array_equal(seen.innovation, expected.innovation)
    np.testing.assert_array_equal(seen.factor, expected.factor)
    narrow = plain.update(plain.init(prior, {"y": 2}), half, y)[1]
    assert np.max(np.abs(narrow.factor - seen.factor)) > 0.01


def test_seeing_again_keeps_what_other_rules_refused():
    def refuse(memory, prior, o):
        return memory, prior, o._replace(accepted=o.accepted & jnp.array([False, True, True]))

    def fade(memory, prior, o):
        return memory, prior._replace(factor=1.5 * prior.factor), o

    one = kalman(rules=[Rule(before=refuse), Rule(before=fade)])
    state = one.init(START, MODEL.dims)
    _, info = one.update(state, MODEL.sensors[0], jnp.ones(3))
    assert info.used.tolist() == [False, True, True]


def test_a_prior_that_is_left_alone_is_not_seen_again():
    looks = []

    def read(x, aux):
        looks.append(1)
        return x[:1]

    sensor = Sensor(read, jnp.ones(1), 1)
    prior = Belief(jnp.zeros(2), jnp.eye(2))

    def count(rules):
        looks.clear()
        one = kalman(rules=rules)
        one.update(one.init(prior, {"y": 1}), sensor, jnp.ones(1))
        return len(looks)

    once = count([])
    assert count([Rule(), Rule()]) == once
    assert count([Rule(before=lambda m, p, o: (m, Belief(*p), o))]) == 2 * once


def test_after_sees_the_observation_and_the_prior_that_were_used():
    # Schmidt: the last state is considered, not estimated. K' = K without its row, and the
    # covariance of that gain in Joseph's form, from what the hook is given.
    def consider(memory, posterior, info, o):
        keep = jnp.array([1.0, 1.0, 1.0, 0.0])
        gain = keep[:, None] * info.gain
        residual = jnp.where(info.used, o.residual, 0.0)
        mean = o.prior.mean + gain @ residual
        noise = jnp.where(info.used[:, None], o.noise, 0.0)
        left = o.prior.factor - gain @ o.spread
        P = left @ left.T + gain @ noise @ noise.T @ gain.T
        return memory, Belief(mean, jnp.linalg.cholesky(P)), info

    solution = run(kalman(rules=[Rule(after=consider)]), MODEL, START, Y[:5])
    m, P = SYSTEM.m0, SYSTEM.P0
    for k in range(5):
        m, P = SYSTEM.F @ m, SYSTEM.F @ P @ SYSTEM.F.T + SYSTEM.Q
        here = np.isfinite(Y[k])
        H, R = SYSTEM.H[here], SYSTEM.R[np.ix_(here, here)]
        K = np.diag([1.0, 1.0, 1.0, 0.0]) @ P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        m = m + K @ (Y[k, here] - H @ m)
        left = np.eye(4) - K @ H
        P = left @ P @ left.T + K @ R @ K.T
        np.testing.assert_allclose(solution.mean[k], m, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(solution.covariance[k], P, rtol=1e-8, atol=1e-9)


# ------------------------------------------------------------------------------- order and memory


def scaling(factor, shift):
    """Noise times a factor, then a shift: not commuting."""

    def process(memory, transition):
        return memory, transition._replace(noise=factor * transition.noise + shift)

    def before(memory, prior, o):
        return memory, prior, o._replace(noise=factor * o.noise + shift * jnp.eye(3))

    def after(memory, posterior, info, o):
        factor_ = factor * posterior.factor + shift * jnp.eye(4)
        return memory, posterior._replace(factor=factor_), info

    return Rule(process=process, before=before, after=after)


def test_rules_act_in_the_order_given():
    first, second = scaling(2.0, 0.0), scaling(1.0, 0.1)
    together = scaling(2.0, 0.1)
    one = run(kalman(rules=[first, second]), MODEL, START, Y)
    np.testing.assert_allclose(
        one.mean, run(kalman(rules=[together]), MODEL, START, Y).mean, rtol=1e-12, atol=1e-13
    )
    other = run(kalman(rules=[second, first]), MODEL, START, Y)
    assert np.max(np.abs(one.mean - other.mean)) > 1e-3


def count_outcomes():
    """A rule that remembers, by sensor, how often each of its hooks was called."""

    def init(belief, dims):
        return jnp.zeros((), int), {name: jnp.zeros((2, m), int) for name, m in dims.items()}

    def process(memory, transition):
        return (memory[0] + 1, memory[1]), transition

    def before(memory, prior, o):
        steps, sensors = memory
        counted = sensors[o.sensor].at[0].add(o.present.astype(int))
        return (steps, {**sensors, o.sensor: counted}), prior, o

    def after(memory, posterior, info, o):
        steps, sensors = memory
        counted = sensors[o.sensor].at[1].add(info.used.astype(int))
        return (steps, {**sensors, o.sensor: counted}), posterior, info

    return Rule(init, process, before, after, "count")


def test_memory_is_kept_by_sensor():
    F, G, H = (jnp.array(a) for a in SYSTEM[:3])
    near = Sensor(lambda x, aux: H[:2] @ x, jnp.ones(2), 2, "near")
    far = Sensor(lambda x, aux: H[2:] @ x, jnp.ones(1), 1, "far")
    model = Model(Motion(lambda x, u: F @ x, G), (near, far))
    y = {"near": Y[:, :2], "far": Y[:, 2:]}
    solution = run(kalman(rules=[Rule(), count_outcomes()]), model, START, y)
    steps, sensors = solution.final.memory[1]
    assert int(steps) == T
    for name, part in y.items():
        want = np.isfinite(part).sum(axis=0)
        np.testing.assert_array_equal(sensors[name], [want, want])


def test_memory_is_restored_when_a_step_is_not_taken():
    one = kalman(rules=[count_outcomes()])
    broken = Motion(lambda x, u: x * jnp.nan, jnp.ones(4))
    state = one.init(START, MODEL.dims)
    after, prediction = one.predict(state, broken)
    assert int(prediction.code) == Code.NOT_FINITE
    assert int(after.memory[0][0]) == 0
    after, info = one.update(state, MODEL.sensors[0], np.full(3, 1e308))
    assert int(info.code) == Code.NOT_FINITE
    assert not np.any(after.memory[0][1]["y"])
    after, info = one.update(state, MODEL.sensors[0], np.ones(3))
    np.testing.assert_array_equal(after.memory[0][1]["y"], np.ones((2, 3)))


def test_a_rule_that_breaks_the_belief_or_its_memory_is_not_followed():
    def infinite(memory, posterior, info, o):
        return memory, posterior._replace(factor=posterior.factor * jnp.inf), info

    def forgets(memory, posterior, info, o):
        return memory * jnp.nan, posterior, info

    for hook in (infinite, forgets):
        one = kalman(rules=[Rule(init=lambda belief, dims: jnp.ones(2), after=hook)])
        state = one.init(START, MODEL.dims)
        after, info = one.update(state, MODEL.sensors[0], jnp.ones(3))
        assert int(info.code) in (Code.NOT_FINITE, Code.INDEFINITE)
        np.testing.assert_array_equal(after.belief.factor, START.factor)
        np.testing.assert_array_equal(after.memory[0], np.ones(2))


def test_memory_may_hold_keys_and_counters():
    def init(belief, dims):
        return {"key": jax.random.key(1), "count": jnp.zeros((), int), "on": jnp.array(True)}

    def process(memory, transition):
        key, _ = jax.random.split(memory["key"])
        return {**memory, "key": key, "count": memory["count"] + 1}, transition

    of_jax = filters.run  # a key has no place in a program
    solution = of_jax(kalman(rules=[Rule(init=init, process=process)]), MODEL, START, Y)
    by_the_book(solution, SYSTEM, Y)
    assert int(solution.final.memory[0]["count"]) == T


# ------------------------------------------------------------------------- judging an innovation


def test_normalised_is_what_the_update_will_say():
    def look(memory, prior, o):
        return normalised(o), prior, o

    def at_zero():
        return normalised(taylor().observation(START, MODEL.sensors[0], jnp.zeros(3), None))

    nothing = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), jax.eval_shape(at_zero))
    start = Rule(before=look, init=lambda belief, dims: nothing)
    for way in (taylor(), unscented(), unscented(1.0, 0.0, -1.0)):
        one = kalman(way, [start])
        state = one.init(START, MODEL.dims)
        state, info = jax.jit(one.update)(state, MODEL.sensors[0], jnp.array(Y[0]))
        (judged,) = state.memory
        np.testing.assert_allclose(judged.nis, info.nis, rtol=1e-12)
        np.testing.assert_allclose(judged.factor, info.factor, rtol=1e-12, atol=1e-14)
        np.testing.assert_array_equal(judged.used, info.used)
        assert int(judged.dof) == int(info.dof) == int(np.isfinite(Y[0]).sum())
        assert float(jnp.sum(judged.white**2)) == pytest.approx(float(judged.nis), rel=1e-14)
