"""A config goes to processes through a file that they map, to the last bit."""

import subprocess
import sys
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from stations import config

from robins.bench.parts import config_files
from robins.bench.parts.config_files import private_folder, put, take
from robins.bench.rigs.satellite import config as satellite

SHORT = ("satellite/s1", "mekf", "duration=60 s", "counted_from=10 s")


class Of(NamedTuple):
    words: str
    rows: Any


def test_what_is_taken_is_what_was_put(tmp_path):
    of = config(*SHORT)
    put(of, tmp_path / "kit")
    back = take(tmp_path / "kit")
    pairs = [jax.tree_util.tree_flatten(x) for x in (of, back)]
    assert pairs[0][1] == pairs[1][1]
    for a, b in zip(pairs[0][0], pairs[1][0], strict=True):
        if jax.dtypes.issubdtype(getattr(a, "dtype", float), jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
        assert np.asarray(a).dtype == np.asarray(b).dtype
    with pytest.raises(ValueError, match="read-only"):
        back.rows.gyro_bias[0] = 1.0


def test_there_may_be_no_arrays_and_empty_ones(tmp_path):
    for rows in (None, np.zeros((0, 3)), np.asfortranarray(np.arange(6.0).reshape(2, 3)), 7):
        put(Of("a", rows), tmp_path / "kit")
        back = take(tmp_path / "kit")
        assert back.words == "a"
        np.testing.assert_array_equal(back.rows, rows)


def test_what_a_killed_bench_has_left_is_removed_by_the_next(tmp_path, monkeypatch):
    monkeypatch.setattr(config_files.tempfile, "tempdir", str(tmp_path))
    with private_folder() as mine, private_folder() as other:
        assert mine != other
        assert mine.stat().st_mode & 0o077 == 0
        dead, making, precious = (tmp_path / f"robins-parts-{k}" for k in "abc")
        for path in (dead, making, tmp_path / "goal"):
            path.mkdir()
            (path / "kit").write_bytes(bytes(100))
        (dead / "locked").touch()
        (tmp_path / "goal" / "locked").touch()
        precious.symlink_to(tmp_path / "goal")
        with private_folder():
            there = {path.name for path in tmp_path.iterdir()}
            assert {mine.name, other.name, making.name, "goal"} < there
            assert dead.name not in there
        assert (tmp_path / "goal" / "kit").exists()
    assert not mine.exists()


def test_a_process_takes_no_memory_of_its_own_for_it(tmp_path):
    put({"rows": np.arange(8e6)}, tmp_path / "kit")  # 64 MB
    script = """if True:
        import sys
        from pathlib import Path
        from robins.bench.parts.config_files import take
        def mb():
            status = Path("/proc/self/status").read_text().splitlines()
            return int(next(x for x in status if x.startswith("RssAnon")).split()[1]) / 1024
        import numpy
        before = mb()
        rows = take(Path(sys.argv[1]))["rows"]
        print(float(rows.sum()), mb() - before)
    """
    command = [sys.executable, "-c", script, str(tmp_path / "kit")]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    total, more = map(float, result.stdout.split())
    assert total == 8e6 * (8e6 - 1) / 2
    assert more < 16.0


def test_rows_are_those_of_the_run_beyond_a_block(monkeypatch):
    monkeypatch.setattr(satellite, "_BLOCK", 17)
    of = config(*SHORT)
    row, last = satellite.driven(of, lambda given, row: row), len(of.due) - 1
    for step in (0, 16, 17, 18, 33, 34, 300, last, last + 50, 5):
        for got, rows in zip(*map(jax.tree.leaves, (row(step), of.rows)), strict=True):
            np.testing.assert_array_equal(got, rows[min(step, last)])
    first = jax.tree.leaves(row(40, begins=[7.0]))[0]
    np.testing.assert_array_equal(
        np.ravel(first), [7.0, *jax.tree.leaves(of.rows)[0][40].ravel()[1:]]
    )
