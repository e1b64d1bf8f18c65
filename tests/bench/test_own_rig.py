"""A vehicle that the bench has never seen, from a file of the user's."""

import ast
import json
import re
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from flights import ran_of
from mcap.reader import make_reader
from sketching import sketch

from robins import bench
from robins.bench.recording import read_record
from robins.bench.rig import LoadedRun, Rig, RigError
from robins.bench.rigs import RIGS, UnknownRig, rig_of
from robins.bench.run.session import Session
from robins.bench.run.setup import config_of, read, setup_of
from robins.bench.run.telemetry import Telemetry
from robins.report import figures
from robins.results import read as read_result
from robins.scenario import ScenarioError
from robins.systems import trust
from robins.workbench import bench_replay, bench_up, publish

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "pendulum.py"
RIG = f"{EXAMPLE}:rig"


def test_it_is_as_short_as_promised():
    assert len(EXAMPLE.read_text("utf-8").splitlines()) <= 150


@pytest.fixture(scope="module")
def series(tmp_path_factory):
    """A run by two processes, with a page's eye on it."""
    where = tmp_path_factory.mktemp("pendulum")
    outcome = bench_up(RIG, record=where / "record.mcap", seconds=6.0)
    with pytest.MonkeyPatch.context() as patch:
        sketch(patch)
        return outcome, publish(outcome, where / "out").path


def test_it_flies_by_the_document_alone(series):
    outcome, folder = series
    told = outcome.metrics["pendulum"]
    assert (outcome.failure, outcome.scenario) == ("", "bench/pendulum:rig")
    # the camera's noise is 1 deg; a filter with the right model is several times better
    assert 0.0 < told["angle_rms_deg"] < 0.5
    solution = read_result(folder).solution
    error, sigma = solution["error_angle"].values[0], solution["sigma_angle"].values[0]
    assert error.shape == (300, 1)
    assert 0.3 < np.sqrt(np.mean((error / sigma)[100:] ** 2)) < 2.0
    drawn = [draw() for draw in figures.drawings(solution, outcome.summary)]
    assert any(picture and "angle" in picture.title for picture in drawn)


def test_a_swing_by_hand():
    """The angle of the pendulum against its period, 2 pi sqrt(l/g) / agm(1, cos(a/2))."""
    flight = read(RIG, ("start=30 deg", "duration=10 s", "step=2 ms"))
    of = flight.rig
    part = of.part("pendulum", of.prepare(flight.setup, flight.given))
    state, angles = part.begin(), []
    for k in range(5000):
        state, ((_, said),) = part.act(state, k, {})
        angles.append(said["angle"])
    angles = np.array(angles)
    up = np.flatnonzero((angles[:-1] < 0.0) & (angles[1:] >= 0.0))
    through = up + angles[up] / (angles[up] - angles[up + 1])
    a, b = 1.0, np.cos(np.radians(15.0))
    for _ in range(5):
        a, b = 0.5 * (a + b), np.sqrt(a * b)
    period = 2.0 * np.pi * np.sqrt(1.0 / 9.81) / a
    np.testing.assert_allclose(np.mean(np.diff(through)) * 2e-3, period, rtol=1e-5)


def test_viewers_decode_every_message_of_its_record(series):
    _, folder = series
    with (folder / "record.mcap").open("rb") as file:
        found = [
            (channel.topic, json.loads(one.data))
            for schema, channel, one in make_reader(file).iter_messages()
            if schema.encoding == "jsonschema" and channel.topic != "/events"
        ]
    assert Counter(topic for topic, _ in found) == {
        "/pendulum/swing": 300, "/camera/estimate": 300
    }  # fmt: skip
    angles = [said["angle"] for topic, said in found if topic == "/camera/estimate"]
    estimate = read_result(folder).solution["error_angle"].values[0, :, 0]
    true = [said["angle"] for topic, said in found if topic == "/pendulum/swing"]
    np.testing.assert_allclose(np.degrees(np.subtract(true, angles)), estimate, atol=1e-12)


@pytest.mark.parametrize("name", [*RIGS, RIG])
def test_the_page_of_any_rig_offers_faults_that_it_has(name):
    """An own rig offers the faults of every line; each can be injected as it stands."""
    rig = rig_of(name)
    made = [rig.fault.model_validate({**one["fault"], "begin": 1.0}) for one in rig.shown.offered]
    labels = [one["label"] for one in rig.shown.offered]
    assert len(set(labels)) == len(labels) > 0
    if name in ("airship", "multirotor", RIG):  # they offer none themselves
        lines = {(one.kind, one.link) for one in made}
        assert lines >= {(k, p) for k in ("silent", "loss", "bit errors") for p in rig.parts}
        needless = {kind for kind, one in rig.table.device_faults.items() if not one.needs}
        assert needless == {one.kind for one in made} - {"silent", "loss", "bit errors"}


def test_its_record_is_heard_again(series):
    _, folder = series
    header = read_record(folder / "record.mcap").header
    assert header["rig"] == f"{EXAMPLE.resolve()}:rig"
    assert bench_replay(folder / "record.mcap", node="camera").same


def test_faults_of_the_line_and_settings_are_of_any_rig(tmp_path):
    scenario = tmp_path / "lossy.toml"
    scenario.write_text(
        f'bench = "{RIG}"\nseconds = "2 s"\nset = ["length=2 m"]\n'
        '[[faults]]\nkind = "loss"\nlink = "pendulum"\nbegin = "1 s"\n'
    )
    trust.confirm(EXAMPLE)
    flight = read(str(scenario))
    assert flight.given.length == 2.0
    assert flight.setup.faults[0].link == "pendulum"
    with pytest.raises(ScenarioError, match="there is no part 'gyro', only pendulum, camera"):
        read(str(scenario), ("faults.0.link=gyro",))
    with pytest.raises(ScenarioError, match="filter: the pendulum has none to choose: leave it"):
        read(str(scenario), ("filter=kf",))
    with pytest.raises(ScenarioError, match="lengt"):
        Session(read(RIG, ("lengt=2 m",)))


def test_all_numbers_are_drawn_where_a_rig_says_nothing():
    rig = rig_of(RIG)
    view = rig.view()
    names = [signal.name for signal in view.signals(None)]
    assert names[:3] == ["swing angle", "swing rate", "estimate angle"]
    telemetry = Telemetry(rig, 3, 10)
    telemetry.observe("swing", 20, rig.wire.encode("swing", {"angle": 0.5, "rate": -1.0}))
    assert view.sample(telemetry.series, None, 0, 2)[:2] == [0.5, -1.0]
    assert np.isnan(view.sample(telemetry.series, None, 2, 2)).all()
    judged = Rig.judge(rig, None, ran_of(telemetry.series))
    assert {"value_swing_angle", "value_estimate_sigma"} <= set(judged.arrays)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sends": {"pendulum": (), "camera": ("estimate",)}}, "each message is sent by one part"),
        ({"takes": {"pendulum": ()}}, "takes is of pendulum, the wire has pendulum, camera"),
        ({"takes": {"pendulum": (), "camera": ("swung",)}}, "there is no message 'swung'"),
        ({"truth": "motion"}, "there is no message 'motion', only estimate, swing"),
        ({"build": {"lamp": "lamps:lamp"}}, "build is of lamp, the wire has pendulum, camera"),
        ({"truht": "swing"}, "a rig has no 'truht'; did you mean 'truth'?"),
    ],
)
def test_a_rig_that_contradicts_itself_is_refused(change, message):
    with pytest.raises(RigError, match=re.escape(message)):
        rig_of(RIG).varied(**change)


def test_a_rig_is_given_by_its_class_or_in_one_call():
    """As rigs were written before they were classes; a class may leave nothing out."""
    of = rig_of(RIG)
    tables = {name: getattr(of, name) for name in ("wire", "sends", "takes", "prepare", "judge")}
    build = {name: partial(of.part, name) for name in of.parts}
    made = Rig(name="pendulum", build=build, parameters=lambda: of.given, **tables)
    config = config_of(LoadedRun("", made, setup_of(made)(), made.given(), ""))
    assert made.part("camera", config).takes == {"swing": 0}
    with pytest.raises(RigError, match="the rig Rig has no parameters and no prepare; define it"):
        Rig(name="pendulum", **{name: tables[name] for name in ("wire", "sends", "takes")})
    with pytest.raises(RigError, match="no function makes the part 'camera'; define one of its"):
        made.varied(build={"pendulum": build["pendulum"]})
    with pytest.raises(RigError, match=r"there is no 'camera' in the module robins\.bench\.rig"):
        made.varied(build={}, code="robins.bench.rig").part("camera", config)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("satelite", r"no rig 'satelite'; did you mean 'satellite'\?"),
        (f"{EXAMPLE}:rigg", r"no rig 'rigg' in it; did you mean 'rig'\?"),
        ("none.py:rig", "there is no such file"),
    ],
)
def test_what_is_no_rig_is_told(name, message):
    with pytest.raises(Exception, match=message) as caught:
        rig_of(name)
    assert isinstance(caught.value, UnknownRig | ValueError)


BENCH = Path(bench.__file__).parent
OF_A_VEHICLE = re.compile(r"\b(gyro|star|wheels?|satellite|adm|acm)\b")


@pytest.mark.parametrize(
    "room", ["wire", "broker", "recording", "live", "run", "parts", "rig.py", "evaluation.py"]
)
def test_the_bench_names_no_vehicle(room):
    """Neither names nor texts of the program do; its documentation gives examples."""
    for path in sorted((BENCH / room).glob("*.py")) if "." not in room else [BENCH / room]:
        tree = ast.parse(path.read_text("utf-8"))
        documented = {id(n.value) for n in ast.walk(tree) if isinstance(n, ast.Expr)}
        for n in ast.walk(tree):
            said = next((str(v) for k in ("id", "attr", "arg") if (v := getattr(n, k, None))), "")
            if isinstance(n, ast.Constant) and isinstance(n.value, str) and id(n) not in documented:
                said = n.value
            named = OF_A_VEHICLE.search(said.replace("_", " "))
            assert not named, f"{path.name}, line {getattr(n, 'lineno', 0)}: {said}"
