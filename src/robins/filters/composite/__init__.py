"""Filters made of filters: of locals, of modes, of particles; guarded; of late measurements."""

from robins.filters.composite.channels import Channel, channel
from robins.filters.composite.delayed import Late, delayed
from robins.filters.composite.distributed import distributed, intersecting
from robins.filters.composite.federated import federated
from robins.filters.composite.fusion import covariance_intersection, fuse, share
from robins.filters.composite.guarded import guarded
from robins.filters.composite.imm import imm, mode
from robins.filters.composite.master import at_master
from robins.filters.composite.modes import Family
from robins.filters.composite.particle import particle, reseed
from robins.filters.composite.shares import observability_shares

__all__ = [
    "Channel",
    "Family",
    "Late",
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
