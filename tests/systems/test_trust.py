"""Which user code may run: what a confirmation covers, and what is imported then."""

import importlib.util
import py_compile
import stat
import sys
from pathlib import Path

import pytest

from robins.errors import RobinsError
from robins.systems import trust


@pytest.fixture(autouse=True)
def nothing_confirmed(monkeypatch, tmp_path):
    """An empty configuration folder; modules that a test imports are forgotten after it."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setattr(trust, "_here", {})
    monkeypatch.setattr(trust, "_local", {})
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        del sys.modules[name]


@pytest.fixture
def code(tmp_path):
    """Write files of a folder, and give the first."""

    def write(**files: str) -> Path:
        for name, text in files.items():
            inside = f"{name.replace('__', '/')}.py".replace("/init.", "/__init__.")
            path = tmp_path / "code" / inside
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return tmp_path / "code" / f"{next(iter(files))}.py"

    return write


def asks(path: Path) -> bool:
    """True if a file that another file names is refused, as in a new process."""
    trust._here.clear()
    try:
        trust.require(path, "mine.toml")
    except RobinsError as error:
        return (error.where, f"--trust {path}" in error.fix) == ("mine.toml", True)
    return False


def test_a_confirmation_lasts_until_the_file_changes(code):
    path = code(study_a="x = 1")
    assert asks(path)
    trust.confirm(path)
    assert not asks(path)
    assert stat.S_IMODE(trust.store().stat().st_mode) == 0o600
    path.write_text("x = 2")
    assert asks(path)
    with pytest.raises(RobinsError, match="that has changed since you confirmed it"):
        trust.require(path, "mine.toml")


IMPORTS = {
    "at the top": ("import near", "near"),
    "in a function": ("def f():\n    from near import x", "near"),
    "of a package": ("import pack.part", "pack__part"),
    "all files of a package": ("import pack", "pack__other"),
    "of a folder": ("from spaces import near", "spaces__near"),
    "by way of another": ("import between", "near"),
    "relative to a package": ("import pack", "pack__deep__leaf"),
}


@pytest.mark.parametrize(("statement", "changed"), IMPORTS.values(), ids=IMPORTS)
def test_a_confirmation_covers_the_local_modules(code, statement, changed):
    files = {
        "near": "x = 1",
        "between": "import near",
        "spaces__near": "x = 1",
        "pack__init": "from . import part\nfrom .deep.leaf import x",
        "pack__part": "x = 1",
        "pack__other": "x = 1",
        "pack__deep__leaf": "x = 1",
    }
    path = code(study_b=statement, **files, unused="x = 1")
    trust.confirm(path)
    code(unused="x = 2")
    assert not asks(path)
    code(**{changed: "x = 2"})
    assert asks(path)
    trust.load(path)  # and each is found when it is imported


def test_a_new_local_module_that_takes_the_place_of_none_asks_again(code):
    path = code(study_c="try:\n    import near_c\nexcept ImportError:\n    pass")
    trust.confirm(path)
    code(near_c="x = 1")
    assert asks(path)


def test_what_runs_is_what_was_hashed(code):
    """Not a compiled file beside it, even one that Python would not compare with its source."""
    path = code(study_d="import near_d\nran = 'text', near_d.ran", near_d="ran = 'text'")
    for source in (path, path.with_name("near_d.py")):
        hidden = code(hidden="ran = 'compiled', 'compiled'")
        cached = importlib.util.cache_from_source(str(source))
        py_compile.compile(
            str(hidden), cached, invalidation_mode=py_compile.PycInvalidationMode.UNCHECKED_HASH
        )
    assert trust.load(path).ran == ("text", "text")


def test_a_local_file_takes_the_place_of_no_installed_module(code):
    path = code(study_e="import numpy, wave\nfound = numpy.__file__, wave.__file__")
    fake = code(numpy="raise ZeroDivisionError", wave="raise ZeroDivisionError")
    assert not {str(fake), str(fake.with_name("wave.py"))} & set(trust.load(path).found)
    assert str(path.parent) not in sys.path
    trust.confirm(path)
    code(wave="x = 1")  # it is not run, so it is not covered
    assert not asks(path)


def test_two_folders_with_a_module_of_one_name_are_told_apart(code, tmp_path):
    trust.load(code(study_f="import near_f", near_f="x = 1"))
    other = tmp_path / "other" / "study_g.py"
    other.parent.mkdir()
    other.write_text("import near_f")
    other.with_name("near_f.py").write_text("x = 2")
    with pytest.raises(RobinsError, match="near_f is that of another module"):
        trust.load(other)


def test_a_folder_that_cannot_be_written_confirms_for_this_process(code, tmp_path):
    (tmp_path / "config").write_text("a file in the way")
    path = code(study_h="x = 1")
    trust.confirm(path)
    trust.require(path, "mine.toml")
    assert asks(path)


def test_confirmations_that_cannot_be_read_confirm_nothing(code):
    path = code(study_i="x = 1")
    trust.confirm(path)
    trust.store().write_text("[")
    assert asks(path)


def test_a_link_is_the_file_that_it_names(code, tmp_path):
    path = code(study_j="x = 1")
    link = tmp_path / "link.py"
    link.symlink_to(path)
    trust.confirm(link)
    assert not asks(path)
    with pytest.raises(RobinsError, match=r"nothing\.py: there is no such file"):
        trust.confirm(tmp_path / "nothing.py")
