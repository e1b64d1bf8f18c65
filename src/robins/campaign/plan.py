"""Plan of a campaign: a scenario, its filters and runs, cut into shards under fixed names."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from importlib import metadata
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import robins
from robins import scenario
from robins.campaign.store import Store
from robins.errors import RobinsError
from robins.systems import trust
from robins.systems.catalogue import is_file

NAME = "campaign.json"
SCHEMA = 1
KEPT = ("keep", "keep_diverged")  # decide what is kept of the runs
_WANTED = ("runs", "filters", "claims", "title", *KEPT)  # change no run of a filter
_SOURCES = {".py", ".h", ".cc", ".toml", ".csv", ".json"}


class Shard(NamedTuple):
    """A filter over a chunk of runs."""

    name: str  # of its object
    filter: str
    chunk: int

    @property
    def stem(self) -> str:
        """Name of the shard without group and ending."""
        return PurePosixPath(self.name).stem


class Chunk(NamedTuple):
    """Some runs, from `begin` on."""

    number: int
    begin: int
    runs: int


@dataclass(frozen=True)
class CampaignPlan:
    """A campaign, as written in `campaign.json`.

    Attributes:
        asked: its scenario as requested: a name of `robins list`, or a file.
        scenario: its name.
        text: TOML, with what the command line changed.
        seed: of all noise.
        runs: their number.
        filters: their names.
        machine: that computes it, "vm", "c" or "jax".
        width: runs of a chunk; what JAX sums in batches depends on it.
        code: hash of robins, of a user's own system, and of the packages that compute.
    """

    asked: str
    scenario: str
    text: str
    seed: int
    runs: int
    filters: tuple[str, ...]
    machine: str
    width: int
    code: str

    @property
    def chunks(self) -> Iterator[Chunk]:
        """All chunks, in the order in which they are joined."""
        yield from map(self.chunk_of, range(0, self.runs, self.width))

    def shard(self, chunk: Chunk, name: str) -> Shard:
        """The shard of a filter, whose name is a hash of all that its content depends on."""
        tables = scenario.mapping_of(self.text)
        of = {k: v for k, v in tables.items() if k not in _WANTED}
        key = [of, self.seed, self.machine, self.width, self.code, name, chunk.begin, chunk.runs]
        return Shard(f"shards/{_hash(key)}.npz", name, chunk.number)

    @property
    def shards(self) -> dict[Chunk, list[Shard]]:
        """Shards of all filters, by chunk."""
        return {c: [self.shard(c, name) for name in self.filters] for c in self.chunks}

    @property
    def keep(self) -> tuple[int, ...]:
        """Runs whose histories are kept."""
        return tuple(scenario.mapping_of(self.text).get("keep", ()))

    @property
    def keep_diverged(self) -> int | None:
        """Number of diverged runs of each filter whose histories are kept; None: all."""
        most = scenario.mapping_of(self.text).get("keep_diverged", 0)
        return None if most == "all" else most

    def chunk_of(self, run: int) -> Chunk:
        """The chunk that holds a run."""
        begin = run // self.width * self.width
        return Chunk(run // self.width, begin, min(self.width, self.runs - begin))

    def with_more(self, runs: int, filters: tuple[str, ...]) -> CampaignPlan:
        """The plan extended to as many runs and to these filters."""
        both = tuple(dict.fromkeys((*self.filters, *filters)))
        return replace(self, runs=max(runs, self.runs), filters=both)


def _hash(data: Any) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True, default=str).encode()).hexdigest()[:40]


def write(store: Store, plan: CampaignPlan) -> None:
    """Write a plan, in place of an earlier one."""
    data = {"schema": SCHEMA} | asdict(plan)
    store.put(NAME, f"{json.dumps(data, indent=2)}\n".encode(), overwrite=True)


def read(store: Store) -> CampaignPlan | None:
    """The plan of a campaign; None where there is none.

    Raises:
        RobinsError: it is damaged, or of another version.
    """
    content = store.get(NAME)
    if content is None:
        return None
    try:
        data = json.loads(content)
        schema = data.pop("schema")
        plan = CampaignPlan(**data | {"filters": tuple(data["filters"])})
        _check(plan)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        fix = "begin the campaign again in another folder; shards are found by their names."
        raise RobinsError(f"{NAME} is damaged ({error})", store.where, fix) from None
    if schema != SCHEMA:
        what = f"{NAME} has schema {schema}, this robins reads {SCHEMA}"
        fix = "use the version of robins that wrote it."
        raise RobinsError(what, store.where, fix)
    return plan


def _check(plan: CampaignPlan) -> None:
    """Refuse a plan that cannot be cut into chunks.

    Raises:
        TypeError, ValueError: a field is of another type, or a count is not positive.
    """
    for field in fields(plan):
        value = getattr(plan, field.name)
        if type(value) is not {"int": int, "str": str}.get(str(field.type), tuple):
            raise TypeError(f"{field.name} is {value!r}")
    if plan.runs < 1 or plan.width < 1 or not all(type(name) is str for name in plan.filters):
        raise ValueError(f"{plan.runs} runs in chunks of {plan.width} of {plan.filters}")


def require_plan(store: Store) -> CampaignPlan:
    """The plan of a campaign that is there.

    Raises:
        RobinsError: there is none.
    """
    plan = read(store)
    if plan is None:
        fix = "`robins campaign run SCENARIO --out DIR --runs N` begins one."
        raise RobinsError(f"is no campaign: it has no {NAME}", store.where, fix)
    return plan


@cache
def _of_package() -> str:
    root = Path(next(iter(robins.__path__)))
    sha = hashlib.sha256()
    for path in sorted(p for p in root.rglob("*") if p.suffix in _SOURCES):
        sha.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    for package in ("jax", "jaxlib", "numpy"):
        sha.update(f"{package} {metadata.version(package)}".encode())
    return sha.hexdigest()


def code_of(asked: str, text: str) -> str:
    """Hash of all code that a shard depends on.

    Args:
        asked: the scenario as requested; a file of a user's own counts with the local modules that
            it imports.
        text: of the scenario, which may name such a file.
    """
    sha = hashlib.sha256(_of_package().encode())
    sha.update(os.environ.get("XLA_FLAGS", "").encode())  # they change the rounding of JAX
    named: Mapping[str, Any] = scenario.mapping_of(text)
    folder = Path(asked).parent if asked.endswith(".toml") else Path()
    for path in dict.fromkeys((Path(asked), folder / str(named.get("system", "")))):
        if is_file(path.name):
            sha.update(trust.digest(path.with_name(path.name.partition(":")[0])).encode())
    return sha.hexdigest()[:16]


def check_code(store: Store, plan: CampaignPlan) -> None:
    """Refuse to go on with other code: half of the runs would be of one version, half of another.

    Raises:
        RobinsError: the campaign was started by other code.
    """
    here = code_of(plan.asked, plan.text)
    if here != plan.code:
        fix = "use the same robins, packages and system, or begin in another folder."
        raise RobinsError(f"was begun by code {plan.code}, this is {here}", store.where, fix)
