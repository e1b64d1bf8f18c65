"""Shares of random drives in which the doctor finds a fault of IMU and receiver, and its size.

python benchmarks/doctor_drives.py --seed 1000 --sound 200 --drives 30
python benchmarks/doctor_drives.py --seed 1000 --sound 0 --drives 0 --bare 60

Sound drives must have no finding above a note. In a drive with a fault its code must be found, its
value within three of its sigmas, and no other cause be named. Thresholds were chosen on `--seed 0`
and `--seed 22000`; quote another. A fault of the clock or of the lever arm cannot be known in a
drive without it whose estimate has a formal sigma above a fifth of its size: such drives are
counted apart, and nothing that is found in them counts.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from robins.dataset import Dataset, GnssTable, ImuTable
from robins.logs import checks_motion, examine
from robins.logs.motion_fit import LEVER, OFFSET, RATE

A, E2, EARTH, G0 = 6378137.0, 0.00669437999014, 7.292115e-5, 9.80665
SECOND = 1_000_000_000


def waves(rng, t, periods, amplitude):
    """Sum of sinusoids that starts at zero with its slope."""
    out = np.zeros_like(t)
    for period in periods:
        w, phase = 2 * np.pi / period, rng.uniform(0, 2 * np.pi)
        out += amplitude * rng.uniform(0.5, 1.0) * (np.sin(w * t + phase) - np.sin(phase))
    return out


def motion(rng, kind, t):
    """Speed, climb angle, course, roll, pitch and crab angle over time."""
    still = rng.uniform(15, 35) if kind != "aircraft" and rng.random() < 0.8 else -30.0
    begin = np.clip((t - still) / 15, 0, 1)
    begin = begin**3 * (10 - 15 * begin + 6 * begin**2)
    s = np.maximum(t - still, 0.0)
    zero = np.zeros_like(t)
    if kind in ("car", "straight"):
        speed = begin * np.maximum(rng.uniform(8, 20) + waves(rng, s, rng.uniform(14, 50, 3), 2), 1)
        course = waves(rng, s, rng.uniform(14, 60, 3), 0.8)
        climb = begin * waves(rng, s, rng.uniform(15, 50, 2), 0.03)
        roll = begin * waves(rng, s, rng.uniform(3, 20, 3), 0.02)
        pitch = climb + begin * waves(rng, s, rng.uniform(3, 20, 3), 0.015)
        crab = zero
        if kind == "straight":
            course, climb, roll, pitch = 0.01 * course, 0.1 * climb, 0.1 * roll, 0.1 * pitch
    elif kind == "walk":
        speed = begin * (1.4 + waves(rng, s, rng.uniform(5, 20, 3), 0.2))
        course = waves(rng, s, rng.uniform(6, 30, 3), 0.8)
        step = 2 * np.pi * rng.uniform(1.6, 2.0) * s
        climb = begin * 0.15 * np.sin(step)
        roll = begin * (waves(rng, s, rng.uniform(3, 20, 3), 0.05) + 0.04 * np.sin(0.5 * step))
        pitch = begin * (waves(rng, s, rng.uniform(3, 20, 3), 0.05) + 0.03 * np.sin(step + 1))
        crab = zero
    else:
        speed = rng.uniform(40, 80) + waves(rng, s, rng.uniform(20, 60, 3), 3)
        course = waves(rng, s, rng.uniform(30, 90, 3), 0.8)
        climb = waves(rng, s, rng.uniform(20, 60, 3), 0.03)
        roll = np.arctan(speed * np.gradient(course, t) / G0)
        roll = roll + waves(rng, s, rng.uniform(3, 15, 3), 0.02)
        pitch = climb + 0.04 + waves(rng, s, rng.uniform(3, 15, 3), 0.015)
        crab = 0.08 * np.sin(course + rng.uniform(0, 6))
    return speed, climb, course + rng.uniform(0, 6.28), roll, pitch, crab


class Truth(NamedTuple):
    """A drive without errors at a high rate."""

    t: np.ndarray
    gyro: np.ndarray  # (n, 3) rad/s
    accel: np.ndarray  # (n, 3) m/s^2
    place: np.ndarray  # (n, 3) latitude, longitude [rad], height [m]
    v_n: np.ndarray  # (n, 3)
    C: np.ndarray  # (n, 3, 3) body to north-east-down


def truth_of(rng, kind, seconds, rate):
    """Path, attitude and what an ideal IMU measures, on the turning Earth."""
    t = np.arange(0, seconds, 1 / rate)
    speed, climb, course, roll, pitch, crab = motion(rng, kind, t)
    level = speed * np.cos(climb)
    v = np.stack([level * np.cos(course), level * np.sin(course), -speed * np.sin(climb)], -1)
    lat0 = np.radians(rng.uniform(-70, 70))

    def summed(x):
        return np.concatenate([[0.0], np.cumsum(0.5 * (x[1:] + x[:-1])) / rate])

    h = rng.uniform(0, 2000) - summed(v[:, 2])
    h += max(0.0, -float(h.min()))  # no flight is below the sea
    lat = np.full_like(t, lat0)
    for _ in range(3):
        w = 1 - E2 * np.sin(lat) ** 2
        meridian, transverse = A * (1 - E2) / w**1.5, A / np.sqrt(w)
        lat = lat0 + summed(v[:, 0] / (meridian + h))
    lon = rng.uniform(-3, 3) + summed(v[:, 1] / (transverse + h) / np.cos(lat))
    heading = course + crab
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    ch, sh = np.cos(heading), np.sin(heading)
    C = np.stack(
        [
            np.stack([cp * ch, sr * sp * ch - cr * sh, cr * sp * ch + sr * sh], -1),
            np.stack([cp * sh, sr * sp * sh + cr * ch, cr * sp * sh - sr * ch], -1),
            np.stack([-sp, sr * cp, cr * cp], -1),
        ],
        -2,
    )
    dr, dp, dh = (np.gradient(x, t) for x in (roll, pitch, heading))
    turn = np.stack([dr - dh * sp, dp * cr + dh * sr * cp, dh * cr * cp - dp * sr], -1)
    earth = EARTH * np.stack([np.cos(lat), 0 * t, -np.sin(lat)], -1)
    over = np.stack(
        [
            v[:, 1] / (transverse + h),
            -v[:, 0] / (meridian + h),
            -v[:, 1] * np.tan(lat) / (transverse + h),
        ],
        -1,
    )
    gyro = turn + np.einsum("nji,nj->ni", C, earth + over)
    s2 = np.sin(lat) ** 2
    g = 9.7803253359 * (1 + 0.00193185265241 * s2) / np.sqrt(1 - E2 * s2) * (1 - 2 * h / A)
    f_n = np.gradient(v, t, axis=0) + np.cross(2 * earth + over, v)
    f_n[:, 2] -= g
    accel = np.einsum("nji,nj->ni", C, f_n)
    return Truth(t, gyro, accel, np.stack([lat, lon, h], -1), v, C)


def sound(seed, lever=(0.0, 0.0, 0.0), straight=False):
    """A random drive without a fault, whose antenna is some metres from the IMU."""
    rng = np.random.default_rng(seed)
    kind = ("car", "car", "aircraft", "walk")[rng.integers(4)]
    kind = "straight" if straight else kind
    imu_hz = int(rng.choice([25, 50, 100, 200, 400]))
    fix_hz = float(rng.choice([0.2, 0.5, 1, 2, 5, 10]))
    seconds = rng.uniform(200, 400) * (1 if fix_hz >= 1 else 2)
    fine = max(1, round(200 / imu_hz))
    true = truth_of(rng, kind, seconds, imu_hz * fine)
    mems = rng.random() < 0.7
    gyro_bias, accel_bias = (np.radians(0.3), 0.15) if mems else (np.radians(2 / 3600), 1e-3)
    noise = (5e-4, 5e-3) if mems else (2e-5, 5e-4)  # rad/s, m/s^2 in 1 Hz
    increments, out = rng.random() < 0.3, []
    for values, bias, density in zip(
        (true.gyro, true.accel), (gyro_bias, accel_bias), noise, strict=True
    ):
        samples = values[::fine]
        if increments:
            steps = 0.5 * (values[1:] + values[:-1])
            whole = steps[: len(steps) // fine * fine].reshape(-1, fine, 3).mean(axis=1)
            samples = np.concatenate([samples[:1], whole])
        errors = np.eye(3) + rng.normal(0, 0.004 if mems else 2e-4, (3, 3))
        white = density * np.sqrt(imu_hz) * rng.normal(size=samples.shape)
        walk = np.cumsum(0.01 * density / np.sqrt(imu_hz) * rng.normal(size=samples.shape), axis=0)
        out.append(samples @ errors.T + rng.normal(0, bias, 3) + white + walk)
    t = true.t[::fine][: len(out[0])]
    epoch = SECOND * (345_600 if rng.random() < 0.5 else 1_700_000_000)
    ns = epoch + np.round(t * 1e9).astype(np.int64)
    if increments:
        out = [x / imu_hz for x in out]
    imu = ImuTable(ns, *out, "increment" if increments else "rate", source="imu.csv")
    at = np.arange(rng.uniform(0.1, 1.0), seconds - 1, 1 / fix_hz)
    for _ in range(rng.integers(0, 3)):
        begin, length = rng.uniform(0.2, 0.8) * seconds, rng.uniform(5, 40)
        at = at[(at < begin) | (at > begin + length)]
    sigma_m, sigma_v = ((0.02, 0.03), (0.5, 0.05), (1.5, 0.1))[rng.integers(3)]

    def there(x):
        return np.stack([np.interp(at, true.t, c) for c in x.T], -1)

    arm = np.array(lever) if np.any(lever) else rng.normal(0, 0.1, 3)
    v = there(true.v_n + np.einsum("nij,nj->ni", true.C, np.cross(true.gyro, arm)))
    place = there(true.place)
    off = there(np.einsum("nij,j->ni", true.C, arm)) + sigma_m * rng.normal(size=v.shape)
    scale = np.stack([0 * at + A, A * np.cos(place[:, 0]), 0 * at - 1], -1)
    place = place + off / scale
    sigmas = [np.full(v.shape, s) for s in (sigma_m, sigma_v)]
    v = v + sigma_v * rng.normal(size=v.shape)
    without = sigma_m == 0.02 and rng.random() < 0.3
    gnss = GnssTable(
        epoch + np.round(at * 1e9).astype(np.int64),
        *place.T,
        sigmas[0],
        None if without else v,
        None if without else sigmas[1],
        np.ones(len(at), int),
        source="fixes.pos",
    )
    words = f"{seed} {kind}, IMU {imu_hz} Hz, fixes {fix_hz:g} Hz"
    return Dataset(f"{words}, {sigma_m} m{', no velocities' if without else ''}", imu, gnss)


def bare(seed):
    """A sound drive of positions alone, with noise of 0.02 to 5 m that is not stated."""
    d, rng = sound(seed, straight=seed % 2 == 1), np.random.default_rng([seed, 1])
    noise_m = 0.02 * 250.0 ** rng.random()
    scale = np.stack([0 * d.gnss.lat_rad + A, A * np.cos(d.gnss.lat_rad), 0 * d.gnss.lat_rad + 1])
    off = noise_m * np.array([1.0, 1.0, 2.0]) * rng.normal(size=(len(d.gnss), 3)) / scale.T
    place = np.stack([d.gnss.lat_rad, d.gnss.lon_rad, d.gnss.alt_m], -1) + off
    gnss = GnssTable(d.gnss.time_ns, *place.T, np.full(place.shape, np.nan), source="fixes.csv")
    return replace(d, name=f"{d.name}, {noise_m:.2f} m more", gnss=gnss)


class Fault(NamedTuple):
    """A way to spoil a drive, and what should be found."""

    spoil: Callable[[Dataset], Dataset]
    codes: str  # of which one must be found
    estimate: str = ""  # name among `estimates` ...
    value: float = 0.0  # ... and its true value
    beside: str = ""  # codes that are no wrong names
    of: str = ""  # formal sigma that tells where it cannot be known ...
    size: float = np.inf  # ... with less than five of it


def gyros(M):
    """Gyros as their matrix makes them."""
    return lambda d: replace(d, imu=replace(d.imu, gyro=d.imu.gyro @ np.transpose(M)))


def forces(M):
    """Accelerometers as their matrix makes them."""
    return lambda d: replace(d, imu=replace(d.imu, accel=d.imu.accel @ np.transpose(M)))


def both(M):
    """Both triads as one matrix makes them."""
    return lambda d: forces(M)(gyros(M)(d))


def fixes_at(change):
    """Stamps of fixes changed by a function of the seconds since the first and of their middle."""

    def spoil(d):
        ns = d.gnss.time_ns
        t = (ns - ns[0]) * 1e-9
        new = ns[0] + np.round(1e9 * change(t, 0.5 * t[-1])).astype(np.int64)
        return replace(d, gnss=replace(d.gnss, time_ns=new))

    return spoil


def step(seconds):
    """A clock of the receiver that is set in the middle of the drive."""
    return fixes_at(lambda t, middle: t + seconds * (t > middle))


def about_z(deg):
    """(3, 3) turn about z."""
    c, s = np.cos(np.radians(deg)), np.sin(np.radians(deg))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def far(d):
    """The same drive with the antenna ahead of the IMU and beside it."""
    return sound(int(d.name.split()[0]), (2.0, -1.0, 0.0))


EYE = np.eye(3)
UNITS = {
    "deg/s": 180 / np.pi,
    "deg/h": 180 / np.pi * 3600,
    "mdeg/s": 180e3 / np.pi,
    "mrad/s": 1e3,
    "rev/min": 30 / np.pi,
    "16.4 counts": 16.4 * 180 / np.pi,
    "131 counts": 131 * 180 / np.pi,
}
AXES = "gyro_axes gyro_reversed left_handed accel_axes accel_reversed"
JUMP = "gap_long gap_short clock_set_back time_backward little_overlap no_overlap"
FAULTS = {
    **{
        f"gyros x {k}": Fault(gyros(k * EYE), "gyro_scale gyro_unit", "gyros", 1 / k)
        for k in (0.25, 0.5, 0.7, 1.4, 2.0, 4.0)
    },
    "gyro z x 1.5": Fault(gyros(np.diag([1, 1, 1.5])), "gyro_scale", "gyro z", 1 / 1.5),
    **{
        f"gyros in {u}": Fault(gyros(k * EYE), "gyro_unit", "gyros", 1 / k)
        for u, k in UNITS.items()
    },
    "gyros x, y exchanged": Fault(gyros(EYE[[1, 0, 2]]), AXES),
    "gyro z negated": Fault(gyros(np.diag([1, 1, -1])), "gyro_axes"),
    "gyros negated": Fault(gyros(-EYE), "gyro_reversed"),
    "accel y negated": Fault(forces(np.diag([1, -1, 1])), "accel_axes"),
    "left-handed": Fault(both(np.diag([1, -1, 1])), "left_handed"),
    "yaw of 20 deg": Fault(both(about_z(-20)), "forward_axis", "forward", -20.0),
    "gyros turned 20 deg": Fault(gyros(about_z(20)), "gyro_axes", "gyros turned", 20.0),
    **{
        f"step of {s} s": Fault(step(s), "time_jump leap_seconds", "step", -s, JUMP, "step", abs(s))
        for s in (1, 18, 36, 3600, -18)
    },
    "offset of 18 s": Fault(
        fixes_at(lambda t, _: t + 18), "leap_seconds", "offset", -18.0, "", "offset", 18.0
    ),
    "latency of 0.3 s": Fault(
        fixes_at(lambda t, _: t + 0.3), "time_offset", "offset", -0.3, "", "offset", 0.3
    ),
    **{
        f"lever arm along {axis}": Fault(
            far, "lever_arm", *[f"lever {axis}", value, ""], *[f"lever {axis}", abs(value)]
        )
        for axis, value in (("x", 2.0), ("y", -1.0))
    },
    "drift of 1 %": Fault(
        fixes_at(lambda t, _: 1.01 * t), "clock_rate", "rate", 1 / 1.01 - 1, "", "rate", 0.01
    ),
}
JUMPS = ("time_jump", "leap_seconds")  # some of stamps alone
NAMES = f"{AXES} gyro_unit gyro_scale force_scale time_offset time_jump leap_seconds clock_rate"
NAMES = set(f"{NAMES} forward_axis".split())


class Seen(NamedTuple):
    """Findings of a log, and the estimates behind them."""

    findings: list
    estimates: dict
    formal: dict  # sigmas of clock and lever arm with a free clock


def seen(d):
    """Examine a log, and keep what was estimated of it."""
    kept = []
    judged = checks_motion.judge
    checks_motion.judge = lambda *args: kept.append(judged(*args)) or kept[-1]
    try:
        findings = examine(d)
    finally:
        checks_motion.judge = judged
    verdict = kept[-1] if kept else None
    if verdict is None:
        return Seen(findings, {}, {})
    sigma = verdict.clocked.sigma
    formal = {"offset": sigma[OFFSET], "step": 2.0 * sigma[OFFSET], "rate": sigma[RATE]}
    formal |= {f"lever {axis}": s for axis, s in zip("xyz", sigma[LEVER], strict=True)}
    return Seen(findings, checks_motion.estimates(verdict), formal)


def quoted(name, fault, drives, found_in):
    """A line about a fault in all drives."""
    found = within = known = wrong = n = 0
    codes_all = Counter()
    for d, formal in drives:
        if 5.0 * formal.get(fault.of, 0.0) > fault.size:
            continue
        n += 1
        findings, found_here, _ = seen(fault.spoil(d))
        codes = {f.code for f in findings if f.severity != "note"}
        codes_all.update(codes)
        hit = bool({f.code for f in findings} & set(fault.codes.split()))
        found += hit
        wrong += bool(codes & NAMES - set(f"{fault.codes} {fault.beside}".split()))
        if hit and fault.estimate:
            value, sigma = found_here.get(fault.estimate, (np.nan, np.nan))
            known += 1
            ok = abs(value - fault.value) < 3 * sigma
            within += ok
            if not ok:
                found_in.append(f"{name}: {d.name}: {value:.4g} +- {sigma:.2g}, {fault.value:.4g}")
        if not hit:
            found_in.append(f"{name}: {d.name}: not found, but {sorted(codes)}")
    share = f"{within / known:4.0%}" if known else "   -"
    of = max(n, 1)
    print(
        f"{name:<22}{n:6}{len(drives) - n:8}{found / of:7.0%}{share:>8}{wrong / of:8.0%}  "
        f"{dict(codes_all.most_common(4))}",
        flush=True,
    )


def main():
    """Print the shares."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sound", type=int, default=20, help="drives without a fault")
    parser.add_argument("--drives", type=int, default=8, help="drives for each fault")
    parser.add_argument("--bare", type=int, default=0, help="sound drives of positions alone")
    parser.add_argument("--only", default="", help="faults whose names hold this")
    parser.add_argument("--why", action="store_true", help="print what was not found")
    args = parser.parse_args()
    began, above, others, checked, spoilt, why, good = time.process_time(), 0, 0, 0, 0, [], []
    for k in range(max(args.sound, args.drives * 2)):
        drive = sound(args.seed + k)
        if k < args.sound or len(good) < args.drives:
            findings, _, formal = seen(drive)
            bad = [f for f in findings if f.severity != "note"]
            judged = all(f.code != "motion_not_checked" for f in findings)
            if judged and len(good) < args.drives:
                good.append((drive, formal))
            if k < args.sound:
                of_motion = any(
                    f.code in NAMES and ("motion fits" in f.sentence or f.code not in JUMPS)
                    for f in bad
                )
                above, others = above + of_motion, others + (bool(bad) and not of_motion)
                checked += judged
                why += [f"sound: seed {args.seed + k}, {drive.name}: {f}" for f in bad]
    seconds = time.process_time() - began
    each = seconds / max(args.sound, len(good), 1)
    print(
        f"{args.sound} sound drives, {checked} with enough motion. Findings above a note: by their"
    )
    print(f"motion in {above}, others in {others}; {each:.2f} s of processor time each")
    for k in range(args.bare):
        drive = bare(args.seed + k)
        bad = [f for f in examine(drive) if f.severity != "note"]
        why += [f"bare: {drive.name}: {f}" for f in bad]
        spoilt = spoilt + bool(bad)
    if args.bare:
        print(
            f"{args.bare} sound drives of positions alone, half of them straight, without sigmas:"
        )
        print(f"findings above a note in {spoilt}")
    names = f"{'drives':>6}{'unknown':>8}{'found':>7}{'in 3 s':>8}{'wrong':>8}"
    print(f"{'fault':<22}{names}  codes above a note")
    for name, fault in FAULTS.items():
        if good and args.only in name:
            quoted(name, fault, good, why)
    if args.why:
        print(*why, sep="\n")


if __name__ == "__main__":
    main()
