"""Results of the scripts of the live page, in the browser, against NumPy."""

import shutil
from itertools import pairwise

import numpy as np
import pytest
from playwright.sync_api import expect, sync_playwright

from robins.bench.live import LivePage, Signal

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SIGNALS = [
    Signal("error", "arcsec", "Error"),
    Signal("sigma", "arcsec", "Error", "sigma", "error"),
    Signal("ratio", "1", "Ratio"),
    Signal("gate", "1", "Ratio", "limit"),
]


@pytest.fixture(scope="module")
def page():
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        pytest.skip(f"needs a Chromium: none of {', '.join(BROWSERS)} is on the path")
    with (
        LivePage(SIGNALS, "a bench", 1) as live,
        sync_playwright() as play,
        play.chromium.launch(executable_path=path, args=["--no-sandbox"]) as browser,
    ):
        opened = browser.new_page()
        opened.goto(live.url)
        opened.wait_for_selector(".plot")
        opened.live = live
        yield opened
        assert opened.evaluate("bench.errors") == []
        opened.close()


COLUMN = """async ([time, values, start]) => {
  const { Samples } = await import("/static/samples.js");
  const samples = new Samples(1);
  time.forEach((t, i) => {
    const view = new DataView(new ArrayBuffer(8));
    view.setFloat64(0, values[i] ?? NaN, true);
    samples.add(t, view, 0);
  });
  // a slice begins with the sample before its first
  const slice = samples.slice(start ? time[start + 1] : -Infinity, Infinity);
  const { out, found, last } = slice.column(0, 3);
  // JSON has no undefined
  return [out.map((v) => (v === undefined ? "goes on" : v === null ? "breaks" : v)), found, last];
}"""


@pytest.mark.parametrize(
    ("seed", "share", "start"), [(0, 0.2, 0), (1, 0.5, 7), (2, 0.9, 3), (3, 1.0, 0)]
)
def test_a_line_breaks_where_a_signal_stays_away_for_long(page, seed, share, start):
    draw = np.random.default_rng(seed)
    time = np.cumsum(draw.uniform(0.05, 0.15, 120))
    values = draw.normal(size=120)
    there = draw.uniform(size=120) < share
    there[60:85] = False
    sent = [float(v) if ok else None for v, ok in zip(values, there, strict=True)]
    out, found, last = page.evaluate(COLUMN, [time.tolist(), sent, start])
    at = start + np.flatnonzero(there[start:])
    usual = np.mean(np.diff(time[at]))
    expected = np.where(there, 3.0 * values, np.nan)[start:].tolist()
    expected = ["goes on" if np.isnan(v) else v for v in expected]
    for before, after in pairwise(at):
        if after > before + 1 and time[after] - time[before] > 2.5 * usual:
            expected[before + 1 - start] = "breaks"
    assert out == expected
    assert out.count("breaks") >= 1
    assert (found, last) == (len(at), 3.0 * values[at[-1]])


def test_memory_stays_constant_and_times_are_found(page):
    kept, last, first, places = page.evaluate(
        """async () => {
          const { Samples } = await import("/static/samples.js");
          const samples = new Samples(2);
          const view = new DataView(new ArrayBuffer(16));
          let most = 0;
          for (let k = 0; k < 130001; k++) {
            view.setFloat64(8, 2 * k, true);
            samples.add(0.5 * k, view, 0);
            most = Math.max(most, samples.length);
          }
          const n = samples.length;
          const start = samples.time[0];
          const times = [-1, start, start + 0.2, start + 0.5, 65000, 1e9];
          const places = times.map((t) => samples.from(t));
          const values = samples.values[1];
          return [most, [samples.last, values[n - 1]], [start, values[0]], [n, ...places]];
        }"""
    )
    assert kept == 48000
    assert last == [65000.0, 260000.0]
    assert first[1] == 4.0 * first[0]
    n, *found = places
    time = first[0] + 0.5 * np.arange(n)
    wanted = np.searchsorted(time, [-1.0, first[0], first[0] + 0.2, first[0] + 0.5, 65000.0, 1e9])
    assert found == wanted.tolist()


RANGES = """async (steps) => {
  const { Scale } = await import("/static/scale.js");
  const scale = new Scale();
  return steps.map(([values, bands, limits, whole]) => {
    scale.whole = whole;
    return scale.fit([values], bands.length ? [bands] : [], limits.length ? [limits] : []);
  });
}"""


@pytest.mark.parametrize(
    ("values", "bands", "limits", "whole", "least", "most"),
    [
        ([0.2, 0.9], [], [], False, 0, 1),
        ([-0.2, 0.9], [], [], False, -1, 1),
        ([1.0], [8.0], [], False, -10, 10),  # a band is always seen whole
        ([500.0], [8.0], [], False, -60, 60),  # nor is it squeezed by what is far beyond
        ([500.0], [8.0], [], True, -600, 600),
        ([0.3], [], [1.0], False, 0, 1.5),
        ([700.0], [], [1.0], False, 0, 5),  # a test ratio that is far over its limit
        ([700.0], [], [1.0], True, 0, 800),
        ([-0.01, 0.01], [], [0.5], False, -0.015, 0.015),  # a limit far away is left out
        ([-0.1, 0.1], [], [0.5], False, -0.6, 0.6),
        ([0.1] * 99 + [1e6], [], [], False, 0, 0.15),  # a single wild one does not count
        ([], [], [], False, 0, 1),
        ([0.0], [], [], False, 0, 1),
    ],
)
def test_ranges(page, values, bands, limits, whole, least, most):
    ((low, high),) = page.evaluate(RANGES, [[values, bands, limits, whole]])
    assert (low, high) == pytest.approx((least, most), rel=1e-12)


def test_a_range_grows_at_once_and_shrinks_late(page):
    sizes = [1.0, 2.0, 9.0, 7.0, 5.0, 4.0, 9.2, 3.0]
    tops = page.evaluate(RANGES, [[[s], [], [], False] for s in sizes])
    assert [top for _, top in tops] == [1.5, 3.0, 10.0, 10.0, 10.0, 5.0, 10.0, 4.0]


@pytest.mark.parametrize(("wild", "rank"), [(1.0, 599), (50.0, 588)])
def test_the_usual_size_is_the_largest_but_for_wild_ones(page, wild, rank):
    values = np.random.default_rng(5).uniform(-1.0, 1.0, size=(3, 200))
    values[1, 7:12] *= wild
    usual = page.evaluate(
        'async (v) => (await import("/static/scale.js")).usualSize(v)', values.tolist()
    )
    assert usual == np.sort(np.abs(values).ravel())[rank]


@pytest.mark.parametrize(
    ("value", "scale", "text"),
    [
        (-219.04, 300.0, "\u2212219"),
        (-0.01, 300.0, "0"),  # no minus before a zero
        (12.3456, 15.0, "12.3"),
        (0.16234, 0.6, "0.162"),
        (12345.6, 20000.0, "12346"),
        (2.5e7, 1e8, "2.5e+7"),
        (-3.21e-8, 1e-7, "\u22123.2e-8"),
        (None, 1.0, "–"),
    ],
)
def test_numbers(page, value, scale, text):
    shown = page.evaluate(
        """async ([value, scale]) => {
          const { decimalsFor, number } = await import("/static/format.js");
          return number(value, decimalsFor(scale));
        }""",
        [value, scale],
    )
    assert shown == text


@pytest.mark.parametrize(
    ("values", "top", "texts"),
    [
        ([-0.3, 0.0, 0.1 + 0.2], 0.3, ["\u22120.3", "0", "0.3"]),
        ([-20000, 0, 12500], 20000, ["\u221220k", "0", "12.5k"]),
        ([-5e-5, 0, 2e-5], 5e-5, ["\u22125e-5", "0", "2e-5"]),
        ([3e6], 4e6, ["3e+6"]),
    ],
)
def test_numbers_at_an_axis(page, values, top, texts):
    shown = page.evaluate(
        """async ([values, top]) => {
          const { tick } = await import("/static/format.js");
          return values.map((value) => tick(value, top));
        }""",
        [values, top],
    )
    assert shown == texts


PIXEL = """([plot, time, below]) => {
  const { chart } = bench.plots[plot];
  const { ctx, bbox } = chart;
  const x = Math.round(chart.valToPos(time, "x", true));
  const { data } = ctx.getImageData(x, 0, 1, ctx.canvas.height);
  return data[4 * Math.round(bbox.top + below) + 3];
}"""


def test_what_is_off_the_scale_is_marked_at_the_edge(page):
    live = page.live
    for k in range(120):
        refused = k == 60
        live.push(0.5 * k, [900.0 if refused else 1.0, 2.0, 50.0 if refused else 0.1, 1.0])
    page.wait_for_function("() => bench.shown === 120")
    top = page.evaluate("bench.plots.map(p => p.range[1])")
    assert top == [8.0, 1.5]
    # A triangle is wider than the line beside which it stands.
    for plot in (0, 1):
        assert page.evaluate(PIXEL, [plot, 30.25, 6]) > 0
        assert page.evaluate(PIXEL, [plot, 33.0, 6]) == 0
    readout = page.locator(".plot").nth(0).locator(".readout b")
    assert readout.inner_text() == "1.00"
    live.push(60.0, [7.0, 2.0, 0.1, 1.0])  # over 3 sigma, and that is said
    page.wait_for_function("() => bench.shown === 121")
    assert "beyond" in page.locator(".plot").nth(0).locator(".readout").get_attribute("class")
    assert "beyond" not in page.locator(".plot").nth(1).locator(".readout").get_attribute("class")


def test_the_whole_range_is_shown_on_demand(page):
    plot = page.locator(".plot").nth(0)
    plot.focus()
    page.keyboard.press("Enter")
    expect(plot).to_contain_text("whole range")
    assert (
        page.evaluate("bench.plots[0].range[1]") == 8
    )  # one wild sample of many is still left out
    for k in range(121, 131):
        page.live.push(0.5 * k, [500.0, 2.0, 0.1, 1.0])
    page.wait_for_function("() => bench.plots[0].range[1] === 600")
    plot.dblclick()
    page.wait_for_function("() => bench.plots[0].range[1] === 40")
    expect(plot).not_to_contain_text("whole range")


def test_the_values_under_the_cursor_are_read(page):
    plot = page.locator(".plot").nth(0)
    box = plot.locator(".u-over").bounding_box()
    time, error = page.evaluate(
        "() => { const d = bench.plots[0].chart.data; return [d[0].at(-3), d[1].at(-3)]; }"
    )
    x = page.evaluate("(t) => bench.plots[0].chart.valToPos(t, 'x')", time)
    assert error == 500.0
    page.mouse.move(box["x"] + 0.25 * x, box["y"] + 30)
    page.wait_for_function("() => document.querySelector('.readout b').textContent === '1.0'")
    page.mouse.move(box["x"] + x, box["y"] + 30)
    page.wait_for_function("() => document.querySelector('.readout b').textContent === '500.0'")
