"""Runs of which a campaign keeps the histories: those that are named, and the first that diverge.

The histories of a run are a shard of that run alone, with its record, under the name of the shard
that it belongs to. They are put before that shard: where a shard is, its histories are.

Workers agree on nothing here either. Each puts those of its own chunk that may be among the first,
and after that drops what is beyond the first of all that are there: what stays is the same in any
order, and never much more is there.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import NamedTuple

from robins.campaign.plan import Chunk, Shard
from robins.campaign.shards import DamagedShardError, unpack
from robins.campaign.statistics import Statistics
from robins.campaign.store import Store

NAMED, DIVERGED = "histories", "diverged"  # groups of objects


class RunHistories(NamedTuple):
    """The histories of one run of a filter."""

    run: int
    name: str  # of its object


def name_of(group: str, shard: Shard, run: int) -> str:
    """The name of the histories of a run of a shard."""
    return f"{group}/{shard.stem}-{run}.npz"


def by_stem(shards: Mapping[Chunk, list[Shard]]) -> dict[str, Shard]:
    """The shards of a campaign, as those to which histories belong."""
    return {shard.stem: shard for some in shards.values() for shard in some}


def histories(
    store: Store, group: str, shards: Mapping[str, Shard]
) -> dict[str, list[RunHistories]]:
    """Histories that a group holds, by filter, in the order of the runs.

    Args:
        store: of the campaign.
        group: `NAMED` or `DIVERGED`.
        shards: `by_stem`; histories of others are of no run of this campaign.
    """
    found: dict[str, list[RunHistories]] = {}
    for name in store.names(group):
        stem, _, run = PurePosixPath(name).stem.partition("-")
        if stem in shards and run.isdecimal():
            of = found.setdefault(shards[stem].filter, [])
            of.append(RunHistories(int(run), f"{group}/{name}"))
    return {name: sorted(of) for name, of in found.items()}


def trim(store: Store, shards: Mapping[str, Shard], name: str, most: int) -> None:
    """Drop the histories of diverged runs of a filter that are beyond so many first ones."""
    for history in histories(store, DIVERGED, shards).get(name, [])[most:]:
        store.drop(history.name)


def kept(store: Store, shards: Mapping[str, Shard]) -> dict[str, list[int]]:
    """Numbers of the runs whose histories are there, by filter."""
    groups = [histories(store, group, shards) for group in (NAMED, DIVERGED)]
    return {
        name: sorted({h.run for of in groups for h in of.get(name, [])})
        for name in dict.fromkeys(name for of in groups for name in of)
    }


def content_of(store: Store, shard: Shard, run: int) -> bytes | None:
    """The histories of a run, as they were packed; None where they are not kept."""
    return store.get(name_of(NAMED, shard, run)) or store.get(name_of(DIVERGED, shard, run))


def damaged(store: Store, shards: Mapping[str, Shard]) -> dict[str, Shard]:
    """Histories whose checksum does not fit, each with the shard that it belongs to."""
    found = {}
    for group in (NAMED, DIVERGED):
        for of in histories(store, group, shards).values():
            for one in of:
                try:
                    unpack(store.get(one.name) or b"", Statistics(()), None)
                except DamagedShardError:
                    found[one.name] = shards[PurePosixPath(one.name).stem.partition("-")[0]]
    return found
