"""Sigmas, rows and units that are none, in alignment and Allan analysis: refused by name."""

import inspect

import numpy as np
import pytest

from robins import ins
from robins.ins.allan import deviation

DOWN = np.array([0.0, 0.0, -9.8])
NORTH = np.array([5.2e-5, 0.0, 5.1e-5])
NOISE = np.random.default_rng(1).normal(size=100)
align, gyrocompass = inspect.unwrap(ins.align), inspect.unwrap(ins.gyrocompass)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ins.level(DOWN, -0.1), "sigma_f must be finite, and zero or more, got -0.1"),
        (lambda: ins.level(DOWN, np.nan), "sigma_f must be finite"),
        (lambda: ins.level(DOWN, 0.1, 0.0, np.inf), "heading_sigma_rad must be finite"),
        (lambda: gyrocompass(NORTH, DOWN, 0.78, -1e-7, 0.01), "sigma_omega must be finite"),
        (lambda: gyrocompass(NORTH, DOWN, 0.78, 1e-7, np.nan), "sigma_f must be finite"),
        (
            lambda: ins.heading_from_velocity(np.array([5.0, 0.0, 0.0]), -1.0),
            "sigma_v must be positive",
        ),
        (
            lambda: align(NORTH, DOWN, 0.01, 0.78, ins.grade("tactical")),
            r"omega_ib_b must have shape \(n, 3\), got \(3,\)",
        ),
        (lambda: deviation(1e200 * NOISE, dt_s=0.01), "is the unit right"),
        (lambda: deviation(1e-200 * NOISE, dt_s=0.01), "is the unit right"),
    ],
)
def test_a_number_that_is_none_is_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()
