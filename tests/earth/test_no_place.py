"""Places at which there is no answer: refused by name."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins.earth import A_M, B_M, geodetic_from_ecef, gravity, gravity_n, transport_rate_n

POLE = np.pi / 2
# as users have it, whose shapes nobody checks at a call
PLAIN_RATE = inspect.unwrap(transport_rate_n)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: gravity(0.0, -A_M), "a height must be -1e\\+06 m or more, got -6.37814e\\+06"),
        (lambda: gravity(POLE, -B_M), "a height must be"),
        (lambda: gravity_n(np.zeros(2), np.array([0.0, -1e7])), "got -1e\\+07"),
        (lambda: transport_rate_n(POLE, 0.0, np.ones(3)), "at a pole"),
        (lambda: transport_rate_n(np.array([0.0, -POLE]), 0.0, np.ones((2, 3))), "at a pole"),
        (lambda: transport_rate_n(0.5, -A_M, np.ones(3)), "a height must be"),
        (lambda: PLAIN_RATE(0.5, 0.0, np.ones(2)), "v_n has 3 components"),
        (lambda: geodetic_from_ecef(np.array([np.inf, 0.0, 0.0])), "finite numbers of metres"),
        (lambda: geodetic_from_ecef(np.array([1e200, 0.0, 0.0])), "finite numbers of metres"),
    ],
)
def test_a_place_without_an_answer_is_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_a_missing_place_stays_missing():
    assert np.isnan(gravity(0.5, np.nan))
    assert np.all(np.isnan(geodetic_from_ecef(np.full(3, np.nan))))
    assert np.all(np.isfinite(transport_rate_n(np.deg2rad(89.9999), 0.0, np.ones(3))))
    assert np.isfinite(jax.jit(transport_rate_n)(POLE, 0.0, jnp.ones(3))[0])
