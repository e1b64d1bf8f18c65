"""Writing (F36): an earlier file stays until the new one is whole; nothing half is left behind."""

import gzip
import lzma
import os
import stat
from pathlib import Path

import pytest

from robins.logs.findings import LogError
from robins.logs.opening import write_lines


def test_text_and_compressed_text(tmp_path):
    for name, opener in (("a.txt", open), ("a.txt.xz", lzma.open), ("a.txt.gz", gzip.open)):
        write_lines(tmp_path / name, ["one\n", "two\n"])
        with opener(tmp_path / name, "rb") as file:
            assert file.read() == b"one\ntwo\n"


def test_permissions_are_those_of_any_new_file(tmp_path):
    (tmp_path / "plain").touch()
    write_lines(tmp_path / "written", ["x\n"])
    modes = [stat.S_IMODE((tmp_path / n).stat().st_mode) for n in ("plain", "written")]
    assert modes[0] == modes[1]


def interrupted():
    yield "half a line"
    raise KeyboardInterrupt


def test_an_interrupted_write_leaves_the_earlier_file_and_nothing_else(tmp_path):
    path = tmp_path / "log.txt"
    path.write_text("before\n")
    with pytest.raises(KeyboardInterrupt):
        write_lines(path, interrupted())
    assert path.read_text() == "before\n"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs the device /dev/full")
def test_a_full_disk_is_told_and_a_device_is_never_replaced():
    with pytest.raises(
        LogError, match=r"^/dev/full: cannot be written: No space left on device; che"
    ):
        write_lines("/dev/full", ["x\n"])
    assert stat.S_ISCHR(os.stat("/dev/full").st_mode)


@pytest.mark.parametrize("name", ["no/such/folder/x.txt", "x" * 300, ""])
def test_what_cannot_be_written(tmp_path, name):
    with pytest.raises(LogError, match="cannot be written: "):
        write_lines(tmp_path / name, ["x\n"])
    assert list(tmp_path.iterdir()) == []


def test_odd_names(tmp_path):
    for name in ("with blanks.txt", "größe-β.txt", "y" * 255):
        write_lines(tmp_path / name, ["x\n"])
        assert Path(tmp_path / name).read_text() == "x\n"
