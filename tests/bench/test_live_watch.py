"""Watching a long run on the live page: going back, marks, alarms, choice, attitude."""

import os
import signal
import struct
import time
from contextlib import closing, contextmanager

import numpy as np
import pytest
from browsing import a_browser, browse, installed
from playwright.sync_api import expect
from reused_page import ReusedPage
from scipy.spatial.transform import Rotation

from robins.bench.live import LivePage, Signal
from robins.bench.live.history import SampleHistory

SIGNALS = [
    *[Signal(f"error {a}", "arcsec", "Error") for a in "xyz"],
    Signal("ratio", "1", "Ratio"),
]
FAULTS = [{"label": "stuck", "fault": {"kind": "stuck"}}]


@pytest.fixture(scope="module")
def chromium():
    with a_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def server():
    with ReusedPage(SIGNALS, "a long run", 1, faults=FAULTS) as made:
        yield made


@pytest.fixture
def live(server):
    server.next_run()
    server.commands()
    return server


def push(live: LivePage, begin: int, end: int, spikes: tuple[int, ...] = ()) -> None:
    """Samples at 20 Hz, as fast as the server takes them."""
    for k in range(begin, end):
        live.push(0.05 * (k + 1), [np.sin(0.01 * k), 0.5, 90.0 if k in spikes else -0.5, 0.1])
        while len(live._samples) > 100:
            live.poll()
            time.sleep(0.001)
    while live._samples:
        live.poll()
        time.sleep(0.001)


def drawn(page, plot: int, column: int) -> np.ndarray:
    """Points of a line of a plot: times and values."""
    script = "([p, c]) => [0, c].map((k) => bench.plots[p].chart.data[k].map((v) => v ?? null))"
    at, values = np.array(page.evaluate(script, [plot, column]), dtype=float)
    return np.stack([at, values])[:, np.isfinite(values)]


def reached(page, time_s: float) -> None:
    page.wait_for_function(f"() => bench.time >= {time_s - 1e-9}")


def span(page) -> list[float]:
    return page.evaluate("bench.plots[0].span")


# ---------------------------------------------------------------------------------- the whole run


def test_a_late_page_sees_the_whole_run_and_its_spike(chromium, live):
    push(live, 0, 20_000, spikes=(50,))
    with browse(chromium, live.url) as page:
        reached(page, 1000.0)
        expect(page.locator("#time")).to_have_text("16 min 40 s")
        page.get_by_test_id("span").select_option("whole run")
        page.wait_for_function("() => bench.plots[0].span[0] === 0")
        at, values = drawn(page, 0, 3)
        assert at[0] == 0.05
        assert at[-1] == 1000.0
        (spike,) = np.flatnonzero(values == 90.0)
        assert abs(at[spike] - 50 * 0.05) < 2.0
        assert set(values) == {-0.5, 90.0}
        assert 500 < len(at) < 5000
        assert page.evaluate("[bench.received, bench.missed]") == [300, 0]


def test_a_page_that_was_away_for_long_gets_what_it_missed(chromium):
    with ReusedPage(SIGNALS, "a long run", 1) as live, browse(chromium, live.url) as page:
        push(live, 0, 400)
        reached(page, 20.0)
        os.kill(live._process.pid, signal.SIGKILL)
        until = time.monotonic() + 2.0
        while live.alive:
            assert time.monotonic() < until
        for k in range(400, 1500):  # nobody hears them
            live.push(0.05 * (k + 1), [0.0, 0.5, -0.5, 0.1])
        live.restart()
        push(live, 1500, 1501)
        reached(page, 75.05)
        page.get_by_test_id("span").select_option("whole run")
        page.wait_for_function("() => bench.plots[0].span[0] === 0")
        at, _ = drawn(page, 0, 1)
        # a bucket of a single sample is two points at one time
        assert np.array_equal(np.unique(at), 0.05 * np.arange(1, 1502))
        assert page.evaluate("bench.missed") == 0


def a_day(signals: int) -> bytes:
    """State of a server after 24 h of 20 samples a second: 3375 buckets of 512."""
    n, samples = 3375, 24 * 3600 * 20
    first = 0.05 * (512 * np.arange(n) + 1)
    noise = np.random.default_rng(0).uniform(0.5, 1.0, size=(signals, n))
    rows = np.concatenate([[first, first + 0.05 * 511], -noise, noise])
    return struct.pack("<6I", 1, 0xFFFFFFFF, n, signals, 512, samples) + rows.tobytes()


def test_a_day_of_forty_signals_is_light_for_the_page(chromium):
    """The page shows all of it, goes on, and no picture takes long."""
    signals = [Signal(f"s{k}", "m", f"plot {k // 4}") for k in range(40)]
    with ReusedPage(signals, "a day", 1) as live:
        live._history = SampleHistory.unpack(a_day(40))
        live.restart()
        with browse(chromium, live.url) as page:
            live.push(86400.05, np.zeros(40))
            while live._samples or live._partial:  # as a bench does after each step
                live.poll()
                time.sleep(0.001)
            reached(page, 86400.05)
            page.get_by_test_id("span").select_option("whole run")
            page.wait_for_function("() => bench.plots[0].span[0] === 0")
            expect(page.locator("#time")).to_have_text("24 h 00 min")
            assert len(drawn(page, 0, 1)[0]) < 2500
            times = []
            for k in range(2, 60):
                live.push(86400.0 + 0.05 * k, np.zeros(40))
                page.keyboard.press("ArrowLeft" if k % 2 else "ArrowRight")
                page.wait_for_timeout(30)
                times.append(page.evaluate("bench.drawn_ms"))
            assert np.median(times) < 150.0  # 25 ms on a quiet machine
            assert page.evaluate("performance.memory.usedJSHeapSize") < 100e6


# ------------------------------------------------------------------------------ holding, going back


def test_plots_are_held_while_the_run_goes_on(chromium, live):
    with browse(chromium, live.url) as page:
        push(live, 0, 2400)
        reached(page, 120.0)
        assert span(page) == [60.0, 120.0]
        page.get_by_test_id("hold").click()
        push(live, 2400, 2800)
        reached(page, 140.0)
        assert span(page) == [60.0, 120.0]
        expect(page.get_by_test_id("window")).to_contain_text("20.0 s ago")
        expect(page.get_by_test_id("follow")).to_have_attribute("aria-pressed", "false")
        page.get_by_test_id("follow").click()
        page.wait_for_function("() => bench.plots[0].span[1] === 140")
        expect(page.get_by_test_id("window")).to_have_text("")
        assert live.commands() == []


@pytest.mark.parametrize(
    ("keys", "wanted"),
    [
        (["h", "h"], [60.0, 120.0]),
        (["ArrowLeft", "ArrowLeft"], [30.0, 90.0]),
        (["ArrowLeft", "ArrowRight"], [60.0, 120.0]),
        (["ArrowRight"], [60.0, 120.0]),  # not into the future
        (["+"], [70.0, 110.0]),
        (["-"], [30.0, 120.0]),  # 90 s, which end with the run
        (["-", "-"], [0.0, 120.0]),
        (["Home"], [0.0, 60.0]),
        (["Home", "End"], [60.0, 120.0]),
    ],
)
def test_the_keyboard_goes_back_and_zooms(chromium, live, keys, wanted):
    with browse(chromium, live.url) as page:
        push(live, 0, 2400)
        reached(page, 120.0)
        page.locator("h1").click()
        for key in keys:
            page.keyboard.press(key)
        page.wait_for_function(
            "(w) => bench.plots[0].span.every((t, k) => Math.abs(t - w[k]) < 1e-9)", arg=wanted
        )


def test_plots_are_dragged_and_zoomed_with_the_mouse(chromium, live):
    with browse(chromium, live.url) as page:
        push(live, 0, 2400)
        reached(page, 120.0)
        box = page.locator(".u-over").first.bounding_box()
        x, y = box["x"] + 0.5 * box["width"], box["y"] + 20
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 0.25 * box["width"], y, steps=5)
        page.mouse.up()
        page.wait_for_function("() => Math.abs(bench.plots[0].span[0] - 45) < 0.5")
        begin, end = span(page)
        assert end - begin == pytest.approx(60.0)
        # zooming leaves what is under the mouse where it is: three quarters of the way
        under = begin + 0.75 * (end - begin)
        page.keyboard.down("Control")
        page.mouse.wheel(0, -200)
        page.keyboard.up("Control")
        page.wait_for_function(f"() => bench.plots[0].span[1] < {end} - 0.1")
        begin, end = span(page)
        assert end - begin == pytest.approx(60.0 * np.exp(-0.4), rel=1e-6)
        assert begin + 0.75 * (end - begin) == pytest.approx(under, abs=0.2)
        # a click on the strip of the whole run goes there
        strip = page.get_by_test_id("overview").bounding_box()
        page.mouse.click(strip["x"] + strip["width"] / 3, strip["y"] + 10)
        page.wait_for_function(
            "() => Math.abs((bench.plots[0].span[0] + bench.plots[0].span[1]) / 2 - 40) < 0.5"
        )


# ----------------------------------------------------------------------------- events and faults

COLUMN = """([plot, time]) => {
  const { chart } = bench.plots[plot];
  const { ctx, bbox } = chart;
  const x = Math.round(chart.valToPos(time, "x", true));
  const { data } = ctx.getImageData(x, bbox.top + 4, 1, bbox.height - 8);
  let covered = 0;
  for (let k = 3; k < data.length; k += 4) covered += data[k] > 0;
  return covered / (data.length / 4);
}"""


def test_events_and_faults_are_marked_in_the_plots(chromium, live):
    with browse(chromium, live.url) as page:
        push(live, 0, 1000)
        reached(page, 50.0)
        # between two lines of the grid nothing is drawn but the lines of the signals
        assert page.evaluate(COLUMN, [1, 23.3]) < 0.1
        assert page.evaluate(COLUMN, [1, 33.3]) < 0.1
        live.event("alarm", 23.3, "star refused")
        spans = [{"label": "stuck", "begin_s": 32.1, "end_s": 34.5}]
        live.status({"state": "running", "fault_spans": spans})
        page.wait_for_function(f"() => ({COLUMN})([1, 33.3]) === 1")
        assert 0.25 < page.evaluate(COLUMN, [1, 23.3]) < 0.75  # dashed
        assert page.evaluate(COLUMN, [1, 27.3]) < 0.1
        expect(page.locator("#faults li.over")).to_contain_text("32.1 s to 34.5 s")


def test_a_click_on_an_event_or_a_fault_goes_there(chromium, live):
    with browse(chromium, live.url) as page:
        push(live, 0, 4000)
        live.event("warning", 40.0, "gyro held")
        live.event("info", 90.0, "later")
        spans = [{"label": "stuck", "begin_s": 120.0, "end_s": 121.0}]
        live.status({"state": "running", "fault_spans": spans})
        reached(page, 200.0)
        page.locator("#events li", has_text="gyro held").click()
        page.wait_for_function("() => bench.plots[0].span[0] === 10")
        assert span(page) == [10.0, 70.0]
        expect(page.locator("#events li.chosen")).to_contain_text("gyro held")
        page.get_by_test_id("events").focus()
        page.keyboard.press("ArrowDown")
        page.keyboard.press("Enter")
        page.wait_for_function("() => bench.plots[0].span[0] === 60")
        page.locator("#faults li.over button").click()
        page.wait_for_function("() => bench.plots[0].span[0] === 90")


def test_what_comes_again_and_again_is_one_line_with_a_count(chromium, live):
    with browse(chromium, live.url) as page:
        live.status({"state": "running"})
        expect(page.get_by_test_id("bench-state")).to_have_text("running")
        for _ in range(50):
            page.get_by_test_id("pause").click()
        heard = 0
        until = time.monotonic() + 3.0
        while heard < 50 and time.monotonic() < until:
            for command in live.commands():
                live.event("warning", 0.1 * heard, command["do"])
                heard += 1
            live.poll()
        expect(page.locator("#events li")).to_have_count(1)
        expect(page.locator("#events li")).to_contain_text("pause  ×50")
        expect(page.get_by_test_id("answer")).to_have_text("pause: the bench has it (50 times)")


# ----------------------------------------------------------------------------------------- alarms


def test_an_alarm_stays_until_it_is_acknowledged_on_any_page(chromium, live):
    with browse(chromium, live.url) as page, browse(chromium, live.url) as other:
        expect(page.get_by_test_id("acknowledge")).to_be_hidden()
        for k in range(3):
            live.event("alarm", 1.0 + k, f"alarm {k}")
            live.event("info", 1.5 + k, f"info {k}")
        for one in (page, other):
            expect(one.get_by_test_id("alarm-tally")).to_have_text("3 not acknowledged")
            expect(one.get_by_test_id("alarm")).to_contain_text("alarm 2")
            assert one.title().startswith("(3) (waiting) ")
        line = page.locator("#events li", has_text="alarm 2")
        line.get_by_role("button", name="Acknowledge").click()
        for one in (page, other):
            expect(one.get_by_test_id("alarm")).to_contain_text("alarm 1")
            assert one.title().startswith("(2) (waiting) ")
        other.keyboard.press("a")
        for one in (page, other):
            expect(one.get_by_test_id("acknowledge")).to_be_hidden()
            expect(one.locator("#alarm")).to_have_attribute("data-level", "old")
            assert one.title().startswith("(waiting) ")
        said = live.commands()
        assert [c["do"] for c in said] == ["acknowledge"] * 2
        assert [len(c["alarms"]) for c in said] == [1, 2]
        assert said[0]["label"] == "'alarm 2' of 3.0 s"
        assert said[1]["label"] == "2 alarms, the last 'alarm 1' of 2.0 s"
        live.event("alarm", 9.0, "alarm 2")  # the same again is to be acknowledged again
        expect(page.get_by_test_id("acknowledge")).to_be_visible()
        page.reload()
        expect(page.get_by_test_id("alarm-tally")).to_have_text("1 not acknowledged")


# ----------------------------------------------------------------------------------------- choice


def test_plots_and_signals_are_hidden_and_stay_so(chromium, live):
    with browse(chromium, live.url) as page:
        push(live, 0, 40)
        reached(page, 2.0)
        page.locator("#choice summary").click()
        page.get_by_label("Ratio", exact=True).uncheck()
        expect(page.locator(".plot")).to_have_count(1)
        expect(page.locator("#choice-tally")).to_have_text("1 of 2")
        page.get_by_label("error z", exact=True).uncheck()
        page.wait_for_function("() => bench.plots[0].chart.data[3].every((v) => v === undefined)")
        assert len(drawn(page, 0, 2)[0]) == 40
        assert page.evaluate("location.hash") == "#hide-plot=Ratio&hide-signal=error+z"
        page.reload()
        reached(page, 2.0)
        expect(page.locator(".plot")).to_have_count(1)
        page.wait_for_function("() => bench.plots[0].chart.data[3].every((v) => v === undefined)")
        page.locator(".readout", has_text="z").click()  # as a legend it does the same
        page.wait_for_function("() => bench.plots[0].chart.data[3].some((v) => v === -0.5)")
        assert page.evaluate("location.hash") == "#hide-plot=Ratio"
        page.evaluate("location.hash = 'hide-plot=Error&hide-plot=Ratio'")
        expect(page.get_by_test_id("notice")).to_contain_text("All plots are hidden")


# ------------------------------------------------------------------------------- before it begins


def test_the_page_says_what_is_being_prepared(chromium, live):
    with browse(chromium, live.url) as page:
        live.status({"state": "preparing", "doing": "The filter is compiled."})
        expect(page.get_by_test_id("status")).to_have_text("preparing")
        expect(page.get_by_test_id("notice")).to_have_text("Preparing. The filter is compiled.")
        # who is quick may press it now: the bench takes it when it is ready
        expect(page.get_by_test_id("start")).to_have_attribute("aria-disabled", "false")
        live.status({"state": "paused"})
        expect(page.get_by_test_id("notice")).to_have_text("The run has not begun. Press Start.")
        live.status({"state": "running"})
        push(live, 0, 5)
        expect(page.get_by_test_id("status")).to_have_text("live")
        expect(page.get_by_test_id("notice")).to_be_hidden()


# ---------------------------------------------------------------------------------------- attitude

ATTITUDES = [
    Signal(f"{of} {c}", "1", "Attitude", "attitude", of) for of in ("true", "ghost") for c in "wxyz"
]


def scalar_first(turned: Rotation) -> np.ndarray:
    return np.roll(turned.as_quat(), 1)


@contextmanager
def attitude_page(chromium):
    with (
        LivePage([*ATTITUDES, *SIGNALS], "attitudes", 1) as live,
        browse(chromium, live.url) as page,
    ):
        yield live, page


PIXEL = """([x, y]) => {
  const view = bench.attitudes[0];
  view.craft.draw(view.now, view.colours);  // what was drawn can be read until it is shown
  const { gl } = view.craft;
  const { width, height } = gl.canvas;
  const out = new Uint8Array(4);
  const least = Math.min(width, height) / 2 / 1.1;
  gl.readPixels(Math.round(width / 2 + x * least), Math.round(height / 2 + y * least),
    1, 1, gl.RGBA, gl.UNSIGNED_BYTE, out);
  return [...out].map((v) => v / 255);
}"""


def test_body_axes_are_drawn_where_they_point(chromium):
    """Projected by rotation matrices: z of the reference is up, seen from the right and above."""
    draw = np.random.default_rng(4)
    camera = (
        Rotation.from_rotvec([0.4, 0.0, 0.0])
        * Rotation.from_rotvec([-np.pi / 2, 0.0, 0.0])
        * Rotation.from_rotvec([0.0, 0.0, -0.6])
    )
    with attitude_page(chromium) as (live, page):
        for k in range(6):
            turned = Rotation.random(random_state=draw)
            ghost = np.full(4, np.nan)
            live.push(0.1 * (k + 1), [*scalar_first(turned), *ghost, 0.0, 0.0, 0.0, 0.0])
            reached(page, 0.1 * (k + 1))
            for axis, colour in ((0, "--x"), (2, "--z")):
                at = (camera * turned).apply(0.8 * np.eye(3)[axis])
                hidden = at[2] < 0.0  # behind the craft, perhaps
                if hidden:
                    continue
                wanted = page.evaluate(
                    "(name) => getComputedStyle(document.documentElement).getPropertyValue(name)",
                    colour,
                ).strip()
                rgb = np.array([int(wanted[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
                seen = np.array(page.evaluate(PIXEL, [float(at[0]), float(at[1])]))
                assert seen[3] == 1.0
                light = np.linalg.norm(seen[:3]) / np.linalg.norm(rgb)
                assert 0.55 < light < 1.05
                assert seen[:3] == pytest.approx(light * rgb, abs=0.02)


def test_the_angle_between_true_and_estimated_is_told(chromium):
    with attitude_page(chromium) as (live, page):
        expect(page.locator(".attitude")).to_contain_text("true to ghost")
        base = Rotation.from_euler("xyz", [0.3, -1.0, 2.0])
        axis = np.array([2.0, -1.0, 2.0]) / 3.0
        for k, (angle, sign, says) in enumerate(
            [
                (12.3 / 206264.806, 1, "12.3 arcsec"),
                (12.3 / 206264.806, -1, "12.3 arcsec"),  # q and -q are one attitude
                (np.radians(10.0), 1, "10.00°"),
            ]
        ):
            other = sign * scalar_first(base * Rotation.from_rotvec(angle * axis))
            live.push(0.1 * (k + 1), [*scalar_first(base), *other, 0.0, 0.0, 0.0, 0.0])
            expect(page.locator(".attitude .apart b")).to_have_text(says)
        live.push(1.0, [*scalar_first(base), *[9.0] * 4, 0.0, 0.0, 0.0, 0.0])
        expect(page.locator(".attitude")).to_contain_text("not known here: ghost")


def test_without_webgl_the_page_says_so(chromium):
    without = chromium.browser_type.launch(
        executable_path=installed(), args=["--no-sandbox", "--disable-3d-apis"]
    )
    with closing(without), attitude_page(without) as (live, page):
        expect(page.locator(".attitude")).to_contain_text("This browser has no WebGL")
        one = [1.0, 0.0, 0.0, 0.0]
        live.push(0.1, [*one, *one, 0.0, 0.0, 0.0, 0.0])
        expect(page.locator(".attitude .apart b")).to_have_text("0.0 arcsec")
        expect(page.locator(".plot")).to_have_count(3)


def test_without_attitudes_there_is_no_panel(chromium, live):
    with browse(chromium, live.url) as page:
        expect(page.locator(".plot")).to_have_count(2)
        assert page.locator(".attitude").count() == 0
