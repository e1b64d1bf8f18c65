"""Arguments of consistency tests, norms and discretisation that are none: refused by name."""

import inspect

import jax.numpy as jnp
import numpy as np
import pytest

from robins import linalg
from robins.filters import Motion, Sensor, gamma_min, steady_h_infinity
from robins.filters.analysis import anees, direction_in_words, gramian, grand_mean_nis, whiteness
from robins.filters.synthesis import closed_form, h2_norm, hinf_norm, plant

EYE = np.eye(2)
# as users have them, whose types and shapes nobody checks at a call
van_loan, symmetric_root, cholesky = map(
    inspect.unwrap, (linalg.van_loan, linalg.symmetric_root, linalg.cholesky)
)
eigenvalue_bounds, factor = map(inspect.unwrap, (linalg.eigenvalue_bounds, linalg.factor))
SERIES = np.random.default_rng(3).normal(size=100)


def steady(gamma=10.0, H=EYE[:1], R=EYE[:1, :1]):
    return inspect.unwrap(steady_h_infinity)(EYE, EYE, H, R, EYE, gamma)


WRONG = {
    "NEES of one run as a row": (
        lambda: inspect.unwrap(anees)(np.ones(5), 2),
        "one epoch or more a column",
    ),
    "NEES of no run": (lambda: inspect.unwrap(anees)(np.ones((0, 5)), 2), "one run or more a row"),
    "no state": (
        lambda: inspect.unwrap(anees)(np.ones((4, 5)), 0),
        "n, the number of states, must be 1 or more",
    ),
    "level of NEES": (
        lambda: inspect.unwrap(anees)(np.ones((4, 5)), 2, 1.5),
        "between 0 and 1, got 1.5",
    ),
    "NIS and degrees that differ": (
        lambda: inspect.unwrap(grand_mean_nis)(np.ones(5), np.ones(4)),
        r"nis is of shape \(5,\), dof of \(4,\)",
    ),
    "level of NIS": (
        lambda: inspect.unwrap(grand_mean_nis)(np.ones(5), np.ones(5), 95.0),
        "got 95",
    ),
    "series of two components": (
        lambda: whiteness(np.ones((100, 2))),
        r"one series, \(T,\), got \(100, 2\)",
    ),
    "degrees below zero": (
        lambda: grand_mean_nis(np.ones(5), -np.ones(5)),
        "degrees of freedom must be zero or more, got -1",
    ),
    "Gramian of NaN": (lambda: gramian(np.full((2, 2), np.nan)), r"L\[0, 0\] is nan"),
    "Gramian of a rectangle": (lambda: gramian(np.ones((2, 3))), r"L is \(2, 3\), must be"),
    "no direction": (
        lambda: direction_in_words(np.zeros(2), "ab"),
        "the length of the vector is, got 0",
    ),
    "direction without names": (
        lambda: direction_in_words(np.ones(3), "ab"),
        "for each of 2 names",
    ),
    "norm of huge numbers": (lambda: hinf_norm(EYE / 2, 1e200 * EYE, EYE), "B holds 1e[+]200"),
    "H2 norm of huge numbers": (lambda: h2_norm(EYE / 2, EYE, 1e200 * EYE), "C holds 1e[+]200"),
    "no end of a search": (
        lambda: inspect.unwrap(gamma_min)(None, None, None, EYE, rtol=0.0),
        "rtol must be 1e-12",
    ),
    "sigma below zero": (
        lambda: Motion(lambda x, u: x, np.array([1.0, -1.0])),
        "noise of the motion holds a negative number",
    ),
    "complex sigma": (
        lambda: Sensor(lambda x, aux: x, np.array([1j]), name="gnss"),
        "noise of sensor 'gnss' is not of real numbers",
    ),
    "sigma of words": (lambda: Motion(lambda x, u: x, "a"), "is not of real numbers"),
    "no lag": (lambda: whiteness(SERIES, 0), "lags must be 1 or more, got 0"),
    "level of whiteness": (lambda: whiteness(SERIES, level=1.0), "between 0 and 1, got 1.0"),
    "series that never changes": (lambda: whiteness(np.full(100, 0.1)), "never changes"),
    "gamma of words": (lambda: steady("a"), "gamma must be one real number, got 'a'"),
    "gamma of many": (lambda: steady([1.0, 2.0]), "gamma must be one real number"),
    "gamma of a design": (
        lambda: inspect.unwrap(closed_form)(plant(0.9 * EYE, EYE, EYE, EYE), "a"),
        "gamma must be one real number",
    ),
    "no measurement": (lambda: steady(H=EYE[:0], R=EYE[:0, :0]), "H has no rows"),
    "complex covariance": (lambda: factor(EYE + 1j), "covariance holds complex128"),
    "covariance of words": (lambda: factor("abc", "Q"), "Q holds <U3"),
    "ragged covariance": (lambda: factor([[1, 2], [3]]), "its rows differ in length"),
    "root of a rectangle": (
        lambda: symmetric_root(jnp.ones((2, 3))),
        r"P has shape \(2, 3\); a square matrix is wanted",
    ),
    "eigenvalues of a rectangle": (lambda: eigenvalue_bounds(jnp.ones((2, 3))), "square"),
    "eigenvalues of nothing": (lambda: eigenvalue_bounds(jnp.ones((0, 0))), "no eigenvalue"),
    "Cholesky of a vector": (lambda: cholesky(jnp.ones(2)), r"P has shape \(2,\)"),
    "noise of another size": (
        lambda: van_loan(jnp.eye(2), jnp.eye(3), 1.0),
        r"Qc has shape \(3, 3\); \(2, 2\) is wanted",
    ),
    "time backwards": (lambda: van_loan(jnp.eye(2), jnp.eye(2), -1.0), "dt must be zero or"),
    "noise of NaN": (
        lambda: van_loan(jnp.eye(2), jnp.full((2, 2), jnp.nan), 1.0),
        "Qc has entries that are not finite",
    ),
}


@pytest.mark.parametrize("mistake", WRONG)
def test_an_argument_that_is_none_is_refused(mistake):
    make, sentence = WRONG[mistake]
    with pytest.raises((TypeError, ValueError), match=sentence):
        make()


@pytest.mark.parametrize("unit", [1e-200, 1e200])
def test_whiteness_does_not_depend_on_the_unit(unit):
    assert whiteness(unit * SERIES).value == pytest.approx(whiteness(SERIES).value)
