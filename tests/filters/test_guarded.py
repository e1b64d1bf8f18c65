"""Guarded filters, against a dense recursion of filters and weight, and by what they lose."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from in_lanes import each
from interpreted import run

from robins.filters import (
    Belief,
    Code,
    Model,
    Motion,
    Rule,
    Sensor,
    StepWarning,
    channel,
    distributed,
    guarded,
    kalman,
)
from robins.filters.rules import gate, igg3
from robins.manifold import Angle

# Position and velocity on two axes: an unmodelled accelerometer offset, positions of 25 m at 1 Hz
# and a velocity that is said to be known.
F1, Q1 = np.array([[1.0, 1.0], [0.0, 1.0]]), 0.07**2 * np.array([[1 / 3, 0.5], [0.5, 1.0]])
F, Q = np.kron(F1, np.eye(2)), np.kron(Q1, np.eye(2))  # states: position (2), velocity (2)
H, HOLD = np.eye(4)[:2], np.eye(4)[2:]
P0 = np.diag([30.0, 30.0, 0.1, 0.1]) ** 2
STEPS, RUNS, SAR_M, GROUPS = 700, 24, 25.0, ((0, 1), (2, 3))
GUARD = {"assumption": "wind", "judges": "sar", "groups": GROUPS}


# One set of functions, so that runs of one filter are compiled once.
MOTION = Motion(lambda x, u: jnp.asarray(F) @ x, np.linalg.cholesky(Q))
READS = {"sar": lambda x, aux: x[:2], "wind": lambda x, aux: x[2:]}
PLAIN, ONE = kalman(), guarded(kalman(), kalman(), **GUARD)


def model(sigma):
    noise = {"sar": jnp.full(2, SAR_M), "wind": jnp.full(2, sigma)}
    return Model(MOTION, tuple(Sensor(READS[k], noise[k], 2, k) for k in noise))


def flown():
    """True states and positions measured: (runs, steps, ...)."""
    rng = np.random.default_rng(3)
    offset = 9.8e-3 * rng.choice([-1.0, 1.0], size=(RUNS, 2))  # 1 mg
    x, xs = rng.normal(size=(RUNS, 4)) @ np.sqrt(P0), []
    noise = np.kron(np.linalg.cholesky(Q1 / 0.07**2) * 4.9e-3, np.eye(2))
    for _ in range(STEPS):
        x = (
            x @ F.T
            + np.concatenate([0.5 * offset, offset], 1)
            + rng.normal(size=(RUNS, 4)) @ noise.T
        )
        xs.append(x)
    truth = np.stack(xs, 1)
    return truth, truth[..., :2] + SAR_M * rng.normal(size=(RUNS, STEPS, 2))


def held(truth, white, lasting, jump=0.0, seed=4):
    """The velocity that is said to be known: white error, one of 50 s, and a jump at half time."""
    rng = np.random.default_rng(seed)
    a, e, errors = np.exp(-1 / 50.0), lasting * rng.normal(size=(RUNS, 2)), []
    for _ in range(STEPS):
        e = a * e + lasting * np.sqrt(1 - a * a) * rng.normal(size=(RUNS, 2))
        errors.append(e + white * rng.normal(size=(RUNS, 2)))
    off = np.stack(errors, 1)
    off[:, STEPS // 2 :, 0] += jump
    return truth[..., 2:] + off


TRUTH, SAR = flown()
SEEN = 16  # runs that are filtered, of all
START = Belief.of(np.zeros(4), P0)


@each
def _both(given):
    sigma, y, z = given
    got = run(ONE, model(sigma), START, {"sar": y, "wind": z}).steps
    plain, bold = (
        run(PLAIN, model(sigma), START, {"sar": y, "wind": one}).steps.posterior
        for one in (jnp.full_like(z, jnp.nan), z)
    )
    return got.posterior, plain, bold, got.info


def both(sigma, wind):
    """Beliefs of the guarded filter and of its parts, and what it notes of each update."""
    return _both((np.full(SEEN, sigma), SAR[:SEEN], wind[:SEEN]))


def mean_error(found, part):
    error = (np.asarray(found.mean) - TRUTH[:SEEN])[:, 100:, part]
    return float(np.mean(np.linalg.norm(error, axis=-1)))


def ratio(found):
    """Error squared over the stated variance, of level velocity."""
    return float(np.mean(((found.mean - TRUTH[:SEEN]) / found.sigma)[:, 100:, V] ** 2))


P, V = slice(0, 2), slice(2, 4)

# what the velocity is, and what it is said to be: errors white, lasting, jump; deviation believed
WRONG = {
    "exact, but 0.3 white and 0.3 lasting": (0.3, 0.3, 0.0, 1e-3),
    "exact, but half white, half lasting": (0.21, 0.21, 0.0, 1e-3),
    "exact, but 1 m/s white": (1.0, 0.0, 0.0, 1e-3),
    "lasting error taken for white": (0.3, 0.3, 0.0, 0.42),
    "a wind wrong by 7 m/s from half time": (0.05, 0.0, 7.0, 0.05),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_costs_nothing(case):
    """No more error than the reference, off by its own offset, and none of it left unstated."""
    white, lasting, jump, sigma = WRONG[case]
    got, plain, bold, said = both(sigma, held(TRUTH, white, lasting, jump))
    assert ratio(got) < 2.0 * max(ratio(plain), 1.0) < ratio(bold)
    assert max(mean_error(bold, p) / mean_error(plain, p) for p in (P, V)) > 1.25
    for part in (P, V):
        assert mean_error(got, part) < 1.01 * mean_error(plain, part)
    assert np.all(said["wind"].notes["guarded.trips"][:, -1] >= 1)


def test_a_weight_falls_and_comes_back_with_what_is_right():
    """Wrong by 7 m/s until half time: no better than the reference till then, and exact after."""
    wind = held(TRUTH, 0.05, 0.0)
    wind[:, : STEPS // 2, 0] += 7.0
    got, plain, _, said = both(0.05, wind)

    def off(found, begin, end):
        error = (np.asarray(found.mean) - TRUTH[:SEEN])[:, begin:end, V]
        return float(np.mean(np.linalg.norm(error, axis=-1)))

    assert off(got, 100, 350) < 1.01 * off(plain, 100, 350)
    assert off(got, 600, 700) < 0.3 * off(plain, 600, 700)
    weight = np.asarray(said["sar"].notes["guarded.weight"])
    assert np.max(weight[:, 50:350]) < 0.1
    assert np.mean(weight[:, 600:]) > 0.9


def test_an_error_as_large_as_the_gain_is_weighed_to_less_than_either():
    """A lasting error b^2 = beta G: by theory P_u - w G, which is below both P_u and P_c + b^2."""
    got, plain, bold, said = both(0.42, held(TRUTH, 0.3, 0.3))
    assert mean_error(got, V) < 0.9 * min(mean_error(plain, V), mean_error(bold, V))
    weight = np.asarray(said["sar"].notes["guarded.weight"])[:, 100:]
    assert 0.3 < np.mean(weight) < 0.9


def test_what_is_right_keeps_most_of_its_gain():
    got, plain, bold, said = both(0.05, held(TRUTH, 0.05, 0.0))
    assert ratio(got) < 1.0
    for part in (P, V):
        gain = mean_error(plain, part) - mean_error(bold, part)
        assert gain > 0.7 * mean_error(plain, part)
        assert mean_error(plain, part) - mean_error(got, part) > 0.9 * gain
    assert np.mean(said["wind"].notes["guarded.trips"][:, -1]) < 0.3


# --------------------------------------------------------------------- the verdict, step by step

LIMIT, PATIENCE, RATIO = 6.0, 2.0, 1.6


def corrected(x, A, C, y, R):
    K = A @ C.T @ np.linalg.inv(C @ A @ C.T + R)
    return x + K @ (y - C @ x), A - K @ C @ A


def by_the_book(sar, wind, sigma):
    """Both filters in covariances, and the sums; a look is a row of what happened in it."""
    c, u, trips = (np.zeros(4), P0), (np.zeros(4), P0), 0
    g, E, gain, looks = np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2)
    out = []

    def verdict(w):
        nonlocal c, trips, g, E, gain, looks
        p, d = np.diag(u[1]), c[0] - u[0]
        T, v = d**2 / p, np.maximum(1 - np.diag(c[1]) / p, 0.0)

        def grouped(x):
            return (w * x).reshape(2, 2)

        g = np.maximum(0.0, g + grouped(T - RATIO * v - 0.1).sum(1))
        kept = np.exp(-grouped(1.0).mean(1).max() / PATIENCE)
        looks = kept * looks + grouped(1.0).mean(1)
        gain = kept * gain + grouped(v).mean(1)
        E = kept * E + grouped(np.minimum(T, 36.0) / (RATIO / 2) - v).mean(1)
        sure = np.any(np.abs(d).reshape(2, 2) > 6.0 * np.sqrt(p).reshape(2, 2), axis=1)
        E = np.where(sure, 36.0 * (gain + 0.1 * np.maximum(looks, 1.0)), E)
        if np.any(sure) or np.any(g > LIMIT):
            c, g, trips = u, np.zeros(2), trips + 1

    def weight():
        beta = max(np.max(E / (gain + 0.1 * np.maximum(looks, 1.0))), 0.0)
        return 1.0 / (1.0 + max(beta - 0.5, 0.0)), beta

    for y, z in zip(sar, wind, strict=True):
        c, u = ((F @ x, F @ A @ F.T + Q) for x, A in (c, u))
        verdict(np.zeros(4))
        if np.all(np.isfinite(y)):
            before = np.diag(u[1])
            c, u = (corrected(*s, H, y, SAR_M**2 * np.eye(2)) for s in (c, u))
            verdict(1 - np.diag(u[1]) / before)
        believed = weight()[0] >= 0.5
        c = corrected(*c, HOLD, z, sigma**2 * np.eye(2))
        verdict(np.zeros(4))
        w, beta = weight()
        # of u's error, and w times the difference's, of which P_u - P_c is common to both
        G = u[1] - c[1]
        mean, P = u[0] + w * (c[0] - u[0]), u[1] - 2.0 * w * G + w**2 * (1.1 + beta) * G
        out.append((mean, P, w, believed, g.max() / LIMIT, trips))
    return [np.array(series) for series in zip(*out, strict=True)]


STRICT = guarded(
    kalman(), kalman(), **GUARD, limit=LIMIT, patience=PATIENCE, ratio=RATIO
)  # fmt: skip


@pytest.mark.parametrize("run_", [4, 6])
def test_the_weight_is_that_of_a_dense_recursion(run_):
    # Lasting errors at which weight comes and goes, a gross one, and a judge that is silent.
    sar, wind = SAR[run_].copy(), held(TRUTH, 0.05, 0.2)[run_]
    sar[250:330] = np.nan
    wind[600] += 9.0
    mean, P, weight, believed, evidence, trips = by_the_book(sar, wind, 0.05)
    assert trips[-1] >= 2
    assert np.min(weight) < 0.1
    assert np.max(weight[300:]) == 1.0
    assert len(set(weight[251:330])) == 1  # nothing is learnt where no judge measures
    got = run(STRICT, model(0.05), START, {"sar": sar, "wind": wind})
    notes = got.steps.info["wind"].notes
    np.testing.assert_allclose(notes["guarded.weight"], weight, rtol=1e-8)
    np.testing.assert_array_equal(notes["guarded.trips"], trips)
    np.testing.assert_allclose(notes["guarded.evidence"], evidence, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(got.mean, mean, rtol=1e-8, atol=1e-7)
    np.testing.assert_allclose(got.covariance, P, rtol=1e-7, atol=1e-8)
    # What is said is said by the filter that had the greater weight when it was measured.
    code = np.asarray(got.steps.info["wind"].code)
    np.testing.assert_array_equal(code == Code.DONE, believed)
    assert set(code[~believed].tolist()) == {Code.REFUSED}
    plain = run(PLAIN, model(0.05), START, {"sar": sar, "wind": np.full_like(wind, np.nan)})
    given = np.asarray(got.steps.info["sar"].notes["guarded.weight"])[:-1] < 0.4
    assert np.any(given)
    for field in ("innovation", "nis", "factor", "gain"):
        seen, want = (np.asarray(getattr(x.steps.info["sar"], field)) for x in (got, plain))
        doubted = np.flatnonzero(weight[:-1] < 0.5) + 1
        np.testing.assert_array_equal(seen[doubted], want[doubted])


def test_nothing_is_learnt_where_there_is_no_judge():
    silent = np.full((STEPS, 2), np.nan)
    data = {"sar": silent, "wind": held(TRUTH, 0.05, 0.0)[0]}
    for trusted, weight in ((True, 1.0), (False, 1.0 / 36.5)):
        one = guarded(kalman(), kalman(), **GUARD, trusted=trusted, leap=np.inf)
        got = run(one, model(0.05), START, data)
        np.testing.assert_allclose(got.steps.info["wind"].notes["guarded.weight"], weight)
        if trusted:
            plain = run(PLAIN, model(0.05), START, data)
            np.testing.assert_array_equal(got.mean, plain.mean)
            assert float(got.log_likelihood) == float(plain.log_likelihood)


# ------------------------------------------------------------------------ filters of all kinds


def locals_(wind):
    star = channel("star")
    return distributed([channel(["sar", "wind"] if wind else "sar"), star])


def test_a_joined_filter_takes_over_local_by_local():
    base = model(0.05)
    star = Sensor(lambda x, aux: x[:1] + x[2:3], jnp.array([20.0]), 1, "star")
    three = Model(base.motion, (base.sensors[0], star, base.sensors[1]))
    data = {"sar": SAR[0], "wind": TRUTH[0, :, 2:]}  # the other local only predicts
    one = guarded(locals_(True), locals_(False), **GUARD, limit=1e3)
    data["wind"] = np.where(np.arange(STEPS)[:, None] == 20, 20.0, 0.0) + data["wind"]
    got = run(one, three, START, {k: v[:21] for k, v in data.items()})
    notes, state = got.steps.info["wind"].notes, got.final
    assert notes["guarded.weight"].tolist()[:20] == [1.0] * 20
    assert notes["guarded.trips"].tolist() == [0] * 20 + [1]
    mine, other = (getattr(state.memory, side) for side in ("filter", "reference"))
    for a, b in zip(mine.memory.members, other.memory.members, strict=True):
        np.testing.assert_array_equal(a.belief.factor, b.belief.factor)
        np.testing.assert_array_equal(a.belief.mean, b.belief.mean)
    np.testing.assert_allclose(state.belief.covariance, other.belief.covariance, rtol=1e-10)


def test_a_filter_that_fails_is_replaced_and_a_lost_reference_holds_the_step():
    broken = Rule(
        before=lambda memory, prior, o: (memory, prior, o._replace(noise=o.noise * jnp.nan))
    )
    ailing = kalman(rules=[broken])
    data = {"sar": SAR[0, :20], "wind": held(TRUTH, 0.05, 0.0)[0, :20]}
    with pytest.warns(StepWarning, match="1 of 20 updates with 'sar' are NOT_FINITE"):
        got = run(guarded(ailing, kalman(), **GUARD), model(0.05), START, data)
    silent = {"sar": SAR[0], "wind": np.full((STEPS, 2), np.nan)}
    plain = run(PLAIN, model(0.05), START, silent)
    np.testing.assert_allclose(got.mean, plain.mean[:20], rtol=1e-12)
    assert int(got.steps.info["sar"].notes["guarded.trips"][-1]) == 39  # each update but the last

    lost = Motion(lambda x, u: jnp.where(u > 0.0, jnp.nan, 1.0) * x, np.linalg.cholesky(Q))
    one = guarded(kalman(), kalman(), **GUARD)
    start = one.init(START, model(0.05).dims)
    after, prediction = one.predict(start, lost, jnp.array(1.0))
    assert int(prediction.code) == Code.NOT_FINITE
    assert not after.current
    assert float(after.memory.weight) == 1.0
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(start), strict=True):
        if a.dtype != bool:  # all that is held but what says that it is
            np.testing.assert_array_equal(a, b)


def test_angles_differ_the_short_way_and_a_run_is_differentiable():
    heading = Model(
        Motion(lambda x, u: Angle(x.rad + u), jnp.array([0.01])),
        (
            Sensor(lambda x, aux: x, jnp.array([0.1]), 1, "sar"),
            Sensor(lambda x, aux: x, jnp.array([0.02]), 1, "wind"),
        ),
    )
    start = Belief.of(Angle(jnp.array(3.0)), np.array([[1e-2]]))
    rate = jnp.full(60, 0.01)  # across half a turn
    truth = 3.0 + 0.01 * jnp.arange(1.0, 61.0)
    noise = np.random.default_rng(0).normal(size=(2, 60))
    data = {"sar": Angle(truth + 0.1 * noise[0]), "wind": Angle(truth + 0.02 * noise[1])}

    @jax.jit
    @partial(jax.value_and_grad, has_aux=True)
    def total(sigma):
        wind = Sensor(heading.sensors[1].read, sigma, 1, "wind")
        two = Model(heading.motion, (heading.sensors[0], wind))
        got = run(guarded(kalman(), kalman(), "wind", "sar"), two, start, data, rate)
        return got.log_likelihood, got.steps.info["sar"].notes["guarded.trips"][-1]

    (_, trips), slope = total(jnp.array([0.02]))
    assert int(trips) == 0
    step = 1e-6
    ends = [float(total(jnp.array([0.02 + s * step]))[0][0]) for s in (-1, 1)]
    assert float(slope[0]) == pytest.approx((ends[1] - ends[0]) / (2 * step), rel=1e-4)


def test_reset_and_notes_reach_both():
    one = guarded(kalman(rules=[igg3()]), kalman(rules=[gate()]), **GUARD)
    state, info = one.update(
        one.init(START, model(0.05).dims), model(0.05).sensors[0], SAR[0, 0], None
    )
    assert {"igg3.weight", "reference.gate.ratio"} <= set(info.notes)
    after = one.reset(state, START)
    for side in ("filter", "reference"):
        np.testing.assert_array_equal(getattr(after.memory, side).belief.factor, START.factor)
    np.testing.assert_array_equal(after.belief.mean, START.mean)


REFUSED = {
    "both sides": ({"judges": "wind"}, "cannot judge"),
    "no judge": ({"judges": ()}, "name at least one"),
    "empty group": ({"groups": [(0, 1), ()]}, "groups must"),
    "ratio": ({"ratio": 0.9}, "ratio must"),
    "limit": ({"limit": 0.0}, "limit must"),
    "patience": ({"patience": np.nan}, "patience must"),
    "leap": ({"leap": -1.0}, "leap must"),
}


@pytest.mark.parametrize(("given", "said"), REFUSED.values(), ids=REFUSED)
def test_a_guard_that_makes_no_sense(given, said):
    with pytest.raises(ValueError, match=said):
        guarded(kalman(), kalman(), **(GUARD | given))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"assumption": "air"}, "no sensor 'air'"),
        ({"judges": ("sar", "radar")}, "no sensor 'radar'"),
        ({"groups": [(0, 4)]}, r"group \[0, 4\] is not of a state of 4"),
    ],
)
def test_a_guard_that_does_not_fit_the_model(given, said):
    with pytest.raises(ValueError, match=said):
        guarded(kalman(), kalman(), **(GUARD | given)).init(START, model(0.05).dims)
