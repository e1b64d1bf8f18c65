"""State manifolds: retract and local undo each other on every kind of state."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from robins import manifold
from robins.earth import Geodetic
from robins.manifold import Angle, wrap
from robins.rotation import Rotation

EPS = np.finfo(float).eps
folded = jax.jit(wrap)


class Navigation(NamedTuple):
    """A state as the systems have them: elements, vectors, something left out, nested."""

    attitude: Any
    position: Any
    velocity: Any
    sensors: Any
    clock: Any = None


def navigation(seed=0):
    rng = np.random.default_rng(seed)
    return Navigation(
        attitude=Rotation.from_euler(*rng.uniform(-1.5, 1.5, 3)),
        position=Geodetic.from_degrees(rng.uniform(-80, 80), rng.uniform(-180, 180), 100.0),
        velocity=jnp.asarray(rng.normal(size=3)),
        sensors={
            "gyro": {"bias": jnp.asarray(rng.normal(size=3)), "scale": None},
            "mount": [Angle(jnp.asarray(rng.uniform(-3, 3))), jnp.asarray(rng.normal(size=(2, 2)))],
            "gain": jnp.asarray(rng.normal()),
        },
    )


N = 3 + 3 + 3 + 1 + 3 + 1 + 4
retract, local = jax.jit(manifold.retract), jax.jit(manifold.local)


@given(st.floats(-1e6, 1e6, allow_subnormal=False))  # XLA takes those for zero
@example(math.pi)
@example(-math.pi)
@example(math.nextafter(math.pi, 0))
@example(math.nextafter(math.pi, 4))
@example(math.nextafter(-math.pi, -4))
@example(1e-300)
@example(-0.0)
def test_wrap_folds_into_the_half_open_turn(angle):
    got = float(folded(angle))
    assert -math.pi <= got < math.pi
    if -math.pi <= angle < math.pi:
        assert got == angle  # not a bit is lost
    else:
        # the float nearest 2 pi counts as the turn; between two values pi apart either is right
        away = math.remainder(got - math.remainder(angle, 2 * math.pi), 2 * math.pi)
        assert abs(away) <= 4 * EPS * abs(angle)


def test_wrap_has_slope_one_everywhere():
    slope = jax.jit(jax.vmap(jax.grad(wrap)))
    at = jnp.array([-4.0, -math.pi, -1.0, 0.0, math.nextafter(math.pi, 0), math.pi, 7.0])
    np.testing.assert_array_equal(slope(at), np.ones(7))


def test_angles_differ_by_the_shortest_way():
    near_south, across = Angle(jnp.array([3.1, -3.1])), Angle(jnp.array([-3.1, 3.1]))
    gap = 2 * math.pi - 6.2
    np.testing.assert_allclose(near_south.local(across), [[gap], [-gap]], atol=4 * EPS)
    moved = near_south.retract(jnp.array([[gap], [-gap]]))
    np.testing.assert_allclose(moved.rad, across.rad, atol=4 * EPS)
    assert manifold.dim(Angle(0.0)) == 1


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-6, 1e-3, 0.03, 1.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_local_gives_back_the_step(size, seed):
    x = navigation(seed)
    d = size * np.random.default_rng(seed + 10).uniform(-1, 1, N)
    y = retract(x, d)
    # The worst rounding is that of the position: 4e-16 rad are 3e-9 m, its height 2e-14 m.
    in_metres = np.zeros(N, bool)
    in_metres[3:6] = True
    bound = np.where(in_metres, 4e-9, 8 * EPS)
    assert np.all(np.abs(local(x, y) - d) <= bound)
    assert jax.tree_util.tree_structure(y) == jax.tree_util.tree_structure(x)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_retract_reaches_the_other_state(seed):
    x = navigation(seed)
    apart = np.random.default_rng(seed + 20).uniform(-3, 3, N) * np.repeat(
        [0.5, 1e5, 1.0], [3, 3, N - 6]
    )
    y = retract(x, apart)
    again = retract(x, local(x, y))
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(y), strict=True):
        np.testing.assert_allclose(a, b, rtol=4 * EPS, atol=4 * EPS)


def test_tangent_vector_follows_the_order_of_leaves():
    x = navigation()
    d = np.zeros(N)
    d[3:6] = 1.0, 2.0, 3.0  # the position comes second, as in the class
    y = retract(x, d)
    np.testing.assert_array_equal(y.velocity, x.velocity)
    np.testing.assert_allclose(y.position.alt - x.position.alt, -3.0, atol=1e-13)
    assert manifold.dim(x) == N == len(d)


def test_arrays_alone_add_and_subtract_exactly():
    x = {"a": jnp.arange(3.0), "b": jnp.ones((2, 2))}
    d = np.arange(7.0) / 3
    y = retract(x, d)
    np.testing.assert_array_equal(y["a"], np.arange(3.0) + d[:3])
    np.testing.assert_array_equal(y["b"], np.ones((2, 2)) + d[3:].reshape(2, 2))
    expected = np.concatenate([y["a"] - x["a"], np.ravel(y["b"] - x["b"])])
    np.testing.assert_array_equal(local(x, y), expected)


def test_a_state_with_nothing_in_it_has_no_tangent():
    assert manifold.dim({"off": None}) == 0
    assert local({"off": None}, {"off": None}).shape == (0,)
    assert retract({"off": None}, np.zeros(0)) == {"off": None}


def test_derivative_of_local_after_retract_is_the_identity():
    x = navigation()
    slope = jax.jit(jax.jacfwd(lambda d: manifold.local(x, manifold.retract(x, d))))(jnp.zeros(N))
    np.testing.assert_allclose(slope, np.eye(N), atol=1e-15)


def test_many_states_move_under_vmap():
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(navigation, range(4)))
    d = np.random.default_rng(5).normal(size=(4, N)) * 0.1
    moved = jax.jit(jax.vmap(manifold.retract))(states, d)
    back = jax.jit(jax.vmap(manifold.local))(states, moved)
    assert np.all(np.abs(back - d) <= 4e-9)
    one = retract(navigation(2), d[2])
    for a, b in zip(jax.tree.leaves(moved), jax.tree.leaves(one), strict=True):
        np.testing.assert_allclose(a[2], b, rtol=4 * EPS, atol=4 * EPS)


@pytest.mark.parametrize("length", [0, N - 1, N + 1])
def test_a_step_of_wrong_length_is_refused(length):
    with pytest.raises(ValueError, match=rf"shape \({length},\), the state needs \({N},\)"):
        manifold.retract(navigation(), jnp.zeros(length))


@pytest.mark.parametrize(
    ("x", "y", "words"),
    [
        ({"a": jnp.zeros(1)}, {"b": jnp.zeros(1)}, "structure"),
        ({"a": None}, {"a": jnp.zeros(1)}, "structure"),
        (jnp.zeros(1), jnp.zeros(3), r"\(1,\) and \(3,\)"),  # would broadcast
        (Angle(jnp.zeros(())), jnp.zeros(1), "Angle and"),
        (Angle(jnp.zeros(())), Rotation.identity(), "Angle and Rotation"),
    ],
)
def test_states_that_do_not_match_are_refused(x, y, words):
    with pytest.raises(ValueError, match=words):
        manifold.local(x, y)
