"""The laws of the house: who may import whom, how long a module gets, what must be written down."""

import ast
import importlib
import inspect
import os
import re
import subprocess
import sys
import tomllib
import typing
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from ratchets import counted, imported_modules

import robins

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "robins"
LONGEST = 500  # lines of a module

# ---------------------------------------------------------------------------- imports point down


class Import(NamedTuple):
    """One import of robins, by a file of a room."""

    room: str
    imported: str
    where: str


def room_of(module: str) -> str:
    """`robins.filters.rules.gate` -> `filters`; the package itself -> ``."""
    return module.split(".")[1] if "." in module else ""


def imports(source: Path) -> Iterator[Import]:
    """Every import of a room of robins by another."""
    rooms = rooms_in(source)
    for path in sorted(source.rglob("*.py")):
        parts = ("robins", *path.relative_to(source).with_suffix("").parts)
        module = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        package = ".".join(parts[:-1])
        for line, name in imported_modules(ast.parse(path.read_text("utf-8")), package):
            inside = name == "robins" or name.startswith("robins.")
            room = room_of(name)
            # `from robins import __version__` names no room: the package imports nothing itself.
            if inside and room in rooms and room != room_of(module):
                yield Import(room_of(module), room, f"{path.relative_to(source)}:{line}")


def rooms_in(source: Path) -> set[str]:
    """Top-level modules and packages."""
    found = {p.stem for p in source.glob("*.py")} | {p.parent.name for p in source.glob("*/*.py")}
    return found - {"__init__"}


def rooms_as_drawn(text: str) -> dict[str, set[str]]:
    """The table of rooms in docs/architecture.md: room -> rooms it may import."""
    drawn = {}
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        room = re.fullmatch(r"`(\w+)(\.py|/)`", cells[0])
        if room and len(cells) == 3:
            drawn[room[1]] = set(re.findall(r"`(\w+)`", cells[2]))
            if cells[2] == "all":
                drawn[room[1]] = {"*"}
    return drawn


def allowed(drawn: dict[str, set[str]]) -> dict[str, set[str]]:
    """Imports allowed to each room, downwards all the way; raises if the table runs in a circle."""
    if unknown := set().union(*drawn.values()) - set(drawn) - {"*"}:
        raise ValueError(f"rooms named but not drawn: {sorted(unknown)}")
    closed: dict[str, set[str]] = {}

    def below(room: str, path: tuple[str, ...]) -> set[str]:
        if room in path:
            raise ValueError(f"imports run in a circle: {' -> '.join((*path, room))}")
        if room not in closed:
            direct = set(drawn) - {room} if "*" in drawn[room] else drawn[room]
            closed[room] = direct.union(*(below(r, (*path, room)) for r in direct))
        return closed[room]

    return {room: below(room, ()) | {"_float64"} for room in drawn}


def violations(source: Path, may: dict[str, set[str]]) -> list[str]:
    """Imports that the table does not allow, one sentence each."""
    found = [
        f"{i.where}: {i.room or 'robins/__init__'} must not import {i.imported}"
        for i in imports(source)
        if i.imported not in may.get(i.room, {"_float64"})
    ]
    return list(dict.fromkeys(found))


@pytest.fixture(scope="module")
def drawn() -> dict[str, set[str]]:
    return rooms_as_drawn((ROOT / "docs" / "architecture.md").read_text("utf-8"))


def test_the_drawing_names_the_rooms_there_are(drawn):
    assert set(drawn) == rooms_in(SOURCE)
    text = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    rooms = re.findall(r"^\| `(\w+(?:\.py|/))`", text, re.MULTILINE)
    assert [room for room in rooms if not (SOURCE / room).exists()] == []


def test_imports_point_down(drawn):
    assert not violations(SOURCE, allowed(drawn))


def test_filters_know_no_navigation_sensor_or_file(drawn):
    below = {"linalg", "manifold", "rotation", "program", "errors", "_float64"}
    assert allowed(drawn)["filters"] == below
    assert allowed(drawn)["program"] == {"errors", "_float64"}  # it knows no filter either


PLANTED = {
    "plain": "import robins.systems.walk",
    "from a room": "from robins.systems import walk",
    "a room": "from robins import systems",
    "relative": "from ..systems import walk",
    "relative room": "from .. import systems",
    "in a function": "def f():\n    from robins.systems import walk\n    return walk",
    "for types": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import robins.systems",
    "dynamic": "import importlib\nwalk = importlib.import_module('robins.systems.walk')",
}


@pytest.mark.parametrize("code", PLANTED.values(), ids=PLANTED)
def test_a_planted_import_upwards_is_found(tmp_path, drawn, code):
    for room in ("filters", "systems"):
        (tmp_path / room).mkdir()
        (tmp_path / room / "__init__.py").touch()
    (tmp_path / "linalg.py").touch()
    (tmp_path / "systems" / "walk.py").write_text("from robins.filters import gate\n")
    (tmp_path / "filters" / "gate.py").write_text("from robins import linalg\n")
    may = allowed(rooms_as_drawn("| `linalg/` | | |\n| `filters/` | | `linalg` |"))
    may["systems"] = {"filters"}
    assert violations(tmp_path, may) == []
    (tmp_path / "filters" / "gate.py").write_text(f"{code}\n")
    (found,) = violations(tmp_path, may)
    assert re.fullmatch(r"filters/gate.py:\d: filters must not import systems", found)


def test_a_circle_in_the_drawing_is_found():
    with pytest.raises(ValueError, match="a -> b -> a"):
        allowed({"a": {"b"}, "b": {"a"}})


# --------------------------------------------------------------- filters use robins.linalg only


def dotted(node: ast.AST, names: dict[str, str]) -> str:
    """Full name of an attribute chain, its first part resolved through the imports."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value, names)}.{node.attr}"
    return names.get(node.id, node.id) if isinstance(node, ast.Name) else "?"


def foreign_linalg(code: str) -> list[str]:
    """Uses of JAX's linear algebra, which knows no singular factors."""
    tree = ast.parse(code)
    names, found = {}, []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                found += [(node.lineno, alias.name)]
                first = alias.name.split(".")[0]
                names[alias.asname or first] = alias.name if alias.asname else first
        elif isinstance(node, ast.ImportFrom):
            for alias in node.names:
                found += [(node.lineno, f"{node.module}.{alias.name}")]
                names[alias.asname or alias.name] = f"{node.module}.{alias.name}"
    found += [(n.lineno, dotted(n, names)) for n in ast.walk(tree) if isinstance(n, ast.Attribute)]
    foreign = re.compile(r"jax\.(numpy|scipy|lax|numpy\.numpy)\.linalg\b")
    return sorted({f"line {line}: {name}" for line, name in found if foreign.match(name)})


def test_filters_do_linear_algebra_only_through_robins():
    modules = (SOURCE / "filters").rglob("*.py")
    found = {str(path): foreign_linalg(path.read_text("utf-8")) for path in modules}
    assert not {path: uses for path, uses in found.items() if uses}


@pytest.mark.parametrize(
    "code",
    [
        "import jax.numpy as jnp\njnp.linalg.inv(0)",
        "import jax\njax.scipy.linalg.cho_solve(0)",
        "from jax import numpy\nnumpy.linalg.qr(0)",
        "from jax.numpy import linalg",
        "from jax.numpy.linalg import qr",
        "import jax.scipy.linalg as jsl",
        "from jax.lax import linalg",
    ],
)
def test_planted_linear_algebra_is_found(code):
    assert foreign_linalg(code)
    assert not foreign_linalg("from robins import linalg\nlinalg.tria(0)\nimport jax.numpy as jnp")


# ------------------------------------------------------------------------------ what is written


def own_files() -> list[Path]:
    """Text of the project, whether or not it lies in a git clone."""
    folders = ("src", "tests", "docs", "benchmarks", "changelog.d", ".ci", ".github")
    built = {"__pycache__", "_build", "_generated"}
    inside = [p for folder in folders for p in (ROOT / folder).rglob("*")]
    files = [p for p in inside if not built & set(p.relative_to(ROOT).parts)]
    return sorted(p for p in [*ROOT.iterdir(), *files] if p.is_file())


def text_of(path: Path) -> str:
    """Text of a file, nothing for pictures and other binaries."""
    try:
        return path.read_text("utf-8")
    except UnicodeDecodeError:
        return ""


def machine_paths(text: str, here: list[str]) -> list[str]:
    """Paths that exist on one machine only: home folders and the given folders."""
    folders = [re.escape(h.rstrip("/")) for h in here if len(h) > 1]
    pattern = "|".join([*folders, r"/home/\w+", "/Users", "/root", r"[A-Z]:\\+Users"])
    return [m[0] for m in re.finditer(rf"(?<![\w.~/-])(?:{pattern})[/\\][\w.]+", text)]


def test_no_path_of_a_machine_is_in_the_project():
    here = [str(ROOT.parent), str(Path.home())]
    found = {str(p.relative_to(ROOT)): machine_paths(text_of(p), here) for p in own_files()}
    assert not {path: hits for path, hits in found.items() if hits}


def test_planted_machine_paths_are_found():
    home = "/ho" + "me/ann/x"
    windows = "C:\\Us" + "ers\\ann"
    assert machine_paths(f"cd {home}", []) == [home]
    assert machine_paths(windows, []) == [windows]
    assert machine_paths('open("/lab/robins/x")', ["/lab"]) == ["/lab/robins"]
    assert not machine_paths("src/lab/x https://a.b/home/ann ../lab/x", ["/lab", "/"])


def test_no_module_grows_beyond_one_idea():
    modules = [p for p in own_files() if p.suffix == ".py"]
    assert [str(p) for p in modules if len(text_of(p).splitlines()) > LONGEST] == []


def test_the_architecture_is_read_in_one_sitting():
    text = text_of(ROOT / "docs" / "architecture.md")
    assert len(text.splitlines()) <= 150
    assert text.count("```text") == 1  # one picture


def test_every_module_says_what_it_is():
    said = {p: ast.get_docstring(ast.parse(p.read_text("utf-8"))) for p in SOURCE.rglob("*.py")}
    assert [str(path) for path, text in said.items() if not text] == []


def test_no_docstring_of_a_test_begins_with_a_clause():
    """The ratchets count those of the source, by room."""
    trees = {p: ast.parse(p.read_text("utf-8")) for p in sorted((ROOT / "tests").rglob("*.py"))}
    assert [str(path) for path, tree in trees.items() if counted(tree)["clauses"]] == []


def test_no_two_files_of_tests_share_a_name():
    """They are imported by their bare names, so of two the second would not be found."""
    names = Counter(path.name for path in (ROOT / "tests").rglob("*.py"))
    del names["conftest.py"]  # these pytest tells apart
    assert [name for name, times in names.items() if times > 1] == []


def undocumented(package) -> list[str]:
    """Public names of a package that lack a docstring of their own."""
    bare = []
    for name in package.__all__:
        thing = getattr(package, name)
        if typing.get_origin(thing) or not callable(thing):
            continue  # a constant or the name of a type; no docstring can hang on it
        text = inspect.getdoc(thing) or ""
        # Dataclasses and named tuples get their signature for a docstring if they have none.
        if not text or text.startswith(f"{name}("):
            bare.append(f"{package.__name__}.{name}")
    return bare


PACKAGES = [
    ".".join(("robins", *p.parent.relative_to(SOURCE).parts))
    for p in sorted(SOURCE.glob("*/**/__init__.py"))
]


@pytest.mark.parametrize("name", PACKAGES)
def test_every_package_lists_its_public_names_and_documents_them(name):
    package = importlib.import_module(name)
    assert package.__all__, f"{name} has no list of public names"
    assert not undocumented(package)


def test_an_undocumented_name_is_found():
    class Bare(NamedTuple):
        x: int

    package = type(sys)("package")
    known = {"Bare": Bare, "documented": room_of, "LIMIT": 3, "Alias": Callable[[int], int]}
    vars(package).update(known, __all__=list(known))
    assert undocumented(package) == ["package.Bare"]


def test_one_version_everywhere():
    """The tag gives it; the fallback stands for the tag in a clone that has none."""
    version = tomllib.loads(text_of(ROOT / "pyproject.toml"))["tool"]["hatch"]["version"]
    cited = re.findall(r"^version: (\S+)$", text_of(ROOT / "CITATION.cff"), re.MULTILINE)
    headings = re.findall(r"^## (\S+)", text_of(ROOT / "CHANGELOG.md"), re.MULTILINE)
    assert headings[0] == robins.__version__
    assert headings[0] == version["fallback-version"]
    assert [headings[0]] == cited


def test_a_source_that_was_never_installed_has_a_version():
    code = f"import sys; sys.path.insert(0, {str(SOURCE.parent)!r}); import robins"
    done = python(f"{code}; print(robins.__version__)", "-I", "-S")
    assert (done.returncode, done.stdout) == (0, "0+unknown\n"), done.stderr


def test_every_make_command_that_is_named_exists():
    workflows = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *workflows]
    targets = set(re.findall(r"^([a-z]+):", text_of(ROOT / "Makefile"), re.MULTILINE))
    commands = r"(?:^|`|- run: )make ([a-z]+)"
    named = {n for page in pages for n in re.findall(commands, text_of(page), re.MULTILINE)}
    assert {"check", "docs", "install", "watch"} <= named
    assert named <= targets


def test_the_files_that_a_new_thing_touches_exist():
    """For a system, rule, format, command and rig they are at most two."""
    text = text_of(ROOT / "CONTRIBUTING.md").partition("## Files that a new thing touches")[2]
    rows = [line.split("|") for line in text.partition("\n## ")[0].splitlines() if "|" in line]
    touched = {
        row[1].strip(): re.findall(r"`(\w[\w/]*\.py)`", row[3]) for row in rows if len(row) == 5
    }
    assert {"system", "filter rule", "format of text logs", "command", "rig"} <= set(touched)
    assert all(len(files) <= 2 for files in touched.values())
    assert [
        file for files in touched.values() for file in files if not (SOURCE / file).is_file()
    ] == []


def test_types_are_shipped():
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]
    hooks = {"custom": {"path": "hatch_build.py"}}  # adds the interpreters
    assert wheel["targets"]["wheel"] == {"packages": ["src/robins"], "hooks": hooks}
    assert (SOURCE / "py.typed").is_file()


# ----------------------------------------------------------------------------------- float width


def python(code: str, *options: str, **variables: str | None) -> subprocess.CompletedProcess[str]:
    """Run code in a fresh interpreter, without the variables that are None."""
    kept = {k: v for k, v in {**os.environ, **variables}.items() if v is not None}
    told = [sys.executable, *options, "-c", code]
    return subprocess.run(told, env=kept, capture_output=True, text=True, timeout=120, check=False)


def test_importing_a_numeric_room_turns_64_bit_on():
    code = "from robins import rotation as r; print(r.Rotation.identity().wxyz.dtype)"
    done = python(code, JAX_ENABLE_X64="0")
    assert (done.returncode, done.stdout) == (0, "float64\n"), done.stderr


def test_a_user_who_turns_64_bit_off_is_told():
    code = (
        "from robins import _float64, logs; import jax; _float64.require();"  # logs import no JAX
        "print('wide'); jax.config.update('jax_enable_x64', False); _float64.require()"
    )
    done = python(code, JAX_ENABLE_X64="0")
    assert done.stdout == "wide\n"
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith(
        "RuntimeError: robins computes in 64-bit floats, but JAX is set to 32-bit: remove"
    )


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="threads are counted on Linux")
@pytest.mark.parametrize(("given", "workers"), [(None, 1), ("3", 3)])
def test_one_worker_thread_unless_the_user_asks_for_more(given, workers):
    """Two workers of jaxlib can wait for each other for ever."""
    code = (
        "import pathlib, robins, jax.numpy as jnp; jnp.ones(2).block_until_ready();"
        "names = [t.read_text() for t in pathlib.Path('/proc/self/task').glob('*/comm')];"
        "print(sum(name.startswith('tf_XLAEigen') for name in names))"
    )
    assert int(python(code, PJRT_NPROC=given).stdout) == workers
