"""INS/GNSS on logs without velocities, beginning at rest or in motion, beside the same with them.

    python benchmarks/positions_only.py --runs 30 --seed 1000
    python benchmarks/positions_only.py --runs 150 --seed 1000 --starts
    python benchmarks/positions_only.py --runs 12 --seed 1000 --verdicts

Cars of 60 s, made here by NumPy: speed and turns are sums of smooth steps, the specific force and
the turn rates follow from them with the rotating Earth (Groves 2013, 5.3 and 2.4.7). Receivers of 1
to 5 Hz and 0.02 to 3 m, consumer IMUs at 50 Hz, shaken while they move. Everything is the default,
but that a third of the replays is given the heading at the first sample. `SURE` and the windows of
`robins.systems.ins_gnss.positions`, and the limits of a verdict, were looked at on `--seed 0`.
"""

import argparse
import warnings
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from robins.dataset import Dataset, GnssTable, ImuTable
from robins.systems.ins_gnss import InsGnssReplay, replay
from robins.systems.ins_gnss.positions import heading_of
from robins.systems.ins_gnss.recording import on_one_clock
from robins.systems.ins_gnss.start import find_start

RATE_HZ, LASTS_S, FINE = 50, 60.0, 4  # samples, length, steps of the truth in a sample
A_M, E2, SPIN, G = 6378137.0, 0.00669437999014, 7.292115e-5, 9.81


class Truth(NamedTuple):
    """A drive at RATE_HZ * FINE."""

    time_s: np.ndarray  # (N,)
    place: np.ndarray  # (N, 3) latitude, longitude [rad], height [m]
    v_n: np.ndarray  # (N, 3)
    heading: np.ndarray  # (N,)
    omega_b: np.ndarray  # (N, 3)
    force_b: np.ndarray  # (N, 3)


def smooth(t: np.ndarray, at: float, lasts: float) -> np.ndarray:
    """Step from 0 to 1 with a continuous slope."""
    x = np.clip((t - at) / lasts, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def truth_of(rng: np.random.Generator, at_rest: bool) -> Truth:
    """A level drive of a car that points along its velocity."""
    t = np.arange(0.0, LASTS_S + 1e-9, 1.0 / (RATE_HZ * FINE))
    begins = rng.uniform(4.0, 8.0) if at_rest else -100.0
    speed = rng.uniform(5.0, 20.0) * smooth(t, begins, 6.0)
    heading = np.full(len(t), rng.uniform(-np.pi, np.pi))
    at = max(begins, 0.0)
    while (at := at + rng.uniform(2.0, 12.0)) < LASTS_S:
        speed += rng.uniform(-0.3, 0.3) * speed * smooth(t, at, rng.uniform(3.0, 6.0))
        heading += rng.uniform(-1.6, 1.6) * smooth(t, at, rng.uniform(4.0, 8.0))
    lat0, alt = rng.uniform(-1.0, 1.0), 300.0
    v_n = np.stack([speed * np.cos(heading), speed * np.sin(heading), 0.0 * t], axis=1)
    dt = t[1]
    w = 1.0 - E2 * np.sin(lat0) ** 2
    north, east = A_M * (1.0 - E2) / w**1.5 + alt, A_M / np.sqrt(w) + alt
    way = np.vstack([np.zeros(3), np.cumsum(0.5 * (v_n[1:] + v_n[:-1]) * dt, axis=0)])
    lat = lat0 + way[:, 0] / north
    place = np.stack([lat, 0.2 + way[:, 1] / (east * np.cos(lat)), np.full(len(t), alt)], axis=1)
    spin = SPIN * np.stack([np.cos(lat), 0.0 * t, -np.sin(lat)], axis=1)
    turn = np.stack([v_n[:, 1] / east, -v_n[:, 0] / north, -v_n[:, 1] * np.tan(lat) / east], axis=1)
    down = 9.7803253359 * (1.0 + 0.001931853 * np.sin(lat) ** 2) / np.sqrt(w) - 3.086e-6 * alt
    force = np.gradient(v_n, dt, axis=0) + np.cross(2.0 * spin + turn, v_n)
    force[:, 2] -= down
    c, s = np.cos(heading), np.sin(heading)

    def in_body(x: np.ndarray) -> np.ndarray:
        return np.stack([c * x[:, 0] + s * x[:, 1], c * x[:, 1] - s * x[:, 0], x[:, 2]], axis=1)

    omega = in_body(spin + turn)
    omega[:, 2] += np.gradient(heading, dt)
    return Truth(t, place, v_n, heading, omega, in_body(force))


def log_of(seed: int, at_rest: bool) -> tuple[Dataset, Truth]:
    """A log with velocities, and its truth."""
    rng = np.random.default_rng([seed, at_rest])
    truth = truth_of(rng, at_rest)
    every = slice(None, None, FINE)
    moves = (np.linalg.norm(truth.v_n[every], axis=1) > 0.1)[:, None]
    count = len(moves)

    def sensed(x: np.ndarray, bias: float, noise: float, shaken: float) -> np.ndarray:
        mean = np.vstack([x[:1], x[1:].reshape(-1, FINE, 3).mean(axis=1)])  # over a sample
        own = rng.normal(0.0, bias, 3) + rng.normal(0.0, noise, (count, 3))
        shakes = np.diff(rng.normal(0.0, shaken, (count + 1, 3)), axis=0)  # to and fro
        return mean + own + moves * shakes

    quiet = rng.uniform() < 0.2  # a smooth road
    gyro = sensed(truth.omega_b, 2e-3, 1e-3, 0.0 if quiet else 0.015)
    accel = sensed(truth.force_b, 0.05, 0.015, 0.0 if quiet else 0.3)
    stamps = np.round(truth.time_s[every] * 1e9).astype(np.int64)
    # increments: a mean over a sample is one, whatever happens within it
    imu = ImuTable(stamps, gyro / RATE_HZ, accel / RATE_HZ, "increment", source="positions_only")
    rate, size = rng.choice([1.0, 2.0, 5.0]), rng.choice([0.02, 0.3, 1.0, 3.0])
    rows = np.arange(round(rng.uniform(0.1, 0.9) * RATE_HZ), count, round(RATE_HZ / rate)) * FINE
    sigma = np.tile(size * np.array([1.0, 1.0, 2.0]), (len(rows), 1))
    off = sigma * rng.normal(size=sigma.shape)
    lat, lon, alt = truth.place[rows].T
    gnss = GnssTable(
        np.round(truth.time_s[rows] * 1e9).astype(np.int64),
        lat + off[:, 0] / A_M,
        lon + off[:, 1] / (A_M * np.cos(lat)),
        alt - off[:, 2],
        sigma,
        truth.v_n[rows] + 0.1 * rng.normal(size=sigma.shape),
        np.full(sigma.shape, 0.1),
    )
    return Dataset("positions-only", imu, gnss), truth


def without_velocities(log: Dataset) -> Dataset:
    """The same log of a receiver that gives none."""
    g = log.gnss
    assert g is not None
    bare = GnssTable(g.time_ns, g.lat_rad, g.lon_rad, g.alt_m, g.sigma_m)
    return Dataset(log.name, log.imu, bare)


def cases(seed: int, at_rest: bool):
    """Name, log, parameters and truth of each way to navigate one drive."""
    log, truth = log_of(seed, at_rest)
    headed = InsGnssReplay.model_validate({"start": {"known_heading": truth.heading[0]}})
    yield "velocities", log, InsGnssReplay(), truth
    yield "positions", without_velocities(log), InsGnssReplay(), truth
    yield "positions, heading given", without_velocities(log), headed, truth


def started(
    log: Dataset, parameters: InsGnssReplay, truth: Truth
) -> tuple[float, float, float, float]:
    """Time of the start [s], error of the heading [deg] and its sigma; velocity error in sigmas."""
    one = on_one_clock(log, parameters)
    found = find_start(one, parameters.start, parameters.aids, None, parameters.gnss)
    at_s = one.gnss_s[found.fix]
    v = np.array([np.interp(at_s, truth.time_s, x) for x in truth.v_n.T])
    heading = heading_of(found.q_nb) - np.interp(at_s, truth.time_s, truth.heading)
    size = np.full(3, parameters.start.velocity)
    if found.spread is not None:
        size = np.sqrt(found.spread[:, 0, 0])
    away = np.degrees(np.angle(np.exp(1j * heading)))
    nees = float(np.mean(((found.v_n - v) / size)[:2] ** 2))
    return at_s, away, np.degrees(found.heading_sigma_rad), nees


def navigated(log: Dataset, parameters: InsGnssReplay, truth: Truth, name: str) -> list[float]:
    """RMS of the horizontal error [m] ten seconds after the start, NIS, and refused fixes."""
    found = replay(log, parameters, (name,))
    s, m = found.solution, found.metrics[name]
    assert s is not None
    t = s["time"].values
    there = t > t[0] + 10.0
    at = [np.interp(t, truth.time_s, x) for x in truth.place.T[:2]]
    north = A_M * (s["lat_rad"].values[0] - at[0])
    east = A_M * np.cos(at[0]) * (s["lon_rad"].values[0] - at[1])
    rms = float(np.sqrt(np.mean((north**2 + east**2)[there])))
    return [rms, m["nis_gnss_position"], m.get("refused_gnss_position", 0)]


def spoilt(log: Dataset, truth: Truth):
    """Name, log and parameters of ways in which a replay of one drive is right or wrong."""
    g, imu = log.gnss, log.imu
    assert g is not None
    yield "sound", log, {}
    for factor in (0.2, 5.0):
        gnss = replace(g, sigma_m=factor * g.sigma_m)
        yield f"sigmas stated {factor:g} times what they are", replace(log, gnss=gnss), {}
    yield "unit mounted 90 deg off", log, {"imu": {"orientation": ["0 deg", "0 deg", "90 deg"]}}
    back = {"known_heading": truth.heading[0] + np.pi, "heading": "5 deg"}
    yield "heading given half a turn off", log, {"start": back}
    slow = replace(imu, gyro=0.25 * imu.gyro)
    yield "gyros a quarter of what they are", replace(log, imu=slow), {}


def verdicts(runs: int, seed: int) -> None:
    """Print how often each word begins the verdict on replays that are right and wrong."""
    words = "Consistent", "With care", "Do not trust"
    print(f"| log | {' | '.join(words)} | not navigated | north RMS, median [m] |")
    print("|---" * (len(words) + 3) + "|")
    found: dict[str, list] = {}
    for one in range(seed, seed + runs):
        log, truth = log_of(one, at_rest=bool(one % 2))
        for kind, given, parameters in spoilt(without_velocities(log), truth):
            row = found.setdefault(kind, [])
            try:
                outcome = replay(
                    given, InsGnssReplay.model_validate(parameters), ("robust", "robust+rts")
                )
            except ValueError:
                row.append(("none", np.nan))
                continue
            s = outcome.solution
            assert s is not None
            north = np.interp(s["time"].values, truth.time_s, truth.place[:, 0])
            north = A_M * (s["lat_rad"].values[0] - north)
            row.append((outcome.verdict.partition(":")[0], float(np.sqrt(np.mean(north**2)))))
    for kind, row in found.items():
        counts = [sum(word == of for of, _ in row) for word in (*words, "none")]
        error = np.nanmedian([size for _, size in row])
        print(f"| {kind} | {' | '.join(map(str, counts))} | {error:.2g} |")


def main() -> None:
    """Print a line for each way to begin and to navigate."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--filter", default="ekf")
    parser.add_argument("--starts", action="store_true", help="look at the starts alone")
    parser.add_argument("--verdicts", action="store_true", help="look at the verdicts alone")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    if given.verdicts:
        verdicts(given.runs, given.seed)
        return
    heads = ["start [s]", "heading [deg]", "sigma [deg]", "velocity NEES a component"]
    if not given.starts:
        heads = ["horizontal RMS [m]", "position NIS", "refused fixes"]
    print(f"| begins | with | runs | {' | '.join(heads)} | not navigated |")
    print("|---" * (len(heads) + 4) + "|")
    for at_rest in (True, False):
        rows: dict[str, list] = {}
        lost: dict[str, list[str]] = {}
        for seed in range(given.seed, given.seed + given.runs):
            for kind, log, parameters, truth in cases(seed, at_rest):
                try:
                    if given.starts:
                        row = list(map(abs, started(log, parameters, truth)))
                    else:
                        row = navigated(log, parameters, truth, given.filter)
                    rows.setdefault(kind, []).append(row)
                except ValueError as error:
                    lost.setdefault(kind, []).append(f"{seed}: {error}")
        for kind, found in rows.items():
            columns = [
                f"{np.median(x):.3g} ({np.quantile(x, 0.9):.3g}; {np.max(x):.3g}), mean "
                f"{np.mean(x):.3g}"
                for x in np.transpose(found)
            ]
            begins = "at rest" if at_rest else "in motion"
            missed = len(lost.get(kind, []))
            print(f"| {begins} | {kind} | {len(found)} | {' | '.join(columns)} | {missed} |")
        for kind, sentences in lost.items():
            print(*(f"{kind}, seed {one}" for one in sentences[:5]), sep="\n")


if __name__ == "__main__":
    main()
