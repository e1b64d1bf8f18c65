"""What is packaged or documented runs: every scenario, every filter, every command line shown.

Figures and claims are judged elsewhere; here it counts that a user who types it gets a result. What
a scenario or a filter gets wrong shows when its run is traced; that is done for all. To compile and
run one takes ten seconds; that is done for one scenario of each study, and by `make certify` for
all. So it is with command lines: each is read up to where its computation begins, and one of each
kind is run to its end.
"""

import re
import shlex
import subprocess
from dataclasses import replace
from functools import partial
from pathlib import Path

import click
import gnss_logs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from short_drive import write_pos
from simulated_pair import pair_dataset

from robins import logs, results, scenario
from robins.bench.rigs import rig_of
from robins.bench.wire.c_header import firmware
from robins.campaign.monte_carlo import _each, _records, contender
from robins.cli import Status, app, main
from robins.dataset import ImuTable
from robins.report import numbers
from robins.results import Outcome
from robins.systems import SYSTEMS
from robins.systems.catalogue import configurations
from robins.systems.ins_gnss import Drive, drive_dataset
from robins.systems.transfer_alignment.product.parameters import Replay
from robins.workbench import campaign_work, plan_campaign, publish
from robins.workbench.scenarios import beside, read_scenario

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
        assert set(beside(read)) == {*read.own, *default}


def test_a_configuration_of_what_is_recorded_is_not_simulated(robins):
    for name in ("transfer-alignment/replay", "ins-gnss/walk"):
        for command in ("run", "bound"):
            answer = robins(command, name)
            assert answer.status == Status.BAD_INPUT
            assert f"{name} describes what is recorded and simulates nothing" in answer.err
    assert not list(Path().iterdir())


@pytest.mark.parametrize("command", ["run", "bound"])
def test_more_runs_than_anyone_waits_for_are_refused_at_once(robins, command):
    answer = robins(command, "rocket/a1", "--runs", 10**20)
    assert answer.status == Status.BAD_INPUT
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
    assert answer.status == Status.DONE, answer.err
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
def test_a_study_runs(robins, kind):
    runs(robins, SHORTEST.get(kind, WHOLE[kind]), [STUDIES[kind][0]])


@KNOWN
@pytest.mark.parametrize("name", PACKAGED)
def test_a_packaged_scenario_runs(robins, name):
    runs(robins, name, filters_of(name))


# ------------------------------------------------------------------------- command lines shown


def write_nine_axes(path, seconds=40.0, hz=50.0):
    """A unit that is turned about all its axes, in CSV of x-io."""
    rng = np.random.default_rng(3)
    t = np.arange(round(seconds * hz)) / hz
    s = np.maximum(t - 5.0, 0.0)
    roll, pitch, yaw = 1.3 * s, 1.2 * np.sin(0.6 * s), 0.9 * s
    rate = np.gradient(np.stack([roll, pitch, yaw]), 1.0 / hz, axis=1)
    sr, cr, sp, cp, sy, cy = (f(a) for a in (roll, pitch, yaw) for f in (np.sin, np.cos))
    gyro = [
        rate[0] - sp * rate[2],
        cr * rate[1] + sr * cp * rate[2],
        cr * cp * rate[2] - sr * rate[1],
    ]
    down = np.stack([-sp, sr * cp, cr * cp])
    north = np.stack([cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy])
    columns = [
        *np.rad2deg(gyro),
        *-down,
        *(20.0 * north + 43.0 * down + np.array([[12.0], [-8.0], [5.0]])),
    ]
    noise = np.repeat([0.05, 0.002, 0.2], 3)[:, None] * rng.standard_normal((9, len(t)))
    head = [
        f"{kind} {axis} ({unit})"
        for kind, unit in (("Gyroscope", "deg/s"), ("Accelerometer", "g"), ("Magnetometer", "uT"))
        for axis in "XYZ"
    ]
    rows = np.column_stack([t, *(np.array(columns) + noise)])
    np.savetxt(path, rows, "%.6f", ",", header=",".join(["Time (s)", *head]), comments="")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The files that the documents name, made small."""
    here = tmp_path_factory.mktemp("shown")
    text = SYSTEMS["ins-gnss"].scenarios["drive"].read_text()
    head, *legs = text.split("[[legs]]")
    car = "[[legs]]".join([head, *legs[:4]])
    car = car.replace('settle = "60 s"', 'settle = "5 s"')
    (here / "my.toml").write_text(car)
    drive = drive_dataset(scenario.parse(Drive, car), seed=1)
    imu, gnss = (
        replace(t, time_ns=t.time_ns + 1_700_000_000_000_000_000) for t in (drive.imu, drive.gnss)
    )
    logs.write_log(here / "imu.csv", imu)
    write_pos(here / "gnss.pos", gnss)
    lever_arm = 'lever_arm = ["0.5 m", "-0.2 m", "-1 m"]'
    unit = car[car.index("[imu]") : car.index("[gnss]")]
    (here / "unit.toml").write_text(f'system = "ins-gnss"\n{unit}[gnss]\n{lever_arm}\n')
    write_nine_axes(here / "turned.csv")
    for name in ("nine_axes.csv", "flight.csv"):
        (here / name).write_bytes((here / "turned.csv").read_bytes())
    page = (ROOT / "docs" / "logs.md").read_text("utf-8").split("### A format of your own")[1]
    (here / "logger.toml").write_text(page.split("```toml\n")[1].split("```")[0])
    turned = logs.open_log(here / "turned.csv")
    logs.write_log(here / "my.csv", turned, logs.columns_from(here / "logger.toml"))
    for name, text in zip(("ranges", "places"), gnss_logs.as_text(*gnss_logs.drive()), strict=True):
        (here / f"{name}.txt").write_text(text)
    rng = np.random.default_rng(2)
    still = rng.normal(size=(2, 3000, 3)) * [[[1e-3]], [[5e-3]]] + [[[0, 0, 0]], [[0, 0, -9.81]]]
    stamps = np.arange(3000) * 10_000_000
    logs.write_log(here / "still.csv", ImuTable(stamps, still[0], still[1], "rate"))
    pair = configurations("transfer-alignment")["replay"].read_text()
    (here / "my-pair.toml").write_text(pair)
    dataset = pair_dataset(scenario.parse(Replay, pair, ["slave.rate=20 Hz"]), seed=3)
    logs.write_log(here / "master.csv", dataset.master)
    logs.write_log(here / "slave.csv", dataset.imu)
    (here / "my_system.py").write_bytes((ROOT / "docs/examples/balloon.py").read_bytes())
    (here / "my_rig.py").write_bytes((ROOT / "docs/examples/pendulum.py").read_bytes())
    problem = ROOT / "src/robins/workbench/problems/baro-height.toml"
    (here / "my-problem.toml").write_text(problem.read_text())
    balloon = f"{here}/my_system.py:study"
    plan_campaign(here / "small-campaign", balloon, runs=2, settings=["duration=10 s"])
    list(campaign_work(here / "small-campaign"))
    (here / "gyro").mkdir()
    for name, text in firmware(rig_of("satellite").wire).items():
        (here / "gyro" / name).write_text(text)
    subprocess.run(["make", "-s", "-C", here / "gyro", "-f", "board.mk", "gyro_board"], check=True)
    for name in ("before", "after"):
        publish(Outcome(metrics={"kf": {"nees": 1.0}}, scenario="x"), here / "results" / name)
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
    "docs/examples/pendulum.py:rig": "my_rig.py:rig",
}
# A reader's own devices and autopilots, and pages that stay open until someone closes them.
NEEDS_MORE = re.compile(r"/dev/|--live|bench node|> |autopilot=")


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
    needed = ("--board", "calibrate", "bench up")  # others use what these leave behind

    def order(line):
        return next((k for k, word in enumerate(needed) if word in line), len(needed)), line

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


# Filters of campaigns, where a line names none.
CHEAP = {
    "airship/s1": ("--filters", "ekf"),
    "ins-gnss/drive": ("--filters", "ekf"),
    "transfer-alignment/s0": ("--filters", "kf"),
}


def as_short_as_can_be(words):
    """One run, two seconds, the cheapest of what is not chosen."""
    match words:
        case ["run", *_] if "--master" in words:
            return [*words, "--filters", "kf"]  # the last of an option counts
        case ["run", "my.toml", *_]:
            return [*words, "--runs", "1", "--filters", "ekf"]
        case ["run", *_]:
            return [*words, "--runs", "1"]
        case ["campaign", "show", *_]:
            return [*words, "--run", "1"]
        case ["campaign", "run", name, *more]:
            return ["campaign", "run", *CHEAP[name], "--workers", "1", name, *more, "--runs", "1"]
        case ["sweep", name, *more]:
            return ["sweep", *CHEAP[name], "--workers", "1", name, *more, "--runs", "1"]
        case ["tune", *_]:
            return [*words, "--runs", "6"]
        case ["sensitivity", name, *_]:
            cheap = ("--filter", CHEAP[name][1]) if name in CHEAP else ()
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
BEGINS = {
    ("run",): "robins.workbench.simulated.simulate",
    ("bound",): "robins.workbench.simulated.bound_of",
    ("allan",): "robins.workbench.still.deviation",
    ("design",): "robins.workbench.gains.trade_off",
    ("replay",): "robins.workbench.recorded.part",
    ("run", "--master"): "robins.workbench.recorded.part",
    ("replay", "--system"): "robins.workbench.recorded.part",
    ("campaign", "run"): "robins.workbench.workers.plan_campaign",
    ("campaign", "report"): "robins.workbench.campaigns.ready",
    ("campaign", "show"): "robins.workbench.campaigns.ready",
    ("campaign", "verify"): "robins.workbench.campaigns.ready",
    ("sweep",): "robins.workbench.sweeps.plan_campaign",
    ("tune",): "robins.workbench.tuning.choose",
    ("sensitivity",): "robins.workbench.sensitivities.simulate_points",
    ("bench", "up"): "robins.bench.run.session.Session.run",
    ("bench", "replay"): "robins.workbench.benches.kit_of",
}


def kind_of(words):
    """The command, and the option that makes it compute something else."""
    command = words[: 2 if words[0] in ("bench", "campaign") else 1]
    return (*command, *(o for o in ("--master", "--system", "--diff") if o in words))


class BeginsError(BaseException):
    """In the place of a computation; passes all who would tell it to the user."""


def begins(*_, **__):
    raise BeginsError


def reaches(words):
    """Let click parse a command line without running it."""
    words = words[: words.index(">")] if ">" in words else words
    command = app
    while isinstance(command, click.Group):
        name, *words = words
        command = command.commands[name]
    command.make_context(name, list(words))


# What a log or runs so short say to a tuning, which then refuses them, as it should.
TOO_SHORT = "the data say too little"
SHOWN = {tuple(words_of(line)): line for line in shown()}
WHOLE_LINES = {}
for words in sorted(SHOWN, key=lambda words: sum(word.startswith("--") for word in words)):
    packaged = kind_of(words) in (("run",), ("bound",)) and words[1] in PACKAGED
    if not NEEDS_MORE.search(SHOWN[words]) and not packaged:
        WHOLE_LINES[kind_of(words)] = words


def test_every_command_is_shown():
    assert {words[0] for words in SHOWN} >= set(app.commands)
    assert len(SHOWN) > 40


@pytest.fixture
def computes(folder, monkeypatch, capsys):
    """Run a command line to its end."""

    def to_the_end(words):
        monkeypatch.chdir(folder)
        status = main(as_short_as_can_be(list(words)))
        told = capsys.readouterr()
        if words[0] == "tune" and TOO_SHORT in told.err:
            assert status == Status.BAD_INPUT
            return
        assert status == Status.DONE, told.out + told.err
        if words == ("demo",):
            assert "3 of 3 claims reproduced." in told.out
            assert len(results.read("results/demo").figures) == 6
        assert "fault of robins" not in told.err

    return to_the_end


@pytest.mark.parametrize("words", SHOWN, ids=SHOWN.values())
def test_a_command_line_shown_runs(words, folder, computes, monkeypatch):
    kind = kind_of(words)
    if NEEDS_MORE.search(SHOWN[words]):
        reaches(words)
    elif kind not in BEGINS or words == WHOLE_LINES.get(kind):
        monkeypatch.setenv("CFLAGS", "-std=c99 -O0")  # programs of boards are built, not flown
        computes(words)
    else:
        monkeypatch.chdir(folder)
        monkeypatch.setattr(BEGINS[kind], begins)
        with pytest.raises(BeginsError):
            main(words)


# In the order of all of them: replays need what others leave behind.
@pytest.mark.parametrize("words", SHOWN, ids=SHOWN.values())
def test_a_command_line_shown_is_computed(words, computes):
    if not NEEDS_MORE.search(SHOWN[words]):
        computes(words)
