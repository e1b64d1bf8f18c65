"""Laws of every rig: over its lines it flies as its parts do in a row, and its record replays.

The parts are on threads; that processes change no bit is shown with the satellite.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
from flights import series
from short_drive import DRIVE
from sketching import sketch
from stations import on_threads

from robins.bench.evaluation import RunResult
from robins.bench.recording import read_record
from robins.bench.rig import Rig
from robins.bench.run import outcome
from robins.bench.run.setup import LoadedRun
from robins.bench.run.telemetry import difference
from robins.logs import load_dataset
from robins.results import Outcome
from robins.results import read as read_result
from robins.workbench import bench_replay, bench_up, publish

SPANS = [f"{of}.{edge}" for of in ("counted", "wind.span") for edge in ("begin=20 s", "end=60 s")]
PLACE = 'velocity_sigma = "0.05 m/s"\n'
ARM = 'lever_arm = ["1 m", "0 m", "-1 m"]\n'
OUTAGE = '[outages]\nlength = "3 s"\nfirst = "9 s"\ngap = "100 s"\nlast = "1 s"\n'


class Row(NamedTuple):
    """A rig, and what is asked of it."""

    scenario: str  # of the bench
    arrays: set[str]  # in its result, among others
    replays: tuple[str, ...]  # parts
    off: float = 0.0  # at most, from the run inside one program
    faulty_from: int | None = None  # step
    deaths: int = 0


TABLE = {
    "airship": Row(
        f'bench = "airship"\nflies = "airship/s1"\nfilter = "ekf"\nseconds = "20 s"\n'
        f"set = {['duration=60 s', *SPANS]}\n",
        {"error_position", "sigma_position"},
        ("navigation",),
        off=1e-12,
    ),
    "ins-gnss": Row(
        'bench = "ins-gnss"\nflies = "{folder}/drive.toml"\nfilter = "ekf"\nseconds = "13 s"\n'
        '[[faults]]\nkind = "shifted"\nshift = "50 m"\nbegin = "12 s"\n',
        {"lat_rad", "error_velocity"},
        ("navigation",),
        faulty_from=600,
    ),
    "laboratory": Row(
        'bench = "laboratory"\nseconds = "10 s"\nset = ["duration=30 s", "counted_from=10 s"]\n',
        {"error_attitude"},
        ("star", "kinematics"),
    ),
    "multirotor": Row(
        'bench = "multirotor"\nseconds = "1.6 s"\non_death = "restart"\nseed = 5\n'
        'set = ["duration=4 s", "height=1 m"]\n'
        '[[faults]]\nkind = "killed"\nlink = "autopilot"\nbegin = "1.2 s"\n',
        {"error_position", "value_motion_p_n"},
        ("imu", "autopilot"),
        deaths=1,
    ),
}


class Done(NamedTuple):
    """A flight over lines."""

    rig: Rig
    result: RunResult
    inside: Any
    outcome: Outcome
    folder: Any


@pytest.fixture(scope="module")
def fly(tmp_path_factory):
    @cache
    def now(name: str) -> Done:
        folder, seen = tmp_path_factory.mktemp(name), list[tuple[LoadedRun, RunResult, Any]]()
        compare = outcome.in_one_program
        drive = DRIVE.replace(PLACE, PLACE + ARM)
        (folder / "drive.toml").write_text(f'system = "ins-gnss"\n{drive}{OUTAGE}')
        scenario = folder / "bench.toml"
        scenario.write_text(TABLE[name].scenario.replace("{folder}", str(folder)))

        def see(flight, result):
            seen.append((flight, result, compare(flight, result)))
            return seen[0][-1]

        with pytest.MonkeyPatch.context() as patch:
            on_threads(patch)
            sketch(patch)
            patch.setattr(outcome, "in_one_program", see)
            done = bench_up(str(scenario), record=folder / "record.mcap")
            published = publish(done, folder / "out").path
        flight, result, inside = seen[0]
        return Done(flight.rig, result, inside, done, published)

    return now


@pytest.mark.parametrize("name", TABLE)
def test_it_flies_over_its_lines_and_its_result_can_be_read(fly, name):
    flight, row = fly(name), TABLE[name]
    assert (flight.outcome.failure, flight.result.deaths) == ("", row.deaths)
    assert max(h.wrong + h.lost + h.late + h.refused for h in flight.result.health.values()) == 0
    (figures,) = flight.outcome.metrics.values()
    assert figures["cycles_per_s"] > 0.0
    assert len(figures) > 2
    assert np.isfinite([figure for figure in figures.values() if figure is not None]).all()
    assert row.arrays <= set(read_result(flight.folder).solution)


@pytest.mark.parametrize("name", TABLE)
def test_it_flies_as_its_parts_do_in_a_row_and_inside_one_program(fly, name):
    flight, row = fly(name), TABLE[name]
    wanted = series(flight.rig, flight.result.config, flight.result.steps)[0]
    assert list(wanted) == list(flight.result.series)
    sound = slice(0, row.faulty_from)
    for field, values in flight.result.series.items():
        np.testing.assert_array_equal(values[sound], wanted[field][sound], err_msg=field)
    faulty = (not np.array_equal(x, wanted[of], True) for of, x in flight.result.series.items())
    assert any(faulty) == (row.faulty_from is not None)
    assert (flight.inside is None) == (type(flight.rig).inside is Rig.inside)
    if flight.inside is not None:
        off = difference(flight.result.series, flight.inside)
        assert off <= row.off
        same = "bit for bit the same as" if off == 0.0 else f"up to {off:.3g} off"
        assert (
            f"Over the wire the run was {same} the run inside one program." in flight.outcome.notes
        )


@pytest.mark.parametrize("name", TABLE)
def test_its_record_is_replayed(fly, name, monkeypatch):
    flight = fly(name)
    record = flight.folder / "record.mcap"
    header = read_record(record).header
    assert (header["rig"], header["steps"]) == (flight.rig.name, flight.result.steps)
    on_threads(monkeypatch)
    for part in TABLE[name].replays:
        found = bench_replay(record, node=part)
        assert (found.same, found.complete) == (True, True)
        assert found.frames >= 20


def test_the_record_of_ins_gnss_is_a_log_as_ros_has_them(fly):
    flight = fly("ins-gnss")
    heard, dataset = load_dataset([flight.folder / "record.mcap"]), flight.result.config.dataset
    steps = flight.result.steps
    np.testing.assert_array_equal(heard.imu.time_ns, dataset.imu.time_ns[:steps])
    np.testing.assert_allclose(heard.imu.gyro, dataset.imu.gyro[:steps], rtol=1e-15)
    shown = np.isfinite(heard.gnss.lat_rad)
    at = np.searchsorted(dataset.gnss.time_ns, heard.gnss.time_ns)
    at_s = 1e-9 * heard.gnss.time_ns
    np.testing.assert_array_equal(~shown, (at_s >= 9.5) & (at_s < 12.5))
    # what was injected came after
    wanted = dataset.gnss.lat_rad[at]
    np.testing.assert_allclose(heard.gnss.lat_rad[shown], wanted[shown], rtol=1e-15)
