"""The particle filter against the Kalman filter, against integrals, and against itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import times
from jax.tree_util import Partial
from scipy import integrate, stats

from robins.filters import Belief, Code, Model, Motion, OnlineFilter, Sensor, kalman, run
from robins.filters.composite.particle import ParticleCloud, _systematic, particle, reseed
from robins.filters.values import content
from robins.manifold import Angle

A = np.array([[1.0, 0.5], [-0.1, 0.9]])
H = np.array([[1.0, 0.3]])
MODEL = Model(
    Motion(Partial(times, jnp.array(A)), jnp.array([[0.3, 0.0], [0.1, 0.4]])),
    (Sensor(Partial(times, jnp.array(H)), jnp.array([0.6]), 1),),
)
START = Belief.of(jnp.array([1.0, -1.0]), np.array([[2.0, 0.5], [0.5, 1.0]]))
T, KEYS = 8, 64


@pytest.fixture(scope="module")
def y():
    rng = np.random.default_rng(0)
    x, out = np.array([1.5, -0.5]), []
    for _ in range(T):
        x = A @ x + np.array([[0.3, 0.0], [0.1, 0.4]]) @ rng.normal(size=2)
        out.append(H @ x + 0.6 * rng.normal(size=1))
    out[5][:] = np.nan
    return np.array(out)


def many(count, model, start, y, keys=KEYS, **options):
    """Runs over the same measurements with other draws."""

    def one(key):
        solution = run(particle(count, key, **options), model, start, y)
        return solution.mean, solution.covariance, solution.log_likelihood

    # One run after another: the thread pool of XLA can lock up on very large batches.
    return jax.jit(lambda keys: jax.lax.map(one, keys))(jax.random.split(jax.random.key(7), keys))


def test_one_step_errs_as_the_integral_says():
    # Self-normalised importance sampling from the prior q to the posterior p errs by
    # N var = integral of p^2/q (x - mean)^2 (Owen 2013, eq. 9.8); 0.3 % of it lies past N^-1.
    count, keys, sigma, r, y = 200, 400, 2.0, 0.7, 1.3
    model = Model(
        Motion(lambda x, u: x, jnp.zeros(1)), (Sensor(lambda x, aux: x, jnp.array([r]), 1),)
    )
    start = Belief.of(jnp.zeros(1), sigma**2 * np.eye(1))
    mean, _, log_likelihood = many(count, model, start, np.array([[y]]), keys)
    p = stats.norm(y * sigma**2 / (sigma**2 + r**2), sigma * r / np.hypot(sigma, r))
    q = stats.norm(0.0, sigma)

    def spread(x):
        return p.pdf(x) ** 2 / q.pdf(x) * (x - p.mean()) ** 2

    want = integrate.quad(spread, p.mean() - 9 * p.std(), p.mean() + 9 * p.std())[0] / count
    got = np.mean((np.asarray(mean)[:, 0, 0] - p.mean()) ** 2)
    low, high = stats.chi2.ppf([1e-4, 1 - 1e-4], keys) / keys
    assert low < got / (want * (1 + 10 / count)) < high * (1 + 10 / count)
    # The likelihood itself, not its logarithm, is without bias.
    ratio = np.exp(np.asarray(log_likelihood) - stats.norm(0, np.hypot(sigma, r)).logpdf(y))
    assert abs(ratio.mean() - 1.0) < 4.0 * ratio.std() / np.sqrt(keys)


def test_it_converges_to_the_kalman_filter_as_the_root_of_the_count(y):
    exact = run(kalman(), MODEL, START, y)
    errors = []
    for count in (64, 576):
        mean, covariance, log_likelihood = many(count, MODEL, START, y)
        errors.append(np.sqrt(np.mean(((mean - exact.mean[None]) / exact.sigma[None]) ** 2)))
        ratio = np.exp(np.asarray(log_likelihood) - float(exact.log_likelihood))
        assert abs(ratio.mean() - 1.0) < 4.0 * ratio.std() / np.sqrt(KEYS)
    # Error over sigma is about c / sqrt(count), c between 1 (independent draws) and what unequal
    # weights add; nine times as many particles, a third of the error.
    assert 1.0 < errors[1] * np.sqrt(576) < 2.5
    assert 2.3 < errors[0] / errors[1] < 3.9
    assert np.std(log_likelihood) < 0.3
    average = np.mean(covariance, axis=0)
    np.testing.assert_allclose(
        np.linalg.norm(average - exact.covariance, axis=(1, 2)),
        0.0,
        atol=0.1 * np.max(np.linalg.norm(exact.covariance, axis=(1, 2))),
    )


def test_with_nothing_sampled_it_is_the_kalman_filter(y):
    exact = run(kalman(), MODEL, START, y)
    found = run(particle(3, 0, sampled=[]), MODEL, START, y)
    np.testing.assert_allclose(found.mean, exact.mean, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(found.covariance, exact.covariance, rtol=1e-12, atol=1e-13)
    assert float(found.log_likelihood) == pytest.approx(float(exact.log_likelihood), rel=1e-13)
    a, b = found.steps.info["y"], exact.steps.info["y"]
    np.testing.assert_array_equal(a.code, b.code)
    np.testing.assert_array_equal(a.dof, b.dof)
    for name in ("innovation", "factor", "gain", "nis"):
        np.testing.assert_allclose(
            getattr(a, name), getattr(b, name), rtol=1e-11, atol=1e-12, err_msg=name
        )
    np.testing.assert_allclose(a.notes["particle.ess"], 3.0)


# ----------------------------------------------------------------------------- Rao-Blackwellised


def bent(x, u):
    """A non-linear first component that decides how the linear second one moves."""
    s, z = x
    return jnp.stack([0.8 * s + jnp.sin(s), jnp.cos(s) * z + 0.3])


BENT = Model(
    Motion(bent, jnp.array([0.4, 0.3])),
    (Sensor(lambda x, aux: jnp.stack([x[0] ** 2 / 4 + x[1]]), jnp.array([0.3]), 1),),
)


def test_rao_blackwell_has_less_variance_and_the_same_mean():
    start = Belief.of(jnp.array([0.5, 0.0]), np.diag([1.0, 4.0]))
    y = np.array([[0.4], [0.9], [1.7], [0.6]])
    mean, _, log_likelihood = many(150, BENT, start, y, 200, sampled=[0])
    plain, _, other = many(150, BENT, start, y, 200)
    # A likelihood is without bias, and so is a likelihood times a mean.
    a, b = (np.exp(np.asarray(x)) for x in (log_likelihood, other))
    for one, two in ((a, b), (a[:, None] * mean[:, -1], b[:, None] * plain[:, -1])):
        error = np.hypot(np.std(one, axis=0), np.std(two, axis=0)) / np.sqrt(200)
        assert np.all(np.abs(np.mean(one, axis=0) - np.mean(two, axis=0)) < 4.0 * error)
    assert np.all(np.var(mean, axis=0) < np.var(plain, axis=0))
    assert np.mean(np.var(plain, axis=0)) > 2.0 * np.mean(np.var(mean, axis=0))
    assert np.var(other) > 2.0 * np.var(log_likelihood)


def test_the_rest_is_conditioned_on_the_draw():
    rng = np.random.default_rng(3)
    L = np.tril(rng.normal(size=(4, 4))) + np.eye(4)
    P, m = L @ L.T, rng.normal(size=4)
    s, r = [3, 1], [0, 2]
    state = particle(5000, 2, sampled=s).init(Belief.of(jnp.array(m), P), {})
    cloud = state.memory.particles
    d = np.asarray(cloud.mean) - m
    C = np.asarray(cloud.factor[0])
    regression = P[np.ix_(r, s)] @ np.linalg.inv(P[np.ix_(s, s)])
    np.testing.assert_allclose(d[:, r], d[:, s] @ regression.T, atol=1e-12)
    schur = P[np.ix_(r, r)] - regression @ P[np.ix_(s, r)]
    np.testing.assert_array_equal(C[s], 0.0)
    np.testing.assert_allclose((C @ C.T)[np.ix_(r, r)], schur, atol=1e-12)
    white = np.linalg.solve(np.linalg.cholesky(P[np.ix_(s, s)]), d[:, s].T)
    sample = white @ white.T / 5000  # of unit variance: sd sqrt(2/5000), of covariance sqrt(1/5000)
    np.testing.assert_allclose(sample, np.eye(2), atol=4 * np.sqrt(2 / 5000))
    np.testing.assert_allclose(white.mean(axis=1), 0.0, atol=4 / np.sqrt(5000))
    np.testing.assert_array_equal(state.belief.mean, m)


# ------------------------------------------------------------------------- weights, resampling


def test_systematic_resampling_takes_each_as_often_as_its_weight():
    rng = np.random.default_rng(1)
    weight = rng.random(50) * (rng.random(50) < 0.5)
    weight[[0, -1]] = 0.0
    weight /= weight.sum()
    draws = jax.jit(jax.vmap(_systematic, (0, None)))(
        jax.random.split(jax.random.key(0), 2000), jnp.array(weight)
    )
    times_taken = np.stack([np.bincount(row, minlength=50) for row in np.asarray(draws)])
    assert np.all(times_taken >= np.floor(50 * weight))
    assert np.all(times_taken <= np.ceil(50 * weight))
    np.testing.assert_allclose(times_taken.mean(axis=0), 50 * weight, atol=4 * 0.5 / np.sqrt(2000))
    one = np.zeros(50)
    one[17] = 1.0
    np.testing.assert_array_equal(_systematic(jax.random.key(1), jnp.array(one)), 17)


def dented(x, u):
    """Not finite for negative states."""
    return jnp.where(x < 0.0, jnp.nan, x)


DENTED = Model(Motion(dented, jnp.array([0.05])), (Sensor(lambda x, a: x, jnp.array([0.3]), 1),))


def test_degenerate_weights_give_no_nan():
    live = OnlineFilter(particle(200, 3), DENTED, Belief.of(jnp.zeros(1), np.eye(1)))
    live.predict()  # loses the half of the cloud that was below zero
    weight = np.exp(live.state.memory.log_weight)
    assert 70 < np.sum(weight > 0) < 130
    assert float(live.belief.mean[0]) == pytest.approx(np.sqrt(2 / np.pi), abs=4 * 0.6 / 10)
    before = live.state
    for value in (1e200, np.nan, np.inf):
        info = live.update([value])
        assert int(info.code) == (Code.NOT_FINITE if value == 1e200 else Code.MISSING)
        assert float(info.log_likelihood) == (-np.inf if value == 1e200 else 0.0)
        assert int(info.dof) == 0
        for a, b in zip(jax.tree.leaves(live.state), jax.tree.leaves(before), strict=True):
            np.testing.assert_array_equal(a, b)
    info = live.update([40.0])  # beyond all of them: the nearest gets all the weight
    assert int(info.code) == Code.DONE
    assert float(info.log_likelihood) < -1e3
    assert float(info.notes["particle.ess"]) < 2.0
    for value in (3.0, 2.9):
        live.predict()
        live.update([value])
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(live.state))

    # and with no particle left that can move, the step is not taken
    lost = Belief.of(-5.0 * jnp.ones(1), 1e-4 * np.eye(1))
    live = OnlineFilter(particle(200, 3), DENTED, lost)
    before = live.belief
    assert int(live.predict().code) == Code.NOT_FINITE
    np.testing.assert_array_equal(live.belief.mean, before.mean)
    assert live.counts == {"NOT_FINITE": 1}


def test_regularising_keeps_the_moments_and_makes_no_copies():
    still = Motion(lambda x, u: x, jnp.zeros(1))
    model = Model(still, (Sensor(lambda x, aux: x, jnp.array([0.5]), 1),))
    start = Belief.of(jnp.zeros(1), np.eye(1))
    spread = {}
    for share in (0.0, 0.3):
        live = OnlineFilter(particle(2000, 5, regularise=share), model, start)
        live.predict()
        live.update([1.5])
        before = live.belief
        live.predict()
        assert live.state.memory.log_weight[0] == pytest.approx(-np.log(2000))  # resampled
        spread[share] = len(np.unique(live.state.memory.particles.mean))
        ratio = float(live.belief.sigma[0] / before.sigma[0])
        assert ratio == pytest.approx(1.0, abs=4 / np.sqrt(2 * 2000))
        gap = abs(float(live.belief.mean[0] - before.mean[0]) / float(before.sigma[0]))
        assert gap < 4 * np.hypot(0.5, share) / np.sqrt(2000)  # 0.5: how uneven copies are
    assert spread[0.3] == 2000
    assert spread[0.0] < 1200


# --------------------------------------------------------------------------- two roll angles


def test_two_rolls_fit_and_only_the_cloud_holds_both():
    # A body that spins slowly shows the sine of its roll: roll and pi - roll look alike until the
    # rate tells them apart. A Kalman filter takes the wrong one and stays.
    dt, truth, rate = 0.1, 2.4, 0.2

    def roll(x, u):
        return {"roll": x["roll"].retract(dt * u), "bias": x["bias"]}

    def read(x, aux):
        return jnp.sin(x["roll"].rad)[None] + x["bias"]

    model = Model(
        Motion(roll, jnp.array([0.0, 0.01])), (Sensor(read, jnp.array([0.05]), 1, "field"),)
    )
    start = Belief.of(
        {"roll": Angle(jnp.array(0.6)), "bias": jnp.zeros(1)}, np.diag([1e-4, 1.5**2])
    )
    rng = np.random.default_rng(8)
    at = truth + rate * dt * np.arange(1, 61)
    y = np.sin(at)[:, None] + 0.05 * rng.normal(size=(60, 1))
    u = np.full((60, 1), rate)
    ekf = run(kalman(), model, start, y, u)
    error = (np.asarray(ekf.mean["roll"].rad) - at + np.pi) % (2 * np.pi) - np.pi
    assert np.all(np.abs(error[30:]) > 10 * np.asarray(ekf.sigma)[30:, 1])
    # sampled in the angle, which comes second in tangent order; the bias is linear given it
    cloud = particle(1000, 1, sampled=[1], regularise=0.02)
    live = run(cloud, model, start, y, u)
    half = np.asarray(live.sigma)[:, 1]
    assert half[3] > 0.5  # both
    error = (np.asarray(live.mean["roll"].rad) - at + np.pi) % (2 * np.pi) - np.pi
    assert np.all(np.abs(error[45:]) < 4 * half[45:] + 1e-3)
    assert half[-1] < 0.05


# -------------------------------------------------------------------------- one protocol of all


def test_one_at_a_time_is_the_run_and_other_keys_are_other_draws(y):
    one = particle(50, 11)
    whole = run(one, MODEL, START, y)
    live = OnlineFilter(one, MODEL, START)
    for row in y:
        live.predict()
        live.update(row)
    np.testing.assert_allclose(live.belief.mean, whole.mean[-1], rtol=1e-11)
    np.testing.assert_array_equal(live.state.memory.key, whole.final.memory.key)
    again = particle(50, jax.random.key(11)).init(START, MODEL.dims)
    start = one.init(START, MODEL.dims)
    np.testing.assert_array_equal(again.memory.particles.mean, start.memory.particles.mean)
    other = one.reset(reseed(start, 12), START)
    assert np.all(other.memory.particles.mean != start.memory.particles.mean)
    assert isinstance(other.memory, ParticleCloud)


def test_its_numbers_are_data_and_its_key_has_a_gradient_of_zero():
    words = np.array([0xFFFFFFFF, 0xFFFFFFFE], np.uint32)
    begun = particle(2, words).init(START, {})
    again = particle(2, 0).reset(reseed(begun, words), START)  # whole numbers all the way
    np.testing.assert_array_equal(begun.memory.particles.mean, again.memory.particles.mean)
    assert content(particle(5, 7)) == content(particle(5, jax.random.key(7, impl="threefry2x32")))
    assert content(particle(5, 7)) != content(particle(5, 8))

    def far(filter_):
        return jnp.sum(filter_.init(START, MODEL.dims).memory.particles.mean)

    slopes = jax.grad(far)(particle(5, jax.random.key(7), regularise=0.1))
    assert all(np.all(x == 0.0) for x in jax.tree.leaves(slopes))

    traced = []

    def counted(x, u):
        traced.append(x)
        return x

    model = Model(Motion(counted, np.ones(2)), MODEL.sensors)
    filters = [particle(5, k, resample=0.1 * k, regularise=0.2 * k) for k in (1, 2)]
    means, counts = [], []
    for one in filters:
        live = OnlineFilter(one, model, START)
        live.predict()
        means.append(live.belief.mean)
        counts.append(len(traced))
    assert counts[0] == counts[1] > 0
    assert np.all(means[0] != means[1])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"count": 0}, "positive count of particles, got 0"),
        ({"resample": 1.5}, "resample of a particle filter must lie in 0..1, got 1.5"),
        ({"regularise": -0.1}, "regularise of a particle filter must lie in 0..1, got -0.1"),
        ({"sampled": [0, 0]}, r"different and not negative, got \(0, 0\)"),
        ({"sampled": [-1]}, r"different and not negative, got \(-1,\)"),
        ({"sampled": [2]}, r"sampled components \(2,\): the state has only 2"),
    ],
)
def test_bad_arguments_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        particle(**{"count": 5, "key": 0} | given).init(START, MODEL.dims)
