"""A system from outside the package: the one of the documents, and what is wrong with others."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from sketching import sketch

from robins import results
from robins.cli import main
from robins.systems import SYSTEMS, catalogue, trust
from robins.systems.finding import UnknownSystem, find_system

pytestmark = pytest.mark.usefixtures("sketched")
EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "balloon.py"


@pytest.fixture(autouse=True)
def modules_as_before(monkeypatch):
    """Forget the modules that a test imports after it."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(trust, "_local", {})
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        if not name.startswith(("robins", "jax", "numpy", "scipy", "xarray")):
            del sys.modules[name]


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    out = tmp_path_factory.mktemp("own") / "balloon"
    with pytest.MonkeyPatch.context() as patch:
        sketch(patch)
        assert main(["run", f"{EXAMPLE}:study", "--runs", "40", "--out", str(out)]) == 0
    return results.read(out)


def test_the_study_of_the_documents_runs_like_a_packaged_one(found):
    summary = found.summary
    assert set(summary["filters"]) == {"kf", "gated"}
    assert [(c["id"], c["verdict"]) for c in summary["claims"]] == [("gate-helps", "reproduced")]
    assert summary["scenario"] == "balloon:study"
    # the filter that knows its noise errs as much as it says, the other does not
    assert np.abs(np.array(summary["filters"]["gated"]["error_over_sigma"]) - 1.0).max() < 0.15
    assert min(summary["filters"]["kf"]["error_over_sigma"]) > 1.5
    assert (found.path / "report.html").stat().st_size > 10_000
    assert (found.path / "figures" / "rms_height.png").exists()


def test_its_covariance_bound_is_that_of_its_riccati_equation(tmp_path):
    out = tmp_path / "bound"
    assert main(["bound", f"{EXAMPLE}:study", "--filters", "kf", "--out", str(out)]) == 0
    sigma = results.read(out).solution["bound_height"].values[-1, 0]
    T, q, r = 1.0, 0.05, 3.0
    F, H = np.array([[1.0, T], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    Q = q**2 * np.array([[T**3 / 3, T**2 / 2], [T**2 / 2, T]])
    P = np.diag([25.0, 1.0])
    for _ in range(300):
        P = F @ P @ F.T + Q
        P = P - P @ H.T @ H @ P / (P[0, 0] + r**2)
    np.testing.assert_allclose(sigma, np.sqrt(P[0, 0]), rtol=1e-9)


def test_a_scenario_file_names_the_file_beside_it(tmp_path, capsys):
    shutil.copy(EXAMPLE, tmp_path / "weather.py")
    text = (
        'system = "weather.py:study"\nruns = 2\nfilters = ["kf"]\nduration = "20 s"\nclaims = []\n'
    )
    (tmp_path / "windy.toml").write_text(text)
    out = tmp_path / "out"
    words = ["run", str(tmp_path / "windy.toml"), "--json", "--out", str(out)]
    assert main(words) == 2  # a file that a file names is confirmed once
    assert f"--trust {tmp_path / 'weather.py'}" in capsys.readouterr().err
    assert main([*words, "--trust", str(tmp_path / "weather.py")]) == 0
    told = json.loads(capsys.readouterr().out)
    assert list(told["filters"]) == ["kf"]
    assert told["claims"] == []
    assert results.read(out).solution.sizes["time"] == 20


def test_a_default_runs_beside_the_filters_of_a_scenario_and_is_not_judged(tmp_path, capsys):
    shutil.copy(EXAMPLE, tmp_path / "sky.py")
    (tmp_path / "much.py").write_text(
        "from dataclasses import replace\n"
        "from sky import study as kite\n"
        "from robins.systems import System\n"
        "from robins.systems.judgement import Claim\n"
        'CLAIM = Claim("there is one filter", (), len, (1, 1))\n'
        'much = System("much", {"": replace(kite, claims={"one": CLAIM})}, default="gated")\n'
    )
    text = 'system = "much.py:much"\nruns = 2\nfilters = ["kf"]\nduration = "20 s"\n'
    (tmp_path / "much.toml").write_text(text)

    trust.confirm(tmp_path / "much.py")

    def told(*more):
        words = ["run", str(tmp_path / "much.toml"), *more, "--json", "--out", str(tmp_path / "o")]
        assert main(words) == 0
        found = json.loads(capsys.readouterr().out)
        return list(found["filters"]), [claim["value"] for claim in found["claims"]]

    assert told() == (["kf", "gated"], [1])
    assert told("--filters", "kf,gated") == (["kf", "gated"], [2])  # both were asked for


def test_its_filters_and_claims_are_listed(capsys):
    assert main(["list", f"{EXAMPLE}:study"]) == 0
    told = capsys.readouterr().out
    assert "kf, gated" in told
    assert "gate-helps" in told
    assert f"robins run {EXAMPLE}:study" in told
    assert "default  all of these run" in told


def test_an_error_in_a_file_of_the_user_is_named_with_its_line(capsys, tmp_path):
    text = EXAMPLE.read_text().replace("T = given.step\n", "T = given.steps\n")
    (tmp_path / "wrong.py").write_text(text)
    line = 1 + text.splitlines().index("    T = given.steps")
    assert main(["run", f"{tmp_path / 'wrong.py'}:study", "--out", str(tmp_path / "out")]) == 1
    told = capsys.readouterr().err
    assert "failed: AttributeError" in told
    assert f"in {tmp_path / 'wrong.py'}, line {line}; run it again with --debug" in told
    assert "fault of robins" not in told


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["--filters", "gatd"], f"in {EXAMPLE}:study; did you mean 'gated'?"),
        (["--set", 'claims=["gate-help"]'], "did you mean 'gate-helps'?"),
        (["--set", "barometr=1 m"], "barometer"),
        (["--set", "barometer=1 s"], "barometer"),
    ],
)
def test_a_mistyped_name_is_refused_with_the_nearest(words, wanted, capsys, tmp_path):
    out = tmp_path / "out"
    assert main(["run", f"{EXAMPLE}:study", *words, "--out", str(out)]) == 2
    assert wanted in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(
    ("text", "name", "wanted"),
    [
        (None, "study", "no such file"),
        ("x = 1", "study", "it defines no study"),
        ("import nothing_of_that_name", "study", "importing it failed: ModuleNotFoundError"),
        ("raise ZeroDivisionError('here')", "study", "ZeroDivisionError: here"),
        (EXAMPLE.read_text(), "studi", "did you mean 'study'?"),
        (EXAMPLE.read_text(), "", "no study is named; write one of wrong.py:study"),
        (EXAMPLE.read_text(), "none", "no study 'none' in it; write one of"),
        (EXAMPLE.read_text(), "FILTERS", "it is of type dict"),
    ],
)
def test_a_file_that_is_no_system_says_what_it_lacks(tmp_path, text, name, wanted):
    if text is not None:
        (tmp_path / "wrong.py").write_text(text)
    with pytest.raises(UnknownSystem) as refused:
        find_system(f"wrong.py:{name}", tmp_path)
    assert wanted in str(refused.value)
    assert "wrong.py" in str(refused.value)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("x = 1\n\nraise ZeroDivisionError('here')\n", 3),
        ("import json\n\ndef read():\n    json.loads('{')\n\nread()\n", 4),
        ("x = 1\ny = )\n", 2),
        ("x = 1\nimport beside_it\n", 2),
        ("x = 1\n\ncompile('x =', 'elsewhere.py', 'exec')\n", 3),
    ],
    ids=["raised", "called", "syntax", "syntax-beside-it", "syntax-in-a-string"],
)
def test_a_file_that_cannot_be_imported_is_named_with_its_line(tmp_path, text, line):
    (tmp_path / "beside_it.py").write_text("x = 1\n\n\n\ndef\n")
    (tmp_path / "wrong.py").write_text(text)
    with pytest.raises(UnknownSystem) as refused:
        find_system("wrong.py:study", tmp_path)
    assert refused.value.where == f"{tmp_path / 'wrong.py'}, line {line}"


def test_a_file_with_the_name_of_a_loaded_module_is_refused(tmp_path):
    (tmp_path / "json.py").write_text(EXAMPLE.read_text())
    with pytest.raises(UnknownSystem, match="give the file another name"):
        find_system("json.py:study", tmp_path)


def test_an_unknown_system_is_refused_with_the_nearest():
    with pytest.raises(UnknownSystem, match=r"did you mean 'airship'\?.*file\.py:name"):
        find_system("airshp")


@pytest.fixture
def package(tmp_path, monkeypatch):
    """An installed package with an entry point and a scenario."""
    home = tmp_path / "sky"
    (home / "scenarios").mkdir(parents=True)
    (home / "__init__.py").write_text("")
    shutil.copy(EXAMPLE, home / "balloon.py")
    (home / "scenarios" / "calm.toml").write_text('title = "A calm day"\nruns = 3\n')
    about = tmp_path / "sky-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: sky\nVersion: 1.0\nSummary: balloons\n"
    )
    (about / "entry_points.txt").write_text(
        "[robins.systems]\nballoon = sky.balloon:study\nairship = sky.balloon:study\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    for kept in (catalogue.installed, catalogue.listed):
        kept.cache_clear()
    yield
    monkeypatch.undo()
    for kept in (catalogue.installed, catalogue.listed):
        kept.cache_clear()


@pytest.mark.usefixtures("package")
def test_a_package_makes_its_system_known_by_name(capsys, tmp_path):
    assert main(["list"]) == 0
    told = capsys.readouterr().out
    assert "balloon  balloons" in told
    assert "A calm day" in told
    out = tmp_path / "out"
    words = ["run", "balloon/calm", "--filters", "kf", "--set", "duration=20 s", "--out", str(out)]
    assert main(words) == 0
    assert results.read(out).summary["runs"] == 3
    assert "balloon" in SYSTEMS
    assert SYSTEMS["airship"].name == "airship", "robins' own name stays its own"
