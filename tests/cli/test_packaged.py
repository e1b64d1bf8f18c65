"""All that is packaged or documented runs: scenarios, filters, command lines shown.

Figures and claims are judged elsewhere; here it counts that a user who types it gets a result. What
a scenario or a filter gets wrong shows when its run is traced; that is done for all. To compile and
run one takes ten seconds; that is done for one scenario of each study, and by `make certify` for
all. So it is with command lines: each is read up to where its computation begins, and one of each
kind is run to its end; `make certify` runs the others.
"""

import pkgutil
import re
import shlex
from functools import partial
from pathlib import Path

import click
import jax
import jax.numpy as jnp
import jaxtyping
import pytest
from bench.stations import on_threads
from shown_files import write_files

from robins import results, scenario
from robins.bench.rigs.satellite import config
from robins.campaign.monte_carlo import _each, _records, contender
from robins.cli import ExitStatus, app, main
from robins.report import numbers
from robins.systems import SYSTEMS
from robins.workbench.scenarios import read_scenario, with_default_filter

ROOT = Path(__file__).resolve().parents[2]

# Of each study the filter that costs least and uses every sensor, and what makes a run short.
STUDIES = {
    "drive": ("ekf", ()),
    "city": ("ekf", ()),
    "attitude-matching": ("kf", ()),
    "velocity-attitude": ("kf", ()),
    "product": ("kf", ()),
    "navigation": ("ekf", ()),
    "magnetic-attitude": ("ukf", ()),
    "field-vector": ("usque", ()),
    "attitude-loop": ("mekf", ("duration=60 s", "counted_from=30 s")),
}


def study_of(name):
    """System, study and name of the study of a packaged scenario."""
    system = SYSTEMS[name.split("/")[0]]
    text = system.scenarios[name.split("/")[1]].read_text()
    study = scenario.mapping_of(text).get("study", next(iter(system.studies)))
    return system, system.studies[study], study


def settings_of(study):
    return [word for setting in STUDIES[study][1] for word in ("--set", setting)]


PACKAGED = [f"{s.name}/{scenario}" for s in SYSTEMS.values() for scenario in s.scenarios]
SHORTEST = {
    "attitude-matching": "transfer-alignment/s1",
    "velocity-attitude": "transfer-alignment/d",
    "product": "transfer-alignment/aircraft",
    "navigation": "airship/s0",
    "magnetic-attitude": "rocket/a4",
}
WHOLE = {study_of(name)[2]: name for name in PACKAGED}  # the last of each study: all filters run


# The campaigns of these tests run a good part of the filters, each of which takes ten seconds to
# compile; here the others run.
CAMPAIGNS = {"navigation": "test_airship_*.py"}


def run_by_campaigns(kind):
    """The text of the tests that run filters of a study over many runs."""
    found = (ROOT / "tests" / "systems").glob(CAMPAIGNS.get(kind, "none"))
    return "".join(path.read_text("utf-8") for path in found)


def filters_of(name):
    """Filters to run: in one scenario of a study all that nothing else of its system runs."""
    system, study, kind = study_of(name)
    if name != WHOLE[kind]:
        return [STUDIES[kind][0]]
    kinds = list(system.studies)
    later = {f for k in kinds[kinds.index(kind) + 1 :] for f in system.studies[k].filters}
    others, text = [f for f in study.usual if not f.endswith("+rts")], run_by_campaigns(kind)
    own = [f for f in others if f not in later and f'"{f}"' not in text]
    return list(dict.fromkeys([STUDIES[kind][0], *own]))


def test_every_study_is_in_the_table():
    assert set(STUDIES) == {study for s in SYSTEMS.values() for study in s.studies} == set(WHOLE)


@pytest.mark.parametrize("name", SYSTEMS)
def test_every_system_has_a_default_that_runs_beside_what_a_scenario_names(name):
    system = SYSTEMS[name]
    assert system.default in system.filters
    for one in (one for one in PACKAGED if one.startswith(f"{name}/")):
        read = read_scenario(one, ())
        default = {system.default} & set(read.study.filters)
        assert set(with_default_filter(read)) == {*read.own, *default}


def test_a_configuration_of_what_is_recorded_is_not_simulated(robins):
    for name in ("transfer-alignment/replay", "ins-gnss/walk"):
        for command in ("run", "bound"):
            answer = robins(command, name)
            assert answer.status == ExitStatus.BAD_INPUT
            assert f"{name} describes what is recorded and simulates nothing" in answer.err
    assert not list(Path().iterdir())


@pytest.mark.parametrize("command", ["run", "bound"])
def test_more_runs_than_anyone_waits_for_are_refused_at_once(robins, command):
    answer = robins(command, "rocket/a1", "--runs", 10**20)
    assert answer.status == ExitStatus.BAD_INPUT
    assert "runs = 100000000000000000000" in answer.err
    assert "1000000" in answer.err.replace("100000000000000000000", "")


def test_every_filter_runs_in_some_scenario():
    for system in SYSTEMS.values():
        run = {f for name in PACKAGED if name.startswith(system.name) for f in filters_of(name)}
        for kind, study in system.studies.items():
            text = run_by_campaigns(kind)
            left = {f for f in study.usual if f not in run and f'"{f}"' not in text}
            assert all(f.endswith("+rts") for f in left), left


def runs(robins, name, filters):
    """The command makes a result of a scenario, with a figure of each filter, and a page."""
    _, study, kind = study_of(name)
    answer = robins(
        *("run", name, "--runs", 1, "--filters", ",".join(filters), "--out", "out"),
        *settings_of(kind),
    )
    assert answer.status == ExitStatus.DONE, answer.err
    summary = results.read("out").summary
    assert list(summary["filters"]) == filters
    for found in summary["filters"].values():
        assert any(numbers.show(value) not in ("", "-") for value in found.values())
    assert {c["id"] for c in summary["claims"]} <= set(study.claims)
    assert summary["files"]["figures"]
    assert "report.html" in answer.out


# A filter that is known to be wrong, and says so, is one of the airship's.
KNOWN = pytest.mark.filterwarnings("ignore:feedback='full' gives every local filter")


@KNOWN
@pytest.mark.parametrize("name", PACKAGED)
def test_a_packaged_scenario_can_be_traced(name):
    """World, filters and what is recorded of them fit together: their shapes are those reported."""
    _, study, kind = study_of(name)
    path = SYSTEMS[name.split("/")[0]].scenarios[name.split("/")[1]]
    parameters = scenario.parse(study.parameters, path.read_text(), settings_of(kind)[1::2])
    problem = study.problem(parameters, tuple(filters_of(name)), 0)
    # A batch of one: a second run would double what is traced.
    worlds = jax.eval_shape(partial(_each, problem.simulate), jnp.arange(1))
    blocks = tuple((b.name, b.where.start, b.where.stop) for b in problem.blocks)
    for filter_ in problem.contenders:
        c = contender(problem, filter_)
        found = _records.eval_shape(c.filter, blocks, c.model, c.case, c.reported, worlds)
        epochs, width = len(problem.epoch_s), max(b.where.stop for b in problem.blocks)
        assert found["error"].shape == found["sigma"].shape == (1, epochs, width)
        assert found["nees"].shape == (1, epochs)


@pytest.mark.parametrize("kind", [kind for kind in STUDIES if kind != "drive"])  # that is the demo
@pytest.mark.usefixtures("unchecked")
def test_a_study_runs(robins, kind):
    runs(robins, SHORTEST.get(kind, WHOLE[kind]), [STUDIES[kind][0]])


@KNOWN
@pytest.mark.parametrize("name", PACKAGED)
@pytest.mark.usefixtures("unchecked")
def test_a_packaged_scenario_runs(robins, name):
    runs(robins, name, filters_of(name))


# ------------------------------------------------------------------------- command lines shown


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The files that the documents name, made small."""
    for name in BEGINS.values():  # modules import from each other before one is replaced
        pkgutil.resolve_name(name)
    here = tmp_path_factory.mktemp("shown")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jaxtyping.config, "jaxtyping_disable", True)
        write_files(here)
    return here


# What stands in a document for a file of the reader.
STANDS_FOR = {
    "imu.csv.xz": "imu.csv",
    "gnss.pos.xz": "gnss.pos",
    "walk.toml": "unit.toml",
    "turned.ulg": "turned.csv",
    "broad_33_disturbed_attached_magnet_2cm.npz": "nine_axes.csv",
    "record.mcap": "results/bench-satellite-s1/record.mcap",
    "other.mcap": "results/bench-satellite-s1/record.mcap",
    "docs/examples/balloon.py:study": "my_system.py:study",
    "docs/examples/first.py:study": "first.py:study",
    "docs/examples/pendulum.py:rig": "my_rig.py:rig",
}
# A reader's own devices and autopilots, and pages that stay open until someone closes them.
NEEDS_MORE = re.compile(r"/dev/|--live|bench node|> |autopilot=")


NEEDED = ("--board", "calibrate", "bench up")  # other lines use what these leave behind


def helps(command=app):
    """The help texts of all commands."""
    yield command.epilog or ""
    for inner in getattr(command, "commands", {}).values():
        yield from helps(inner)


def shown():
    """Every command line of the documents and of the help texts."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    texts = [p.read_text("utf-8") for p in pages if "_build" not in p.parts] + list(helps())
    lines = re.findall(r"^ *(?:\$ )?(robins (?!needs ).*)$", "\n".join(texts), re.MULTILINE)
    cut = (re.sub(r"\s(\s{2,}|\s+#).*", "", line) for line in lines)

    def order(line):
        return next((k for k, word in enumerate(NEEDED) if word in line), len(NEEDED)), line

    return sorted(set(cut), key=order)


def words_of(line):
    """The words of a command line, with small files in the place of the reader's."""
    _, *words = shlex.split(line)
    words = [STANDS_FOR.get(word, word) for word in words]
    if words[0] == "design":
        words = [word.replace("my.toml", "my-problem.toml") for word in words]
    if "--master" in words:
        words = [word.replace("my.toml", "my-pair.toml") for word in words]
    if words[0] == "campaign" and words[1] != "run":
        words[2] = "small-campaign"
    return words


def cheapest(name):
    """The filter that costs least in a packaged scenario."""
    return STUDIES[study_of(name)[2]][0]


def as_short_as_can_be(words):
    """One run, two seconds, the cheapest of what is not chosen."""
    match words:
        case ["run", *_] if "--master" in words:
            return [*words, "--filters", "kf"]  # the last of an option counts
        case ["run", "my.toml", *_]:
            return [*words, "--runs", "1", "--filters", "ekf"]
        case ["run", name, *more] if name in PACKAGED:
            return ["run", "--filters", cheapest(name), name, *more, "--runs", "1"]
        case ["run", *_]:
            return [*words, "--runs", "1"]
        case ["campaign", "show", *_]:
            return [*words, "--run", "1"]
        case ["campaign", "run", name, *more]:
            cheap = ("--filters", cheapest(name), "--workers", "1")
            return ["campaign", "run", *cheap, name, *more, "--runs", "1"]
        case ["sweep", name, *more]:
            cheap = ("--filters", cheapest(name), "--workers", "1")
            return ["sweep", *cheap, name, *more, "--runs", "1"]
        case ["tune", *_]:
            return [*words, "--runs", "6"]
        case ["sensitivity", name, *_]:
            cheap = ("--filter", cheapest(name)) if name in PACKAGED else ()
            return [*words, *cheap, "--runs", "1", "--samples", "2"]
        case ["design", *_] if "--methods" not in words:
            return [*words, "--methods", "riccati"]
        case ["replay", *_] if "gnss" in words:
            return [*words, "--filters", "ls"]
        case ["replay", *_]:
            return [*words, "--filters", "marg" if "--system" in words else "ekf"]
        case ["bench", "up", *_]:
            return [*words, "--seconds", "2"]
    return words


# Of these commands, which begin to compute when this is called, one line of each kind is computed:
# that with the most options. Packaged scenarios run above, and `test_cli_bound.py` computes bounds.
PROBLEM = "robins.workbench.scenarios:Simulated.problem"  # any command that simulates
BEGINS = {
    ("run",): PROBLEM,
    ("bound",): PROBLEM,
    ("allan",): "robins.workbench.allan:deviation",
    ("design",): "robins.workbench.design:trade_off",
    ("replay",): "robins.workbench.replay:part",
    ("run", "--master"): "robins.workbench.replay:part",
    ("replay", "--system"): "robins.workbench.replay:part",
    ("campaign", "run"): "robins.workbench.workers:plan_campaign",
    ("campaign", "report"): "robins.workbench.campaign:ready",
    ("campaign", "show"): "robins.workbench.campaign:ready",
    ("campaign", "verify"): "robins.workbench.campaign:ready",
    ("sweep",): "robins.workbench.sweep:plan_campaign",
    ("tune",): "robins.workbench.tune:choose",
    ("sensitivity",): "robins.workbench.sensitivity:simulate_points",
    ("bench", "up"): "robins.workbench.bench:Session",
    ("bench", "replay"): "robins.workbench.bench:config_of",
    ("export",): "robins.workbench.export:files_of",
    ("export", "--adjust"): "robins.workbench.export:files_of",
    ("export", "--board"): "robins.workbench.export:_request_for_rig",
}
# The option that makes a command compute something else.
OPTIONS = ("--master", "--system", "--diff", "--adjust", "--board")

# A part of the bench that is built in `make certify`, and one that always is.
BUILT = {"navigation=navigation/navigation_board": "navigation=gyro/gyro_board"}


def kind_of(words):
    """The command, and the option that makes it compute something else."""
    command = words[: 2 if words[0] in ("bench", "campaign") else 1]
    return (*command, *(o for o in OPTIONS if o in words))


class BeginsError(BaseException):
    """Stand-in for a computation; passes all that would report it to the user."""


def begins(*_, **__):
    raise BeginsError


def reaches(words):
    """Let click parse a command line without running it."""
    words = words[: words.index(">")] if ">" in words else words
    command, context = app, click.Context(app, **app.context_settings)
    while isinstance(command, click.Group):
        name, *words = words
        command = command.commands[name]
    # A command keeps the help option of its first context: without a parent that has no "-h".
    command.make_context(name, list(words), parent=context)


# What a log or runs so short say to a tuning, which then refuses them, as it should.
TOO_SHORT = "the data say too little"
SHOWN = {tuple(words_of(line)): line for line in shown()}
WHOLE_LINES = {}
for words in sorted(SHOWN, key=lambda words: sum(word.startswith("--") for word in words)):
    packaged = kind_of(words) in (("run",), ("bound",)) and words[1] in PACKAGED
    if not NEEDS_MORE.search(SHOWN[words]) and not packaged:
        WHOLE_LINES[kind_of(words)] = words


def runs_whole(words):
    """Test for a line that every `make test` runs to its end."""
    return kind_of(words) not in BEGINS or words == WHOLE_LINES.get(kind_of(words))


def needed(line):
    """Test for a line whose files other lines use."""
    return any(word in line for word in NEEDED)


def test_every_command_is_shown():
    assert {words[0] for words in SHOWN} >= set(app.commands)
    assert len(SHOWN) > 40


def interpreted(prepare, setup, given):
    """The config of a satellite on the bench, of parts that compile nothing."""
    made = prepare(setup, given)
    on_host = setup.filter == "mixed-lmi-step"  # no program
    return made if on_host else made._replace(machine="vm")


@pytest.fixture
def computes(folder, sketched, unchecked, monkeypatch, capsys):
    """Run a command line to its end; programs of boards are built, parts of a bench are threads.

    Those of the satellite are interpreted where they can be.
    """
    monkeypatch.setenv("CFLAGS", "-std=c99 -O0")
    monkeypatch.setattr(config, "prepare", partial(interpreted, config.prepare))

    def to_the_end(words):
        monkeypatch.chdir(folder)
        if words[:2] == ("bench", "up") and "--node" not in words:
            on_threads(monkeypatch)
        status = main(as_short_as_can_be(list(words)))
        told = capsys.readouterr()
        if words[0] == "tune" and TOO_SHORT in told.err:
            assert status == ExitStatus.BAD_INPUT
            return
        assert status == ExitStatus.DONE, told.out + told.err  # so the demo has passed
        assert "fault of robins" not in told.err

    return to_the_end


@pytest.mark.parametrize("words", SHOWN, ids=SHOWN.values())
def test_a_command_line_shown_runs(words, folder, computes, monkeypatch):
    kind = kind_of(words)
    if NEEDS_MORE.search(SHOWN[words]):
        reaches(words)
    elif runs_whole(words):
        computes(words)
    else:
        monkeypatch.chdir(folder)
        for path in (PROBLEM, BEGINS[kind]):
            module, _, name = path.partition(":")
            owner, _, name = name.rpartition(".")
            of = pkgutil.resolve_name(f"{module}:{owner}" if owner else module)
            monkeypatch.setattr(of, name, begins)
        with pytest.raises(BeginsError):
            main([BUILT.get(word, word) for word in words])


def result_of(words):
    """A command line as short as it can be, without where its result goes and how long it runs."""
    short, out = as_short_as_can_be(list(words)), {"--out", "--seconds", "--runs"}
    pairs = zip(["", *short], short, strict=False)
    return tuple(word for before, word in pairs if not {before, word} & out)


LEFT = {words: line for words, line in SHOWN.items() if not NEEDS_MORE.search(line)}
LEFT = {words: line for words, line in LEFT.items() if needed(line) or not runs_whole(words)}
COMPUTED = set()  # results of lines that ran to their end


# In the order of all of them: replays need what others leave behind.
@pytest.mark.parametrize("words", LEFT, ids=LEFT.values())
def test_a_command_line_shown_is_computed(words, computes):
    """Lines of which `make test` sees the beginning; of those with one result only the first."""
    result = result_of(words)
    if result in COMPUTED:
        reaches(words)
    else:
        computes(words)
        COMPUTED.add(result)
