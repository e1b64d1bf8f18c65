"""The table of faults fits the code: each can be planted, and the tests that it names are there."""

import ast
from collections import Counter

import mutants
import pytest


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
