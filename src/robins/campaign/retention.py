"""Retention of histories in a campaign: of named runs, and of the first that diverge.

The histories of a run are a shard of that run alone, with its record, named after the shard that it
belongs to. They are stored before that shard: where a shard exists, so do its histories.

Workers do not coordinate. Each stores those of its own chunk that may be among the first, and then
drops all beyond the first in the store: the rest does not depend on the order, and the surplus
stays small.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePosixPath

from robins.campaign.plan import Chunk, Shard
from robins.campaign.shards import DamagedShardError, unpack
from robins.campaign.statistics import Statistics
from robins.campaign.store import Store

NAMED, DIVERGED = "histories", "diverged"  # groups of objects


def name_of(group: str, shard: Shard, run: int) -> str:
    """The name of the histories of a run of a shard."""
    return f"{group}/{shard.stem}-{run}.npz"


def by_stem(shards: Mapping[Chunk, list[Shard]]) -> dict[str, Shard]:
    """Shards of a campaign by stem, to find the shard of a history."""
    return {shard.stem: shard for some in shards.values() for shard in some}


def histories(store: Store, group: str, shards: Mapping[str, Shard]) -> dict[str, dict[int, str]]:
    """Names of the histories that a group holds, by filter and run, in the order of the runs.

    Args:
        store: of the campaign.
        group: `NAMED` or `DIVERGED`.
        shards: of `by_stem`; histories of other shards are left out.
    """
    found: dict[str, dict[int, str]] = {}
    for name in store.names(group):
        stem, _, run = PurePosixPath(name).stem.partition("-")
        if stem in shards and run.isdecimal():
            found.setdefault(shards[stem].filter, {})[int(run)] = f"{group}/{name}"
    return {name: dict(sorted(of.items())) for name, of in found.items()}


def trim(store: Store, shards: Mapping[str, Shard], name: str, most: int) -> None:
    """Drop the histories of diverged runs of a filter beyond the first `most`."""
    for history in list(histories(store, DIVERGED, shards).get(name, {}).values())[most:]:
        store.drop(history)


def kept(store: Store, shards: Mapping[str, Shard]) -> dict[str, list[int]]:
    """Numbers of the runs whose histories are there, by filter."""
    groups = [histories(store, group, shards) for group in (NAMED, DIVERGED)]
    return {
        name: sorted({run for of in groups for run in of.get(name, ())})
        for name in dict.fromkeys(name for of in groups for name in of)
    }


def content_of(store: Store, shard: Shard, run: int) -> bytes | None:
    """The histories of a run, as they were packed; None where they are not kept."""
    return store.get(name_of(NAMED, shard, run)) or store.get(name_of(DIVERGED, shard, run))


def damaged(store: Store, shards: Mapping[str, Shard]) -> dict[str, Shard]:
    """Histories whose checksum does not match, each with the shard that it belongs to."""
    found = {}
    for group in (NAMED, DIVERGED):
        for of in histories(store, group, shards).values():
            for name in of.values():
                try:
                    unpack(store.get(name) or b"", Statistics(()), None)
                except DamagedShardError:
                    found[name] = shards[PurePosixPath(name).stem.partition("-")[0]]
    return found
