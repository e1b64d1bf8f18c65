"""Filters: a way to linearise and a chain of rules. Knows no navigation, no sensor, no file."""

from robins.filters.belief import SENTENCES, Belief, Code, StepInfo
from robins.filters.bound import Bound, bound_along, covariance_bound, linearised, used_sensors
from robins.filters.channels import Channel, channel
from robins.filters.closed_loop import Closed, Loop, Reading, run_closed
from robins.filters.delayed import Late, delayed
from robins.filters.distributed import distributed, intersecting
from robins.filters.federated import federated
from robins.filters.fusion import covariance_intersection, fuse, share
from robins.filters.guarded import guarded
from robins.filters.imm import imm, mode
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
from robins.filters.master import at_master
from robins.filters.model import Model, Motion, Sensor
from robins.filters.modes import Family
from robins.filters.observability import observability, observability_along
from robins.filters.observation import Normalised, Observation, normalised
from robins.filters.online import OnlineFilter
from robins.filters.particle import particle, reseed
from robins.filters.rule import Rule
from robins.filters.run import Solution, Step, filter_step, run
from robins.filters.shares import observability_shares
from robins.filters.smooth import rts_smoother
from robins.filters.tally import StepWarning, Tally, doubts
from robins.filters.worst_case import (
    existence_margin,
    gamma_min,
    steady_h_infinity,
    worst_case_gain,
)

__all__ = [
    "SENTENCES",
    "Belief",
    "Bound",
    "Channel",
    "Closed",
    "Code",
    "Family",
    "Filter",
    "FilterState",
    "Late",
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
    "at_master",
    "bound_along",
    "channel",
    "covariance_bound",
    "covariance_intersection",
    "cubature",
    "delayed",
    "distributed",
    "doubts",
    "existence_margin",
    "federated",
    "filter_step",
    "fuse",
    "gamma_min",
    "guarded",
    "imm",
    "intersecting",
    "iterated",
    "kalman",
    "linearised",
    "mode",
    "normalised",
    "observability",
    "observability_along",
    "observability_shares",
    "particle",
    "reseed",
    "rts_smoother",
    "run",
    "run_closed",
    "share",
    "sigma_points",
    "sigma_weights",
    "steady_h_infinity",
    "taylor",
    "unscented",
    "unscented_transform",
    "used_sensors",
    "worst_case_gain",
]
