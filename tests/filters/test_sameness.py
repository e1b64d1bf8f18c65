"""A filter made again with equal arguments is compiled once; with others, or a user's, anew."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins.filters import (
    Belief,
    Model,
    Motion,
    OnlineFilter,
    Sensor,
    guarded,
    imm,
    kalman,
    particle,
    run,
    sameness,
    taylor,
    unscented,
)
from robins.filters.rules import equality, fading_memory, gate, h_infinity, huber, student_t
from robins.filters.run import _scan
from robins.filters.sameness import same, same_model

EYE = np.eye(2)
# How to make a thing, arguments, and others that must tell.
MADE = {
    "gate": (gate, [(0.99,), (0.999,), (0.99, 5), (0.99, 10, "accept")]),
    "huber": (huber, [(0.9,), (0.95,)]),
    "student_t": (student_t, [(), (4.0,)]),
    "fading_memory": (fading_memory, [(1.0,), (1.1,)]),
    "h_infinity": (h_infinity, [(9.0, EYE), (9.0, 2 * EYE), (8.0, EYE)]),
    "equality": (equality, [(EYE[:1], np.zeros(1)), (EYE[1:], np.zeros(1)), (EYE[:1], np.ones(1))]),
    "taylor": (taylor, [()]),
    "unscented": (unscented, [(), (0.5,)]),
    "kalman": (
        lambda form, *p: kalman(taylor(), [gate(x) for x in p], form),
        [("sqrt",), ("joseph",), ("sqrt", 0.99), ("sqrt", 0.99, 0.99), ("sqrt", 0.98)],
    ),
    "imm": (
        lambda stay, p: imm([kalman(), kalman(rules=[huber(p)])], [[stay, 1 - stay], [0.5, 0.5]]),
        [(0.9, 0.9), (0.8, 0.9), (0.9, 0.8)],
    ),
    "guarded": (lambda p: guarded(kalman(rules=[gate(p)]), kalman(), "y", "z"), [(0.9,), (0.8,)]),
    "particle": (lambda n, k: particle(n, jax.random.key(k)), [(10, 0), (20, 0), (10, 1)]),
}


@pytest.mark.parametrize("name", MADE)
def test_equal_arguments_make_the_same_and_others_do_not(name):
    make, arguments = MADE[name]
    made = [(same(make(*given)), same(make(*given))) for given in arguments]
    assert all(one is other for one, other in made)
    assert len({id(one) for one, _ in made}) == len(arguments)


@pytest.mark.parametrize("pair", [(0.0, -0.0), (1, 1.0), (True, 1)])
def test_numbers_that_only_compare_as_equal_are_not_the_same(pair):
    one, other = (around(x) for x in pair)
    assert same(one) is not same(other)


def around(x):
    """A rule of robins around a thing of the user's."""
    return gate(0.9)._replace(name=(x,))


def test_functions_of_a_user_are_the_same_only_if_they_are_one():
    """What such a function reads from outside may have changed."""

    def make(factor):
        return lambda x, u: factor * x

    one = make(0.5)
    assert same(one) is one
    assert same(make(0.5)) is not same(one)


def model(step):
    return Model(Motion(step, jnp.ones(2)), (Sensor(lambda x, aux: x, jnp.ones(2), 2),))


def still(x, u):
    return x


def read(x, aux):
    return x


def test_a_loop_that_makes_its_filter_again_compiles_once():
    """Also of a model whose functions robins made, and whose numbers change."""
    start, y = Belief.of(jnp.zeros(2), jnp.eye(2)), jnp.ones((5, 2))

    def once(sigma, probability=0.99):
        noise = jnp.full(2, sigma)
        it = Model(Motion(still, noise), (Sensor(read, noise, 2),))
        return run(kalman(rules=[gate(probability)]), it, start, y).mean[-1]

    first = once(1.0)
    before = _scan._cache_size()
    assert not np.array_equal(once(2.0), first)
    assert np.array_equal(once(1.0), first)
    assert _scan._cache_size() == before
    once(1.0, 0.98)
    assert _scan._cache_size() == before + 1


def test_a_model_keeps_its_data_and_takes_the_first_of_equal_functions():
    def partial_of(factor):
        return jax.tree_util.Partial(fading_memory(1.1).process, factor)

    one, other = (same(partial_of(jnp.asarray(x))) for x in (1.0, 2.0))
    assert one.func is other.func
    assert (one.args[0], other.args[0]) == (1.0, 2.0)
    it = model(still)
    assert jax.tree_util.tree_structure(same_model(it)) == jax.tree_util.tree_structure(it)
    assert same_model(it).motion.noise is it.motion.noise


def test_what_a_transformation_is_looking_at_is_not_remembered():
    """Each trace has numbers of its own: to take an earlier one's would leak it."""
    begun = len(sameness._first)

    @jax.jit
    def at(x):
        one = around(x)
        assert same(one) is one
        return x

    at(1.0)
    assert len(sameness._first) == begun


def test_a_stream_made_again_is_compiled_once():
    from robins.filters.machine import _update

    def stream():
        it = OnlineFilter(
            kalman(rules=[gate(0.97)]),
            Model(Motion(still, jnp.ones(2)), (Sensor(read, jnp.ones(2), 2),)),
            Belief.of(jnp.zeros(2), jnp.eye(2)),
        )
        it.predict()
        it.update(jnp.ones(2))
        return it.belief.mean

    first = stream()
    before = _update._cache_size()
    assert np.array_equal(stream(), first)
    assert _update._cache_size() == before
