"""The predict and update atoms against plain dense forms."""

import inspect
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import System, kalman_filter, random_system, simulate, stacked
from interpreted import run
from jax.tree_util import Partial
from scipy.stats import multivariate_normal

from robins.filters import (
    SENTENCES,
    Belief,
    Code,
    Model,
    Motion,
    Sensor,
    StepWarning,
    cubature,
    kalman,
    taylor,
    unscented,
)

FORMS = ["sqrt", "joseph"]
T = 20  # one length and, as a rule, one size, so that a filter is compiled once

EKF = {form: kalman(form=form) for form in FORMS}
UKF = {form: kalman(unscented(), form=form) for form in FORMS}


def close(got, want, tolerance):
    """Within a share of the largest, step by step."""
    got, want = np.asarray(got), np.asarray(want)
    worst = np.max(np.abs(got - want).reshape(len(want), -1), axis=1)
    assert np.all(worst <= tolerance * np.max(np.abs(want).reshape(len(want), -1), axis=1)), worst


def first_four(one, system, y):
    """Means, covariances, log-likelihoods and codes of four steps, and those of the book."""
    solution = run(one, system.model(), system.start(), y)
    info, (*want, _) = solution.steps.info["y"], kalman_filter(system, y[:4])
    got = (solution.mean, solution.covariance, info.log_likelihood, info.code)
    return *(series[:4] for series in got), want


def like_the_book(solution, system, y, tolerance):
    means, covariances, log_likelihood, nis = kalman_filter(system, y)
    info = solution.steps.info["y"]
    close(solution.mean, means, tolerance)
    close(solution.covariance, covariances, tolerance)
    np.testing.assert_allclose(info.log_likelihood, log_likelihood, rtol=tolerance, atol=1e-11)
    np.testing.assert_allclose(info.nis, nis, rtol=10 * tolerance, atol=1e-12)
    np.testing.assert_array_equal(info.dof, np.isfinite(y).sum(axis=1))
    total = float(solution.log_likelihood)
    assert total == pytest.approx(log_likelihood.sum(), rel=tolerance)


# ---------------------------------------------------------------------------- linear, by the book


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("missing", [0.0, 0.4])  # per component, noise correlated between them
def test_the_filter_is_the_textbook_filter(form, missing):
    for seed in range(8):
        system = random_system(seed)
        _, y = simulate(system, seed, T, missing)
        like_the_book(run(EKF[form], system.model(), system.start(), y), system, y, 1e-9)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (2, 6)])
def test_sizes_at_the_edge(n, m):
    system = random_system(1, n=n, m=m, q=1)
    _, y = simulate(system, 1, T, 0.2)
    like_the_book(run(EKF["sqrt"], system.model(), system.start(), y), system, y, 1e-10)


def test_the_log_likelihood_is_the_density_of_all_that_was_measured():
    system = random_system(3)
    _, y = simulate(system, 3, T, 0.25)
    per_step = [[a] * T for a in (system.F, system.Q, system.H, system.R)]
    mean, P, H, R = stacked(*per_step, system.m0, system.P0)
    here = np.isfinite(y.ravel())
    want = multivariate_normal.logpdf(
        y.ravel()[here], (H @ mean)[here], (H @ P @ H.T + R)[here][:, here]
    )
    got = run(kalman(), system.model(), system.start(), y).log_likelihood
    assert float(got) == pytest.approx(want, rel=1e-12)


def test_one_innovation_after_the_other():
    # Innovation, its factor and gain of one step, in a system with correlated noise.
    system = random_system(5)
    y = simulate(system, 5, T)[1]
    y[0, 1] = np.nan
    info = run(EKF["sqrt"], system.model(), system.start(), y).steps.info["y"]
    P = system.F @ system.P0 @ system.F.T + system.Q
    here = [0, 2]
    H, R = system.H[here], system.R[np.ix_(here, here)]
    S = H @ P @ H.T + R
    innovation = y[0] - system.H @ system.F @ system.m0
    np.testing.assert_allclose(info.innovation[0], innovation, rtol=1e-12)
    factor = np.asarray(info.factor[0])
    np.testing.assert_allclose((factor @ factor.T)[np.ix_(here, here)], S, rtol=1e-12)
    np.testing.assert_allclose(factor[1], [0.0, 1.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(info.sigma[0][np.array(here)], np.sqrt(np.diag(S)), rtol=1e-12)
    gain = np.asarray(info.gain[0])
    np.testing.assert_allclose(gain[:, here], P @ H.T @ np.linalg.inv(S), rtol=1e-10)
    np.testing.assert_array_equal(gain[:, 1], np.zeros(4))
    assert info.used[0].tolist() == [True, False, True]
    assert int(info.code[0]) == Code.PARTLY_MISSING


@pytest.mark.parametrize("form", FORMS)
def test_with_nothing_measured_the_belief_stands_bit_for_bit(form):
    system, k = random_system(2), 3
    y = simulate(system, 2, T)[1]
    y[k] = [np.nan, np.inf, -np.inf]
    for one in (EKF[form], UKF[form]):
        steps = run(one, system.model(), system.start(), y).steps
        before, after, info = jax.tree.map(
            lambda a: a[k], (steps.prediction.belief, steps.posterior, steps.info["y"])
        )
        np.testing.assert_array_equal(after.mean, before.mean)
        np.testing.assert_array_equal(after.factor, before.factor)
        assert int(info.code) == Code.MISSING
        assert (float(info.nis), int(info.dof), float(info.log_likelihood)) == (0.0, 0, 0.0)
        assert np.all(np.isnan(info.innovation))
        np.testing.assert_array_equal(info.gain, np.zeros((4, 3)))


def test_infinite_is_missing():
    system = random_system(4)
    _, y = simulate(system, 4, T, 0.4)
    model, start = system.model(), system.start()
    never = np.where(np.isnan(y) & (np.arange(3) == 1), np.inf, y)
    never = np.where(np.isnan(y) & (np.arange(3) == 2), -np.inf, never)
    assert np.isinf(never).sum() > 3
    one, other = (run(EKF["sqrt"], model, start, z) for z in (y, never))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


def test_any_real_kind_of_numbers():
    system = random_system(4)
    y = np.round(simulate(system, 4, T)[1])
    model, start = system.model(), system.start()
    want = run(EKF["sqrt"], model, start, y).mean
    for kind in ("int64", "int16", ">f8", "float32"):
        np.testing.assert_array_equal(run(EKF["sqrt"], model, start, y.astype(kind)).mean, want)
    for kind in (y.tolist(), np.asfortranarray(y), y[:, ::-1][:, ::-1]):
        np.testing.assert_array_equal(run(EKF["sqrt"], model, start, kind).mean, want)


# ------------------------------------------------------------------- every linearisation on a line

WEIGHTS = [
    ((1e-3, 2.0, 0.0), "joseph"),
    ((0.5, 0.1, 1.0), "joseph"),  # beta < alpha^2
    ((1.0, 0.0, -1.0), "sqrt"),  # and so far below that some must be taken away
    ((1.0, 0.0, -1.0), "joseph"),
    ((1.3, -0.5, -0.5), "sqrt"),
]


@pytest.mark.parametrize(("weights", "form"), WEIGHTS)
def test_sigma_points_on_a_linear_model_are_the_kalman_filter(weights, form):
    one = kalman(unscented(*weights), form=form)
    # values alpha sigma apart keep alpha of their digits, their second difference alpha^2
    tolerance = 1e-11 if weights[0] > 0.1 else 1e-8
    for seed in range(2):
        system = random_system(seed)
        y = simulate(system, seed, T)[1]
        y[1, 0] = y[2, :] = np.nan
        means, covariances, log_likelihood, codes, want = first_four(one, system, y)
        close(means, want[0], tolerance)
        close(covariances, want[1], tolerance)
        np.testing.assert_allclose(log_likelihood, want[2], rtol=tolerance, atol=1e-12)
        assert codes.tolist() == [Code.DONE, Code.PARTLY_MISSING, Code.MISSING, Code.DONE]


def test_a_whole_run_with_sigma_points():
    system = random_system(6)
    _, y = simulate(system, 6, T, 0.3)
    like_the_book(run(UKF["sqrt"], system.model(), system.start(), y), system, y, 1e-10)


@pytest.mark.parametrize("way", [taylor(), cubature(), unscented(1.0, 0.0, -1.0)])
def test_a_known_part_of_the_state_stays_known(way):
    # P0 singular, Q of rank one: sigma points are drawn from it all the same.
    system = random_system(7)._replace(P0=np.diag([0.0, 1.0, 0.0, 2.0]))
    system = system._replace(G=system.G * np.array([1.0, 0.0, 0.0, 0.0]))
    y = simulate(system, 7, T)[1]
    means, covariances, log_likelihood, codes, want = first_four(kalman(way), system, y)
    close(means, want[0], 1e-11)
    close(covariances, want[1], 1e-11)
    np.testing.assert_allclose(log_likelihood, want[2], rtol=1e-11)
    assert not codes.any()


# ----------------------------------------------------------------------------------- invariance


def test_units_and_order_do_not_matter():
    system = random_system(8)
    _, y = simulate(system, 8, T, 0.2)
    plain = run(EKF["sqrt"], system.model(), system.start(), y)
    order, unit = [2, 0, 3, 1], np.array([1e-6, 1.0, 1e4])
    U = np.diag([1e6, 1e-8, 3.0, 1e3])[order]
    V, M = np.linalg.inv(U), np.diag(unit)
    m0, P0 = U @ system.m0, U @ system.P0 @ U.T
    other = System(U @ system.F @ V, U @ system.G, M @ system.H @ V, M @ system.W, m0, P0)
    again = run(EKF["sqrt"], other.model(), other.start(), y * unit)
    np.testing.assert_allclose(again.mean @ V.T, plain.mean, rtol=1e-10, atol=1e-12)
    close(V @ np.asarray(again.covariance) @ V.T, plain.covariance, 1e-11)
    # but for the density, which is of the measurements
    shift = np.sum(np.isfinite(y) * np.log(unit))
    want = float(plain.log_likelihood) - shift
    assert float(again.log_likelihood) == pytest.approx(want, rel=1e-12)


# ------------------------------------------------------------------------------------- outcomes


STEPS = {
    "stays": lambda x: x,
    "overflows": lambda x: x * 1e200 * 1e200,
    "root": lambda x: jnp.sqrt(x - 2.0),
}
READS = {
    "seen": lambda x: x[:3],
    "far": lambda x: -1e308 * jnp.ones(3),
    "nan": lambda x: x[:3] * jnp.nan,
    "slope": lambda x: jnp.sqrt(x - x)[:3],
    "infinite": lambda x: x[:3] / 0.0,
    "squared": lambda x: x[:3] ** 2,
}


def one_step(one, y, step="stays", read="seen", mean=1.0, r=0.5):
    """One step of four states, three of them measured, all alike; a number selects the model."""
    motion = Motion(by_number(tuple(STEPS.values())), jnp.full(4, 0.1))
    sensor = Sensor(by_number(tuple(READS.values())), jnp.full(3, r), 3)
    start = Belief(np.full(4, mean), np.eye(4))
    steps, reads = list(STEPS), list(READS)
    state, prediction = one.predict(one.init(start, {"y": 3}), motion, steps.index(step))
    after, info = one.update(state, sensor, np.full(3, y), reads.index(read))
    return state, prediction, after, info


@cache
def by_number(functions):
    return lambda x, which: jax.lax.switch(which, functions, x)


@pytest.mark.parametrize(
    ("form", "read", "y"),
    [
        ("sqrt", "seen", 1e308),  # too far to be squared
        ("joseph", "seen", -1e200),
        ("sqrt", "far", 1e308),  # too far even to be measured
        # a model's fault is not a missing measurement, nor is a slope that is not finite
        ("joseph", "nan", 1.0),
        ("sqrt", "slope", 1.0),
        ("sqrt", "infinite", 1.0),
    ],
)
def test_a_step_that_would_break_the_belief_is_not_taken(form, read, y):
    state, _, after, info = one_step(EKF[form], y, read=read)
    assert int(info.code) == Code.NOT_FINITE
    np.testing.assert_array_equal(after.belief.mean, state.belief.mean)
    np.testing.assert_array_equal(after.belief.factor, state.belief.factor)
    assert (float(info.nis), int(info.dof), float(info.log_likelihood)) == (0.0, 0, -np.inf)
    assert not np.any(info.used)


def test_a_noise_whose_square_is_no_number_is_refused_or_the_step_not_taken():
    """The largest double as a sigma made the state known exactly."""
    with pytest.raises(ValueError, match=r"noise of sensor 'y' holds a number above 1.34e\+154"):
        Sensor(lambda x, aux: x, np.full(4, np.finfo(float).max), 4, "y")
    huge = Partial(lambda s, x, aux: s, jnp.full(4, np.finfo(float).max))
    one, start = EKF["sqrt"], Belief.of(jnp.zeros(4), np.eye(4))
    after, info = one.update(
        one.init(start, {"y": 4}), Sensor(lambda x, aux: x, huge, 4, "y"), np.ones(4)
    )
    assert int(info.code) == Code.NOT_FINITE
    np.testing.assert_array_equal(after.belief.factor, np.eye(4))
    loud = Partial(lambda s, x, u: s, jnp.full(4, np.finfo(float).max))
    _, prediction = one.predict(one.init(start, {}), Motion(lambda x, u: x, loud))
    assert int(prediction.code) == Code.NOT_FINITE


def test_a_large_but_possible_measurement_is_used():
    _, _, after, info = one_step(EKF["sqrt"], 1e100)
    assert int(info.code) == Code.DONE
    np.testing.assert_allclose(after.belief.mean[:3], 1e100 * 1.01 / 1.26, rtol=1e-12)


def test_what_is_missing_may_have_a_reading_that_fails():
    # No star, no direction to it: the reading is NaN, but so is the measurement.
    state, _, after, info = one_step(EKF["sqrt"], np.nan, read="nan")
    assert int(info.code) == Code.MISSING
    np.testing.assert_array_equal(after.belief.mean, state.belief.mean)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("step", ["overflows", "root"])
def test_a_prediction_that_would_break_the_belief_is_not_taken(form, step):
    state, prediction, after, info = one_step(EKF[form], 1.2, step)
    assert int(prediction.code) == Code.NOT_FINITE
    np.testing.assert_array_equal(state.belief.mean, np.ones(4))
    np.testing.assert_array_equal(state.belief.factor, np.eye(4))
    # The belief is of an earlier time than the measurement, which is not fused into it.
    assert int(info.code) == Code.NOT_PREDICTED
    assert (float(info.nis), int(info.dof), float(info.log_likelihood)) == (0.0, 0, -np.inf)
    np.testing.assert_array_equal(after.belief.mean, state.belief.mean)
    np.testing.assert_array_equal(after.belief.factor, state.belief.factor)


def test_no_search_is_drawn_to_models_that_fail():
    system = random_system(1)
    y = simulate(system, 1, T)[1]
    for broken in (system._replace(F=system.F * np.nan), system._replace(H=system.H * np.nan)):
        with pytest.warns(StepWarning, match=f"{T} of {T} .* are NOT_FINITE"):
            solution = run(EKF["sqrt"], broken.model(), system.start(), y)
        assert float(solution.log_likelihood) == -np.inf
        assert np.all(np.isfinite(solution.mean))


@pytest.mark.parametrize("form", FORMS)
def test_sigma_points_that_leave_no_covariance_say_so(form):
    # h = x^2 with a negative weight at the centre: the variance comes out negative.
    given = {"read": "squared", "mean": 0.0, "r": 0.01}
    worst = kalman(unscented(1.0, -6.0, 0.0), form=form)
    state, _, after, info = one_step(worst, 0.3, **given)
    assert int(info.code) == Code.INDEFINITE
    np.testing.assert_array_equal(after.belief.factor, state.belief.factor)
    assert float(info.log_likelihood) == -np.inf
    assert int(one_step(UKF[form], 0.3, **given)[3].code) == Code.DONE


def squared(x, aux):
    return x[:1] ** 2 + 0.1 * x[1:]


@pytest.mark.parametrize(
    ("one", "known", "code"),
    [
        # P = 0 and Q = 0 in the first step: the predicted covariance is singular.
        (EKF["joseph"], 0.0, Code.NOT_PREDICTED),
        # h = x^2 with a negative weight at the centre: at first its variance comes out negative.
        (kalman(unscented(1.0, -6.0, 0.0)), 1.0, Code.INDEFINITE),
        (kalman(unscented(1.0, -6.0, 0.0), form="joseph"), 1.0, Code.INDEFINITE),
    ],
    ids=["joseph", "unscented", "unscented-joseph"],
)
def test_a_step_that_is_not_taken_leaves_the_gradients_of_the_others(one, known, code):
    noise = jnp.array([[0.0, 0.0], [0.3, 0.3], [0.3, 0.3], [0.3, 0.3]])
    start = Belief(jnp.array([0.0, 0.5]), known * jnp.eye(2))
    y = jnp.array([[0.4], [4.0], [3.8], [4.1]])

    def last(drift):
        step = Partial(lambda drift, x, u: x + drift, drift)
        sensor = Sensor(squared, lambda x, aux: aux, 1)
        model = Model(Motion(step, lambda x, u: u), (sensor,))
        found = run(one, model, start, y, noise, {"y": jnp.array([[0.1], [9.0], [9.0], [9.0]])})
        return found.mean[-1, 0], found.steps.info["y"].code

    at = jax.jit(jax.value_and_grad(last, has_aux=True))
    (_, codes), slope = at(0.7)
    assert codes[0] == code
    assert Code.DONE in codes.tolist()
    (above, _), (below, _) = at(0.7 + 1e-5)[0], at(0.7 - 1e-5)[0]
    np.testing.assert_allclose(slope, (above - below) / 2e-5, rtol=1e-6)


def test_every_code_has_its_sentence():
    assert set(SENTENCES) == set(Code)


# ------------------------------------------------------------------------------- at the boundary


def sensor(count: int, noise, dim: int) -> Sensor:
    return Sensor(lambda x, aux: x[:count], noise, dim, "gnss")


@pytest.mark.parametrize("one", [EKF["sqrt"], UKF["sqrt"]], ids=["taylor", "unscented"])
@pytest.mark.parametrize(
    ("sensor", "y", "message"),
    [
        (sensor(3, jnp.ones(3), 3), jnp.ones(1), r"'gnss' reads shape \(3,\), .* given \(1,\)"),
        (sensor(3, jnp.ones(3), 3), jnp.ones(()), r"'gnss' reads shape \(3,\), .* given \(\)"),
        (sensor(3, jnp.ones(3), 3), None, r"'gnss' reads shape \(3,\), .* given None"),
        (sensor(3, jnp.ones(2), 2), jnp.ones(3), "'gnss' says dim = 2, but reads 3"),
        (sensor(3, jnp.ones(2), 3), jnp.ones(3), r"noise of sensor 'gnss' has shape \(2,\)"),
        (sensor(3, 0.5, 3), jnp.ones(3), r"noise of sensor 'gnss' has shape \(\)"),
    ],
)
def test_a_sensor_that_does_not_fit_is_named(one, sensor, y, message):
    state = one.init(Belief.of(jnp.zeros(4), np.eye(4)), {"gnss": sensor.dim})
    with pytest.raises(ValueError, match=message):
        one.update(state, sensor, y)


@pytest.mark.parametrize("noise", [jnp.ones(3), jnp.ones((3, 4)), 1.0])
def test_noise_of_another_size_than_the_state(noise):
    one = EKF["sqrt"]
    state = one.init(Belief.of(jnp.zeros(4), np.eye(4)), {})
    with pytest.raises(ValueError, match=r"noise of the motion has shape .*\(4,\) standard"):
        one.predict(state, Motion(lambda x, u: x, noise))
    wrong = Motion(lambda x, u: x, jnp.ones(4), lambda x, u: (x, jnp.eye(4), noise))
    with pytest.raises(ValueError, match="noise of the motion"):
        one.predict(state, wrong)


@pytest.mark.parametrize(
    ("mean", "P", "error", "message"),
    [
        (np.zeros(2), np.eye(3), ValueError, r"covariance is \(3, 3\), the state needs \(2, 2\)"),
        (np.array([0.0, np.nan]), np.eye(2), ValueError, "initial mean has entries that are not"),
        (np.zeros(2, complex), np.eye(2), TypeError, "initial mean holds complex128"),
        (np.array(["a", "b"]), np.eye(2), TypeError, "initial mean holds <U1"),
        (np.zeros(2), -np.eye(2), ValueError, "initial covariance is not positive semidefinite"),
    ],
)
def test_a_belief_that_is_none(mean, P, error, message):
    with pytest.raises(error, match=message):
        Belief.of(mean, P)


def test_a_belief_of_whole_numbers():
    belief = Belief.of({"a": np.array([1, 2]), "b": 3}, 4 * np.eye(3, dtype=int))
    assert {leaf.dtype.name for leaf in jax.tree.leaves(belief)} == {"float64"}
    np.testing.assert_array_equal(belief.covariance, 4 * np.eye(3))
    assert belief.sigma.tolist() == [2.0, 2.0, 2.0]


def test_a_form_that_is_none():
    # A wrong literal is caught by the type check in tests, by the filter itself elsewhere.
    plain = inspect.unwrap(kalman)
    with pytest.raises(ValueError, match="form must be 'sqrt' or 'joseph', got 'cholesky'"):
        plain(form="cholesky")


def test_sensors_with_one_name():
    sensor = Sensor(lambda x, a: x, jnp.ones(1), 1, "gnss")
    with pytest.raises(ValueError, match="names of their own"):
        Model(Motion(lambda x, u: x, jnp.ones(1)), (sensor, sensor))
    with pytest.raises(KeyError, match="no sensor 'imu'; this model has"):
        Model(Motion(lambda x, u: x, jnp.ones(1)), (sensor,)).sensor("imu")


def test_noise_as_it_may_be_given():
    # standard deviations, a factor, and functions of the state with parameters bound
    q, r = jnp.array([0.3, 0.7, 0.1, 2.0]), jnp.array([0.5, 1.5, 0.2])
    noises = [
        (q, r),
        (jnp.diag(q), jnp.diag(r)),
        (lambda x, u: q, lambda x, aux: r),
        (Partial(lambda s, x, u: s, q), Partial(lambda s, x, aux: jnp.diag(s), r)),
    ]
    for of_motion, of_sensor in noises:
        one = EKF["sqrt"]
        state = one.init(Belief.of(jnp.zeros(4), np.eye(4)), {"y": 3})
        state, _ = one.predict(state, Motion(lambda x, u: x, of_motion))
        np.testing.assert_allclose(state.belief.sigma**2, 1.0 + q**2, rtol=1e-14)
        sensor = Sensor(lambda x, aux: x[:3], of_sensor, 3)
        _, info = one.update(state, sensor, jnp.zeros(3))
        np.testing.assert_allclose(info.sigma**2, 1.0 + q[:3] ** 2 + r**2, rtol=1e-14)
