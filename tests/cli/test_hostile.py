"""Command lines drawn by chance, and settings that look right: a status and a sentence, always.

`python tests/hostile.py lines 2000` and `... settings 1000` try more of them.
"""

import hostile
import pytest

SEED, COUNT = 43, 200


def check(every):
    """No answer is a finding."""
    answers = [hostile.answered(words) for words in every]
    assert [(one.words, one.fault) for one in answers if one.fault] == []
    return answers


@pytest.mark.usefixtures("unchecked")
def test_a_line_drawn_by_chance_is_answered(monkeypatch, tmp_path):
    hostile.furnish(tmp_path)
    monkeypatch.chdir(tmp_path)
    refused = [one for one in check(hostile.lines(SEED, COUNT)) if one.status == 2]
    assert len(refused) > COUNT / 2
    assert all(one.said.startswith("robins: ") for one in refused)


@pytest.mark.parametrize("words", [["verify", "x" * 300], ["bench", "header", "--to", "text.py"]])
def test_a_path_that_the_system_refuses_is_named(monkeypatch, tmp_path, words):
    hostile.furnish(tmp_path)
    monkeypatch.chdir(tmp_path)
    (one,) = check([words])
    assert one.status == 2
    assert words[-1] in one.said


@pytest.mark.usefixtures("unchecked")
def test_a_setting_that_looks_right_is_taken_or_refused(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    answers = check(hostile.settings(SEED, COUNT))
    assert {one.status for one in answers} == {None, 2}
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_answer_is_a_finding(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("robins.cli.main", lambda words: 1 / 0)
    assert "ZeroDivisionError" in hostile.answered(["x"]).fault
    monkeypatch.setattr("robins.cli.main", lambda words: 7)
    assert hostile.answered(["x"]).fault == "ended with 7"
    monkeypatch.setattr("robins.cli.main", lambda words: print("{") or 0)
    assert "no JSON" in hostile.answered(["--json"]).fault
