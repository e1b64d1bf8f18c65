"""The page on a screen as narrow as a phone's, in a headless Chromium."""

import shutil

import pytest
from example_results import a_summary
from playwright.sync_api import sync_playwright

from robins import report

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
WIDTH = 375  # CSS pixels
ORIGIN = report.ReportOrigin(
    "robins run x --seed 7", 'name = "x"', "cpu", {"robins": "0.1.0"}, "2030"
)

# Where the cells of a row of numbers lie, the first of a scrolling box first.
CELLS = """[...document.querySelectorAll("tbody tr")].map(
  row => [...row.querySelectorAll("td.number")].map(cell => {
    const [box, all] = [cell.getBoundingClientRect(), document.createRange()];
    all.selectNodeContents(cell);
    const text = all.getBoundingClientRect();
    return [Math.min(box.left, text.left), Math.max(box.right, text.right)];
  }))"""


@pytest.fixture(scope="module")
def phone():
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        pytest.skip(f"needs a Chromium: none of {', '.join(BROWSERS)} is on the path")
    with (
        sync_playwright() as play,
        play.chromium.launch(executable_path=path, args=["--no-sandbox"]) as browser,
    ):
        yield browser.new_page(viewport={"width": WIDTH, "height": 667})


def summary_of(filters):
    values = {
        "horizontal_rms_m": 0.3076,
        "accelerometer_bias_rms_mg": 0.1462,
        "error_over_sigma_bounds": [0.0] * 14 + [37.85],
        "nis_gnss_position_band": [0.8896, 1.118],
    }
    return a_summary() | {"filters": dict.fromkeys(filters, values)}


@pytest.mark.parametrize("count", [1, 3, 20])
def test_numbers_are_seen_without_scrolling(phone, count):
    names = [f"federated-filter-{k}" for k in range(count)]
    phone.set_content(report.page(summary_of(names), [], ORIGIN))
    rows = [row for row in phone.evaluate(CELLS) if row]
    assert len(rows) > 6
    assert all(left >= 0.0 and right <= WIDTH for row in rows for left, right in row[:1])
    if count == 1:  # also the numbers of claims
        assert all(right <= WIDTH for row in rows for _, right in row)
    assert phone.evaluate("document.documentElement.scrollWidth") <= WIDTH
