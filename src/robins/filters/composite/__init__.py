"""Filters made of filters: federated, multiple-model, particle, guarded, delayed and others."""

from robins.filters.composite.adaptive import adaptive
from robins.filters.composite.alternative import alternative
from robins.filters.composite.channels import Channel, at_master, channel
from robins.filters.composite.delayed import DelayedMeasurement, delayed
from robins.filters.composite.distributed import distributed, intersecting
from robins.filters.composite.federated import federated, observability_shares
from robins.filters.composite.fusion import covariance_intersection, fuse, share
from robins.filters.composite.guarded import guarded
from robins.filters.composite.imm import ModeFamily, imm, mode
from robins.filters.composite.particle import particle, reseed

__all__ = [
    "Channel",
    "DelayedMeasurement",
    "ModeFamily",
    "adaptive",
    "alternative",
    "at_master",
    "channel",
    "covariance_intersection",
    "delayed",
    "distributed",
    "federated",
    "fuse",
    "guarded",
    "imm",
    "intersecting",
    "mode",
    "observability_shares",
    "particle",
    "reseed",
    "share",
]
