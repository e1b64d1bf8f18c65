"""The rocket's filters against the bands and orders of the specification, section 10.

A1: the model is right, the magnetometer is off by 5 deg for a second in thirty. A2: the filters
believe coefficients that are 2 % too large. B: one vector, the gyro drives. The angles over 150 s
(20 runs against 50 of 600 s: that changes A1 by 2 %, A2 by 6 %), the field vector over the whole
flight, for what is not seen grows with time.

`make test` makes 8 runs of the filters of the paper and of the one that is best, which have to stay
within the same bands; `make certify` 20 of every filter.
"""

import numpy as np
import pytest
from rocket_runs import MANY, RUNS, found

STRONG = "federated-vector-stukf"


OF_THE_PAPER = [
    ("a1", "ukf", "attitude", 0.40, 0.50),
    ("a1", "ukf", "peak", 1.3, 1.8),
    ("a1", "ukf", "nees_attitude", 3.0, np.inf),
    ("a1", STRONG, "attitude", 0.95, 1.10),
    ("a1", STRONG, "peak", 5.4, 6.2),  # it follows the disturbance
    ("a1", "discriminator", "peak", 0.0, 0.7),
    ("b2", "gate", "across", 0.095, 0.12),
    ("b2", "gate", "about", 2.1, 3.1),  # dead reckoning
]
OTHERS = [
    ("a1", "huber", "attitude", 0.20, 0.25),
    ("a1", "gate", "nees_attitude", 0.8, 1.2),
    ("a2", "ukf", "attitude", 0.85, 0.97),
    ("a2", STRONG, "quiet", 0.47, 0.57),
    ("a2", "discriminator", "attitude", 0.54, 0.66),
    ("b1n", "usque", "nees_attitude", 0.8, 1.3),
    ("b1", "gate", "nees_attitude", 0.8, 1.7),
]


@pytest.mark.parametrize(
    ("runs", "name", "filter_", "figure", "low", "high"),
    [(RUNS, *row) for row in OF_THE_PAPER] + [(MANY, *row) for row in OF_THE_PAPER + OTHERS],
)
def test_figures_are_those_of_the_reference(runs, name, filter_, figure, low, high):
    assert low < getattr(found(name, filter_, runs), figure) < high


@pytest.mark.parametrize(
    ("runs", "name", "figure", "filters"),
    [
        (RUNS, "a1", "attitude", ("discriminator", "ukf", STRONG)),
        # by `make certify`
        (MANY, "a1", "attitude", ("discriminator", "ukf", STRONG)),
        (MANY, "a1", "attitude", ("gate", "huber", "ukf")),
        (MANY, "a2", "attitude", ("discriminator", "ukf")),
        (MANY, "a2", "attitude", ("discriminator", STRONG)),
        (MANY, "b1", "nees_attitude", ("gate", "usque")),
        (MANY, "b2", "across", ("gate", "usque")),
    ],
    ids=lambda x: "<".join(x) if isinstance(x, tuple) else str(x),
)
def test_the_order_is_that_of_the_specification(runs, name, figure, filters):
    figures = [getattr(found(name, filter_, runs), figure) for filter_ in filters]
    assert figures == sorted(figures)


def test_what_comes_close_to_another_filter():
    """The root of the information is the central filter, for all is linear but the angles."""
    root, ukf = found("a1", "federated-root"), found("a1", "ukf")
    assert abs(root.attitude - ukf.attitude) < 1e-3
    assert np.max(np.abs((root.error - ukf.error)[:, ukf.counted, :3])) < 0.02
    assert found("a1", "discriminator").attitude < 1.1 * found("a1", "huber").attitude
