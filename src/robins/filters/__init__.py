"""Filters: a way to linearise and a chain of rules. Knows no navigation, no sensor, no file."""

from robins.filters.belief import SENTENCES, Belief, Code, StepInfo
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

__all__ = [
    "SENTENCES",
    "Belief",
    "Code",
    "Filter",
    "FilterState",
    "Linearisation",
    "Model",
    "Motion",
    "Normalised",
    "Observation",
    "OnlineFilter",
    "Points",
    "Prediction",
    "Reuse",
    "Rule",
    "Sensor",
    "Solution",
    "Step",
    "StepInfo",
    "Transition",
    "cubature",
    "filter_step",
    "kalman",
    "normalised",
    "rts_smoother",
    "run",
    "sigma_points",
    "sigma_weights",
    "taylor",
    "unscented",
    "unscented_transform",
]
