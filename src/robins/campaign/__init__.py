"""Campaigns: many runs of a problem, in chunks, with statistics and their confidence."""

from robins.campaign.machine import MACHINES, check_machine
from robins.campaign.memory import CHUNK
from robins.campaign.monte_carlo import record, worlds
from robins.campaign.outcome import campaign_solution, simulate
from robins.campaign.statistics import Statistics, mean_with_bounds, rms_with_bounds

__all__ = [
    "CHUNK",
    "MACHINES",
    "Statistics",
    "campaign_solution",
    "check_machine",
    "mean_with_bounds",
    "record",
    "rms_with_bounds",
    "simulate",
    "worlds",
]
