"""The discriminator against its recursion written down plainly; and the scale of the noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import System, random_system, simulate
from in_lanes import each
from interpreted import run
from scipy import optimize, signal, stats

from robins.filters import Belief, Code, Model, Motion, Observation, Sensor, kalman, unscented
from robins.filters.rules._fading import chance_levels
from robins.filters.rules._robust import MOST, scale_to_quantile
from robins.filters.rules.discriminator import PUBLISHED, DiscriminatorVerdict, discriminator
from robins.manifold import Angle

T, PATIENCE, RHO = 60, 4, 0.9
SYSTEM = random_system(5)._replace(W=np.diag([0.5, 2.0, 1.3]))
MODEL, START = SYSTEM.model(), SYSTEM.start()


def disturbed() -> np.ndarray:
    """Measurements with holes, two short bursts and a lasting fault."""
    y = simulate(SYSTEM, 5, T, 0.2)[1]
    y[10:13] += 25.0
    y[20, 1] -= 60.0
    y[30:48] += 25.0 * np.sin(np.arange(18.0))[:, None]
    y[11] = y[35] = np.nan
    return y


Y = disturbed()
# Rule and form, and what the recursion is told: probability, multiple, gated, sigmas, limit.
KINDS = {
    "projected, Huber": (
        discriminator(PATIENCE, 0.999, RHO, threshold=PUBLISHED, limit=20.0),
        "sqrt",
        (0.999, False, False, 3.0, 20.0),
    ),
    "multiple, gate": (
        discriminator(
            PATIENCE, 0.99, RHO, "multiple", "gate", threshold=1, weights=[2.0, 1.0, 1.6, 0.5]
        ),
        "joseph",
        (0.99, True, True, 1.0, 1e3),
    ),
}


def surprise(scale, r, H, P, R) -> float:
    """The NIS with R scaled."""
    return r @ np.linalg.inv(H @ P @ H.T + scale * R) @ r


def beyond(log_scale, k2, *given) -> float:
    return surprise(np.exp(log_scale), *given) - k2


def book(s: System, y: np.ndarray, probability, multiple, gated, sigmas, limit) -> dict:
    """The recursion with inverses, R diagonal; the noise scale by bracketing."""
    m, P, count = s.m0, s.P0, 0
    alpha = np.array([2.0, 1.0, 1.6, 0.5]) / 2.0
    V = np.diag(s.R).copy()
    out = {name: [] for name in ("mean", "weight", "lambda", "counter", "state")}
    for row in y:
        m, P = s.F @ m, s.F @ P @ s.F.T + s.Q
        here = np.flatnonzero(np.isfinite(row))
        weight, lam, state = 1.0, 1.0, 0
        if len(here):
            H, R = s.H[here], s.R[np.ix_(here, here)]
            r, size = row[here] - H @ m, len(here)
            k2 = stats.chi2.ppf(probability, size)

            count = count + 1 if surprise(1.0, r, H, P, R) > k2 else 0
            if 0 < count < PATIENCE:
                state = 1
                bracket = optimize.root_scalar(
                    beyond, args=(k2, r, H, P, R), bracket=(0.0, 25.0), xtol=1e-13
                )
                weight = 0.0 if gated else np.exp(-bracket.root)
            else:
                V[here] = RHO * V[here] + (1 - RHO) * r**2
                inverse = np.linalg.inv(R)
                trace_V = np.sum(V[here] / np.diag(R))
                M = np.trace(inverse @ H @ P @ H.T)
                allowed = 1 + sigmas * np.sqrt(2 * (1 - RHO) / ((1 + RHO) * size))
                if trace_V > allowed * (M + size):
                    seen = P @ H.T @ inverse @ H
                    lam = (trace_V - size) / (alpha @ np.diag(seen) if multiple else M)
                    lam = min(max(lam, 1.0), limit)
                if multiple:
                    root = np.diag(np.sqrt(np.maximum(alpha * lam, 1.0)))
                    P = root @ P @ root
                else:
                    P = P + (lam - 1) * P @ H.T @ np.linalg.inv(H @ P @ H.T) @ H @ P
                state = 2 if lam > 1.0 or count >= PATIENCE else 0
            if weight > 0.0:
                K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R / weight)
                m = m + K @ r
                left = np.eye(4) - K @ H
                P = left @ P @ left.T + K @ R @ K.T / weight
        for name, value in zip(out, (m, weight, lam, count, state), strict=True):
            out[name].append(value)
    return {name: np.array(values) for name, values in out.items()}


@pytest.mark.parametrize("name", KINDS)
def test_is_its_recursion(name):
    rule, form, told = KINDS[name]
    want = book(SYSTEM, Y, *told)
    solution = run(kalman(rules=[rule], form=form), MODEL, START, Y)
    info = solution.steps.info["y"]
    for note in ("counter", "state", "weight", "lambda"):
        got = info.notes[f"discriminator.{note}"]
        np.testing.assert_allclose(got, want[note], rtol=1e-8, err_msg=note)
    np.testing.assert_allclose(solution.mean, want["mean"], rtol=1e-8, atol=1e-9)
    # every verdict was passed: the bursts outlasted nobody's patience, the lasting fault did
    state = want["state"]
    assert set(state[[10, 12, 20]]) == {DiscriminatorVerdict.OUTLIER}
    assert np.count_nonzero(state[30:48] == DiscriminatorVerdict.MODEL) > 5
    assert np.count_nonzero(state == DiscriminatorVerdict.CLEAN) > 10
    # and a burst goes on behind a measurement that is missing
    assert info.notes["discriminator.counter"][9:14].tolist() == [0, 1, 1, 2, 0]
    refused = np.asarray(info.code) == Code.REFUSED
    np.testing.assert_array_equal(
        refused, (state == DiscriminatorVerdict.OUTLIER) & ("gate" in name)
    )


def test_clean_data_is_left_alone():
    # 0.1 % of right measurements are taken for outliers, and V exceeds no level by chance.
    y = simulate(SYSTEM, 8, 4000)[1]
    strict = kalman(rules=[discriminator(30)])
    notes = run(strict, MODEL, START, y).steps.info["y"].notes
    outliers = np.mean(np.asarray(notes["discriminator.state"]) == DiscriminatorVerdict.OUTLIER)
    assert abs(outliers - 0.001) < 4 * np.sqrt(0.001 / 4000)
    assert np.all(np.asarray(notes["discriminator.lambda"]) == 1.0)


@pytest.mark.parametrize(("rho", "least"), [(0.9, 0.4), (0.98, 0.1)])
@pytest.mark.parametrize("m", [1, 3])
def test_levels_are_exceeded_in_a_run_no_more_often_than_stated(rho, least, m):
    rng, runs, steps, stated = np.random.default_rng(6), 4000, 600, 0.2
    squares = rng.chisquare(m, size=(runs, steps))
    average, _ = signal.lfilter([1 - rho], [1, -rho], squares, zi=np.full((runs, 1), rho * m))
    level = chance_levels(rho, m, stated / steps)[m]
    share = np.mean(np.max(average, axis=1) > level * m)
    assert least * stated < share < stated
    # At one time alone it is the tail that it should be, of which the runs are independent.
    level = chance_levels(rho, m, 0.002)[m]
    share = np.mean(average[:, 299::300] > level * m)
    assert abs(share - 0.002) < 4 * np.sqrt(0.002 / (2 * runs))


def test_a_right_model_is_doubted_no_more_often_in_a_run_than_stated():
    runs, steps, stated = 200, 600, 0.5
    model = Model(
        Motion(lambda x, u: x, jnp.array([0.05])),
        (Sensor(lambda x, aux: x, jnp.array([1.0]), 1),),
    )
    rng = np.random.default_rng(9)
    x = np.cumsum(0.05 * rng.normal(size=(runs, steps)), axis=1)
    y = jnp.asarray((x + rng.normal(size=(runs, steps)))[..., None])

    def doubted(**given):
        one = kalman(rules=[discriminator(probability=1, **given)])
        start = Belief.of(jnp.zeros(1), np.array([[1e-4]]))
        notes = each(lambda z: run(one, model, start, z).steps.info["y"].notes)(y)
        factor = np.asarray(notes["discriminator.lambda"])
        return np.mean(np.any(factor > 1.0, axis=1))

    assert 0.1 * stated < doubted(rho=0.9, false_alarm=stated, looks=steps) < stated
    assert doubted(rho=0.9, false_alarm=stated, looks=100 * steps) < 0.1 * stated
    assert doubted(rho=0.9, threshold=PUBLISHED) > stated


def test_each_sensor_has_a_counter_of_its_own_and_angles_wrap():
    def turn(x, u):
        heading, rate = x
        return heading.retract(0.1 * rate), rate

    steps = 200
    rng = np.random.default_rng(3)
    true = 3.0 + 0.02 * jnp.arange(1.0, steps + 1.0)
    a, b = 0.05 * jnp.array(rng.normal(size=(2, steps)))
    a = a.at[100:105].add(1.0)
    model = Model(
        Motion(turn, jnp.array([1e-3, 1e-3])),
        tuple(Sensor(lambda x, aux: x[0], jnp.array([0.05]), 1, name) for name in "ab"),
    )
    start = Belief.of((Angle(3.0), jnp.array([0.2])), np.diag([0.01, 0.01]))
    y = {"a": Angle(true + a), "b": Angle(true + b)}
    solution = run(kalman(unscented(), [discriminator(10)]), model, start, y)
    counter = {
        name: np.asarray(solution.steps.info[name].notes["discriminator.counter"]) for name in "ab"
    }
    np.testing.assert_array_equal(counter["a"][99:106], [0, 1, 2, 3, 4, 5, 0])
    assert not np.any(counter["b"][99:106])
    error = np.asarray(Angle(true).local(solution.mean[0])[:, 0])
    assert np.max(np.abs(error[20:])) < 0.1  # the burst was 1 rad
    assert np.max(true) > 2.0 * np.pi


# ------------------------------------------------------------------------ the scale of the noise


def observation(r, H, P, W, accepted=None) -> Observation:
    m = len(r)
    used = jnp.ones(m, bool) if accepted is None else jnp.asarray(accepted)
    prior = Belief(jnp.zeros(len(P)), jnp.linalg.cholesky(P))
    spread = H @ prior.factor
    return Observation(
        "y", prior, r, used, used, spread, jnp.zeros((m, 0)), W, jnp.sum(spread**2, axis=1)
    )


def at_limit(r, H, P, W, accepted, limit):
    return scale_to_quantile(observation(r, H, P, W, accepted), limit)


def draws(count: int) -> tuple:
    rng = np.random.default_rng(2)
    r = rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-1, 3, size=(count, 1))
    H = rng.normal(size=(count, 3, 4))
    A = rng.normal(size=(count, 4, 4)) * 10.0 ** rng.uniform(-1.5, 0.5, size=(count, 1, 1))
    W = rng.normal(size=(count, 3, 3)) * 10.0 ** rng.uniform(-1, 1, size=(count, 3, 1))
    P = A @ np.swapaxes(A, 1, 2) + 1e-3 * np.eye(4)
    return r, H, P, W, rng.random((count, 3)) < 0.8


def test_the_scaled_noise_makes_the_innovation_as_large_as_the_limit():
    limit, given = 11.3, draws(300)
    scales = np.asarray(jax.jit(jax.vmap(at_limit, (0, 0, 0, 0, 0, None)))(*given, limit))
    above = reached = 0
    for s, r, H, P, W, used in zip(scales, *given, strict=True):
        H, R, r = H[used], (W @ W.T)[np.ix_(used, used)], r[used]
        nis = [r @ np.linalg.solve(H @ P @ H.T + k * R, r) if used.any() else 0 for k in (1.0, s)]
        if nis[0] <= limit:
            assert s == 1.0
        else:
            above += 1
            reached += s < MOST
            assert nis[1] == pytest.approx(limit, rel=1e-6) or (s == MOST and nis[1] > limit)
    assert 50 < reached == above < 250


def test_the_slope_of_the_scale_is_that_of_the_root():
    # Noise and prediction alike in all directions: repeated eigenvalues must do no harm.
    r, P = jnp.array([5.0, 3.0, 2.0]), 0.5 * jnp.eye(3)

    def scale(a):
        return scale_to_quantile(
            observation(a[0] * r, jnp.eye(3), a[1] * P, a[2] * jnp.eye(3)), 3.0
        )

    # 38 a0^2 / (a1 / 2 + s a2^2) = 3
    one = jnp.ones(3)
    assert float(scale(one)) == pytest.approx(38 / 3 - 0.5, rel=1e-12)
    gradient = jax.jit(jax.grad(scale))
    slope = gradient(one)
    np.testing.assert_allclose(slope, [76 / 3, -0.5, -2 * (38 / 3 - 0.5)], rtol=1e-10)
    within = gradient(jnp.array([1e-2, 1.0, 1.0]))  # a residual too small to be scaled
    np.testing.assert_array_equal(within, np.zeros(3))


def test_what_has_no_noise_cannot_be_made_likely():
    r = jnp.array([9.0, 9.0])
    assert float(at_limit(r, jnp.eye(2), jnp.eye(2), jnp.zeros((2, 2)), None, 5.0)) == MOST
