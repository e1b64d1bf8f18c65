"""The filters of the satellite: what each is made of."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Literal, NamedTuple

import numpy as np

from robins.filters import Filter, kalman, taylor
from robins.filters.rules import constant_gain, gate
from robins.systems.satellite.nodes import STAR

GATE = 0.9999962  # chi-square of 3 at 27.9
PATIENCE = 20  # frames refused in a row, after which what they agree on is believed again
Way = Literal["raw", "h2", "lmi", "riccati"]
Enters = Literal["rate", "bias"]


Build = Literal["mekf", "quaternion", "gated", "fixed", "fixed-gated"]


class Recipe(NamedTuple):
    """How the gain of an axis is found."""

    way: Way
    share: float = 1.0  # gamma over the H-infinity norm that the Kalman filter of the axis has
    enters: Enters = "rate"  # where n does


class Kind(NamedTuple):
    """A filter of the study."""

    build: Build
    recipe: Recipe | None = None  # of its gains; of a Kalman filter, of what its Q is inflated by
    drift: float | None = None  # variance of the bias' walk over the believed; None: told the truth
    text: str = ""


KINDS: Mapping[str, Kind] = {
    "raw": Kind("fixed", Recipe("raw"), 1.0, "the star sensor's reading, moved by the gyro"),
    "mekf": Kind("mekf", None, 1.0, "multiplicative EKF"),
    "mekf-gate": Kind("gated", None, 1.0, "the same with a gate that opens again"),
    "mekf-tuned": Kind("mekf", None, 30.0, "the same, noise of the bias times 30"),
    "mekf-informed": Kind("mekf", None, None, "the same, told the true drift"),
    "ekf-quaternion": Kind("quaternion", None, 1.0, "additive EKF of seven states"),
    "h2": Kind("fixed", Recipe("h2"), 1.0, "steady Kalman gain"),
    "mixed-lmi": Kind("fixed", Recipe("lmi", 0.5), 1.0, "mixed, by LMI, n on the rate"),
    "mixed-riccati": Kind("fixed", Recipe("riccati", 0.5), 1.0, "mixed, by Riccati, n on the rate"),
    "mixed-riccati-quarter": Kind("fixed", Recipe("riccati", 0.25), 1.0, "the same, gamma halved"),
    "mixed-bias-half": Kind(
        "fixed", Recipe("riccati", 0.5, "bias"), 1.0, "mixed, by Riccati, n on the bias"
    ),
    "mixed-bias": Kind("fixed", Recipe("riccati", 0.25, "bias"), 1.0, "the same, gamma halved"),
    "mixed-bias-gate": Kind(
        "fixed-gated", Recipe("riccati", 0.25, "bias"), 1.0, "the same with the gate"
    ),
    "mekf-inflated": Kind(
        "mekf", Recipe("riccati", 0.25, "bias"), 1.0, "MEKF with the noise of mixed-bias"
    ),
    "hinf": Kind("fixed", Recipe("riccati", 0.1), 1.0, "worst case first: gamma a tenth"),
}
FILTERS = tuple(KINDS)


@cache
def make_filter(build: Build) -> Filter:
    """The same object each time, so that filters that differ in numbers compile once."""
    reopened = gate(GATE, PATIENCE, "reinitialise")
    held = constant_gain({STAR: np.zeros((6, 3))})
    rules = {"gated": [reopened], "fixed": [held], "fixed-gated": [reopened, held]}
    return kalman(taylor(), rules.get(build, []))
