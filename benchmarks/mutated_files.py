"""Damaged files of every kind that robins reads: each is read, or refused as bad input.

    python benchmarks/mutated_files.py --count 10000 --seed 42

Each round takes the next kind of file, damages it at places drawn from the seed and reads it. The
only exception that may come out is a `RobinsError` whose `bad_input` holds, for which a command
exits with 2. A kind named `doctor` is a command line, with its exit status. `make test` reads 200.
"""

from __future__ import annotations

import argparse
import contextlib
import gzip
import io
import lzma
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "tests" / "logs"))

from log_samples import SAMPLES
from made_binary import bag, content
from made_rosbag import drive, rosbag
from mcap.writer import CompressionType

from robins.bench.recording import Entry, Event, Recorder, read_record
from robins.bench.rigs.satellite.messages import WIRE
from robins.campaign.plan import CampaignPlan, read, write
from robins.campaign.shards import pack, unpack
from robins.campaign.statistics import Statistics
from robins.campaign.store import FolderStore
from robins.cli import main
from robins.errors import RobinsError
from robins.logs import FORMATS, open_log
from robins.logs.declared import columns_from
from robins.logs.librsf import read_librsf
from robins.results import snapshot
from robins.workbench.campaign import SWEEP, campaigns_of

DECLARED = 'delimiter = ","\n[columns]\ntime = { name = "t", unit = "s" }\n'
RANGES = "pseudorange3 1.0 2e7 4.0 1e7 2e7 3e6 4 0 45 40\nodom3 1.0 5 0 0 0 0 0.1 1 1 1 1 1 1\n"
SWEPT = b'{"vary": ["runs=1,2"], "points": ["points/1"]}'


class Kind(NamedTuple):
    """A kind of file: a sound one, and what reads it."""

    name: str
    content: bytes
    read: Callable[[Path], object]
    compiles: bool = False  # JAX compiles a program for each number of rows


def kinds() -> list[Kind]:
    """All of them; commands are not among them."""
    samples = {k: _longer(v) if isinstance(v, str) else v for k, v in SAMPLES.items()}
    for one in CompressionType:
        samples[f"ros-mcap {one.name}"] = rosbag(drive(), one)
    for one in ("LZ4", "BZ2"):
        samples[f"ros-bag {one}"] = content(bag, "drive.bag", compression=one)
    samples["gz"] = gzip.compress(samples["named-imu"], mtime=0)
    samples["xz"] = lzma.compress(samples["rtklib-pos"])
    paths = {f.name for f in FORMATS if set(f.holds) & {"trajectory", "attitude"}} - {"broad-npz"}
    found = [Kind(name, content, _open, name in paths) for name, content in samples.items()]
    found += [
        Kind(f"{name} as named", content, partial(_open, format=name), name in paths)
        for name, content in samples.items()
        if name in SAMPLES
    ]
    return [
        *found,
        Kind("librsf", RANGES.encode() * 9, lambda path: read_librsf(path, [])),
        Kind("declared columns", DECLARED.encode(), columns_from),
        Kind("shard", _shard(), lambda path: unpack(path.read_bytes(), Statistics(()))),
        Kind("live state", _state(), lambda path: snapshot.read(path, "Unit")),
        Kind("record", _record(), read_record),
        Kind("campaign.json", _plan(), _read_plan),
        Kind(SWEEP, SWEPT, _read_sweep),
    ]


def _longer(text: str) -> bytes:
    """A text log with its last line 20 times."""
    return (text + 19 * text.splitlines(keepends=True)[-1]).encode()


def _open(path: Path, format: str | None = None) -> object:
    return open_log(path, format, findings=[])


def _shard() -> bytes:
    rng = np.random.default_rng(0)
    found = Statistics((), runs=4, diverged=1, n=6)
    found.sums = {"square": rng.normal(size=(5, 3)), "dof of y": rng.integers(0, 9, 5)}
    found.each = {"rms": [rng.normal(size=(4, 2))]}
    return pack({"filter": "kf", "begin": 4}, found)


def _state() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "state"
        snapshot.write(path, "Unit", "a = 1\n", {"x": np.arange(9.0), "of": (1, "two", None)})
        return path.read_bytes()


def _record() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "record.mcap"
        with Recorder(path, WIRE, {"scenario": "title = 'a'\n"}) as recorder:
            for k in range(60):
                recorder.write(Entry(k * 10**6, "gyro", "from", bytes([k] * 20)))
            recorder.event(Event(10**8, "fault", "a frame", {"link": "gyro"}))
        return path.read_bytes()


def _plan() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        plan = CampaignPlan("walk", "walk", "runs = 4\n", 0, 4, ("kf",), "jax", 4, "0")
        write(FolderStore(folder), plan)
        return (Path(folder) / "campaign.json").read_bytes()


def _beside(path: Path, name: str) -> Path:
    """The folder of a file that bears this name."""
    folder = path.with_name("of " + name)
    folder.mkdir(exist_ok=True)
    (folder / name).write_bytes(path.read_bytes())
    return folder


def _read_plan(path: Path) -> object:
    plan = read(FolderStore(_beside(path, "campaign.json")))
    return plan if plan is None or plan.runs > 10_000 else plan.shards


def _read_sweep(path: Path) -> object:
    return campaigns_of(_beside(path, SWEEP))


# ------------------------------------------------------------------------------------------ damage

SIZES = (b"\xff" * 8, (1 << 40).to_bytes(8, "little"), (1 << 31).to_bytes(4, "little"), bytes(8))
WORDS = (b",,,,,,,,,,,,,,\n", b"nan", b"1e999", b"-", b"\xff\xfe", b"[" * 3000, b"9" * 5000, b"\0")


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """A file with one to three kinds of damage."""
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(0, max(len(content), 1)))
        length = int(rng.integers(1, 40))
        kind = rng.integers(0, 8)
        head, tail = content[:at], content[at:]
        if kind == 0:  # a bit
            flipped = bytes([tail[0] ^ 1 << int(rng.integers(8))]) if tail else b""
            content = head + flipped + tail[1:]
        elif kind == 1:  # bytes of chance
            content = head + rng.bytes(length) + tail[length:]
        elif kind == 2:  # some are lost
            content = head + tail[length:]
        elif kind == 3:  # some come twice
            content = head + tail[:length] + tail
        elif kind == 4:  # the copy was interrupted
            content = head
        elif kind == 5:  # a size that is a lie
            size = SIZES[rng.integers(len(SIZES))]
            content = head + size + tail[len(size) :]
        elif kind == 6:  # words of a program that failed, on a line of their own or within one
            at = content.rfind(b"\n", 0, at) + 1 if rng.integers(2) else at
            content = content[:at] + WORDS[rng.integers(len(WORDS))] + content[at:]
        else:  # a field is exchanged
            fields = content.split(b",")
            fields[rng.integers(len(fields))] = WORDS[rng.integers(len(WORDS))]
            content = b",".join(fields)
    return content


def outcome(kind: Kind, content: bytes, path: Path) -> str:
    """Result of reading a damaged file: "read", "refused", or what should not have come out."""
    path.write_bytes(content)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            kind.read(path)
    except RobinsError as error:
        return "refused" if error.bad_input and str(error) else f"not as bad input: {error}"
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
    return "read"


def by_doctor(path: Path) -> object:
    """Examine a file by the command; a status that the contract does not state is raised."""
    with (
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(io.StringIO()) as said,
    ):
        status = main(["doctor", str(path)])
    if status not in (0, 2) or "fault of robins" in said.getvalue():
        raise AssertionError(f"status {status}: {said.getvalue()[-300:]}")
    return status


def try_all(count: int, seed: int, among: list[Kind], folder: Path) -> dict[str, Counter[str]]:
    """Outcomes of so many damaged files, by kind; what should not be is told with its round."""
    found: dict[str, Counter[str]] = {kind.name: Counter() for kind in among}
    for k in range(count):
        kind = among[k % len(among)]
        content = damaged(kind.content, np.random.default_rng((seed, k)))
        told = outcome(kind, content, folder / "file")
        found[kind.name][told if told in ("read", "refused") else f"round {k}: {told}"] += 1
    return found


def wrong(found: dict[str, Counter[str]]) -> list[str]:
    """Outcomes that should not be."""
    return [f"{k}: {w}" for k, of in found.items() for w in of if w not in ("read", "refused")]


def report() -> int:
    """Print the table; the exit status is 1 if something came out that should not."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--doctor", type=int, default=200, help="command lines among them")
    parser.add_argument("--seed", type=int, default=42)
    asked = parser.parse_args()
    began = time.monotonic()
    logs = [kind._replace(read=by_doctor) for kind in kinds() if kind.read is _open]
    with tempfile.TemporaryDirectory() as folder:
        found = try_all(asked.count - asked.doctor, asked.seed, kinds(), Path(folder))
        told = try_all(asked.doctor, asked.seed, logs, Path(folder))
    found["doctor"] = sum(told.values(), Counter())
    for name, of in sorted(found.items()):
        print(f"{name:28} {of['read']:6} read {of['refused']:6} refused")
    total = sum((of for of in found.values()), Counter())
    print(
        f"{sum(total.values())} files, seed {asked.seed}: {total['read']} read, {total['refused']} "
        f"refused, {len(wrong(found))} neither; {time.monotonic() - began:.0f} s"
    )
    for one in wrong(found):
        print(one)
    return bool(wrong(found))


if __name__ == "__main__":
    raise SystemExit(report())
