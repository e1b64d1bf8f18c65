"""The filter of INS/GNSS, exported as C with its loop, as the navigation computer of the bench."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from flights import series
from short_drive import DRIVE
from stations import on_threads, parts
from test_firmware import SANITISERS, Board, sanitised

from robins.bench.ports.port import open_pair
from robins.bench.recording import read_record
from robins.bench.rigs import rig_of
from robins.bench.rigs.ins_gnss import WIRE
from robins.bench.rigs.ins_gnss.navigating import epochs_of
from robins.bench.run.setup import changed, read
from robins.bench.wire import Receiver
from robins.cli import main
from robins.errors import RobinsError
from robins.systems import trust
from robins.systems.ins_gnss import SYSTEM
from robins.systems.streaming import Flag
from robins.workbench import bench_replay, bench_up
from robins.workbench import replay as replay_log
from robins.workbench.errors import InputError
from robins.workbench.export import export_filter

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs a C compiler, gcc")
RIG = rig_of("ins-gnss")
PLACE = 'velocity_sigma = "0.05 m/s"\n'
ARM = 'lever_arm = ["1 m", "0 m", "-1 m"]\nvelocity_window = "0.2 s"\n'
TURNED = 'gyro_bias_walk = "0.0005 deg/s/sqrt(s)"\n'
AXES = 'orientation = ["0.1 deg", "0 deg", "-0.2 deg"]\n'
TURN = 'do = "turn"\nangle = "70 deg"\nrate = "14 deg/s"\n'
FASTER = 'do = "accelerate"\nseconds = "4 s"\nspeed = "14 m/s"\n'
# from 15 to 18 s; it stops at 16 s
OUTAGE = '[outages]\nlength = "3.2 s"\nfirst = "14.4 s"\ngap = "100 s"\nlast = "0.1 s"\n'
STRICT = "-std=c99 -O0 -Wall -Wextra -Werror -pedantic -Wno-unused-function"
FIELDS = ("q_nb", "v_n", "lat", "lon", "alt", "sigma")


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    path = tmp_path_factory.mktemp("drive") / "short.toml"
    text = DRIVE.replace(PLACE, PLACE + ARM).replace(TURNED, TURNED + AXES)
    text = text.replace(TURN, FASTER) + OUTAGE + "[update]\ngate = 0.0\n"
    path.write_text('system = "ins-gnss"\n' + text)
    return str(path)


@pytest.fixture(scope="module")
def program(scenario, tmp_path_factory):
    """The part as `robins export --board` builds it; accesses to memory checked where they can."""
    folder = tmp_path_factory.mktemp("navigation")
    extra = SANITISERS if sanitised(folder) else []
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CFLAGS", " ".join([STRICT, *extra]))
        made = export_filter(scenario, folder / "c", filter_name="ekf", board=True)
    assert made.program is not None
    return made.program


@pytest.fixture(scope="module")
def config(scenario):
    flight = changed(read(scenario), {"filter": "ekf"})
    return RIG.prepare(flight.setup, flight.given)


def sensed(config, steps):
    """Inputs of the part in each step, by message."""
    parts, found = [RIG.part(name, config) for name in ("imu", "gnss")], []
    states = [part.begin() for part in parts]
    for k in range(steps):
        found.append({})
        for i, part in enumerate(parts):
            states[i], said = part.act(states[i], k, {})
            found[-1].update(said)
    return found


def of_the_part(config, reached):
    """Answers of the part in Python, by step."""
    part, told = parts(config, RIG)["navigation"], []
    state = part.begin()
    for k, inputs in enumerate(reached):
        heard = {
            name: WIRE.decode(name, WIRE.encode(name, inputs[name])) if name in inputs else None
            for name in part.takes
        }
        state, said = part.act(state, k, heard)
        told.append({name: WIRE.decode(name, WIRE.encode(name, v)) for name, v in said})
    return told


class Navigator(Board):
    """The bench's end of the line to the program."""

    def send(self, name, time_ns=0, **values):
        self.put(WIRE.message(name).number, WIRE.encode(name, values), time_ns)


def of_the_board(program, config, reached, runs=1):
    """Answers of the program, by step; in the last of some runs."""
    told = []
    with open_pair() as pair:
        board = Navigator(program, pair)
        try:
            for run in range(5, 5 + runs):
                board.begin(run)
                told = [
                    asked(board, k, (k + 1) * config.step_ns, row) for k, row in enumerate(reached)
                ]
                board.send("stop")
        finally:
            board.process.kill()
            _, said = board.process.communicate()
    assert "runtime error" not in said, said
    return told


def asked(board, k, time_ns, inputs):
    for name, values in inputs.items():
        board.send(name, time_ns, **values)
    board.send("tick", time_ns, step=k)
    said = {}
    while "done" not in said:
        frame = board.frame()
        assert frame is not None, f"no answer in step {k}"
        name = WIRE.message(frame.header.type).name
        assert (name not in said, frame.header.time_ns) == (True, time_ns)
        said[name] = WIRE.decode(name, frame.payload)
    del said["done"]
    return said


def compare(told, wanted, name):
    """The same messages in the same steps, and numbers within 1e-9 of their scale.

    That of the position is a kilometre, of attitudes 1 rad, of all else the largest number.
    """
    assert [k for k, row in enumerate(told) if name in row] == [
        k for k, row in enumerate(wanted) if name in row
    ]
    got, want = ([row[name] for row in rows if name in row] for rows in (told, wanted))
    for field in ("time", "flags") if name == "state" else ("time",):
        assert [row[field] for row in got] == [row[field] for row in want], field
    worst = {}
    for field in FIELDS:
        a, b = (np.array([row[field] for row in rows], float) for rows in (got, want))
        np.testing.assert_array_equal(np.isnan(a), np.isnan(b))
        known = np.isfinite(b)
        scale = {"q_nb": 1.0, "lat": 1e3 / 6.4e6, "lon": 1e3 / 6.4e6, "alt": 1e3}.get(field)
        if field == "sigma":
            worst[field] = float(np.max(np.abs(a[known] / b[known] - 1.0)))
        else:
            scale = scale or float(np.max(np.abs(b[known])))
            worst[field] = float(np.max(np.abs(a[known] - b[known]))) / scale
    assert max(worst.values()) < 1e-9, worst
    assert known.sum() > 0
    return worst


def meddled(reached):
    """Inputs with faults: lost, repeated, late and impossible samples and fixes, and a gap."""
    rows = [dict(row) for row in reached]
    at = [k for k, row in enumerate(rows) if "fix" in row]
    begun = next(k for k in at if k > 300)
    after = [k for k in at if begun + 20 < k < 700]
    one, two, three, four, five, six, seven = after[::2][:7]
    rows[one + 9]["fix"] = rows[one].pop("fix")  # late
    rows[two + 88]["fix"] = rows[two].pop("fix")  # later than the longest delay
    rows[three + 2]["fix"] = rows[three]["fix"]  # again
    rows[four]["fix"] = {**rows[four]["fix"], "quality": 5}
    nothing = np.full(3, np.nan)
    rows[five]["fix"] = {**rows[five]["fix"], "v_n": nothing, "sigma": np.array([0.0, 1.0, 2.0])}
    blind = {"lat": np.nan, "lon": np.nan, "alt": np.nan, "v_n": nothing}
    rows[six]["fix"] = {**rows[six]["fix"], **blind}
    ahead = rows[seven]["fix"]["time"] + 11_000_000_000
    rows[seven + 4]["fix"] = {**rows[seven]["fix"], "time": ahead}
    del rows[begun + 40]["sample"]
    for k in range(begun + 95, begun + 110):
        rows[k].pop("sample")
    wrong = rows[begun + 50]["sample"]
    rows[begun + 50]["sample"] = {**wrong, "f_s": np.array([0.0, np.nan, 0.0])}
    rows[begun + 60]["sample"] = rows[begun + 58]["sample"]  # runs backwards
    return rows


def test_it_says_what_the_part_says_whatever_goes_wrong(program, config):
    reached = meddled(sensed(config, 740))
    wanted, told = of_the_part(config, reached), of_the_board(program, config, reached, runs=2)
    for name in ("state", "epoch"):
        compare(told, wanted, name)
    flags = np.array([row["state"]["flags"] for row in told if "state" in row])
    assert np.count_nonzero(flags & Flag.REFUSED) == 6
    assert 0 < np.count_nonzero(flags & Flag.STARTING) < 500


def test_after_a_long_pause_it_begins_anew_as_the_part_does(program, config):
    reached = [dict(row) for row in sensed(config, 790)]
    for k in range(500, 600):
        reached[k].pop("sample")
    wanted, told = of_the_part(config, reached), of_the_board(program, config, reached)
    for name in ("state", "epoch"):
        compare(told, wanted, name)
    flags = [row["state"]["flags"] if "state" in row else 0 for row in told]
    assert (flags[499], flags[600], flags[789]) == (0, int(Flag.REFUSED), 0)
    assert flags[610] == int(Flag.STARTING)


def test_its_library_agrees_with_jax_and_all_compiles_as_c_plus_plus(program):
    folder = Path(program).parent
    command = ["make", "-C", folder, "check", f"CFLAGS={STRICT} -ffp-contract=off"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    if shutil.which("g++") is None:
        pytest.skip("needs a C++ compiler")
    flags = ["-std=c++11", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", "-x", "c++"]
    command = ["g++", *flags, "navigation_board.c", "filter.c", "platform_posix.c"]
    built = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr


def test_it_flies_on_the_bench_and_its_record_is_heard_again(
    scenario, program, config, tmp_path, monkeypatch
):
    """As docs/from-design-to-board.md does it, against the part in Python."""
    on_threads(monkeypatch)  # the other parts
    bench, record = tmp_path / "with-board.toml", tmp_path / "record.mcap"
    bench.write_text(
        f'bench = "ins-gnss"\nflies = "{scenario}"\nfilter = "ekf"\n'
        f'[ports]\nnavigation = "{program}"\n'
    )
    trust.confirm(program)
    outcome = bench_up(str(bench), record=record)
    assert outcome.failure == ""
    assert np.isfinite(outcome.solution["lat_rad"].values[0][-1])
    assert bench_replay(record, node="navigation").same
    told, of = replayed_epochs(record), series(RIG, config, outcome.solution.sizes["time"])[0]
    rows = epochs_of(of)
    assert len(rows) > 30
    assert list(told) == list(of["epoch.time"][rows])
    # it rests when the fixes are back: those of 0.05 m/s alone would not make it so sure
    sure = np.all(of["epoch.sigma"][rows, 3:6] < 0.2 * 0.05, axis=1)
    assert np.count_nonzero(sure) >= 5
    assert not np.any(sure[:-6])
    for field in ("q_nb", "v_n"):
        values = np.array([row[field] for row in told.values()])
        np.testing.assert_allclose(values, of[f"epoch.{field}"][rows], rtol=0.0, atol=1e-9)


def replayed_epochs(record):
    """The last word on each epoch in a record, by time [ns]."""
    found, receivers = {}, {}
    for entry in read_record(record).entries:
        if entry.direction != "from":
            continue
        for frame in receivers.setdefault(entry.link, Receiver()).feed(entry.data):
            name = WIRE.names.get(frame.header.type)
            if name == "epoch":
                said = WIRE.decode(name, frame.payload)
                found[said["time"]] = said
    return dict(sorted(found.items()))


def test_what_the_loop_does_not_do_is_refused(scenario, tmp_path, capsys):
    to = tmp_path / "c"
    rest = {"settings": ["aids.non_holonomic=true"], "filter_name": "ekf", "board": True}
    with pytest.raises(RobinsError, match=r"aids.non_holonomic is set, .* --set aids"):
        export_filter(scenario, to, **rest)
    given = {**rest, "settings": ["start.known_heading=10 deg"]}
    told = r"known_heading is given, .* from the course; leave it out"
    with pytest.raises(RobinsError, match=told):
        export_filter(scenario, to, **given)
    with pytest.raises(InputError, match=r"--float32: .* single precision; leave it out"):
        export_filter(scenario, to, filter_name="ekf", float32=True, board=True)
    asked = ["export", "ins-gnss/walk", "--filter", "ekf", "--to", str(to), "--board"]
    assert main(asked) == 2
    assert "no log and no drive" in capsys.readouterr().err
    assert not to.exists()


def test_the_walk_on_a_line_has_the_epochs_of_its_replay(data_dir, tmp_path, monkeypatch):
    paths = [data_dir / f"gnssimu_walk_{part}.xz" for part in ("imu.csv", "gnss.pos")]
    if not all(path.exists() for path in paths):
        pytest.skip("the walk is not in the folder of real logs")
    files = ", ".join(f'"{path}"' for path in paths)
    settings = (f"log=[{files}]",)
    monkeypatch.setenv("CFLAGS", "-std=c99 -O0")
    made = export_filter(
        "ins-gnss/walk", tmp_path / "c", filter_name="ekf", settings=settings, board=True
    )
    flight = changed(read("ins-gnss/walk", settings), {"filter": "ekf"})
    config = RIG.prepare(flight.setup, flight.given)
    told = of_the_board(made.program, config, sensed(config, 150 * 60))
    configuration = SYSTEM.replay_default.parent / "walk.toml"
    wanted = replay_log([*paths, configuration], filters=("ekf",)).solution
    last = {row["epoch"]["time"]: row["epoch"] for row in told if "epoch" in row}
    rows = [last[time] for time in sorted(last)]
    first_ns = int(config.dataset.imu.time_ns[0])
    told_s = np.array([(row["time"] - first_ns) * 1e-9 for row in rows])
    at = np.searchsorted(wanted["time"].values, told_s - 1e-6)
    np.testing.assert_allclose(wanted["time"].values[at], told_s, atol=1e-6)
    assert np.sum(np.asarray(wanted["outage"].values)[at]) >= 40
    for field, role in (("q_nb", "q_nb"), ("v_n", "estimate_velocity")):
        values = np.array([row[field] for row in rows])
        np.testing.assert_allclose(values, wanted[role].values[0][at], rtol=0.0, atol=1e-9)
