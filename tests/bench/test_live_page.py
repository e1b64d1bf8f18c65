"""The live page in a headless Chromium that reaches nothing but this machine."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from browsing import a_browser, browse
from playwright.sync_api import expect
from reused_page import ReusedPage

from robins.bench.live import LivePage, Signal

AXES = "xyz"
SIGNALS = [
    *[Signal(f"error {a}", "arcsec", "Attitude error") for a in AXES],
    *[Signal(f"sigma {a}", "arcsec", "Attitude error", "sigma", f"error {a}") for a in AXES],
    *[Signal(f"innovation {a}", "arcsec", "Innovation") for a in AXES],
    *[Signal(f"stated {a}", "arcsec", "Innovation", "sigma", f"innovation {a}") for a in AXES],
    *[Signal(f"rate {a}", "arcsec/s", "Rate") for a in AXES],
    Signal("ratio", "1", "Test ratio"),
    Signal("gate", "1", "Test ratio", "limit"),
    *[Signal(f"wheel {k}", "N m s", "Wheel momentum") for k in (1, 2, 3)],
]
FAULTS = [
    {"label": "star stuck", "fault": {"kind": "stuck", "link": "star"}},
    {"label": "gyro noise", "fault": {"kind": "bit errors", "bits": 2}},
]
RUN = 5


def values(k: int) -> list[float]:
    """Twenty numbers of which the star sensor's come every fifth time."""
    phase = 0.1 * k + np.arange(3)
    seen = 1.0 if k % 5 == 0 else float("nan")
    return [
        *(3.0 * np.sin(phase)),
        *[2.0, 2.5, 3.0],
        *(seen * np.cos(phase)),
        *[seen * 4.0] * 3,
        *(np.sin(phase) - [0.0, 200.0, 0.0]),
        seen * 0.2,
        1.0,
        *(0.1 * np.sin(0.01 * phase)),
    ]


@pytest.fixture(scope="module")
def chromium():
    with a_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def server():
    with ReusedPage(SIGNALS, "satellite/test", RUN, faults=FAULTS) as made:
        yield made


@pytest.fixture
def live(server):
    """A server as new; the run differs from test to test."""
    server.next_run()
    server.commands()
    return server


def push(live: LivePage, page, many: int, first: int = 0) -> None:
    """Samples, until they are drawn."""
    before = page.evaluate("bench.shown")
    for k in range(first, first + many):
        live.push(0.1 * (k + 1), values(k))
    until = time.monotonic() + 5.0
    while page.evaluate("bench.shown") < before + many:
        assert time.monotonic() < until, page.evaluate("[bench.shown, bench.received]")
        live.poll()
        time.sleep(0.02)


def state(page, wanted: str, within_s: float) -> float:
    """Wait for what the page says of its line; the seconds it took."""
    began = time.monotonic()
    says = f"() => document.querySelector('[data-testid=status]').textContent === '{wanted}'"
    page.wait_for_function(says, timeout=1e3 * within_s)
    return time.monotonic() - began


def go_on(live: LivePage, page, k: int, wanted: str, within_s: float) -> int:
    """Samples at 10 Hz until the page says what is wanted; the number of the next one."""
    began = time.monotonic()
    while page.evaluate("bench.state") != wanted:
        assert time.monotonic() < began + within_s
        live.push(0.1 * (k + 1), values(k))
        k += 1
        time.sleep(0.1)
    return k


def command(live: LivePage) -> dict:
    """The next command that reaches the bench."""
    until = time.monotonic() + 3.0
    while time.monotonic() < until:
        if found := live.commands():
            (one,) = found
            return one
        time.sleep(0.02)
    raise AssertionError("no command came")


# --------------------------------------------------------------------------------- what is shown


def test_twenty_signals_at_10_hz_are_shown(chromium, live):
    assert len(SIGNALS) == 20
    with browse(chromium, live.url) as page:
        expect(page.locator(".plot")).to_have_count(5)
        began = time.monotonic()
        for k in range(100):
            live.push(0.1 * (k + 1), values(k))
            page.wait_for_timeout(max(0.0, 1e3 * (began + 0.1 * (k + 1) - time.monotonic())))
        shown = page.evaluate("bench.shown")
        assert time.monotonic() - began < 11.0  # the machine kept up with 10 Hz
        assert shown >= 95
        assert page.get_by_test_id("status").inner_text() == "live"
        expect(page.get_by_test_id("sequence")).to_have_text("99")
        assert page.get_by_test_id("dropped").inner_text() == "0"
        assert page.evaluate("bench.missed") == 0
        drawn = page.evaluate(
            "() => bench.plots.map(p => p.chart.data.map(c => c.map(v => v ?? null)))"
        )
    sent = np.array([values(k) for k in range(100)])
    error, *_ = (np.array(plot, dtype=float) for plot in drawn)
    assert np.array_equal(error[0], 0.1 * np.arange(1, 101))
    assert np.array_equal(error[1:4], sent[:, :3].T)
    assert np.array_equal(error[4::2], 3.0 * sent[:, 3:6].T)  # upper edges of the bands
    assert np.array_equal(error[5::2], -3.0 * sent[:, 3:6].T)
    innovation = np.array(drawn[1], dtype=float)
    assert np.array_equal(innovation[1:4], sent[:, 6:9].T, equal_nan=True)


def test_bands_are_filled(chromium, live):
    """Colours of pixels: inside the widest band not that outside all of them."""
    with browse(chromium, live.url) as page:
        expect(page.locator(".plot")).to_have_count(5)
        push(live, page, 60)
        inside, outside = page.evaluate(
            """() => {
              const { chart } = bench.plots[0];
              const x = Math.round(chart.valToPos(5.55, "x", true));
              const { data } = chart.ctx.getImageData(x, 0, 1, chart.ctx.canvas.height);
              const at = (value) => 4 * Math.round(chart.valToPos(value, "y", true));
              return [8.2, 9.6].map((value) => [...data.slice(at(value), at(value) + 4)]);
            }"""
        )
    assert outside[3] == 0  # nothing is drawn there
    assert inside[3] > 0


def test_a_page_without_any_bench_waits(chromium):
    command_ = [sys.executable, "-m", "robins.bench.live"]
    with subprocess.Popen(command_, stdout=subprocess.PIPE, text=True) as alone:
        try:
            assert alone.stdout
            with browse(chromium, alone.stdout.readline().strip()) as page:
                expect(page.get_by_text("Waiting for a bench.")).to_be_visible()
                state(page, "waiting", 1.0)
                page.get_by_test_id("pause").click()
                expect(page.get_by_test_id("answer")).to_have_text("no bench takes commands now")
        finally:
            alone.terminate()


def test_a_bench_that_says_nothing_is_waited_for(chromium, live):
    with browse(chromium, live.url) as page:
        state(page, "waiting", 1.0)
        push(live, page, 3)
        state(page, "live", 0.5)
        state(page, "waiting", 3.0)
        push(live, page, 1, first=3)
        state(page, "live", 0.5)


def test_a_reloaded_page_is_not_empty(chromium, live):
    with browse(chromium, live.url) as page:
        expect(page.locator(".plot")).to_have_count(5)
        push(live, page, 50)
        live.event("alarm", 4.0, "star refused")
        expect(page.get_by_test_id("alarm")).to_contain_text("star refused")
        for k in range(250):
            live.event("warning", 4.0, f"command {k}")
            live.poll()
        expect(page.locator("#events li").first).to_contain_text("command 249")
        expect(page.locator("#events li")).to_have_count(200)
        expect(page.locator("#events li.alarm")).to_contain_text("star refused")
        page.reload()
        page.wait_for_function("() => bench.shown === 50")
        expect(page.get_by_test_id("alarm")).to_contain_text("4.0 s  star refused")
        assert page.evaluate("bench.state") == "waiting"  # what is old does not make it live


def test_a_new_run_clears_plots_and_events(chromium, live):
    with browse(chromium, live.url) as page:
        expect(page.locator(".plot")).to_have_count(5)
        push(live, page, 30)
        live.event("alarm", 1.0, "old")
        expect(page.get_by_test_id("alarm")).to_contain_text("old")
        live.next_run()
        expect(page.get_by_test_id("run")).to_have_text(str(live.run))
        assert page.evaluate("[bench.shown, bench.plots[0].chart.data[0].length]") == [0, 0]
        expect(page.get_by_test_id("alarm")).to_have_text("no alarm")
        assert page.locator("#events li").count() == 0
        push(live, page, 2)  # times begin anew
        assert page.evaluate("bench.plots[0].chart.data[0].length") == 2


def test_health_of_the_bench_is_told(chromium, live):
    with browse(chromium, live.url) as page:
        live.status(
            {
                "state": "running",
                "clock": "real time, 100 Hz",
                "deadlines": {
                    "missed": 3,
                    "lateness_us": {"p50": 171.4, "p99": 538.0, "max": 5904},
                    "histogram": {"edges_us": [10, 1000], "counts": [0, 99, 9]},
                },
                "links": {"gyro": {"frames": 12345, "wrong": 2, "lost": 0, "silent_s": 0.01}},
                "nodes": {"gyro": "running", "acm": "dead"},
                "faults": [{"label": "star stuck", "until_s": 12.0}],
                "counts": {"refused_measurements": 17},
            }
        )
        rows = page.get_by_test_id("links").locator("tbody tr")
        expect(rows).to_have_count(2)
        cells = rows.nth(0).locator("th, td").all_inner_texts()
        assert cells == ["gyro", "running", "12\u202f345", "2", "0", "–", "0.0"]
        expect(rows.nth(1).locator("td.word")).to_have_class("word alarm")
        assert page.locator("#deadlines dd").all_inner_texts() == [
            "–",
            "3",
            "171",
            "538",
            "5\u202f904",
        ]
        bars = page.get_by_test_id("histogram").locator("i")
        heights = bars.evaluate_all("all => all.map((bar) => parseFloat(bar.style.height))")
        assert heights == [0.0, 100.0, 50.0]  # log10(1 + count), the largest is all of it
        assert bars.nth(1).get_attribute("title") == "10 to 1000 µs: 99"
        expect(page.get_by_test_id("faults")).to_contain_text("star stuckuntil 12.0 s")
        assert page.get_by_test_id("counts").inner_text().split("\n") == [
            "refused",
            "17",
        ]
        expect(page.get_by_test_id("start")).to_have_attribute("aria-disabled", "true")


# ------------------------------------------------------------------------------- what can break


def test_a_killed_server_is_noticed_and_its_return_too(chromium):
    with ReusedPage(SIGNALS, "satellite/test", RUN) as live, browse(chromium, live.url) as page:
        expect(page.locator(".plot")).to_have_count(5)
        push(live, page, 20)
        state(page, "live", 1.0)
        os.kill(live._process.pid, signal.SIGKILL)
        assert state(page, "lost", 2.0) < 2.0
        expect(page.get_by_test_id("pause")).to_have_attribute("aria-disabled", "true")
        for k in range(20, 30):
            live.push(0.1 * (k + 1), values(k))
        live.restart()
        count = go_on(live, page, 30, "live", 5.0)
        page.wait_for_function(f"() => bench.shown === {count}")  # nothing twice, nothing left out
        assert page.evaluate("[bench.missed, bench.repeated, bench.reconnects]") == [0, 20, 1]
        expect(page.get_by_test_id("reconnects")).to_have_text("1")


def test_a_server_that_hangs_is_noticed(chromium):
    with LivePage(SIGNALS, "satellite/test", RUN) as live, browse(chromium, live.url) as page:
        push(live, page, 3)
        os.kill(live._process.pid, signal.SIGSTOP)
        try:
            state(page, "lost", 2.5)
        finally:
            os.kill(live._process.pid, signal.SIGCONT)
        go_on(live, page, 3, "live", 5.0)


def test_what_was_dropped_on_the_way_is_told(chromium, live):
    with browse(chromium, live.url) as page:
        expect(page.locator(".plot")).to_have_count(5)
        push(live, page, 3)
        live._sequence += 40  # as when samples went while the pipe was full
        push(live, page, 1, first=43)
        expect(page.get_by_test_id("dropped")).to_have_text("40")
        assert page.evaluate("bench.missed") == 40


def test_a_page_of_a_stranger_cannot_reach_the_bench(chromium, live):
    context = chromium.new_context()
    try:
        page = context.new_page()
        page.route(
            "http://stranger.example/",
            lambda route: route.fulfill(body="<!doctype html>", content_type="text/html"),
        )
        page.goto("http://stranger.example/")
        outcome = page.evaluate(
            """(url) => new Promise((done) => {
              const socket = new WebSocket(url);
              socket.onopen = () => { socket.send('{"do":"stop"}'); done("open"); };
              socket.onerror = () => done("refused");
            })""",
            live.url.replace("http", "ws") + "live",
        )
        framed = page.evaluate(
            """(url) => new Promise((done) => {
              const frame = document.createElement("iframe");
              frame.src = url;
              frame.onload = () => {
                try { done(frame.contentWindow.length === 0 && String(frame.contentDocument)); }
                catch { done("foreign"); }
              };
              document.body.append(frame);
            })""",
            live.url,
        )
    finally:
        context.close()
    assert outcome == "refused"
    assert framed == "null"  # an error page of the browser, whose inside nobody may see
    assert live.commands() == []


# -------------------------------------------------------------------------------- what is pressed


def test_the_buttons_reach_the_bench(chromium, live):
    with browse(chromium, live.url) as page:
        live.status({"state": "running", "faults": [{"label": "gyro noise"}]})
        expect(page.get_by_test_id("bench-state")).to_have_text("running")
        page.get_by_test_id("start").click(force=True)  # makes no sense now: nothing is sent
        page.get_by_test_id("pause").click()
        assert command(live) == {"do": "pause"}
        expect(page.get_by_test_id("answer")).to_have_text("pause: the bench has it")
        page.get_by_test_id("stop").click()
        expect(page.get_by_test_id("stop")).to_have_text("Sure?")
        assert live.commands() == []
        page.get_by_test_id("stop").click()
        assert command(live) == {"do": "stop"}
        page.get_by_label("Clear gyro noise").click()
        assert command(live) == {"do": "clear", "label": "gyro noise"}
        page.get_by_test_id("clear").click()
        assert command(live) == {"do": "clear", "label": None}


def test_what_the_operator_may_say_is_a_button_each(chromium, live):
    says = ["slew 10 deg", 'back to "the course"']
    with (
        LivePage(SIGNALS, "a bench", 5, says=says) as made,
        browse(chromium, made.url) as page,
    ):
        made.status({"state": "running"})
        buttons = page.get_by_test_id("says").locator("button")
        assert buttons.all_inner_texts() == says
        buttons.nth(1).click()
        assert command(made) == {"do": "say", "label": says[1]}
        expect(page.get_by_test_id("answer")).to_have_text("say: the bench has it")
        made.status({"state": "stopped"})
        expect(buttons.nth(0)).to_have_attribute("aria-disabled", "true")
    with browse(chromium, live.url) as page:  # a bench that offers none
        expect(page.get_by_test_id("says")).to_be_hidden()


def test_a_fault_is_injected_with_the_keyboard_alone(chromium, live):
    with browse(chromium, live.url) as page:
        page.get_by_test_id("fault").focus()
        page.keyboard.press("ArrowDown")
        page.keyboard.press("Tab")
        page.keyboard.type("2.5")
        page.keyboard.press("Enter")
        assert command(live) == {"do": "inject", **FAULTS[1], "duration_s": 2.5}
        page.get_by_test_id("duration").fill("")
        page.get_by_test_id("inject").click()
        assert command(live) == {"do": "inject", **FAULTS[1], "duration_s": None}


def test_a_chosen_fault_stays_chosen_when_the_server_returns(chromium):
    with (
        ReusedPage(SIGNALS, "satellite/test", RUN, faults=FAULTS) as live,
        browse(chromium, live.url) as page,
    ):
        page.get_by_test_id("fault").select_option("gyro noise")
        live.restart()
        page.wait_for_function("() => bench.hellos > 1 && bench.state !== 'lost'")
        expect(page.get_by_test_id("fault")).to_have_value("gyro noise")


def test_what_the_server_refuses_is_said(chromium, live):
    with browse(chromium, live.url) as page:
        page.locator("#inject").evaluate("form => { form.noValidate = true; }")
        page.get_by_test_id("duration").fill("99999")
        page.get_by_test_id("inject").click()
        expect(page.get_by_test_id("answer")).to_contain_text("a fault lasts 0 to 3600 s")
        assert live.commands() == []


# ------------------------------------------------------------------------------------ how it looks


def test_everything_that_is_pressed_or_filled_has_a_name(chromium, live):
    with browse(chromium, live.url) as page:
        expect(page.locator(".plot")).to_have_count(5)
        nameless = page.locator("button, select, input, figure").evaluate_all(
            """all => all.filter(e => !(e.textContent.trim() && e.tagName === "BUTTON")
                 && !e.ariaLabel && !e.labels?.length).map(e => e.outerHTML)"""
        )
    assert nameless == []


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (1920, 1080), (1000, 700), (390, 800)])
def test_it_fits_and_does_not_jump(chromium, live, width, height):
    """Boxes stay where they are while numbers grow, and nothing needs to be scrolled sideways."""
    view = {"width": width, "height": height}
    boxes = """() => [...document.querySelectorAll(".plot, aside section:not(.events), header > *")]
        .map(e => e.getBoundingClientRect()).map(b => [b.x, b.y, b.width, b.height])"""
    with browse(chromium, live.url, viewport=view) as page:
        expect(page.locator(".plot")).to_have_count(5)
        live.status(health(1, []))
        push(live, page, 5)
        expect(page.locator("#links tbody tr")).to_have_count(7)
        before = page.evaluate(boxes)
        live.status(health(1_000_000, [{"label": "star stuck"}, {"label": "gyro noise"}]))
        live.event("alarm", 0.6, "something long was refused " * 12)
        expect(page.locator("#faults li")).to_have_count(2)
        live.push(0.6, [-1e5 * abs(v) for v in values(5)])
        page.wait_for_function("() => bench.shown === 6")
        assert page.evaluate(boxes) == before
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        if width >= 1280:  # all at a glance
            assert page.evaluate("document.documentElement.scrollHeight") <= height


def health(n: int, faults: list) -> dict:
    """A status with numbers of that size."""
    parts = ("plant", "table", "gyro", "star", "adm", "acm", "actuators")
    link = {"frames": n, "wrong": n // 1000, "lost": n // 1000, "late": 0, "silent_s": n / 1e5}
    return {
        "state": "running",
        "clock": "real time, 100 Hz",
        "deadlines": {"missed": n, "lateness_us": {"p50": n, "p99": n, "max": n}},
        "links": dict.fromkeys(parts, link),
        "nodes": dict.fromkeys(parts, "running"),
        "faults": faults,
        "counts": {"frames": n, "wrong_frames": n, "lost_frames": n, "refused_measurements": n},
    }
