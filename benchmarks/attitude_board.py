"""Attitude on public logs with a reference: robins beside VQF and imufusion, trial by trial.

    python benchmarks/attitude_board.py --broad FOLDER --euroc FOLDER --repoimu FOLDER \
        --als FOLDER --ese FOLDER

Every folder is optional, and nothing is fetched. What is read:

- BROAD (Laidig et al. 2021): ``broad_*.npz``. Errors over the samples marked as motion.
- EuRoC: a text file of inertial samples (ns, gyro rad/s, accelerometer m/s^2) and one of the truth
  (s, position, quaternion x y z w, unit to world, z up), paired by the time they share. There
  is no magnetometer: the inclination alone is compared.
- RepoIMU T-stick: ``TStick_*.csv``. The frame of the cameras, its body and the clock are not
  those of the unit. Once a trial the offset of the clocks (up to 0.2 s) and the rotation of the
  bodies are solved from the two angular rates, and the rotation of the Earth's axes from the mean
  specific force and the mean field in camera axes over the trial. No estimate of attitude enters.
  The field is stored without a unit and is taken for 50 uT in the mean. Where the attitude of the
  cameras jumps (more than 20 rad/s between two frames) the longest stretch between jumps counts:
  of Test06_Trial1 all but the last 2.5 s. Errors from the first to the last time that the true
  rate exceeds 0.2 rad/s.
- ALS (Josef4Sci/AHRS_Filter): ``ALS_dataset.mat``, a flight with a magnetometer that nobody
  calibrated. Units are g and rad/s; the field is taken for 50 uT in the mean. The reference turns
  earth axes into axes of its own body, of which x and y are -y and -x of the unit, as the angular
  rates of both show, and z is down; its north is turned to the mean field.
- ESE650 (yashv28/Orientation-Estimation-using-Unscented-Kalman-Filter): ``imuRawN.mat`` and
  ``viconRotN.mat``, a bare chip read by a converter of 10 bit. Scales are those of its data sheet,
  biases the mean of the first 100 samples at rest. Inclination alone.

What was chosen on a trial cannot be judged on it. Of a set of several trials that came after the
choices for BROAD, EuRoC and T-stick (today ESE650) the one whose name has the least SHA-256 is kept
aside: it is read only with --final "why", and the look is added to benchmarks/looks.md.

Columns: total, heading and inclination error (root mean square, deg, as BROAD defines them), mean
squared heading error over its stated variance (one is right), seconds with a heading or inclination
beyond three stated sigmas, whether the replay warned (of this filter, or of the samples that both
have), and the time of a sample.
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Iterator, Sequence
from datetime import date
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.io
from scipy.spatial.transform import Rotation, Slerp

from robins.dataset import AttitudeTable, Dataset, ImuTable, MagTable
from robins.logs.broad import read_broad
from robins.rotation import multiply
from robins.systems.marg import MargReplay, replay
from robins.systems.marg.replay import orientation_errors, rms_deg, truth_at

ENU_TO_NED = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])
NWU_TO_ENU = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
MOVING_RATE = 0.2  # rad/s, of the reference
LONGEST_OFFSET_S = 0.2
GRAVITY = 9.81
FLU_TO_FRD = np.array([1.0, -1.0, -1.0])
FLU_FRD = NWU_TO_NED = np.array([0.0, 1.0, 0.0, 0.0])  # half a turn about x
ALS_BODY = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
ESE_G, ESE_DEG_S = 3300.0 / 1023.0 / np.array([330.0, 3.33])  # of a count, by the data sheet
ESE_DEVELOPMENT = {"1", "3"}  # and 6 until 2026-11-30
JUMP_RATE = 20.0  # rad/s between two frames of the reference
FIELD_T = 50e-6  # of a field that is stored without a unit
# Trials on which settings were found in releases before, or may be found now.
BROAD_DEVELOPMENT = {1, 2, 5, 6, 7, 10, 12, 15, 16, 24, 26, 28, 29, 30, 32, 33}
EUROC_DEVELOPMENT = {"V102", "V202", "MH03"}
REPOIMU_DEVELOPMENT = {"02", "04", "06", "10", "11"}


class Trial(NamedTuple):
    """A log with its reference."""

    set: str
    name: str
    log: Dataset
    tilt_only: bool
    development: bool


class Row(NamedTuple):
    """Result of one estimator on a trial."""

    total: float
    heading: float
    inclination: float
    nees: float = float("nan")
    beyond_s: float = float("nan")
    warned: bool = False
    us: float = float("nan")


# ---------------------------------------------------------------------------------------- reading


def scalar_first(rotation: Rotation) -> np.ndarray:
    return np.roll(rotation.as_quat(), 1, axis=-1)


def at_times(time_ns: np.ndarray, seen_ns: np.ndarray, q: np.ndarray) -> np.ndarray:
    """(N, 4) attitude interpolated at given times; NaN outside the reference."""
    inside = (time_ns >= seen_ns[0]) & (time_ns <= seen_ns[-1])
    out = np.full((len(time_ns), 4), np.nan)
    seconds = (seen_ns - seen_ns[0]) * 1e-9
    between = Slerp(seconds, Rotation.from_quat(np.roll(q, -1, axis=1)))
    out[inside] = scalar_first(between((time_ns[inside] - seen_ns[0]) * 1e-9))
    return out


def broad(folder: Path) -> Iterator[Trial]:
    """Trials of BROAD."""
    for path in sorted(folder.glob("broad_*.npz")):
        number = int(path.name.split("_")[1])
        name = path.stem.removeprefix("broad_").replace("_", " ")
        yield Trial("BROAD", name, read_broad(path), False, number in BROAD_DEVELOPMENT)


def euroc(folder: Path) -> Iterator[Trial]:
    """Flights of EuRoC: each table of samples with the truth that shares most of its time."""
    tables = {path: np.loadtxt(path, delimiter="," if _commas(path) else None, ndmin=2)
              for path in sorted(folder.glob("*.txt"))}  # fmt: skip
    truths = [t for t in tables.values() if t.shape[1] == 8]
    for path, rows in tables.items():
        if rows.shape[1] != 7:
            continue
        first_line = np.loadtxt(path, delimiter=",", usecols=0, dtype=np.int64)
        begin, end = first_line[0] * 1e-9, first_line[-1] * 1e-9
        shared = [min(end, t[-1, 0]) - max(begin, t[0, 0]) for t in truths]
        if not shared or max(shared) <= 0.0:
            continue
        truth = truths[int(np.argmax(shared))]
        seen_ns = np.round(truth[:, 0] * 1e6).astype(np.int64) * 1000
        q = at_times(first_line, seen_ns, np.roll(truth[:, 4:8], 1, axis=1))
        log = Dataset(
            name=path.stem,
            imu=ImuTable(first_line, rows[:, 1:4], rows[:, 4:7], "rate"),
            attitude=AttitudeTable(first_line, q, nav="ENU"),
        )
        yield Trial("EuRoC", path.stem, log, True, path.stem in EUROC_DEVELOPMENT)


def _commas(path: Path) -> bool:
    with path.open() as lines:
        return any("," in line for line, _ in zip(lines, range(3), strict=False))


def repoimu(folder: Path) -> Iterator[Trial]:
    """Trials of the T-stick."""
    for path in sorted(folder.glob("TStick_*.csv")):
        rows = np.genfromtxt(path, delimiter=";", skip_header=2)[:, :14]
        rows = rows[np.all(np.isfinite(rows), axis=1)]
        seconds, q, accel, gyro, mag = np.split(rows, [1, 5, 8, 11], axis=1)
        time_ns = np.round(seconds[:, 0] * 1e9).astype(np.int64)
        field = mag * FIELD_T / np.mean(np.linalg.norm(mag, axis=1))
        true, moving = _aligned(time_ns, q, accel, gyro, field)
        log = Dataset(
            name=path.stem,
            imu=ImuTable(time_ns, gyro, accel, "rate"),
            mag=MagTable(time_ns, field),
            attitude=AttitudeTable(time_ns, true, moving=moving),
        )
        number = path.stem.split("_")[1].removeprefix("Test")
        yield Trial("T-stick", path.stem[7:], log, False, number in REPOIMU_DEVELOPMENT)


def _rates(time_ns: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middles of intervals [s] and mean body rates over them [rad/s]."""
    r = Rotation.from_quat(np.roll(q, -1, axis=1))
    dt = np.diff(time_ns) * 1e-9
    return (time_ns[:-1] - time_ns[0]) * 1e-9 + 0.5 * dt, (r[:-1].inv() * r[1:]).as_rotvec() / dt[
        :, None
    ]


def _aligned(
    time_ns: np.ndarray, q: np.ndarray, accel: np.ndarray, gyro: np.ndarray, field: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(N, 4) true q_nb from the cameras, NaN at the ends, and (N,) when the body moves."""
    middle, rate = _rates(time_ns, q)
    clock = (time_ns - time_ns[0]) * 1e-9
    edges = [-1, *np.flatnonzero(np.linalg.norm(rate, axis=1) > JUMP_RATE), len(rate)]
    longest = int(np.argmax(np.diff(edges)))
    stretch = slice(edges[longest] + 1, edges[longest + 1])
    good = np.zeros(len(rate), dtype=bool)
    good[stretch] = True

    def fit(offset: float) -> tuple[float, Rotation]:
        read = np.stack([np.interp(middle + offset, clock, g) for g in gyro.T], axis=1)
        read = read - np.mean(read[good], axis=0)
        seen = rate[good] - np.mean(rate[good], axis=0)
        turn, missed = Rotation.align_vectors(seen, read[good])
        return float(missed), turn  # unit to the body of the cameras

    coarse = np.arange(-LONGEST_OFFSET_S, LONGEST_OFFSET_S + 1e-9, 0.01)
    best = coarse[int(np.argmin([fit(x)[0] for x in coarse]))]
    fine = best + np.arange(-0.01, 0.0101, 0.001)
    offset = float(fine[int(np.argmin([fit(x)[0] for x in fine]))])
    turn = fit(offset)[1]
    seen_ns = time_ns + round(offset * 1e9)
    own = scalar_first(Rotation.from_quat(np.roll(q, -1, axis=1)) * turn)
    stretch = slice(stretch.start, stretch.stop + 1)
    own = at_times(time_ns, seen_ns[stretch], own[stretch])
    there = np.all(np.isfinite(own), axis=1)
    r = Rotation.from_quat(np.roll(own[there], -1, axis=1))
    up, north = np.mean(r.apply(accel[there]), axis=0), np.mean(r.apply(field[there]), axis=0)
    down = -up / np.linalg.norm(up)
    east = np.cross(down, north)
    east = east / np.linalg.norm(east)
    ned = Rotation.from_matrix(np.stack([np.cross(east, down), east, down]))
    true = np.full_like(own, np.nan)
    true[there] = scalar_first(ned * r)
    quick = np.flatnonzero(good & (np.linalg.norm(rate, axis=1) > MOVING_RATE))
    moving = np.zeros(len(time_ns), dtype=bool)
    if quick.size:
        moving[quick[0] : quick[-1] + 1] = True
    return true, moving


# ---------------------------------------------------------------------------------------- scoring


def scored(trial: Trial, q_nb: np.ndarray) -> Row:
    """Errors of attitudes at the samples of a log."""
    assert trial.log.attitude is not None
    true, counts = truth_at(trial.log.attitude, trial.log.imu.time_ns)
    e = orientation_errors(q_nb[counts], true[counts])
    nan = float("nan")
    total, heading = (nan, nan) if trial.tilt_only else (rms_deg(e.total), rms_deg(e.heading))
    return Row(total, heading, rms_deg(e.inclination))


def of_robins(trial: Trial, parameters: MargReplay) -> dict[str, Row]:
    """The causal and the smoothed replay."""
    begin = time.perf_counter()
    found = replay(trial.log, parameters)
    took = (time.perf_counter() - begin) / len(trial.log.imu) * 1e6
    assert trial.log.attitude is not None
    out = {}
    clock = found.solution["time"].values
    begin_ns = trial.log.imu.time_ns[0]
    _, counts = truth_at(trial.log.attitude, begin_ns + np.round(clock * 1e9).astype(np.int64))
    lost = found.counts["imu_saturated"] - found.counts["imu_bridged"]
    of_both = f"{lost} samples are at the end of their range"
    for name, words in (("marg", "robins"), ("marg-smoothed", "robins smoothed")):
        m, one = found.metrics[name], found.solution.sel(filter=name)
        ratio = np.abs(one["error_inclination"].values / one["sigma_inclination"].values).max(
            axis=1
        )
        if not trial.tilt_only:
            turned = np.abs(one["error_heading"].values / one["sigma_heading"].values).max(axis=1)
            ratio = np.maximum(ratio, turned)
        beyond = float(np.sum((ratio > 3.0) & counts) * np.median(np.diff(clock)))
        free = float("nan") if trial.tilt_only else 1.0
        out[words] = Row(
            free * m["total_rmse_deg"],
            free * m["heading_rmse_deg"],
            m["inclination_rmse_deg"],
            free * m["heading_nees"],
            beyond,
            any(w.startswith((f"{name}:", of_both)) for w in found.warnings),
            took,
        )
    return out


def installed(name: str) -> Any:
    """A package, or None without it."""
    return importlib.import_module(name) if importlib.util.find_spec(name) else None


def of_peers(trial: Trial) -> dict[str, Row]:
    """VQF causal and offline, and imufusion, where they are installed, with their defaults."""
    vqf, imufusion = installed("vqf"), installed("imufusion")
    log = trial.log
    step = float(np.median(np.diff(log.imu.time_ns))) * 1e-9
    gyro, accel = (
        np.ascontiguousarray(log.imu.gyro, float),
        np.ascontiguousarray(log.imu.accel, float),
    )
    field = None if log.mag is None else np.ascontiguousarray(log.mag.field_t * 1e6, float)
    key = "quat6D" if field is None else "quat9D"
    runs = {}
    if vqf is not None:
        runs["VQF"] = lambda: vqf.VQF(step).updateBatch(gyro, accel, field)[key]
        runs["VQF offline"] = lambda: vqf.offlineVQF(gyro, accel, field, step)[key]
    if imufusion is not None:
        runs["imufusion"] = lambda: fused(imufusion, step, gyro, accel, field)
    out = {}
    for name, run in runs.items():
        begin = time.perf_counter()
        q = run()
        took = (time.perf_counter() - begin) / len(gyro) * 1e6
        out[name] = scored(trial, multiply(ENU_TO_NED, q))._replace(us=took)
    return out


def fused(imufusion: Any, step: float, gyro: Any, accel: Any, field: Any) -> np.ndarray:
    """(N, 4) imufusion with its defaults, body to east-north-up.

    It is asked for north-west-up: its east-north-up has a heading that differs by a right angle.
    """
    settings = imufusion.AhrsSettings(sample_rate=1.0 / step, convention=imufusion.CONVENTION_NWU)
    ahrs = imufusion.Ahrs()
    ahrs.set_settings(settings)
    out = np.empty((len(gyro), 4))
    for k, (g, a) in enumerate(zip(np.degrees(gyro), accel / 9.81, strict=True)):
        if field is None:
            ahrs.update_no_magnetometer(g, a)
        else:
            ahrs.update(g, a, field[k])
        out[k] = ahrs.get_quaternion()
    return multiply(NWU_TO_ENU, out)


def als(folder: Path) -> Iterator[Trial]:
    """The flight of ALS."""
    for path in sorted(folder.glob("ALS*.mat")):
        data = scipy.io.loadmat(path)
        time_ns = np.round(data["time"][:, 0] * 1e9).astype(np.int64)
        field = data["Magnetometer"] * FLU_TO_FRD
        field = field * FIELD_T / np.mean(np.linalg.norm(field, axis=1))
        seen = np.roll(data["qViconReference"][: len(time_ns)], -1, axis=1)
        q = Rotation.from_quat(seen).inv() * Rotation.from_matrix(ALS_BODY)
        north, east, _ = np.mean(q.apply(field), axis=0)
        q = Rotation.from_euler("z", -np.arctan2(east, north)) * q
        accel = data["Accelerometer"] * FLU_TO_FRD * GRAVITY
        log = Dataset(
            name=path.stem,
            imu=ImuTable(time_ns, data["Gyroscope"] * FLU_TO_FRD, accel, "rate"),
            mag=MagTable(time_ns, field),
            attitude=AttitudeTable(time_ns, scalar_first(q)),
        )
        yield Trial("ALS", path.stem, log, False, True)


def ese(folder: Path) -> Iterator[Trial]:
    """Trials of ESE650."""
    for path in sorted(folder.glob("imuRaw*.mat")):
        number = path.stem.removeprefix("imuRaw")
        raw, truth = (scipy.io.loadmat(folder / f"{k}{number}.mat") for k in ("imuRaw", "viconRot"))
        clock, counts = raw["ts"][0], raw["vals"].T.astype(float)
        zero = counts[:100].mean(axis=0)
        force = (counts[:, :3] - zero[:3]) * [-1.0, -1.0, 1.0] * ESE_G + [0.0, 0.0, 1.0]
        rate = np.radians((counts - zero)[:, [4, 5, 3]] * ESE_DEG_S)
        fresh = np.concatenate([[True], np.diff(clock) > 0.0])
        time_ns = np.round((clock - clock[0])[fresh] * 1e9).astype(np.int64)
        turns, seen = np.moveaxis(truth["rots"], 2, 0), truth["ts"][0] - clock[0]
        seen = seen[: len(turns)]
        good = np.all(np.isfinite(turns), axis=(1, 2)) & np.concatenate([[True], np.diff(seen) > 0])
        q = scalar_first(Rotation.from_matrix(turns[good]))
        q = at_times(time_ns, np.round(seen[good] * 1e9).astype(np.int64), q)
        log = Dataset(
            name=path.stem,
            imu=ImuTable(
                time_ns, rate[fresh] * FLU_TO_FRD, force[fresh] * FLU_TO_FRD * GRAVITY, "rate"
            ),
            attitude=AttitudeTable(time_ns, multiply(NWU_TO_NED, multiply(q, FLU_FRD))),
        )
        yield Trial("ESE650", number, log, True, number in ESE_DEVELOPMENT)


READERS = {"broad": broad, "euroc": euroc, "repoimu": repoimu, "als": als, "ese": ese}
CHOSEN_ON = {"BROAD", "EuRoC", "T-stick"}  # before trials were kept aside
LOOKS = Path(__file__).with_name("looks.md")


def aside(trials: Sequence[Trial]) -> set[tuple[str, str]]:
    """Set and name of the trials that no choice may look at."""
    out = set()
    for which in {trial.set for trial in trials} - CHOSEN_ON:
        names = [trial.name for trial in trials if trial.set == which]
        if len(names) > 1:
            out.add(
                (which, min(names, key=lambda name: sha256(f"{which} {name}".encode()).digest()))
            )
    return out


def looked(why: str, trials: set[tuple[str, str]]) -> None:
    """Add a look at the trials kept aside to the list of looks."""
    names = ", ".join(f"{which} {name}" for which, name in sorted(trials))
    with LOOKS.open("a") as lines:
        lines.write(f"- {date.today()}: {names}. {why}\n")


# --------------------------------------------------------------------------------------- printing


def line(first: str, row: Row) -> str:
    numbers = [row.total, row.heading, row.inclination, row.nees, row.beyond_s, row.us]
    cells = ["" if np.isnan(x) else f"{x:.2f}" for x in numbers]
    cells.insert(5, "yes" if row.warned else "")
    return f"| {first} | " + " | ".join(cells) + " |"


def mean_of(rows: list[Row]) -> Row:
    """Means, and the share of trials whose heading NEES lies within 0.5 to 2 as `nees`."""
    table = np.array([[*row[:3], row.beyond_s, row.us] for row in rows], dtype=float)
    total, heading, inclination, beyond, us = table.mean(axis=0)
    nees = np.array([row.nees for row in rows])
    share = float("nan") if np.isnan(nees).any() else float(np.mean((nees > 0.5) & (nees < 2.0)))
    return Row(total, heading, inclination, share, beyond, any(r.warned for r in rows), us)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    for name in READERS:
        parser.add_argument(f"--{name}", type=Path, action="append", default=[])
    parser.add_argument("--final", metavar="WHY", default="", help="read what is kept aside too")
    given = vars(parser.parse_args())
    trials = [
        t for name, reader in READERS.items() for folder in given[name] for t in reader(folder)
    ]
    if not trials:
        parser.error("no trial found: give a folder of logs")
    kept = aside(trials)
    if given["final"] and kept:
        looked(given["final"], kept)
    elif kept:
        trials = [trial for trial in trials if (trial.set, trial.name) not in kept]
    head = ["total", "heading", "inclination", "NEES", "beyond_s", "warned", "us"]
    found: dict[tuple[str, bool, str], list[Row]] = {}
    print(f"| trial, estimator | {' | '.join(head)} |\n|{'---|' * (len(head) + 1)}")
    for trial in trials:
        rows = of_robins(trial, MargReplay()) | of_peers(trial)
        for name, row in rows.items():
            print(line(f"{trial.set} {trial.name}, {name}", row), flush=True)
            found.setdefault((trial.set, trial.development, name), []).append(row)
    print("\nMeans; NEES: share of trials with a heading NEES of 0.5 to 2")
    print(f"\n| set, part, trials, estimator | {' | '.join(head)} |\n|{'---|' * (len(head) + 1)}")
    for (which, development, name), rows in found.items():
        part = "development" if development else "other"
        print(line(f"{which}, {part}, {len(rows)}, {name}", mean_of(rows)))


if __name__ == "__main__":
    main()
