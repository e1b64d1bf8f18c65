"""The airship on the bench: instruments that fail, and what is made of a flight."""

import numpy as np
import pytest
from flights import ran_of, series

from robins.bench.broker.faults import LinkFault
from robins.bench.rigs import rig_of
from robins.bench.run.setup import read

RIG = rig_of("airship")
SPANS = [f"{of}.{edge}" for of in ("counted", "wind.span") for edge in ("begin=20 s", "end=60 s")]
SETTINGS = ("duration=60 s", *SPANS)


@pytest.fixture(scope="module")
def run():
    flight = read("airship/s1", SETTINGS)
    flight = flight._replace(setup=flight.setup.model_copy(update={"filter": "cukf-soft"}))
    return flight, RIG.prepare(flight.setup, flight.given)


def judged(flight, config, of):
    return RIG.judge(flight, ran_of(of, config))


def test_it_is_right_about_the_flight(run):
    flight, config = run
    assert flight.timing.steps == len(config.u.dt) == 60
    said = judged(flight, config, series(RIG, config, 60)[0])
    error, sigma = (said.arrays[f"{what}_velocity"].values[0] for what in ("error", "sigma"))
    assert 0.1 < np.sqrt(np.mean((error / sigma) ** 2)) < 3.0
    assert 0.0 < said.metrics["attitude_rms_arcsec"] < 200.0
    assert said.counts["steps_without_increment"] == 0


def test_what_does_not_come_is_missing(run):
    flight, config = run
    whole = series(RIG, config, 40)[0]
    blind = series(RIG, config, 40, lambda name, k: name == "attitude" and 20 <= k < 30)[0]
    place = slice(6, 9)
    np.testing.assert_array_equal(blind["state.sigma"][:20], whole["state.sigma"][:20])
    assert np.all(blind["state.sigma"][29, :3] > 1.1 * whole["state.sigma"][29, :3])
    nothing = series(
        RIG, config, 40, lambda name, k: name in ("fix", "attitude", "wind") and k >= 20
    )[0]
    assert np.all(nothing["state.sigma"][39, place] > whole["state.sigma"][39, place])
    dark = series(RIG, config, 40, lambda name, k: name == "increment" and k == 30)[0]
    assert judged(flight, config, dark).counts["steps_without_increment"] == 1
    assert np.isfinite(dark["state.lat"]).all()


def test_filters_that_take_more_than_the_wire_carries_are_not_offered():
    offered = RIG.filters()
    assert offered[0] == "ukf"
    assert {"ekf", "raukf", "cukf-soft"} <= set(offered)
    assert not {"cukf-hard", "product", "adaptive"} & set(offered)


def test_faults_of_its_instruments():
    fault: type[LinkFault] = RIG.fault
    said = RIG.device_faults()[0]
    place = {"place": np.array([1.0, 2.0]), "heading": 0.1, "alt": 3.0}
    off = said["shifted"].act(place, fault(kind="shifted", begin=0.0, shift=50.0), 0)
    np.testing.assert_array_equal(off["place"], [51.0, 2.0])
    assert off["heading"] == 0.1
    assert np.isnan(said["blind"].act({"euler": np.zeros(3)}, None, 0)["euler"]).all()
