"""A filter with a second run from a wider start: bit for bit one of the two, by their evidence."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from robins.filters import Belief, Model, Motion, Sensor, kalman, run
from robins.filters.composite import alternative
from robins.filters.kalman import WRONG

STEPS, NATS = 40, 12.0


def _advance(x, u):
    return x * jnp.array([0.98, 1.0])


def _read(x, aux):
    return x[:1] + x[1:]


# what is read has an offset, the second component, that is told to be small
MODEL = Model(
    Motion(_advance, jnp.array([0.3, 0.0])), (Sensor(_read, jnp.array([0.5]), 1, "level"),)
)
NARROW, ADDED = np.array([1.0, 0.1]), np.array([0.0, 8.0])
START = Belief(jnp.zeros(2), jnp.diag(jnp.asarray(NARROW)))
WIDE = Belief(jnp.zeros(2), jnp.diag(jnp.asarray(np.hypot(NARROW, ADDED))))
FILTER = alternative(kalman(), ADDED, {"level": [np.inf]}, NATS, "offset")


def levels(offset, until=STEPS, seed=0):
    rng = np.random.default_rng(seed)
    x, y = 0.0, np.zeros((STEPS, 1))
    for k in range(STEPS):
        x = 0.98 * x + 0.3 * rng.standard_normal()
        y[k] = x + (offset if k < until else 0.0) + 0.5 * rng.standard_normal()
    y[5] = np.nan
    return y


def ran(filter_, start, y):
    return run(filter_, MODEL, start, {"level": y}, machine="vm").steps


def likelihood(y, P):
    """(STEPS,) log-likelihoods of a dense Kalman filter from a covariance P; 0 where missing."""
    F, Q, H, m, out = np.diag([0.98, 1.0]), np.diag([0.09, 0.0]), np.ones((1, 2)), np.zeros(2), []
    for (z,) in y:
        m, P = F @ m, F @ P @ F.T + Q
        if np.isnan(z):
            out.append(0.0)
            continue
        s = float((H @ P @ H.T)[0, 0]) + 0.25
        out.append(stats.norm.logpdf(z, float((H @ m)[0]), np.sqrt(s)))
        K = (P @ H.T)[:, 0] / s
        m, P = m + K * (z - float((H @ m)[0])), P - np.outer(K, H @ P)
    return np.array(out)


@pytest.mark.parametrize(
    ("offset", "until", "found"), [(0.1, STEPS, False), (6.0, STEPS, True), (6.0, 8, True)]
)
def test_it_is_the_first_run_until_the_second_is_likelier_and_then_the_second(offset, until, found):
    y = levels(offset, until)
    both, one, other = ran(FILTER, START, y), ran(kalman(), START, y), ran(kalman(), WIDE, y)
    info = both.info["level"]
    taken = np.asarray(info.notes[WRONG])[:, 0] > 0.0
    assert taken[-1] == found
    for steps, where in ((one, ~taken), (other, taken)):
        np.testing.assert_array_equal(
            np.asarray(both.posterior.mean)[where], np.asarray(steps.posterior.mean)[where]
        )
        np.testing.assert_allclose(
            np.asarray(both.posterior.sigma)[where],
            np.asarray(steps.posterior.sigma)[where],
            rtol=1e-12,
        )
    want, total = [], 0.0
    gained = likelihood(y, np.diag(NARROW**2 + ADDED**2)) - likelihood(y, np.diag(NARROW**2))
    for gain in gained:
        total = max(total + gain, 0.0)
        want.append(total)
    np.testing.assert_allclose(np.asarray(info.notes["alternative.evidence"]), want, atol=1e-8)
    np.testing.assert_array_equal(taken, np.maximum.accumulate(np.array(want) > NATS))


@pytest.mark.parametrize("size", [0.3, 8.0])
def test_the_second_run_does_not_take_over_while_it_contradicts_what_is_stated(size):
    y, judged = levels(6.0), alternative(kalman(), ADDED, {"level": [size]}, NATS, "offset")
    both, other = ran(judged, START, y).info["level"], ran(kalman(), WIDE, y).info["level"]
    square, want = 1.0, []
    for r in np.asarray(other.innovation)[:, 0]:
        square = square if np.isnan(r) else 0.95 * square + 0.05 * (r / size) ** 2
        want.append(square < 10.0)
    likelier = np.asarray(both.notes["alternative.evidence"]) > NATS
    taken = np.asarray(both.notes[WRONG])[:, 0] > 0.0
    np.testing.assert_array_equal(taken, np.maximum.accumulate(likelier & want))
    assert np.any(likelier & ~np.array(want)) == (size == 0.3)
    assert taken[-1]


def test_it_names_what_is_wrong_and_goes_on_from_another_belief():
    assert FILTER.suspects == ("offset",)
    begun = FILTER.init(START, MODEL.dims)
    np.testing.assert_array_equal(np.asarray(FILTER.suspicions(begun)), [0.0])
    there = Belief(jnp.ones(2), 2.0 * jnp.eye(2))
    again = FILTER.reset(begun, there)
    np.testing.assert_array_equal(np.asarray(again.belief.mean), np.ones(2))
    np.testing.assert_array_equal(np.asarray(again.memory[0].belief.mean), np.ones((2, 2)))


@pytest.mark.parametrize(
    ("spread", "judging", "nats", "word"),
    [
        ([0.0, -1.0], {"level": [1.0]}, 1.0, "finite numbers from 0 up"),
        ([[0.0, 1.0]], {"level": [1.0]}, 1.0, "must be a vector"),
        ([0.0, 1.0], {"level": [1.0]}, 0.0, "nats of an alternative must be positive"),
        ([0.0, 1.0], {"level": [0.0]}, 1.0, "level of an alternative must be a vector of positive"),
        ([0.0, 1.0], {"level": 1.0}, 1.0, "level of an alternative must be a vector of positive"),
        ([0.0, 1.0], {}, 1.0, "needs a sensor that judges"),
    ],
)
def test_bad_arguments_are_named(spread, judging, nats, word):
    with pytest.raises(ValueError, match=word):
        alternative(kalman(), spread, judging, nats, "offset")


@pytest.mark.parametrize(
    ("spread", "judging", "word"),
    [
        ([0.0, 1.0], {"depth": [1.0]}, "no such sensor"),
        ([1.0], {"level": [1.0]}, "spread of an alternative needs 2 numbers"),
        ([0.0, 1.0], {"level": [1.0, 1.0]}, "level of an alternative needs 1 numbers"),
    ],
)
def test_what_does_not_fit_the_model_is_named(spread, judging, word):
    with pytest.raises(ValueError, match=word):
        alternative(kalman(), spread, judging, NATS, "offset").init(START, MODEL.dims)
