"""Time of an answer of the live objects: every sample of a made log, pushed one by one.

The sample in the middle, the mean, and the slowest of a hundred, after the start, in wall time and,
in brackets, in time of all processors, which other programs disturb less; samples at the end of a
block or with a fix take a step of the filter. Nothing is compiled meanwhile. First what a call of
an `OnlineFilter` of fifteen states takes; then the live objects, with their filters on each
machine, and how long they took to be made.

    python benchmarks/live.py [calls] [marg] [ekf] [robust] [ranges] [product] [adaptive]
        [vm] [jax] [c]
"""

import sys
import time
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from marg import RATE_HZ, made_log

from robins import scenario
from robins.filters import Belief, Model, Motion, OnlineFilter, Sensor, kalman, taylor, unscented
from robins.systems import SYSTEMS
from robins.systems.gnss import City, GnssReplay, LiveGnss, world
from robins.systems.gnss.model import RANGES
from robins.systems.ins_gnss import SYSTEM, Drive, LiveInsGnss, drive_dataset
from robins.systems.ins_gnss import InsGnssReplay as Navigated
from robins.systems.marg import LiveMarg, MargReplay
from robins.systems.streaming import Flag
from robins.systems.transfer_alignment import LiveAlignment, PairReplay
from robins.systems.transfer_alignment.product.world import lay_out, simulate_pair

SAMPLES = 6_000
LATE_S = 0.1
N, M = 15, 3
MACHINES = ("vm", "jax", "c")  # the last is compiled for minutes where it was not yet


def told(name: str, rows: list[tuple[float, float, bool]], period_s: float = 0.0) -> None:
    """A line of microseconds."""
    wall, used = (1e6 * np.array(column) for column in list(zip(*rows, strict=True))[:2])
    known = np.array([row[2] for row in rows])
    figures = [
        f"{what} {of(wall[known]):7.0f} ({of(used[known]):7.0f})"
        for what, of in (
            ("median", np.median),
            ("mean", np.mean),
            ("99 %", lambda x: np.percentile(x, 99.0)),
        )
    ]
    lasts = f"; a sample lasts {1e6 * period_s:.0f} us" if period_s else ""
    print(f"{name:36}", *figures, f"us{lasts}", flush=True)


def timed(call: Any, *arguments: Any) -> tuple[float, float, bool]:
    """Seconds of a call, by both clocks, and whether its answer has numbers."""
    begin, used = time.perf_counter(), time.process_time()
    answer = call(*arguments)
    spent = time.perf_counter() - begin, time.process_time() - used
    return *spent, not answer.flags & Flag.STARTING


def mean_of(step: Any) -> Any:
    """All that is looked at of a step."""
    return step.posterior.mean


def calls() -> None:
    """Calls of filters of 15 states, ``A x + 0.01 sin x`` with a full A, square-root form."""
    rng = np.random.default_rng(0)
    A = np.eye(N) + 0.01 * rng.normal(size=(N, N))
    A /= max(1.0, np.abs(np.linalg.eigvals(A)).max())
    F, H, y = jnp.asarray(A), jnp.asarray(rng.normal(size=(M, N))), rng.normal(size=M)
    motion = Motion(lambda x, u: F @ x + 0.01 * jnp.sin(x), 0.1 * np.ones(N))
    model = Model(motion, (Sensor(lambda x, aux: H @ x, np.ones(M), M),))
    start = Belief.of(jnp.zeros(N), np.eye(N))
    for kind, way in (("EKF-15", taylor()), ("UKF-15", unscented())):
        for machine in MACHINES:
            live = OnlineFilter(kalman(way), model, start, machine)
            kinds = {
                "predict": live.predict,
                "update": lambda live=live: live.update(y),
                "step": lambda live=live: live.step({"y": y}),
                "step, mean kept": lambda live=live: live.step({"y": y}, keep=mean_of),
            }
            for name, call in kinds.items():
                told(f"{kind}, {machine}: {name}", [called(call) for _ in range(SAMPLES)])


def made(what: Any, *arguments: Any, machine: str, **named: Any) -> Any:
    """A live object, and a line of the seconds that it took to be made."""
    begin, used = time.perf_counter(), time.process_time()
    live = what(*arguments, machine=machine, **named)
    spent = time.perf_counter() - begin, time.process_time() - used
    print(f"{what.__name__}, {machine}: made in {spent[0]:.1f} s ({spent[1]:.1f})", flush=True)
    return live


def called(call: Any) -> tuple[float, float, bool]:
    """Seconds of a call, by both clocks; the first one compiles."""
    begin, used = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - begin, time.process_time() - used, True


def orientation(machine: str) -> None:
    """Nine axes at 286 Hz."""
    log, live = made_log(), made(LiveMarg, MargReplay(), RATE_HZ, machine=machine)
    assert log.mag is not None
    stamps, imu, field = log.imu.time_ns.tolist(), log.imu, log.mag.field_t
    rows = [
        timed(live.push, stamps[k], imu.gyro[k], imu.accel[k], field[k]) for k in range(SAMPLES)
    ]
    told(f"LiveMarg, {machine}", rows, 1.0 / RATE_HZ)


def navigation(name: str, machine: str) -> None:
    """A drive at 100 Hz, fixes at 1 Hz that come late."""
    drive = scenario.parse(Drive, SYSTEM.scenarios["drive"].read_text(), [])
    log = drive_dataset(drive, seed=0)
    step_s = 1.0 / drive.imu_rate
    imu = replace(log.imu, gyro=log.imu.gyro / step_s, accel=log.imu.accel / step_s, kind="rate")
    g = log.gnss
    assert g is not None
    assert g.v_n is not None
    assert g.sigma_v is not None
    rates = drive.imu_rate, drive.gnss.rate
    live = made(LiveInsGnss, Navigated(), *rates, filter=name, machine=machine)
    comes = [(int(t), 0, k) for k, t in enumerate(imu.time_ns[:SAMPLES])]
    comes += [(int(t + 1e9 * LATE_S), 1, k) for k, t in enumerate(g.time_ns)]
    samples, fixes = [], []
    for _, fix, k in sorted(comes):
        if fix and k * drive.imu_rate / drive.gnss.rate < SAMPLES - drive.imu_rate:
            place = float(g.lat_rad[k]), float(g.lon_rad[k]), float(g.alt_m[k])
            velocity = g.v_n[k], g.sigma_v[k]
            fixes.append(timed(live.push_fix, int(g.time_ns[k]), *place, g.sigma_m[k], *velocity))
        elif not fix:
            stamp = int(imu.time_ns[k])
            samples.append(timed(live.push_imu, stamp, imu.gyro[k], imu.accel[k]))
    told(f"LiveInsGnss {name}, {machine}, a sample", samples, step_s)
    told(f"LiveInsGnss {name}, {machine}, a fix", fixes, step_s)


def ranges(machine: str) -> None:
    """The city: odometry and pseudoranges of 16 satellites at 5 Hz."""
    city = scenario.parse(City, SYSTEMS["gnss"].scenarios["city"].read_text(), [])
    course = world.lay_out(city)
    run = world.simulate(city, course, 0, jnp.asarray(0))
    live = made(LiveGnss, GnssReplay(), {"G": 8, "R": 8}, machine=machine)
    y, sigma = np.asarray(run.y[RANGES]), np.asarray(run.sky.sigma)
    cn0 = 45.0 - 40.0 * np.log10(sigma / city.satellites.noise)
    odometry, epochs = [], []
    for k, t in enumerate(course.epoch_s):
        stamp, there = round(1e9 * t), np.flatnonzero(np.isfinite(y[k]))
        row = [float(np.asarray(x)[k]) for x in run.u[1:5]]
        odometry.append(timed(live.push_odometry, stamp, *row))
        names = [course.satellites[n] for n in there]
        rows = y[k, there], sigma[k, there], course.satellite_e[there]
        shown = course.elevation_rad[there], cn0[k, there]
        epochs.append(timed(live.push_ranges, stamp, names, *rows, *shown))
    told(f"LiveGnss, {machine}, odometry", odometry, 1.0 / city.rate)
    told(f"LiveGnss, {machine}, an epoch", epochs, 1.0 / city.rate)


def pair(name: str, machine: str) -> None:
    """The aircraft: a slave at 50 Hz, records at 10 Hz."""
    given = scenario.parse(
        PairReplay, SYSTEMS["transfer-alignment"].scenarios["aircraft"].read_text()
    )
    run = simulate_pair(given, lay_out(given), 0, jnp.asarray(0))
    live = made(LiveAlignment, given, given.slave.rate, filter=name, machine=machine)
    master, p = run.master, run.master.position
    parts = *run.increments[:3], p.lat, p.lon, p.alt, master.v_n, master.q_nb.wxyz
    dt, theta, dv, lat, lon, alt, v, q = (np.asarray(a, float) for a in parts)
    samples, records, step_s = [], [], 1.0 / given.slave.rate
    for e in range(len(dt)):
        for k in range(dt.shape[1]):
            stamp = round(1e9 * step_s * (e * dt.shape[1] + k + 0.5))
            rows = theta[e, k] / step_s, dv[e, k] / step_s
            samples.append(timed(live.push_imu, stamp, *rows))
        stamp = round(1e9 * step_s * (e + 1) * dt.shape[1])
        records.append(timed(live.push_record, stamp, lat[e], lon[e], alt[e], v[e], q[e]))
    told(f"LiveAlignment {name}, {machine}, a sample", samples, step_s)
    told(f"LiveAlignment {name}, {machine}, a record", records, step_s)


if __name__ == "__main__":
    asked = [a for a in sys.argv[1:] if a not in MACHINES]
    asked = asked or ["calls", "marg", "ekf", "robust", "ranges", "product", "adaptive"]
    if "calls" in asked:
        calls()
    for machine in [m for m in MACHINES if m in sys.argv[1:]] or MACHINES:
        if "marg" in asked:
            orientation(machine)
        for name in ("ekf", "robust"):
            if name in asked:
                navigation(name, machine)
        if "ranges" in asked:
            ranges(machine)
        for name in ("product", "adaptive"):
            if name in asked:
                pair(name, machine)
