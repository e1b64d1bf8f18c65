"""The choice of parameters against closed forms: a variance has a maximum likelihood of its own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins.campaign.many_runs import ManyRuns
from robins.campaign.tuning import Data, Objective, Trial, UndeterminedError, choose

KEYS = ["a", "b"]


def spread(count, sigma, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 50)) * sigma


def likelihood(numbers, z):
    """(1,) minus the mean log density of normal numbers (N,) of a standard deviation."""
    (sigma,) = numbers
    return jnp.mean(jnp.log(sigma) + 0.5 * (z / sigma) ** 2)[None]


def first(mean):
    return float(mean[0])


def of_one(x):
    return Trial("one", (jnp.exp(x[0]),))


ONE = Objective(of_one, likelihood, first)


def test_a_standard_deviation_is_that_of_the_sample():
    z, held = spread(30, 4.0), spread(30, 4.0, seed=1)
    found = choose(ONE, ["a"], Data(z), Data(held))
    assert found.gradient
    assert np.exp(found.x[0]) == pytest.approx(np.sqrt(np.mean(z**2)), rel=1e-4)
    # of ln sigma by maximum likelihood: 1 / sqrt(2 N)
    assert found.sigma[0] == pytest.approx(1.0 / np.sqrt(2.0 * z.size), rel=0.35)
    was, now = (
        np.mean(np.log(s) + 0.5 * (held / s) ** 2) for s in (1.0, float(np.exp(found.x[0])))
    )
    assert found.gain == pytest.approx(was - now, rel=1e-9)
    assert 0.0 < found.gain_low < found.gain
    assert found.better


def test_the_interval_holds_as_often_as_it_says():
    inside = []
    for seed in range(40):
        found = choose(ONE, ["a"], Data(spread(12, 1.5, seed)), Data(spread(12, 1.5, seed + 100)))
        inside.append(abs(found.x[0] - np.log(1.5)) < 1.96 * found.sigma[0])
    assert np.mean(inside) > 0.85


def test_what_is_right_is_left_alone():
    z = spread(30, 1.0)
    held = spread(30, 1.0, seed=3)
    assert not choose(ONE, ["a"], Data(z), Data(held)).better


def test_rows_part_what_is_measured_at_once():
    z = np.concatenate([spread(20, 4.0), spread(20, 2.0)])
    found = choose(ONE, ["a"], Data(z, np.arange(20)), Data(z, np.arange(20, 40)))
    assert np.exp(found.x[0]) == pytest.approx(np.sqrt(np.mean(z[:20] ** 2)), rel=1e-4)
    assert len(found.before) == 20


def told(size):
    """Filter of a size that is data, or the structure of a tree."""
    return {"data": (jnp.asarray(size),), "structure": {str(size): ()}}


def likelihood_told(numbers, z):
    (sigma,) = numbers if isinstance(numbers, tuple) else map(float, numbers)
    return likelihood((jnp.asarray(sigma),), z)


@pytest.mark.parametrize("way", ["data", "structure"])
def test_what_may_leap_or_is_compiled_is_searched(way):
    def trial(x):
        size = round(float(np.exp(x[0])), 6)
        return Trial(size if way == "data" else (), told(size)[way])

    z = spread(30, 3.0)
    at = Objective(trial, likelihood_told, first)
    found = choose(at, ["a"], Data(z), Data(spread(30, 3.0, 1)))
    assert not found.gradient
    assert np.exp(found.x[0]) == pytest.approx(np.sqrt(np.mean(z**2)), rel=0.02)


@pytest.mark.parametrize(
    ("trial", "says"),
    [
        (lambda x: Trial("one", (jnp.exp(x[0] + x[1]),)), "too little: .*some act alike"),
        (lambda x: Trial("one", (jnp.exp(x[0]),)), "^b changes nothing"),
    ],
    ids=["a product", "an idle one"],
)
def test_it_refuses_what_the_data_do_not_tell(trial, says):
    with pytest.raises(UndeterminedError, match=says):
        choose(
            Objective(trial, likelihood, first), KEYS, Data(spread(30, 2.0)), Data(spread(30, 2.0))
        )


def test_it_refuses_a_parameter_that_runs_away():
    z = np.zeros((10, 50))
    with pytest.raises(UndeterminedError, match="a would become small without end"):
        choose(ONE, ["a"], Data(z), Data(z))


def test_it_refuses_few_parts_and_a_lost_filter():
    with pytest.raises(UndeterminedError, match="3 runs or segments"):
        choose(ONE, ["a"], Data(spread(3, 2.0)), Data(spread(3, 2.0)))
    z = spread(10, 2.0)
    z[0, 0] = np.inf
    with pytest.raises(UndeterminedError, match="lost as it is written"):
        choose(ONE, ["a"], Data(z), Data(spread(10, 2.0)))


@pytest.mark.parametrize(("lost_at", "better"), [(1.0, True), (2.0, False)])
def test_a_filter_that_is_lost_on_what_was_held_out_is_worse(lost_at, better):
    def measure(numbers, arrays):
        z, held_out = arrays
        found = likelihood(numbers, z)
        return jnp.where(held_out & (jnp.abs(numbers[0] - lost_at) < 0.2), jnp.inf, found)

    z, no, yes = spread(20, 2.0), np.zeros(20, bool), np.ones(20, bool)
    found = choose(Objective(of_one, measure, first), ["a"], Data((z, no)), Data((z, yes)))
    assert found.better is better


def test_numbers_that_differ_are_arguments_of_one_program():
    """Also one that first differs late, beside one that never does."""
    traced = []

    def measure(numbers, z):
        traced.append(1)
        sigma, bend, fixed = numbers
        return likelihood((sigma,), z) + bend + fixed

    def numbers(x):
        return np.exp(x), np.maximum(x - 1.0, 0.0), np.float64(7.0)

    z = spread(21, 2.0)  # no multiple of the lanes, with any number of points
    many = ManyRuns(measure)
    for some in ([0.0, 0.5, 0.9], [0.1, 0.2], [0.0, 2.0], [1.5]):
        found = many(list(map(numbers, some)), z)
        want = [np.log(np.exp(x)) + 0.5 * np.mean((z / np.exp(x)) ** 2, 1) for x in some]
        bent = np.maximum(np.array(some) - 1.0, 0.0)[:, None] + 7.0
        np.testing.assert_allclose(found[..., 0], want + bent, rtol=1e-14)
    assert len(traced) == 2


def test_a_program_that_is_replaced_leaves_its_notes_and_each_is_said_once():
    def measure(numbers, z):
        """Sum by JAX, as complex numbers have no place in a program, until one differs."""
        known = not isinstance(numbers[0], jax.core.Tracer)
        return jnp.sum(jnp.abs(jnp.fft.fft(z))) if known else numbers[0] * jnp.sum(z)

    many, z = ManyRuns(measure), spread(3, 1.0)
    for x in (1.0, 2.0):
        many([(np.float64(x),)], z)
        (note,) = many.notes
        assert "complex" in note


def test_what_differs_does_so_by_its_bits_and_keys_come_back():
    def drawn(numbers, k):
        given, sign = numbers
        return {
            "sign": jnp.copysign(1.0, sign) + 0.0 * k.astype(float),
            "key": jax.random.key(k),
            "y": given[0],
        }

    many = ManyRuns(drawn)
    y = np.array([2.0, np.nan])
    found = many([(y, np.float64(0.0)), (y.copy(), np.float64(-0.0))], np.arange(3))
    np.testing.assert_array_equal(found["sign"], [[1.0] * 3, [-1.0] * 3])
    np.testing.assert_array_equal(found["y"], np.full((2, 3), 2.0))
    assert many._differ == [1]
    keys = jax.random.key_data(jax.vmap(jax.random.key)(jnp.arange(3)))
    np.testing.assert_array_equal(jax.random.key_data(found["key"][1]), keys)
    with pytest.raises(ValueError, match="there must be points and runs"):
        many([], np.arange(3))
