"""Matrices and quaternions that are no rotation: refused, or no number where nothing can raise."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins import rotation as rot


def test_a_matrix_that_is_no_rotation_is_refused():
    mirror = jnp.diag(jnp.array([1.0, 1.0, -1.0]))
    for wrong, words in (
        (mirror, "is a reflection"),
        (-jnp.eye(3), "is a reflection"),
        (jnp.stack([jnp.eye(3), mirror]), "is a reflection"),
        (jnp.zeros((3, 3)), "differs from the identity by 1"),
        (2.0 * jnp.eye(3), "differs from the identity by 3"),
    ):
        with pytest.raises(ValueError, match=words):
            rot.from_dcm(wrong)
    # what cannot raise gives no number, and what is missing stays missing
    assert np.all(np.isnan(jax.jit(rot.from_dcm)(mirror)))
    assert np.all(np.isnan(rot.from_dcm(jnp.full((3, 3), jnp.nan))))


TURNS = {
    "to_dcm": rot.to_dcm,
    "to_euler": inspect.unwrap(rot.to_euler),
    "rotate": lambda q: inspect.unwrap(rot.rotate)(q, np.ones(3)),
}


@pytest.mark.parametrize("turn", TURNS)
def test_a_quaternion_that_is_no_rotation_is_refused(turn):
    for q in (np.zeros(4), np.array([2.0, 0.0, 0.0, 0.0]), np.full(4, np.inf), np.eye(4) * 1.1):
        for given in (q, jnp.asarray(q)):
            with pytest.raises(ValueError, match="the length of a quaternion differs from 1 by"):
                TURNS[turn](given)
    with pytest.raises(ValueError, match=r"4 components along its last axis, got \(3,\)"):
        inspect.unwrap(TURNS[turn])(np.ones(3))
    # what is missing stays missing, what was written with two digits is one
    assert np.any(np.isnan(TURNS[turn](jnp.full(4, jnp.nan))[0]))
    TURNS[turn](np.array([0.71, 0.0, 0.71, 0.0]))
    TURNS[turn](np.zeros((0, 4)))


def test_what_has_no_length_is_not_made_one():
    for q in (np.zeros(4), np.full(4, 1e-200), np.array([1e200, 0.0, 0.0, 0.0])):
        with pytest.raises(ValueError, match="no rotation"):
            rot.normalise(jnp.asarray(q))
    with pytest.raises(ValueError, match=r"3 x 3, got \(9,\)"):
        inspect.unwrap(rot.from_dcm)(jnp.zeros(9))
