"""Pictures of the live page, with a made-up bench behind it: light, dark, wide, narrow.

The numbers are drawn, not simulated: a star sensor that is wrong by 10 deg once and is stuck later,
and a node that died. Needs a Chromium and the extras "live" and "dev".

python docs/studies/live_pictures.py [--folder docs/pictures] [--all]
"""

from __future__ import annotations

import argparse
import math
import shutil
import time
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from playwright.sync_api import sync_playwright

from robins.bench.live import Live, Signal

PICTURES = Path(__file__).resolve().parents[1] / "pictures"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
RATE_HZ = 10.0
STAR_EVERY = 5  # samples
PARTS = ("plant", "table", "gyro", "star", "adm", "acm", "actuators")
WHEEL_LIMIT = 0.5  # N m s
STUCK_S = (118.0, 126.0)


def signals() -> list[Signal]:
    """What the page of the satellite shows."""
    found = []
    for plot, unit in (("Attitude error", "arcsec"), ("Innovation", "arcsec")):
        found += [Signal(f"{plot} {axis}", unit, plot) for axis in "xyz"]
        found += [
            Signal(f"{plot} sigma {axis}", unit, plot, "sigma", f"{plot} {axis}") for axis in "xyz"
        ]
    found += [Signal(f"Pointing error {axis}", "arcsec", "Pointing error") for axis in "xyz"]
    found += [Signal("Test ratio", "1", "Test ratio"), Signal("gate", "1", "Test ratio", "limit")]
    found += [Signal(f"Rate {axis}", "arcsec/s", "Body rate") for axis in "xyz"]
    found += [Signal(f"Wheel {k}", "N m s", "Wheel momentum") for k in range(1, 5)]
    return [*found, Signal("wheel limit", "N m s", "Wheel momentum", "limit")]


def samples(seconds: float, seed: int = 1) -> Iterator[tuple[float, list[float]]]:
    """Times and values that look like those of a satellite that points to the Earth."""
    draw = np.random.default_rng(seed)
    attitude, pointing, rate = np.zeros(3), np.zeros(3), np.zeros(3)
    for k in range(int(seconds * RATE_HZ)):
        t = (k + 1) / RATE_HZ
        stuck = STUCK_S[0] <= t < STUCK_S[1]
        frame = k % STAR_EVERY == 0
        since = t - STUCK_S[0] if stuck else (k % STAR_EVERY) / RATE_HZ
        sigma = 2.6 + 30.0 * math.exp(-t / 4.0) + 0.25 * since
        attitude = 0.94 * attitude + 0.34 * sigma * draw.normal(size=3)
        rate = 0.9 * rate + 0.4 * draw.normal(size=3)
        pointing = 0.96 * pointing + 0.05 * attitude + 0.1 * rate + 0.5 * draw.normal(size=3)
        wrong = frame and abs(t - 96.1) < 0.3
        spread = math.hypot(sigma, 8.0)
        innovation = attitude + spread * 0.8 * draw.normal(size=3)
        innovation += 36000.0 * wrong + (219.0 * since * stuck) * np.array([0.0, -1.0, 0.1])
        ratio = float(np.sum((innovation / spread) ** 2) / 27.9)
        seen = frame and t > 2.0
        missing = np.full(3, math.nan)
        slow = 2.0 * math.pi * t / 400.0
        wheels = [0.16 + 0.02 * math.sin(slow + j) + 0.001 * draw.normal() for j in range(4)]
        wheels[2] = -wheels[2]
        yield (
            t,
            [
                *attitude,
                *np.full(3, sigma) * (1.0, 1.1, 1.3),
                *(innovation if seen else missing),
                *(np.full(3, spread) * (1.0, 1.0, 1.2) if seen else missing),
                *pointing,
                ratio if seen else math.nan,
                1.0,
                *(rate + np.array([0.0, -219.0, 0.0])),
                *wheels,
                WHEEL_LIMIT,
            ],
        )


def status(t: float, faults: list[Any], state: str = "running") -> dict[str, Any]:
    """Health of the made-up bench."""
    n = int(100 * t)
    links = {
        part: {
            "frames": (3 if part == "adm" else 2) * n,
            "wrong": 14 if part == "gyro" else 0,
            "lost": 15 if part == "gyro" else 0,
            "late": 0,
            "silent_s": 2.4 if part == "acm" else 0.01,
        }
        for part in PARTS
    }
    return {
        "state": state,
        "clock": "real time, 100 Hz",
        "deadlines": {
            "missed": 3,
            "cycles_per_s": 99.98,
            "lateness_us": {"p50": 171.0, "p99": 538.0, "max": 5904.0},
            "histogram": {
                "edges_us": [10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000],
                "counts": [0, 2, 80, 2900, 5200, 3000, 90, 4, 2, 1, 0],
            },
        },
        "links": links,
        "nodes": {part: "restarting" if part == "acm" else "running" for part in PARTS},
        "faults": faults,
        "counts": {
            "frames": 17 * n,
            "wrong_frames": 14,
            "lost_frames": 15,
            "refused_measurements": 17,
        },
    }


def tell(live: Live, until_s: float) -> None:
    """A run from its beginning."""
    for t, values in samples(until_s):
        live.push(t, values)
        time.sleep(0.0005)  # the page is to get all of them
    live.status(status(until_s, [{"label": "star stuck", "until_s": STUCK_S[1]}]))
    live.event("info", 0.0, "run 12 begins: satellite/s1, mekf with gate, seed 1")
    live.event("warning", 60.2, "gyro: 14 frames with a wrong check (bit errors are injected)")
    live.event("alarm", 96.1, "star refused: test ratio 2.2e+06")
    live.event("warning", STUCK_S[0], "fault injected: star stuck")
    live.event("alarm", 121.0, "star refused 7 times in a row: test ratio 193")
    live.event("alarm", 123.4, "acm is dead (killed), it is started anew")


def main() -> None:
    """Take the pictures."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--folder", type=Path, default=PICTURES)
    parser.add_argument("--all", action="store_true", help="every size, not only that of the docs")
    given = parser.parse_args()
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise SystemExit(f"no browser: none of {', '.join(BROWSERS)} is installed")
    views = {"live": (1280, 800, "light")}
    if given.all:
        views |= {
            "live-dark": (1280, 800, "dark"),
            "live-wide": (1920, 1080, "dark"),
            "live-narrow": (480, 900, "light"),
        }
    faults = [{"label": label, "fault": {}} for label in ("star stuck", "star wrong by 10 deg")]
    with (
        Live(signals(), "satellite/s1", 11, faults=faults) as live,
        sync_playwright() as play,
        play.chromium.launch(executable_path=browser, args=["--no-sandbox"]) as chromium,
    ):
        for name, (width, height, scheme) in views.items():
            live.new_run(live.run + 1)
            page = chromium.new_page(
                viewport={"width": width, "height": height},
                color_scheme="dark" if scheme == "dark" else "light",
            )
            page.goto(live.url)
            page.wait_for_selector(".plot")
            tell(live, 124.0)
            page.wait_for_function("() => bench.shown >= 1240")
            picture = Image.open(BytesIO(page.screenshot(full_page=given.all)))
            picture.quantize(256).save(given.folder / f"{name}.png", optimize=True)
            print(name, page.evaluate("[bench.shown, bench.errors]"))
            page.close()


if __name__ == "__main__":
    main()
