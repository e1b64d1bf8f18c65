"""The file of a live state: what goes in comes out, and a file that is not whole is refused."""

import json
import os
import zipfile

import numpy as np
import pytest

from robins.results import ResultError, snapshot

STATE = {
    "plain": [1, 2.5, float("inf"), float("nan"), None, True, "word", (1, (2,))],
    "arrays": [
        np.arange(3.0),
        np.float64(0.1),
        np.zeros((0, 3)),
        np.array(7),
        np.eye(2, dtype=bool),
    ],
}


def same(a, b):
    """Equal to the bit, with types."""
    if isinstance(a, np.ndarray | np.generic):
        return np.array_equal(a, b, equal_nan=True) and np.asarray(a).dtype == b.dtype
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and (a == b or a != a)


def test_what_goes_in_comes_out(tmp_path):
    path = tmp_path / "a.live"
    snapshot.write(path, "Unit", 'title = "ä"\n', STATE)
    found = snapshot.read(path, "Unit")
    assert found.parameters == 'title = "ä"\n'
    assert same(STATE, found.state)
    snapshot.write(path, "Unit", "", {})  # over it
    assert snapshot.read(path, "Unit").state == {}
    assert os.listdir(tmp_path) == ["a.live"]


def test_what_is_no_number_is_not_written(tmp_path):
    with pytest.raises(TypeError, match="cannot hold object"):
        snapshot.write(tmp_path / "a", "Unit", "", {"x": object()})
    assert os.listdir(tmp_path) == []


def test_every_flipped_bit_and_every_cut_is_refused(tmp_path):
    path = tmp_path / "a.live"
    snapshot.write(path, "Unit", "a = 1\n", STATE)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for at in rng.integers(0, len(whole), 300):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1 << int(at % 8)]) + whole[at + 1 :])
        try:
            found = snapshot.read(path, "Unit")
        except ResultError as error:
            refused += "a.live" in str(error)
        else:  # a bit that says nothing, such as a time in the archive
            assert same(STATE, found.state)
    assert refused > 200
    for end in rng.integers(0, len(whole), 60):
        path.write_bytes(whole[:end])
        with pytest.raises(ResultError, match="damaged"):
            snapshot.read(path, "Unit")


def test_another_version_class_or_file_is_refused_with_what_to_do(tmp_path, monkeypatch):
    path = tmp_path / "a.live"
    snapshot.write(path, "Unit", "", STATE)
    with pytest.raises(
        ResultError, match=r"it holds a Unit, not a Vehicle; load it with Unit\.load"
    ):
        snapshot.read(path, "Vehicle")
    with pytest.raises(ResultError, match="No such file"):
        snapshot.read(tmp_path / "b", "Unit")
    path.write_bytes(b"time,x\n0,1\n")
    with pytest.raises(ResultError, match="no file of a live state"):
        snapshot.read(path, "Unit")
    np.savez(tmp_path / "c.npz", a0=np.zeros(3))
    with pytest.raises(ResultError, match="no file of a live state"):
        snapshot.read(tmp_path / "c.npz", "Unit")
    np.save(tmp_path / "d.npy", np.zeros(3))
    with pytest.raises(ResultError, match="no file of a live state"):
        snapshot.read(tmp_path / "d.npy", "Unit")
    monkeypatch.setattr(snapshot, "VERSION", 3)
    snapshot.write(path, "Unit", "", STATE)
    monkeypatch.undo()
    with pytest.raises(ResultError, match="of version 3 of the format, this robins reads 2"):
        snapshot.read(path, "Unit")


def test_numbers_that_were_changed_by_hand_are_refused(tmp_path):
    path = tmp_path / "a.live"
    snapshot.write(path, "Unit", "a = 1\n", STATE)
    with np.load(path) as packed:
        told = json.loads(packed["told"].tobytes())
        arrays = {name: packed[name] for name in packed.files if name != "told"}
    arrays["a0"] = arrays["a0"] + 1.0
    with path.open("wb") as file:
        np.savez(file, told=np.frombuffer(json.dumps(told).encode(), np.uint8), **arrays)
    assert zipfile.is_zipfile(path)
    with pytest.raises(ResultError, match="damaged"):
        snapshot.read(path, "Unit")


def test_a_file_that_cannot_be_written_leaves_the_earlier_one(tmp_path, monkeypatch):
    path = tmp_path / "a.live"
    snapshot.write(path, "Unit", "", {"x": 1})

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ResultError, match="free some space"):
        snapshot.write(path, "Unit", "", {"x": 2})
    monkeypatch.undo()
    assert snapshot.read(path, "Unit").state == {"x": 1}
    assert os.listdir(tmp_path) == ["a.live"]
