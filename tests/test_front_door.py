"""The front door: light, lazy, typed, and the same objects as at their homes."""

import importlib
import re

import front_door
import pytest
import rings
from test_house import python

import robins
from robins import errors

# a module of robins that names a room would hide what the front door has by that name
ROOMS = {p.stem for p in front_door.STUB.parent.iterdir()}


@pytest.mark.parametrize("name", robins.FRONT_DOOR)
def test_a_name_is_the_object_of_its_home(name):
    module, _, attribute = robins.FRONT_DOOR[name].partition(":")
    assert getattr(robins, name) is getattr(importlib.import_module(module), attribute)
    assert name in dir(robins)
    assert name not in ROOMS


def test_editors_see_the_same_objects():
    found = {name: getattr(robins, name) for name in robins.__all__}
    typed = front_door.typed(front_door.STUB.read_text("utf-8"))
    assert typed == found, "write the stub again: python tests/front_door.py"


def test_importing_robins_imports_nothing_else():
    """Before the front door it took the standard library that asks for a version, and no more."""
    code = (
        "import collections.abc, importlib, os, sys\nfrom importlib.metadata import version\n"
        "version('robins')\nbefore = set(sys.modules)\nimport robins\n"
        "print(sorted(set(sys.modules) - before))\ndir(robins)\nrobins.RobinsError\n"
        "print(sorted(m for m in set(sys.modules) - before if m.startswith('robins')))\n"
        "print({'jax', 'numpy'} & set(sys.modules))"
    )
    done = python(code)
    assert done.stdout.splitlines() == ["['robins']", "['robins', 'robins.errors']", "set()"], done


def test_an_unknown_name_is_refused_with_the_nearest():
    with pytest.raises(AttributeError, match="has no attribute 'kalmn'; did you mean 'kalman'\\?"):
        _ = robins.kalmn
    with pytest.raises(ImportError, match="cannot import name 'kalmn'"):
        exec("from robins import kalmn")


def test_a_name_that_moved_works_for_two_minor_releases(monkeypatch):
    """The rule of docs/api.md, at the front door and in a room."""
    rows = {"lms": ("robins.filters", "kalman"), "old": ("robins.filters", "kalman", "0.7")}
    monkeypatch.setitem(errors.MOVED, "robins", rows)
    for version, works in {"0.1.0": "lms old", "0.4.0": "old", "0.8.3": "old", "1.0.0": ""}.items():
        monkeypatch.setattr(robins, "__version__", version)
        for name, ends in {"lms": "0.4", "old": "0.9"}.items():
            now = rf"robins\.{name} is now robins\.filters\.kalman"
            if name in works.split():
                with pytest.warns(DeprecationWarning, match=f"{now}; .* before robins {ends}$"):
                    assert getattr(robins, name) is robins.kalman
            else:
                with pytest.raises(AttributeError, match=f"^{now}$"):
                    getattr(robins, name)
    monkeypatch.setattr(robins, "__version__", "0+unknown")
    with pytest.warns(DeprecationWarning, match="is now"):
        assert robins.lms is robins.kalman


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("filters.kalman", r"\*Stable:\* `kalman`\. \*May change:\* `Filter`, .*are inside\.\*"),
        ("errors", r"\*May change\*, but `RobinsError` is stable\."),
        ("sim.random", r"\*May change:\* `Component`, `stream`\. \*All .* inside\.\*"),
        ("program.tape", r"\*Inside\.\*"),
    ],
)
def test_pages_state_the_ring_of_a_name(module, line):
    assert re.fullmatch(line, rings.line_of(f"robins.{module}"))


def test_the_front_door_is_a_table_of_sentences():
    rows = rings.front_door().splitlines()[2:]
    assert len(rows) == len(robins.FRONT_DOOR)
    assert all(
        re.fullmatch(r"\| `rb\.\w+` \| \{py:\w+\}`robins[\w.]+` \| .{15,} \|", r) for r in rows
    )
