"""Faults of rows that the doctor finds, and findings in sound drives.

python benchmarks/doctor_rows.py [--drives N] [--seed K]

Random drives by NumPy: rates of 25 to 400 Hz, fixes of 0.2 to 10 Hz with outages, noise and biases
of MEMS to tactical units, columns in steps of their noise or finer, vibration, increments or
rates, stamps of Unix time or of the week. Then each fault in each drive: the share in which its
finding is made, and in which another finding above a note is. What compares tables has a benchmark
of its own and is left out. Thresholds were chosen on seed 0; quote seed 3000.
"""

import argparse
from collections import Counter

import numpy as np

from robins.dataset import GnssTable, ImuTable
from robins.logs import doctor

G = 9.80665
doctor.TOGETHER = ()


def motion(t, k):
    """Velocity and attitude angles: rest, then speed, turns and hills."""
    s = np.maximum(t - k["rest"], 0.0)
    begin = s**2 / (s**2 + 25.0)
    speed = begin * k["speed"] * (1.0 + 0.3 * np.sin(k["w"][0] * s))
    roll, pitch = begin * 0.05 * np.sin(k["w"][1] * s), begin * 0.06 * np.sin(k["w"][2] * s + 1.0)
    heading = k["heading"] + begin * k["turn"] * np.sin(k["w"][3] * s)
    level = speed * np.cos(pitch)
    v = np.stack([level * np.cos(heading), level * np.sin(heading), -speed * np.sin(pitch)], -1)
    return v, roll, pitch, heading


def drive(rng):
    """Stamps [s], rates, specific forces and fixes of a random drive."""
    k = {"rest": rng.uniform(12, 40), "speed": rng.uniform(3, 40), "w": rng.uniform(0.05, 0.6, 4)}
    k |= {"heading": rng.uniform(-3, 3), "turn": rng.uniform(0.3, 2.5)}
    rate, fix_s = np.exp(rng.uniform(np.log(25), np.log(400))), rng.choice([0.1, 0.2, 1.0, 5.0])
    rate = round(rate) if rng.random() < 0.5 else rate
    t, h = np.arange(0, rng.uniform(90, 200), 1 / rate), 1e-4
    before, now, after = (motion(t + d, k) for d in (-h, 0, h))
    dr, dp, dh = ((b - a) / (2 * h) for a, b in zip(before[1:], after[1:], strict=True))
    _, r, p, y = now
    gyro = np.stack([dr - dh * np.sin(p), dp * np.cos(r) + dh * np.sin(r) * np.cos(p),
                     dh * np.cos(r) * np.cos(p) - dp * np.sin(r)], -1)  # fmt: skip
    a = (after[0] - before[0]) / (2 * h) - [0, 0, G]
    c, s = (np.cos([r, p, y]), np.sin([r, p, y]))
    (cr, cp, cy), (sr, sp, sy) = c, s
    rows = (
        (cp * cy, cp * sy, -sp),
        (sr * sp * cy - cr * sy, sr * sp * sy + cr * cy, sr * cp),
        (cr * sp * cy + sr * sy, cr * sp * sy - sr * cy, cr * cp),
    )
    accel = np.stack([sum(m * a[:, i] for i, m in enumerate(row)) for row in rows], -1)
    grade = np.exp(rng.uniform(np.log(1e-3), 0.0))  # of a cheap MEMS unit
    noise = grade * np.array([2e-4, 2e-3]) * np.sqrt(rate)
    moving = (t > k["rest"])[:, None]
    shake = np.sin(2 * np.pi * rng.uniform(20, 90, 3) * t[:, None] + rng.uniform(0, 6, 3))
    gyro = gyro + noise[0] * rng.normal(size=gyro.shape) + grade * 0.01 * rng.normal(size=3)
    accel = accel + noise[1] * rng.normal(size=gyro.shape) + grade * 0.1 * rng.normal(size=3)
    accel += rng.choice([0.0, 0.0, 1.0, 3.0]) * shake * moving
    steps = noise * np.exp(rng.uniform(np.log(0.05), 0.0))
    gyro, accel = (np.round(x / step) * step for x, step in zip((gyro, accel), steps, strict=True))
    at = np.arange(0, t[-1], fix_s)
    out = rng.uniform(0, t[-1]), rng.choice([0, 10, 18.5, 19, 40])
    at = at[(at < out[0]) | (at > out[0] + out[1])]
    fine = np.arange(0, t[-1] + 0.01, 0.01)
    v = motion(fine, k)[0]
    way = np.concatenate([[[0, 0, 0]], np.cumsum((v[1:] + v[:-1]) * 0.005, axis=0)])
    n = np.rint(at * 100).astype(int)
    fix = way[n] + 0.02 * rng.normal(size=(len(at), 3)), v[n] + 0.03 * rng.normal(size=(len(at), 3))
    start = rng.choice([1.7e9, rng.uniform(0, 6e5)])
    d = {"t": t, "gyro": gyro, "accel": accel, "at": at, "fix": fix, "moving": moving}
    d |= {"start": round(start), "rate": rate, "lat": rng.uniform(-1.2, 1.2)}
    return d | {"kind": rng.choice(["rate", "increment"]), "quality": np.ones(len(at), int)}


def found(d, stamps=None):
    """Findings above a note, and all codes; stamps [ns] since the start."""
    ns = np.rint(d["t"] * 1e9).astype(np.int64) if stamps is None else stamps
    per = 1.0 / d["rate"] if d["kind"] == "increment" else 1.0
    imu = ImuTable(d["start"] * 10**9 + ns, d["gyro"] * per, d["accel"] * per, str(d["kind"]))
    (north, east, down), v = d["fix"][0].T, d["fix"][1]
    lat = d["lat"] + north / 6.37e6
    sigma = np.full(v.shape, 0.02)
    gnss = GnssTable(d["start"] * 10**9 + np.rint(d["at"] * 1e9).astype(np.int64), lat,
                     0.2 + east / (6.37e6 * np.cos(d["lat"])), 100.0 - down, sigma, v, 1.5 * sigma,
                     d["quality"])  # fmt: skip
    every = doctor.examine([imu, gnss])
    return {f.code for f in every if f.severity != "note"}, {f.code for f in every}


def shared(rng, d):
    n = int(rng.integers(2, min(40, d["rate"])))
    ns, row = np.rint(d["t"] * 1e9).astype(np.int64), np.arange(len(d["t"]))
    return d, ns[np.minimum(row // n * n + n - 1, len(ns) - 1)]


def bursts(rng, d):
    d, ns = shared(rng, d)
    first = np.flatnonzero(np.diff(ns, prepend=ns[0] - 1))
    sizes = np.diff(first, append=len(ns))
    since = np.arange(len(ns)) - np.repeat(first + sizes - 1, sizes)
    gap = min(rng.uniform(0.01, 0.08) / d["rate"], 2e-4) * 1e9
    return d, ns + np.rint(since * gap).astype(np.int64) + rng.integers(0, 500, len(ns))


def digits(rng, d):
    lost = 10 ** int(np.ceil(np.log10(rng.choice([1.5, 3.0, 10.0, 30.0]) / d["rate"] * 1e9)))
    return d, np.rint(np.rint(d["t"] * 1e9) / lost).astype(np.int64) * lost


def clipped(rng, d):
    size, axis = rng.uniform(1.0, 2.0) * G, rng.integers(0, 3)
    shake = size * np.sin(2 * np.pi * rng.uniform(20, 90) * d["t"]) * d["moving"][:, 0]
    accel = d["accel"].copy()
    accel[:, axis] += shake
    level = np.quantile(np.abs(accel[:, axis]), 1.0 - rng.uniform(0.02, 0.3))
    level = max(level, 1.2 * np.abs(accel[~d["moving"][:, 0], axis]).max())  # rest is in the range
    accel[:, axis] = np.clip(accel[:, axis], -level, level)
    return d | {"accel": accel}, None


def unloaded(rng, d):
    return d | {"accel": d["accel"] + [0, 0, G]}, None


def floats(rng, d):
    return d | {"quality": 1 + (np.arange(len(d["at"])) > len(d["at"]) // 2)}, None


FAULTS = {
    "stamps of a FIFO": (shared, {"stamps_shared"}),
    "bursts": (bursts, {"stamps_shared"}),
    "lost digits": (digits, {"stamps_shared", "stamps_rounded"}),
    "clipping": (clipped, {"saturated"}),
    "gravity removed": (unloaded, {"gravity_missing", "gravity_not_seen"}),
    "float fixes": (floats, {"float_sigma"}),
}


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--drives", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--verbose", action="store_true")
    asked = parser.parse_args()
    hits, wrong, names, loud = Counter(), Counter(), Counter(), Counter()
    for k in range(asked.drives):
        rng = np.random.default_rng([asked.seed, k])
        d = drive(rng)
        sound = found(d)[0]
        loud.update(sound)
        loud["any"] += bool(sound)
        for name, (spoil, codes) in FAULTS.items():
            above, every = found(*spoil(rng, d))
            hits[name] += bool(every & codes)
            others = above - codes - sound
            wrong[name] += bool(others)
            names.update((name, code) for code in others)
            if asked.verbose and (others or not every & codes):
                print(k, name, sorted(every), {x: d[x] for x in ("rate", "kind")})
    n = asked.drives
    print(f"sound drives with a finding above a note: {loud.pop('any')} of {n} {dict(loud)}")
    for name in FAULTS:
        others = {code: k for (fault, code), k in names.items() if fault == name}
        shares = f"found {hits[name] / n:6.1%}, another name {wrong[name] / n:6.1%}"
        print(f"{name:18} {shares} {others}")


if __name__ == "__main__":
    main()
