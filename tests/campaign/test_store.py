"""Objects that are put once: whole or not at all, by several writers, on a full disk, damaged."""

import errno
import importlib.util
import json
import os
import subprocess
import sys
import urllib.request
import zipfile
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from robins import foreign
from robins.campaign import shards
from robins.campaign import store as stores
from robins.campaign.shards import DamagedShardError, digest, pack, tables, unpack
from robins.campaign.statistics import Statistics
from robins.campaign.store import FolderStore, open_store
from robins.errors import RobinsError


@pytest.fixture(scope="module")
def server():
    """A store of the S3 kind on this machine."""
    pytest.importorskip("obstore", reason="object storage is an extra")
    moto = pytest.importorskip("moto.server", reason="moto is for development")
    running = moto.ThreadedMotoServer(port=0, verbose=False)
    running.start()
    yield "http://{}:{}".format(*running.get_host_and_port())
    running.stop()


@pytest.fixture(params=["folder", "objects", "s3"])
def store(request, tmp_path, monkeypatch):
    if request.param == "folder":
        return open_store(tmp_path / "store")
    if request.param == "objects":
        pytest.importorskip("obstore", reason="object storage is an extra")
        (tmp_path / "bucket").mkdir()
        return open_store(f"file://{tmp_path}/bucket")
    address = request.getfixturevalue("server")
    about = {"ACCESS_KEY_ID": "a", "SECRET_ACCESS_KEY": "b", "REGION": "us-east-1"}
    about |= {"ENDPOINT_URL": address, "ALLOW_HTTP": "true"}
    for name, value in about.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    bucket = tmp_path.name.replace("_", "-")
    urllib.request.urlopen(urllib.request.Request(f"{address}/{bucket}", method="PUT")).close()
    return open_store(f"s3://{bucket}/campaign")


def test_the_first_object_under_a_name_stays(store):
    assert store.get("shards/a") is None
    assert store.put("shards/a", b"one")
    assert not store.put("shards/a", b"two")
    assert store.get("shards/a") == b"one"
    assert store.put("shards/a", b"three", overwrite=True)
    assert store.get("shards/a") == b"three"
    assert store.names("shards") == {"a"}
    store.drop("shards/a")
    store.drop("shards/a")
    assert store.names("shards") == set() == store.names("nothing")


def test_of_many_writers_one_puts(store):
    with ThreadPoolExecutor(8) as pool:
        put = list(pool.map(lambda k: store.put("claims/x", bytes([k])), range(32)))
    assert sum(put) == 1
    assert store.get("claims/x") == bytes([put.index(True)])


def test_a_writer_that_is_killed_leaves_no_object(tmp_path):
    code = (
        "import os, sys; from robins.campaign import store\n"
        "os.fsync = lambda _: os.kill(os.getpid(), 9)\n"
        f"store.FolderStore({str(tmp_path)!r}).put('shards/a', b'content')"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == -9
    folder = FolderStore(tmp_path)
    assert folder.names("shards") == set()
    left = next((tmp_path / ".partial").iterdir())
    folder.sweep()
    assert left.exists()  # its writer may be alive
    os.utime(left, (0, 0))
    folder.sweep()
    assert not left.exists()


def test_a_full_disk_leaves_what_is_there(tmp_path, monkeypatch):
    folder = FolderStore(tmp_path)
    folder.put("shards/a", b"one")

    def full(_descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(stores.os, "fsync", full)
    with pytest.raises(RobinsError, match=r"No space left.*make room") as caught:
        folder.put("shards/b", b"two")
    assert not caught.value.bad_input
    assert folder.names("shards") == {"a"}
    assert not list((tmp_path / ".partial").iterdir())


def test_where_files_have_one_name_only(tmp_path, monkeypatch):
    def refused(*_):
        raise OSError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(stores.os, "link", refused)
    folder = FolderStore(tmp_path)
    assert folder.put("shards/a", b"one")
    assert folder.get("shards/a") == b"one"


def statistics(seed: int) -> Statistics:
    rng = np.random.default_rng(seed)
    found = Statistics((), runs=4, diverged=1, n=6)
    found.sums = {"square": rng.normal(size=(5, 3)), "dof of y": rng.integers(0, 9, 5)}
    found.each = {"rms": [rng.normal(size=(3, 2)), rng.normal(size=(1, 2))]}
    found.bins = {"attitude": np.arange(6, dtype=np.int32).reshape(2, 3) + np.int32(seed)}
    return found


def test_a_shard_is_read_as_it_was_written():
    told = statistics(0)
    told.example = {"error": np.arange(6.0).reshape(2, 3), "mean": (np.float64(1.0),)}
    content = pack({"filter": "kf", "begin": 4}, told)
    read = Statistics(())
    about = unpack(content, read, {"error": 0, "mean": (0,)})
    assert (about["filter"], about["begin"]) == ("kf", 4)
    assert (read.runs, read.diverged, read.n) == (4, 1, 6)
    assert tables(read).keys() == tables(told).keys()
    for name, x in tables(told).items():
        assert x.dtype == tables(read)[name].dtype
        np.testing.assert_array_equal(x, tables(read)[name])
    np.testing.assert_array_equal(read.example["error"], told.example["error"])
    assert read.example["mean"] == (1.0,)
    assert digest({"kf": read}) == digest({"kf": told})
    assert digest({"kf": read}) != digest({"kf": statistics(1)}) != digest({"ukf": read})


@pytest.mark.parametrize("part", np.linspace(0.0, 0.999, 40))
def test_a_flipped_bit_or_a_cut_is_seen(part):
    content = bytearray(pack({"filter": "kf"}, statistics(0)))
    at = int(part * len(content))
    with pytest.raises(DamagedShardError):
        unpack(bytes(content[:at]), Statistics(()))
    content[at] ^= 4
    try:
        read = Statistics(())
        unpack(bytes(content), read)
    except DamagedShardError:
        return
    # A bit of the archive that says nothing of the numbers, such as a date, may be flipped unseen.
    assert digest({"kf": read}) == digest({"kf": statistics(0)})


def test_a_bit_of_the_flags_of_an_archive_is_damage():
    """The bit "encrypted" made `zipfile` raise a RuntimeError."""
    content = pack({"filter": "kf"}, statistics(0))
    for magic, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8), (b"PK\x01\x02", 10)):
        for bit in range(8):
            spoilt = bytearray(content)
            spoilt[content.index(magic) + at] ^= 1 << bit
            try:
                unpack(bytes(spoilt), Statistics(()))
            except DamagedShardError:
                continue
            assert (magic, bit) != (b"PK\x01\x02", 0)


def test_sizes_that_an_archive_declares_are_not_believed(monkeypatch):
    file = BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        np.save(packed := BytesIO(), np.zeros(3 << 17))
        archive.writestr("sum x.npy", packed.getvalue())
    monkeypatch.setattr(foreign, "FREE", 1 << 20)
    with pytest.raises(DamagedShardError, match="'sum x' it would take 3145856 bytes"):
        unpack(file.getvalue(), Statistics(()))
    header = {"descr": "<f8", "fortran_order": False, "shape": (10**15, 3)}
    for name, fill in (("sum x.npy", bytes(64)), ("sum x.npy", b"")):
        np.lib.format.write_array_header_1_0(lie := BytesIO(), header)
        with zipfile.ZipFile(file := BytesIO(), "w") as archive:
            archive.writestr(name, lie.getvalue() + fill)
        with pytest.raises(DamagedShardError, match="where its header declares 24000000000000000"):
            unpack(file.getvalue(), Statistics(()))


def test_shards_of_others_with_a_checksum_that_fits():
    """A checksum proves nothing: anybody can write one, so the parts are checked all the same."""
    about = {"filter": "kf"}
    told = statistics(0)
    told.example = {"error": np.zeros(3)}
    content = pack(about, told)
    with pytest.raises(DamagedShardError, match="its record has 1 arrays, not 2"):
        unpack(content, Statistics(()), {"error": 0, "mean": 0})
    arrays = {"about": np.array(json.dumps({"sha256": shards._seal({}, {})}))}
    np.savez(file := BytesIO(), **arrays)
    with pytest.raises(DamagedShardError, match="does not state 'runs'"):
        unpack(file.getvalue(), Statistics(()))


SPEC = importlib.util.spec_from_file_location(
    "mutated_files", Path(__file__).parents[2] / "benchmarks" / "mutated_files.py"
)
assert SPEC is not None
assert SPEC.loader is not None
mutated_files = importlib.util.module_from_spec(SPEC)
sys.modules["mutated_files"] = mutated_files
SPEC.loader.exec_module(mutated_files)


def test_damaged_files_of_every_kind_are_read_or_refused(tmp_path):
    kinds = [kind for kind in mutated_files.kinds() if not kind.compiles]
    found = mutated_files.try_all(200, 43, kinds, tmp_path)
    assert mutated_files.wrong(found) == []
    assert sum(of["read"] for of in found.values()) > 20
    assert sum(of["refused"] for of in found.values()) > 100


def test_paths_are_told(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RobinsError, match="cannot write shards/a: Not a directory; name"):
        FolderStore(tmp_path / "file").put("shards/a", b"")
    assert isinstance(open_store(Path("a")), FolderStore)
