"""Join of a campaign's shards: its progress, and the statistics of all its runs."""

from __future__ import annotations

import itertools
from pathlib import PurePosixPath
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from robins.campaign.monte_carlo import blocks_of, contender, one_record
from robins.campaign.plan import CampaignPlan, Shard
from robins.campaign.shards import DamagedShardError, digest, unpack
from robins.campaign.statistics import Statistics
from robins.campaign.store import Store
from robins.systems.study import Problem


class CampaignState(NamedTuple):
    """Progress of a campaign.

    Attributes:
        found: statistics by filter of all shards that are there and whole, joined in the order of
            the runs: sums have the same bits on every worker, at any time.
        done: number of runs of each filter among these.
        damaged: shards whose checksum does not match.
        lacking: number of shards that are missing or damaged.
    """

    found: dict[str, Statistics]
    done: dict[str, int]
    damaged: list[Shard]
    lacking: int

    @property
    def digest(self) -> str | None:
        """SHA-256 of the final statistics; None while shards are missing."""
        return None if self.lacking else digest(self.found)


def gather(store: Store, plan: CampaignPlan, problem: Problem | None = None) -> CampaignState:
    """Read all shards, check and join them.

    Args:
        store: where they are.
        plan: of the campaign.
        problem: whose figures are wanted; without it sums and counts only.
    """
    there = store.names("shards")
    blank = Statistics(()) if problem is None else Statistics.of(problem)
    found = {name: blank.blank() for name in plan.filters}
    examples = {name: problem and example_of(problem, name) for name in plan.filters}
    damaged, missing = [], 0
    for shard in itertools.chain(*plan.shards.values()):
        is_there = PurePosixPath(shard.name).name in there
        content = store.get(shard.name) if is_there else None
        if content is None:
            missing += 1
            continue
        of_chunk = blank.blank()
        try:
            unpack(content, of_chunk, examples[shard.filter])
        except DamagedShardError:
            damaged.append(shard)
        else:
            found[shard.filter].merge(of_chunk)
    done = {name: s.runs for name, s in found.items()}
    return CampaignState(found, done, damaged, missing + len(damaged))


def example_of(problem: Problem, name: str) -> PyTree:
    """Record of a run as shapes and types, without its numbers."""
    one, blocks = contender(problem, name), blocks_of(problem)
    number = jax.ShapeDtypeStruct((), jnp.asarray(0).dtype)
    return jax.eval_shape(lambda k: one_record(blocks, one, problem.simulate(k)), number)
