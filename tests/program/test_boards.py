"""The smallest filter on a Cortex-M4F of QEMU: the bits of this machine."""

import importlib.util
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from boat import STEPS, write_boat

from robins.program import DOUBLE, SINGLE

FILE = Path(__file__).parents[2] / "benchmarks" / "boards.py"
SPEC = importlib.util.spec_from_file_location("boards", FILE)
assert SPEC is not None
assert SPEC.loader is not None
boards = importlib.util.module_from_spec(SPEC)
sys.modules["boards"] = boards
SPEC.loader.exec_module(boards)

MISSING = boards.missing()
pytestmark = pytest.mark.skipif(bool(MISSING), reason=MISSING or "all is here")


@pytest.mark.parametrize("precision", [DOUBLE, SINGLE], ids=["double", "float"])
def test_a_cortex_m4f_has_the_bits_of_this_machine(tmp_path, precision):
    folder = write_boat(tmp_path, precision)
    here, there = boards.on_host(folder), boards.on_board(folder, boards.M4F)
    assert f"{STEPS} steps: 0 codes differ" in there.said
    assert "passed" in there.said
    assert boards.apart(here, there) == "to the bit"
    np.testing.assert_array_equal(here.reals, there.reals)
    assert len(here.reals) == len(here.sizes) > 2 * STEPS
    size = boards.built(folder, boards.M4F)
    assert 500 < size.flash < 50_000
    assert 50 < size.stack < 8_000


def test_a_library_that_is_wrong_fails_there_too(tmp_path):
    folder = write_boat(tmp_path)
    source = folder / "boat.c"
    source.write_text(
        source.read_text().replace("at_mean_rate[1] = {0.4}", "at_mean_rate[1] = {0.41}")
    )
    there = boards.on_board(folder, boards.M4F)
    assert "FAILED" in there.said
    right = boards.on_host(write_boat(tmp_path))
    # The rate begins 0.01 off, of 0.4 and a little more.
    told = boards.apart(right, there)
    off = float(told.removeprefix("within ").removesuffix(" of a field"))
    assert 0.01 < off < 0.05


def test_it_says_what_is_missing(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert boards.missing() == "needs arm-none-eabi-gcc and qemu-system-arm"
