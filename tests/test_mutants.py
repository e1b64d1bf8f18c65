"""The table of faults fits the code: each can be planted, and the tests that it names are there."""

import ast
from collections import Counter
from pathlib import Path

import mutants
import mutations
import pytest

# Planted faults of each room in the commit 6c2b523; a room may have more.
LEAST = {
    "bench": 29,
    "campaign": 5,
    "cli": 3,
    "dataset": 1,
    "earth": 5,
    "filters": 29,
    "gps_time": 2,
    "ins": 9,
    "linalg": 3,
    "logs": 10,
    "manifold": 2,
    "program": 6,
    "report": 3,
    "results": 6,
    "ros": 3,
    "rotation": 3,
    "scenario": 3,
    "sim": 9,
    "systems": 11,
    "units": 2,
    "workbench": 5,
}


def test_no_room_loses_a_fault():
    rooms = Counter(Path(mutant["file"]).parts[0].removesuffix(".py") for mutant in mutants.table())
    assert rooms >= Counter(LEAST)


def test_every_fault_can_be_planted():
    for mutant in mutants.table():
        file, text, _ = mutants.planted(mutant, mutants.ROOT)
        assert ast.dump(ast.parse(text)) != ast.dump(ast.parse(file.read_text("utf-8")))


def test_faults_have_names_and_words_of_their_own():
    for key in ("id", "what"):
        assert max(Counter(mutant[key] for mutant in mutants.table()).values()) == 1


def test_a_place_that_is_gone_is_told():
    gone = {**mutants.table()[0], "old": "no such text", "new": ""}
    with pytest.raises(ValueError, match="units-root-hour: not just one `old` in units"):
        mutants.planted(gone, mutants.ROOT)


def test_a_change_that_is_no_python_is_not_planted():
    text = "def f(x=1):\n    return -x\n"
    assert mutations.is_python(text, {"old": "return -x", "new": "return  x"})
    assert not mutations.is_python(text, {"old": "return -x", "new": "return -x)"})
