"""The coverage-guided fuzzer finds nothing in the receiver, and finds what is planted there."""

import os
import platform
import re
import resource
import subprocess
import sys
from pathlib import Path

import fuzz_receiver
import pytest

HERE = (sys.platform, platform.machine()) == ("linux", "x86_64")
pytestmark = pytest.mark.skipif(not HERE, reason="atheris has wheels for Linux on x86-64 only")


def fuzz(tmp_path: Path, runs: int, seconds: int, bug: str = "") -> subprocess.CompletedProcess:
    corpus = tmp_path / "corpus"
    corpus.mkdir()
    for k, seed in enumerate(fuzz_receiver.seeds()):
        (corpus / f"seed{k}").write_bytes(seed)
    # The peak of memory that libFuzzer reads begins at that of the process that started it, this
    # one, so the receiver may have what is beyond.
    begin_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    memory = [f"-rss_limit_mb={begin_mb + 2048}", "-malloc_limit_mb=256"]
    limits = [f"-runs={runs}", f"-max_total_time={seconds}", "-max_len=1000", "-seed=1", *memory]
    return subprocess.run(
        [sys.executable, fuzz_receiver.__file__, "corpus", *limits, "-artifact_prefix=found-"],
        cwd=tmp_path,
        env=os.environ | {"ROBINS_PLANTED_BUG": bug},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


def test_nothing_is_found(tmp_path):
    result = fuzz(tmp_path, 4000, 10)
    assert result.returncode == 0, result.stdout + result.stderr
    assert list(tmp_path.glob("found-*")) == []
    runs = re.search(r"Done (\d+) runs", result.stderr)
    assert int(runs[1]) > len(fuzz_receiver.seeds())
    covered = [int(n) for n in re.findall(r"cov: (\d+)", result.stderr)]
    assert covered[-1] > 20  # branches of the receiver that it saw, so it was guided by them


@pytest.mark.parametrize(
    ("bug", "words"),
    [
        ("raises", "IndexError: planted"),
        ("hoards", "AssertionError: holds too much"),
        ("cut", "AssertionError: cut matters"),
        ("unchecked", "AssertionError: not the frames of the stream"),
    ],
)
def test_what_is_planted_is_found(tmp_path, bug, words):
    result = fuzz(tmp_path, 100_000, 30, bug)
    assert result.returncode != 0
    assert words in result.stdout + result.stderr
    assert len(list(tmp_path.glob("found-crash-*"))) == 1
