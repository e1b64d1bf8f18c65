"""Pictures of the live page of a real run: light, dark, wide, narrow.

A satellite points to the Earth in real time while its star sensor is wrong by 10 deg once and is
stuck later, and the line of its gyro is noisy for a while. Needs a Chromium and the extras "live"
and "dev".

python docs/studies/live_pictures.py [--folder docs/pictures] [--all]
"""

from __future__ import annotations

import argparse
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from io import BytesIO
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

PICTURES = Path(__file__).resolve().parents[1] / "pictures"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
AT_S = 124.0  # of the run
SCENARIO = """
bench = "satellite"
title = "satellite/s1, MEKF with a gate"
flies = "satellite/s1"
filter = "mekf-gate"
clock = "realtime"
rate = "20 Hz"

[[faults]]
kind = "bit errors"
link = "gyro"
begin = "80 s"
end = "84 s"
share = 0.3

[[faults]]
kind = "turned"
angle = "10 deg"
begin = "96 s"
end = "96.5 s"

[[faults]]
kind = "stuck"
begin = "116 s"
end = "126 s"
"""


def views(every: bool) -> dict[str, tuple[int, int, str]]:
    """Width, height and scheme of colours, by the name of the picture."""
    found = {"live": (1280, 800, "light")}
    if every:
        found |= {
            "live-dark": (1280, 800, "dark"),
            "live-wide": (1920, 1080, "dark"),
            "live-narrow": (480, 900, "light"),
        }
    return found


def main() -> None:
    """Take the pictures."""
    ask = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    ask.add_argument("--folder", type=Path, default=PICTURES)
    ask.add_argument("--all", action="store_true", help="every size, not only that of the docs")
    asked = ask.parse_args()
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise SystemExit(f"no browser: none of {', '.join(BROWSERS)} is installed")
    with tempfile.TemporaryDirectory() as folder:
        scenario = Path(folder) / "picture.toml"
        scenario.write_text(SCENARIO)
        robins = str(Path(sys.executable).with_name("robins"))
        command = [robins, "bench", "up", str(scenario)]
        command += ["--live", "--paused", "--port", "0", "--out", str(Path(folder) / "out")]
        bench = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        try:
            assert bench.stderr is not None
            found = (re.search(r"http://\S+", line) for line in bench.stderr)
            url = next(match[0] for match in found if match)
            take(url, browser, asked.folder, views(asked.all))
        finally:
            bench.send_signal(signal.SIGINT)
            bench.communicate()


def take(url: str, browser: str, folder: Path, wanted: dict[str, tuple[int, int, str]]) -> None:
    """Start the run from its page, and look at it some time later."""
    with (
        sync_playwright() as play,
        play.chromium.launch(executable_path=browser, args=["--no-sandbox"]) as chromium,
    ):
        pages = {}
        for name, (width, height, scheme) in wanted.items():
            page = pages[name] = chromium.new_page(
                viewport={"width": width, "height": height},
                color_scheme="dark" if scheme == "dark" else "light",
            )
            page.goto(url)
            page.wait_for_selector(".plot")
        next(iter(pages.values())).get_by_test_id("start").click()
        for name, page in pages.items():
            reached = f"() => bench.time >= {AT_S}"
            page.wait_for_function(reached, timeout=300e3)
            picture = Image.open(BytesIO(page.screenshot(full_page=len(pages) > 1)))
            picture.quantize(256).save(folder / f"{name}.png", optimize=True)
            print(name, page.evaluate("[bench.shown, bench.errors]"))


if __name__ == "__main__":
    main()
