"""Filters: a way to linearise and a chain of rules; without navigation, sensors or files."""

from robins.filters import composite
from robins.filters.analysis import (
    Bound,
    bound_along,
    covariance_bound,
    existence_margin,
    gamma_min,
    linearised,
    observability,
    observability_along,
    steady_h_infinity,
    used_sensors,
    worst_case_gain,
)
from robins.filters.belief import SENTENCES, Belief, Code, StepInfo
from robins.filters.closed_loop import Closed, Loop, Reading, run_closed
from robins.filters.composite import *  # noqa: F403
from robins.filters.iterated import iterated
from robins.filters.kalman import Filter, FilterState, Prediction, kalman
from robins.filters.linearise import (
    Linearisation,
    Points,
    Reuse,
    Transition,
    cubature,
    sigma_points,
    sigma_weights,
    taylor,
    unscented,
    unscented_transform,
)
from robins.filters.model import Model, Motion, Sensor
from robins.filters.observation import Normalised, Observation, normalised
from robins.filters.online import OnlineFilter
from robins.filters.rule import Rule
from robins.filters.run import Solution, Step, filter_step, run
from robins.filters.smooth import rts_smoother
from robins.filters.tally import StepWarning, Tally, doubts

__all__ = [
    "SENTENCES",
    "Belief",
    "Bound",
    "Closed",
    "Code",
    "Filter",
    "FilterState",
    "Linearisation",
    "Loop",
    "Model",
    "Motion",
    "Normalised",
    "Observation",
    "OnlineFilter",
    "Points",
    "Prediction",
    "Reading",
    "Reuse",
    "Rule",
    "Sensor",
    "Solution",
    "Step",
    "StepInfo",
    "StepWarning",
    "Tally",
    "Transition",
    "bound_along",
    "covariance_bound",
    "cubature",
    "doubts",
    "existence_margin",
    "filter_step",
    "gamma_min",
    "iterated",
    "kalman",
    "linearised",
    "normalised",
    "observability",
    "observability_along",
    "rts_smoother",
    "run",
    "run_closed",
    "sigma_points",
    "sigma_weights",
    "steady_h_infinity",
    "taylor",
    "unscented",
    "unscented_transform",
    "used_sensors",
    "worst_case_gain",
]
__all__ += composite.__all__
