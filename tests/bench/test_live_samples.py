"""Samples that the page keeps and draws of a long run, in the browser, against NumPy."""

import base64

import numpy as np
import pytest
from browsing import a_browser

from robins.bench.live import LivePage, Signal
from robins.bench.live.feed import pack_sample
from robins.bench.live.history import SampleHistory


@pytest.fixture(scope="module")
def page():
    with LivePage([Signal("a", "1", "A")], "a bench", 1) as live, a_browser() as browser:
        opened = browser.new_page()
        opened.goto(live.url)
        opened.wait_for_selector(".plot")
        yield opened
        assert opened.evaluate("bench.errors") == []


def drawn(seed: int, many: int, share: float = 0.7) -> tuple[np.ndarray, np.ndarray]:
    """Times, and two signals that are there at times."""
    draw = np.random.default_rng(seed)
    values = draw.normal(size=(many, 2))
    values[draw.uniform(size=values.shape) > share] = np.nan
    return np.cumsum(draw.uniform(0.04, 0.06, many)), values


def packed(time_s: np.ndarray, values: np.ndarray) -> bytes:
    """The history of the server."""
    kept = SampleHistory(values.shape[1])
    for k in range(len(time_s)):
        kept.add(pack_sample(1, k, float(time_s[k]), values[k]))
    return kept.pack(1)


def text(some: bytes | np.ndarray) -> str:
    return base64.b64encode(some if isinstance(some, bytes) else some.tobytes()).decode()


def numbers(some: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(some), "<f8")


SCRIPT = """async ([asked, job]) => {
  const { History } = await import("/static/history.js");
  const { Samples } = await import("/static/samples.js");
  const bytes = (b64) => Uint8Array.from(atob(b64), (c) => c.charCodeAt(0));
  const floats = (b64) => new Float64Array(bytes(b64).buffer);
  const coded = (row) => {
    let made = "";
    const raw = new Uint8Array(Float64Array.from(row).buffer);
    for (const byte of raw) made += String.fromCharCode(byte);
    return btoa(made);
  };
  const fill = (samples, times, rows, signals) => {
    const view = new DataView(rows.buffer);
    times.forEach((time, i) => samples.add(time, view, 8 * signals * i));
  };
  const jobs = {
    history() {
      const past = asked.before ? History.read(bytes(asked.before).buffer) : new History(2);
      const times = floats(asked.time);
      const columns = asked.columns.map(floats);
      times.forEach((time, i) => past.add(time, columns, i));
      const rows = [past.first, past.last, ...past.least, ...past.most];
      return [past.samples, past.per, rows.map((row) => coded(row.subarray(0, past.buckets)))];
    },
    slice() {
      const past = asked.before ? History.read(bytes(asked.before).buffer) : undefined;
      const samples = new Samples(2, past);
      fill(samples, floats(asked.time), floats(asked.rows), 2);
      const slice = samples.slice(...asked.span.map(Number));
      const columns = [0, 1].map((k) => slice.column(k).out.map((v) => v ?? NaN));
      return [coded(slice.time), ...columns.map(coded), samples.length, slice.column(0).last];
    },
    value() {
      const samples = new Samples(2, History.read(bytes(asked.before).buffer));
      fill(samples, floats(asked.time), floats(asked.rows), 2);
      return asked.at.map((time) => samples.valueAt(0, time));
    },
    clock() {
      return import("/static/format.js").then(({ clock, seconds }) =>
        asked.map(([value, step]) => (step ? clock(value, step) : seconds(value))),
      );
    },
  };
  return jobs[job]();
}"""


def test_the_history_of_the_page_is_that_of_the_server(page):
    """Both halve their buckets at the same samples; one goes on where the other ended."""
    time_s, values = drawn(0, 20_000)
    before = packed(time_s[:9000], values[:9000])
    whole = packed(time_s, values)
    for begin, known in ((0, ""), (9000, text(before))):
        asked = {
            "before": known,
            "time": text(time_s[begin:]),
            "columns": [text(np.ascontiguousarray(column)) for column in values[begin:].T],
        }
        samples, per, rows = page.evaluate(SCRIPT, [asked, "history"])
        assert (samples, per) == (20_000, 8)
        assert np.array_equal(
            np.concatenate([numbers(row) for row in rows]),
            np.frombuffer(whole[24:], "<f8"),
            equal_nan=True,
        )


def test_a_long_run_is_drawn_with_few_points_and_every_spike(page):
    """Past 48 000 samples the oldest go into the history; no point of the run is left out."""
    time_s, values = drawn(1, 100_000, share=1.0)
    values[[7, 50_000, 99_999], 0] = [90.0, -80.0, 70.0]
    asked = {"time": text(time_s), "rows": text(values), "span": ["-Infinity", "Infinity"]}
    at, first, second, kept, last = page.evaluate(SCRIPT, [asked, "slice"])
    at, first, second = numbers(at), numbers(first), numbers(second)
    assert kept <= 48_000
    assert last == 70.0
    assert len(at) <= 2 * (2048 + 1)
    assert np.all(np.diff(at) >= 0.0)
    assert (at[0], at[-1]) == (time_s[0], time_s[-1])
    assert (second.min(), second.max()) == (values[:, 1].min(), values[:, 1].max())
    for spike in (7, 50_000, 99_999):  # at its time, to the width of a group
        (near,) = np.flatnonzero(first == values[spike, 0])
        assert abs(at[near] - time_s[spike]) < 0.002 * time_s[-1]


@pytest.mark.parametrize(("begin", "end"), [(400, 470), (8990, 9040), (9990, 20_000)])
def test_every_span_is_drawn_as_it_was(page, begin, end):
    """Every kept sample, every bucket of a history, and the one before them."""
    time_s, values = drawn(2, 10_000, share=1.0)
    span = [time_s[begin] - 1e-6, time_s[min(end, 9999)] + 1e-6]
    asked = {
        "before": text(packed(time_s[:9000], values[:9000])),  # four samples a bucket
        "time": text(time_s[9000:]),
        "rows": text(values[9000:]),
        "span": [str(one) for one in span],
    }
    at, *columns, _, _ = page.evaluate(SCRIPT, [asked, "slice"])
    at = numbers(at)
    inside = at[(at >= span[0]) & (at <= span[1])]
    old = [k for k in range(9000) if k % 4 in (0, 3) and span[0] <= time_s[k] <= span[1]]
    new = [k for k in range(9000, 10_000) if span[0] <= time_s[k] <= span[1]]
    assert np.array_equal(inside, time_s[old + new])
    assert at[0] < span[0]
    for column, all_of in zip(columns, values.T, strict=True):
        points = dict(zip(at, numbers(column), strict=True))
        assert [points[time_s[k]] for k in new] == list(all_of[new])
        for k in set(old) & {k for k in range(0, 9000, 4) if k + 3 in old}:
            pair = {points[time_s[k]], points[time_s[k + 3]]}
            assert pair == {all_of[k : k + 4].min(), all_of[k : k + 4].max()}


def test_a_value_at_a_time(page):
    time_s = np.arange(5000) * 0.5
    values = np.stack([np.floor(time_s / 100.0), time_s], 1)  # constant but for its steps
    values[4900:, 0] = np.nan
    asked = {
        "before": text(packed(time_s[:4500], values[:4500])),  # two samples a bucket
        "time": text(time_s[4500:]),
        "rows": text(values[4500:]),
        "at": [0.2, 1234.6, 2300.3, 2449.0, 2480.0, 1e6],
    }
    found = page.evaluate(SCRIPT, [asked, "value"])
    assert found == [0.0, 12.0, 23.0, 24.0, 24.0, 24.0]  # what was said last, where nothing is


@pytest.mark.parametrize(
    ("value", "step", "says"),
    [
        (4.0, None, "4.0 s"),
        (59.96, None, "1 min 00 s"),
        (123.4, None, "2 min 03 s"),
        (3599.7, None, "1 h 00 min"),
        (7385.0, None, "2 h 03 min"),
        (90061.0, None, "25 h 01 min"),
        (-3.0, None, "\u22123.0 s"),
        (12.34, 0.1, "12.3 s"),
        (0.25, 0.05, "0.25 s"),
        (60.0, 10, "1:00 min"),
        (300.0, 60, "5 min"),
        (307.0, 1, "5:07 min"),
        (307.25, 0.05, "5:07.25 min"),
        (7200.0, 3600, "2 h"),
        (8100.0, 900, "2:15 h"),
        (8107.0, 1, "2:15:07 h"),
        (0.0, 3600, "0 s"),
    ],
)
def test_times_in_fitting_units(page, value, step, says):
    (told,) = page.evaluate(SCRIPT, [[[value, step]], "clock"])
    assert told.replace("\u202f", " ") == says
