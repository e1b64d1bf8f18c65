"""Worker of a campaign, which computes the next missing shards and stores them.

Workers do not coordinate. A claim only shows others what a worker computes; after a time, as when
its worker died, another computes the same, and if both finish, one of two equal shards is kept.
"""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePosixPath
from time import monotonic, sleep
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from robins.campaign.machine import JaxMachine, LaneMachine
from robins.campaign.memory import release_memory
from robins.campaign.plan import CampaignPlan, Chunk, Shard
from robins.campaign.retention import DIVERGED, NAMED, by_stem, histories, name_of, trim
from robins.campaign.shards import pack
from robins.campaign.statistics import Statistics
from robins.campaign.store import Store
from robins.systems.study import Problem

CLAIM_CHUNKS = 3.0  # times the duration of a chunk, for which claims of others are respected
LEAST_S = 5.0  # at least, also before this worker has computed one
POLL_S = 0.2


class MissingShards(NamedTuple):
    """A chunk, and its shards that are not in the store yet."""

    chunk: Chunk
    shards: list[Shard]

    @property
    def claim(self) -> str:
        """The name of the object that claims it."""
        return f"claims/{self.shards[0].stem}"


def missing(store: Store, shards: Mapping[Chunk, list[Shard]]) -> list[MissingShards]:
    """Chunks with missing shards, in the order of the runs."""
    there = store.names("shards")
    lack = (
        MissingShards(chunk, [s for s in some if PurePosixPath(s.name).name not in there])
        for chunk, some in shards.items()
    )
    return [one for one in lack if one.shards]


class Worker:
    """Worker of one campaign."""

    def __init__(self, store: Store, plan: CampaignPlan, problem: Problem):
        self.store, self.plan, self.problem = store, plan, problem
        by_jax = plan.machine == "jax"
        self.machine = JaxMachine(problem) if by_jax else LaneMachine(problem, plan.machine)
        self._shards = plan.shards
        self._stems = by_stem(self._shards)
        self._seen: dict[str, float] = {}  # when a claim was first seen
        self._took = 0.0
        self._left = 0  # runs that are not computed yet

    def work(self) -> Iterator[int]:
        """Compute until nothing is missing; yields the number missing before each chunk."""
        while lack := missing(self.store, self._shards):
            yield sum(len(one.shards) for one in lack)
            self._left = sum(one.chunk.runs for one in lack)
            taken = self._next(lack)
            if taken is None:
                sleep(POLL_S)
                continue
            began = monotonic()
            self.compute(taken)
            release_memory()
            self._took = monotonic() - began
            self.store.drop(taken.claim)

    def compute(self, one: MissingShards) -> None:
        """Compute and store shards of a chunk, after the histories to be kept of its runs."""
        names = [s.filter for s in one.shards]
        found = self.found(one.chunk, names)
        for shard in one.shards:
            self._keep(shard, one.chunk, found[shard.filter])
        for shard in one.shards:
            self.store.put(shard.name, self.packed(shard, one.chunk, found[shard.filter]))

    def found(self, chunk: Chunk, names: list[str]) -> dict[str, Statistics]:
        """The statistics of filters over a chunk."""

        def taken(name: str, record: dict[str, PyTree]) -> Statistics:
            of_chunk = Statistics.of(self.problem)
            of_chunk.add(record)
            if chunk.number:
                of_chunk.example = None  # figures show the first run of all
            return of_chunk

        return self.machine.compute(chunk, self.plan.width, names, taken, self._left)

    def run_statistics(
        self, chunk: Chunk, names: list[str], runs: Sequence[int]
    ) -> dict[str, dict[int, Statistics]]:
        """Statistics of some runs of a chunk by filter, each alone with its histories.

        The chunk is computed as it was, so that the runs have the same bits.
        """
        return {
            name: {run: self._alone(record, run - chunk.begin) for run in runs}
            for name, record in self.machine.histories(chunk, self.plan.width, names).items()
        }

    def _alone(self, record: dict[str, PyTree], index: int) -> Statistics:
        one = Statistics.of(self.problem)
        one.add(jax.tree_util.tree_map(lambda x: x[index : index + 1], record))
        return one

    def packed(self, shard: Shard, chunk: Chunk, statistics: Statistics) -> bytes:
        """A shard as it is stored; it does not name its worker, so equal shards are equal files."""
        about = {"filter": shard.filter, "begin": chunk.begin, "code": self.plan.code}
        return pack(about, statistics)

    def _keep(self, shard: Shard, chunk: Chunk, statistics: Statistics) -> None:
        """Store the histories of those runs of a chunk that the scenario wants kept."""
        every, most = range(chunk.begin, chunk.begin + chunk.runs), self.plan.keep_diverged
        group = {run: NAMED for run in self.plan.keep if run in every}
        lost = [every[k] for k in np.flatnonzero(statistics.lost)] if most != 0 else []
        if lost and most is not None:
            there = histories(self.store, DIVERGED, self._stems).get(shard.filter, {})
            first = sorted({*lost, *there})[:most]
            lost = [run for run in lost if run in first]
        group = dict.fromkeys(lost, DIVERGED) | group
        if not group:
            return
        for run, one in self.run_statistics(chunk, [shard.filter], list(group))[
            shard.filter
        ].items():
            self.store.put(name_of(group[run], shard, run), self.packed(shard, chunk, one))
        if lost and most is not None:
            trim(self.store, self._stems, shard.filter, most)

    def _next(self, lack: list[MissingShards]) -> MissingShards | None:
        """Chunk that is not claimed; else one with an old claim; None if there is neither."""
        claimed = self.store.names("claims")
        who = {"host": socket.gethostname(), "process": os.getpid()}
        for one in lack:
            if PurePosixPath(one.claim).name not in claimed:
                if self.store.put(one.claim, json.dumps(who).encode()):
                    return one
                claimed = self.store.names("claims")
        now = monotonic()
        for one in lack:
            since = self._seen.setdefault(one.claim, now)
            if now - since > max(CLAIM_CHUNKS * self._took, LEAST_S):
                self._seen[one.claim] = now  # others in their turn
                return one
        return None
