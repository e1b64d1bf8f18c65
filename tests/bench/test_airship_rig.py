"""The airship on the bench: its filters over lines are those of the study."""

from types import SimpleNamespace

import numpy as np
import pytest

from robins.bench.broker.faults import LinkFault
from robins.bench.rigs import rig_of
from robins.bench.run.setup import read
from robins.bench.run.telemetry import Telemetry, difference
from robins.results import read as read_result
from robins.workbench import bench_replay, bench_up, publish

RIG = rig_of("airship")
SPANS = [f"{of}.{edge}" for of in ("counted", "wind.span") for edge in ("begin=20 s", "end=60 s")]
SETTINGS = ("duration=60 s", *SPANS)


def flown(kit, steps, lost=lambda name, k: False):
    """The parts in their order, without lines; what is lost does not come."""
    parts = [RIG.build[name](kit) for name in RIG.parts]
    states = {part.name: part.begin() for part in parts}
    telemetry = Telemetry(RIG, steps, kit.step_ns)
    for k in range(steps):
        heard = {}
        for part in parts:
            inputs = {name: heard.get(name) for name in part.takes}
            states[part.name], sent = part.act(states[part.name], k, inputs)
            for name, values in sent:
                payload = RIG.wire.encode(name, values)
                assert RIG.wire.unsound(name, payload) is None
                if not lost(name, k):
                    heard[name] = RIG.wire.decode(name, payload)
                telemetry.observe(name, (k + 1) * kit.step_ns, payload)
    return telemetry.flown


@pytest.fixture(scope="module")
def run():
    flight = read("airship/s1", SETTINGS)
    flight = flight._replace(setup=flight.setup.model_copy(update={"filter": "cukf-soft"}))
    return flight, RIG.prepare(flight.setup, flight.given)


def judged(flight, kit, of):
    return RIG.judge(flight, SimpleNamespace(flown=of, kit=kit, steps=len(of.time_s)))


def test_it_is_the_run_inside_one_program(run):
    flight, kit = run
    assert flight.timing.steps == len(kit.u.dt) == 60
    of = flown(kit, 60)
    assert difference(of, RIG.inside(kit)) < 1e-9
    said = judged(flight, kit, of)
    error, sigma = (said.arrays[f"{what}_velocity"].values[0] for what in ("error", "sigma"))
    assert 0.1 < np.sqrt(np.mean((error / sigma) ** 2)) < 3.0
    assert said.metrics["attitude_rms_arcsec"] < 200.0
    assert said.counts["steps_without_increment"] == 0


def test_what_does_not_come_is_missing(run):
    flight, kit = run
    whole = flown(kit, 40)
    blind = flown(kit, 40, lambda name, k: name == "attitude" and 20 <= k < 30)
    place = slice(6, 9)
    np.testing.assert_array_equal(blind["state.sigma"][:20], whole["state.sigma"][:20])
    assert np.all(blind["state.sigma"][29, :3] > 1.1 * whole["state.sigma"][29, :3])
    nothing = flown(kit, 40, lambda name, k: name in ("fix", "attitude", "wind") and k >= 20)
    assert np.all(nothing["state.sigma"][39, place] > whole["state.sigma"][39, place])
    dark = flown(kit, 40, lambda name, k: name == "increment" and k == 30)
    assert judged(flight, kit, dark).counts["steps_without_increment"] == 1
    assert np.isfinite(dark["state.lat"]).all()


def test_filters_that_take_more_than_the_wire_carries_are_not_offered():
    offered = RIG.filters()
    assert offered[0] == "ukf"
    assert {"ekf", "raukf", "cukf-soft"} <= set(offered)
    assert not {"cukf-hard", "product", "adaptive"} & set(offered)


def test_faults_of_its_instruments():
    fault: type[LinkFault] = RIG.fault
    said = RIG.said()[0]
    place = {"place": np.array([1.0, 2.0]), "heading": 0.1, "alt": 3.0}
    off = said["shifted"].act(place, fault(kind="shifted", begin=0.0, shift=50.0), 0)
    np.testing.assert_array_equal(off["place"], [51.0, 2.0])
    assert off["heading"] == 0.1
    assert np.isnan(said["blind"].act({"euler": np.zeros(3)}, None, 0)["euler"]).all()


def test_it_flies_by_processes_and_its_record_is_heard_again(tmp_path):
    outcome = bench_up(
        "airship/s1", settings=SETTINGS, filter="ekf", seconds=20.0, record=tmp_path / "r.mcap"
    )
    folder = publish(outcome, tmp_path / "out").path
    assert outcome.failure == ""
    assert outcome.metrics["ekf"]["attitude_rms_arcsec"] > 0.0
    assert {"error_position", "sigma_position"} <= set(read_result(folder).solution)
    assert bench_replay(folder / "record.mcap", node="navigation").same
