"""INS/GNSS on the bench: what the navigation computer says is what a replay of the log says."""

import pickle

import numpy as np
import pytest
from flights import ran_of, series
from short_drive import DRIVE

from robins.bench.rig import RigError
from robins.bench.rigs import rig_of
from robins.bench.rigs.ins_gnss import FLAGS
from robins.bench.rigs.ins_gnss.navigating import epochs_of
from robins.bench.run.setup import read
from robins.scenario import ScenarioError
from robins.systems.ins_gnss import SYSTEM
from robins.systems.streaming import Flag
from robins.workbench import replay as replay_log

RIG = rig_of("ins-gnss")
PLACE = 'velocity_sigma = "0.05 m/s"\n'
ARM = 'lever_arm = ["1 m", "0 m", "-1 m"]\n'
OUTAGE = '[outages]\nlength = "3 s"\nfirst = "9 s"\ngap = "100 s"\nlast = "1 s"\n'


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    path = tmp_path_factory.mktemp("drive") / "short.toml"
    path.write_text('system = "ins-gnss"\n' + DRIVE.replace(PLACE, PLACE + ARM) + OUTAGE)
    return str(path)


@pytest.fixture(scope="module")
def run(scenario):
    flight = read(scenario)
    flight = flight._replace(setup=flight.setup.model_copy(update={"filter": "ekf"}))
    config = RIG.prepare(flight.setup, flight.given)
    steps = flight.timing.steps
    return flight, config, steps, series(RIG, config, steps)[0]


def judged(flight, config, of):
    return RIG.judge(flight, ran_of(of, config))


def as_replayed(config):
    """Figures and epochs of a replay of what the sensors say, by the code of the replay."""
    outcome = SYSTEM.replay(config.dataset, config.given, ("ekf",))
    return outcome.metrics["ekf"], outcome.solution


def test_its_figures_are_those_of_a_replay_with_outages(run):
    flight, config, _, of = run
    wanted, solution = as_replayed(config)
    said = judged(flight, config, of).metrics
    # the last fixes are waited for
    assert wanted["outage_fixes"] == said["outage_fixes"] == 6
    assert 0 <= wanted["aided_fixes"] - said["aided_fixes"] <= 2
    for name in ("outage_horizontal_rms_m", "outage_horizontal_max_m", "outage_vertical_rms_m"):
        np.testing.assert_allclose(said[name], wanted[name], rtol=0.0, atol=5e-9)
    rows = epochs_of(of)
    told_s = (of["epoch.time"][rows] - int(config.dataset.imu.time_ns[0])) * 1e-9
    at = np.searchsorted(solution["time"].values, told_s - 1e-6)
    np.testing.assert_allclose(solution["time"].values[at], told_s, atol=1e-6)
    assert len(at) >= solution.sizes["time"] - 3
    q_nb = np.asarray(solution["q_nb"].values)[0]
    np.testing.assert_allclose(of["epoch.q_nb"][rows], q_nb[at], atol=1e-12)


def test_it_is_right_about_the_drive(run):
    flight, config, _, of = run
    said = judged(flight, config, of)
    assert said.metrics["heading_rms_deg"] < 3.0
    error, sigma = (said.arrays[f"{what}_velocity"].values[0] for what in ("error", "sigma"))
    known = np.all(np.isfinite(error), axis=1)
    assert np.mean(known) > 0.5
    assert 0.2 < np.sqrt(np.mean((error[known] / sigma[known]) ** 2)) < 2.0
    assert said.counts["steps_starting"] == int(np.sum(of["state.flags"] & 1))
    assert said.counts["steps_refused"] == 6  # each fix of the outage has no number
    view = RIG.shown
    named = [signal.name for signal in view.signals(flight.given)]
    values = dict(zip(named, view.sample(of, config, 0, len(of.time_s) - 1), strict=True))
    truth = config.dataset.truth
    north = 6.37e6 * (truth.lat_rad[-1] - truth.lat_rad[0])
    assert abs(values["position from the start north"] - north) < 5.0


def test_the_computer_goes_on_from_its_memory_to_the_bit(run):
    _, config, steps, whole = run
    half = steps // 2
    _, states = series(RIG, config, half)
    again, _ = series(RIG, config, steps, begin=half, states=pickle.loads(pickle.dumps(states)))
    for name in ("state.q_nb", "state.v_n", "state.lat", "epoch.q_nb"):
        np.testing.assert_array_equal(again[name][half:], whole[name][half:])


def test_flags_are_those_of_the_live_object():
    assert [(flag.name or "").lower() for flag in Flag] == list(FLAGS)


def test_without_samples_it_says_what_to_give():
    flight = read("ins-gnss/walk")
    with pytest.raises(RigError, match=r"nobody speaks as gnss and imu: .* no log and no drive"):
        RIG.prepare(flight.setup, flight.given)
    with pytest.raises(ScenarioError, match="imu_rate"):
        read("ins-gnss/walk", ("imu_rate=0 Hz",))
    boards = read("ins-gnss/walk", ("imu_rate=20 Hz", "duration=5 s"))
    setup = boards.setup.model_copy(update={"ports": {"imu": "a", "gnss": "b"}, "filter": "ekf"})
    config = RIG.prepare(setup, boards.given)
    assert (config.rates_hz, boards.timing.steps) == ((20.0, 1.0), 100)
    silent, _ = series(RIG, config, 3)
    assert np.isnan(silent["state.lat"]).all()
    assert judged(boards, config, silent).metrics == {}


@pytest.mark.parametrize("machine", ["jax", "c"])
def test_the_walk_has_the_figures_of_its_replay(data_dir, machine):
    paths = [data_dir / f"gnssimu_walk_{part}.xz" for part in ("imu.csv", "gnss.pos")]
    if not all(path.exists() for path in paths):
        pytest.skip("the walk is not in the folder of real logs")
    files = ", ".join(f'"{path}"' for path in paths)
    flight = read("ins-gnss/walk", (f"log=[{files}]",))
    setup = flight.setup.model_copy(update={"filter": "ekf", "machine": machine})
    config = RIG.prepare(setup, flight.given)
    configuration = SYSTEM.replay_default.parent / "walk.toml"
    whole, off = machine == "c", {"jax": 1e-12, "c": 1e-9}[machine]
    steps = flight.timing.steps if whole else 150 * 40
    of, _ = series(RIG, config, steps)
    said = judged(flight, config, of).metrics
    outcome = replay_log([*paths, configuration], filters=("ekf",))
    if whole:
        wanted = outcome.metrics["ekf"]
        for name in ("outage_horizontal_rms_m", "outage_horizontal_max_m", "aided_vertical_rms_m"):
            np.testing.assert_allclose(said[name], wanted[name], rtol=0.0, atol=1e-6)
    solution = outcome.solution
    rows = epochs_of(of)
    told_s = (of["epoch.time"][rows] - int(config.dataset.imu.time_ns[0])) * 1e-9
    at = np.searchsorted(solution["time"].values, told_s - 1e-6)
    np.testing.assert_allclose(solution["time"].values[at], told_s, atol=1e-6)
    assert np.sum(np.asarray(solution["outage"].values)[at]) >= 40  # epochs without fixes
    q_nb = np.asarray(solution["q_nb"].values)[0]
    np.testing.assert_allclose(of["epoch.q_nb"][rows], q_nb[at], atol=off)
    v_n = np.asarray(solution["estimate_velocity"].values)[0]
    np.testing.assert_allclose(of["epoch.v_n"][rows], v_n[at], atol=off)
