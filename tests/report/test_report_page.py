"""The page needs nothing but itself, stays small, escapes what it prints, goes with its folder."""

import io
import re
import xml.etree.ElementTree as ElementTree
from base64 import b64decode
from html.parser import HTMLParser
from urllib.parse import unquote

import numpy as np
import pytest
from example_results import a_drive, a_summary
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from robins import report, results
from robins.report import embed, style

ORIGIN = report.ReportOrigin(
    command="robins run 'a b' --seed 7",
    scenario_text='name = "<town>"',
    device="cpu",
    versions={"robins": "0.1.0", "numpy": "2.0"},
    created_utc="2030-01-01 00:00 UTC",
    notes=("Nobody drove.",),
)
_EMPTY = {"meta", "img", "br", "hr", "link", "input"}


class Reader(HTMLParser):
    """Collects what a page holds and refuses tags that do not match."""

    def __init__(self, page):
        super().__init__()
        self.open, self.tags, self.text, self.images, self.links = [], [], [], [], []
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        assert not any(name.startswith("on") for name in found)
        self.tags.append(tag)
        if tag not in _EMPTY:
            self.open.append(tag)
        if tag == "img":
            self.images.append(found)
        if "href" in found:
            self.links.append(found["href"])

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)

    @property
    def words(self):
        return " ".join(" ".join(self.text).split())


@pytest.fixture(scope="module")
def shots(drive, town):
    """Six figures of all kinds."""
    errors = [f"error_{block}" for block in ("position", "velocity", "gyro_bias")]
    few = drive.drop_vars([*errors, "alt_m", "estimate_gyro_bias"])
    return [report.draw(picture) for picture in report.pictures(few, town)]


@pytest.fixture(scope="module")
def text(shots, town):
    return report.page(town, shots, ORIGIN)


def test_the_page_holds_the_whole_summary(text, town):
    reader = Reader(text)
    words = reader.words
    for expected in (
        *("ins_gnss/town", "1 run", "Nobody drove.", "seed 7", "kalman", "robust"),
        *("Horizontal RMS m 0.0213 0.03621", "Attitude RMS arcmin 3.21 5.457"),
        *("Velocity RMS m/s 0.021, 0.019, 0.03", "Worst step µs – –"),
        "1 of 2 claims reproduced, 1 partly.",
        "✓ reproduced Smoothed error in 15 s outages is at most 0.29 m (smoothed-outage) 0.18",
        "≈ partly Stated sigma equals Monte Carlo RMS within 5 % (sigma) 1.061 0.95 to 1.05",
        *("IMU duplicate time 2", "GNSS not finite 14"),
        *("robins run 'a b' --seed 7", "numpy 2.0", 'name = "<town>"'),
    ):
        assert expected in words, expected


def test_the_page_shows_every_figure_with_its_title_in_words(text, shots):
    images = Reader(text).images
    assert [image["alt"] for image in images] == [shot.picture.title for shot in shots]
    for image, shot in zip(images, shots, strict=True):
        ratio = int(image["width"]) / int(image["height"])
        assert ratio == pytest.approx(shot.dots.width / shot.dots.height, rel=0.01)


def test_the_page_asks_nothing_of_the_network(text):
    reader = Reader(text)
    assert all(image["src"].startswith("data:image/") for image in reader.images)
    assert reader.links == []
    assert not {"script", "link", "iframe", "object", "form", "base"} & set(reader.tags)
    # A drawing refers to its own parts, with # quoted.
    assert re.search(r"url\s*\((?!%23)|@import", text) is None
    assert "default-src 'none'" in text


def test_the_page_is_small(text):
    assert len(text.encode()) < report.LIMIT == 500_000


def test_hostile_names_are_printed_and_not_obeyed(town):
    hostile = "<script>alert(1)</script>\"'&<!--"
    claim = {"id": hostile, "text": hostile, "verdict": "not", "value": hostile, "band": None}
    summary = town | {
        "scenario": hostile,
        "filters": {hostile: {f"{hostile}_m": 1.0}},
        "claims": [claim],
        "counts": {hostile: 3},
        "warnings": [hostile],
    }
    said = hostile, f"</pre>{hostile}", hostile, {hostile: hostile}, hostile, (hostile,)
    reader = Reader(report.page(summary, [], report.ReportOrigin(*said)))
    assert "script" not in reader.tags
    assert reader.words.count("alert(1)") >= 11
    assert hostile in reader.text


def test_nothing_to_show_is_said(town):
    nothing = town | {"claims": [], "counts": {}, "filters": {}, "machine": "jax"}
    words = Reader(report.page(nothing, [], ORIGIN)).words
    assert "No claims are attached to this scenario." in words
    recorded = {key: value for key, value in nothing.items() if key != "machine"}
    assert "No claims" not in Reader(report.page(recorded, [], ORIGIN)).words
    assert "Every sample was used." in words
    assert "Figures" not in words


def test_a_long_scenario_is_cut_and_it_is_said(town):
    page = report.page(town, [], ORIGIN._replace(scenario_text="x = 1\n" * 20_000))
    assert len(page) < 60_000
    assert "the rest is in manifest.json" in page


@pytest.mark.parametrize("limit", [190_000, 30_000])
def test_pictures_give_way_to_a_limit(shots, town, limit):
    page = report.page(town, shots, ORIGIN, limit)
    assert len(page.encode()) <= limit
    reader = Reader(page)
    dropped = len(shots) - len(reader.images)
    assert (dropped == 0) == (limit >= 190_000)
    assert len(reader.links) == dropped
    assert all(re.fullmatch(r"figures/\w+\.png", link) for link in reader.links)


# --------------------------------------------------------------------------------------- pictures


def decoded(source):
    kind, content = source.split(",", 1)
    if kind == "data:image/svg+xml":
        return ElementTree.fromstring(unquote(content))
    assert kind == "data:image/png;base64"
    return Image.open(io.BytesIO(b64decode(content)))


def test_embedded_pictures_can_be_read(text):
    for image in Reader(text).images:
        decoded(image["src"])


def test_a_simple_figure_is_embedded_as_lines_and_a_crowded_one_as_dots(shots):
    figure, grid = style.new_figure()
    grid[0, 0].plot([1.0, 2.0, 1.0])
    grid[0, 0].set_xlabel("averaging time [s] & \"'<>#%")
    simple = report.draw(report.Picture("simple", "Simple", "", figure))
    crowded = next(s for s in shots if s.picture.name.startswith("innovation"))
    drawing, dots = embed.embed([simple, crowded], 10**6)
    tree = decoded(drawing.source)
    assert tree.tag.endswith("}svg")
    assert "averaging time [s] & \"'<>#%" in " ".join(tree.itertext())
    assert "script" not in {e.tag.split("}")[1] for e in tree.iter()}
    assert decoded(dots.source).size == crowded.dots.size


def test_a_palette_keeps_the_colours_that_carry_meaning(shots):
    shot = next(s for s in shots if s.picture.name == "error_attitude")
    small = Image.open(io.BytesIO(embed.packed(shot.dots, 24))).convert("RGB")
    assert small.size == shot.dots.size
    before, after = np.asarray(shot.dots, int), np.asarray(small, int)
    for name in ("#ffffff", style.OUTAGE, style.COLOURS[0], style.COLOURS[1]):
        colour = [int(name[i : i + 2], 16) for i in (1, 3, 5)]
        exact = (before == colour).all(axis=-1)
        assert exact.sum() > 100, name
        assert np.abs(after[exact] - colour).max() <= 3, name
    assert np.abs(after - before).mean() < 2.0


def test_fewer_colours_and_dots_are_fewer_bytes(shots):
    dots = shots[1].dots
    forms = [(embed.shrunk(dots, share), *kept) for share, *kept, _ in embed._LADDER]
    assert forms[0][0].tobytes() == dots.tobytes()
    sizes = [len(embed.packed(*one)) for one in forms]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[0] < 0.6 * len(shots[1].png())


def test_a_picture_is_drawn_once_whatever_its_size_on_the_page(drive, town, monkeypatch):
    times = []
    drawing = FigureCanvasAgg.draw
    monkeypatch.setattr(FigureCanvasAgg, "draw", lambda c: times.append(c) or drawing(c))
    (picture,) = report.pictures(drive[["lat_rad", "lon_rad", "outage"]], town)[:1]
    sharp, coarse = (report.draw(picture, embed.dpi_for(count)) for count in (8, 9))
    assert len(times) == 2
    assert sharp.dots.width == pytest.approx(coarse.dots.width * 4 / 3, abs=2)
    assert sharp.pixels == pytest.approx(coarse.pixels, abs=2)
    (shown,) = embed.embed([sharp], 10**6)
    (small,) = embed.embed([sharp], len(shown.source) // 2)
    assert (small.width, small.height) == (shown.width, shown.height) == sharp.pixels
    assert decoded(small.source).width < decoded(shown.source).width
    assert len(times) == 2


def test_a_picture_of_one_colour_can_be_packed():
    packed = embed.packed(Image.new("RGB", (40, 30), "#123456"), 64)
    assert Image.open(io.BytesIO(packed)).convert("RGB").getcolors() == [(1200, (18, 52, 86))]


# ------------------------------------------------------------------------------------ the folder


@pytest.fixture
def walk(town):
    """Files of a folder beside its summary."""
    names = ["lat_rad", "lon_rad", "outage", "error_velocity", "sigma_velocity"]
    return a_drive(1, seconds=40.0)[names]


def written(path, walk, progress=None, **more):
    """A result with its report."""
    with results.ResultWriter(path, scenario_text="x = 1", command="robins run x") as writer:
        writer.save_summary(a_summary(1))
        writer.save_solution(walk)
        report.add(writer, progress, **more)
    return results.read(path)


def test_a_result_gets_its_figures_and_page(tmp_path, walk):
    seen = []
    back = written(tmp_path / "walk", walk, lambda *told: seen.append(told))
    assert set(back.figures) == {"track", "error_velocity"}
    assert back.summary["files"]["report"] == "report.html"
    assert back.manifest["command"] == "robins run x"
    assert back.manifest["scenario"]["text"] == "x = 1"
    page = back.report.read_text("utf-8")
    assert "robins run x" in page
    assert len(Reader(page).images) == 2
    share = [done / total for done, total, _ in seen]
    assert share == sorted(share)
    assert share[-1] == 1.0


def test_only_the_figures_asked_for_are_drawn(tmp_path, walk):
    assert set(written(tmp_path / "a", walk, only=["error_velocity"]).figures) == {"error_velocity"}
    assert set(written(tmp_path / "b", walk, only=["track", "nothing"]).figures) == {"track"}


def drawn(path, walk):
    """The figures that a result gets, byte for byte."""
    return {n: p.read_bytes() for n, p in written(path, walk).figures.items()}


def test_the_same_result_gets_the_same_figures(tmp_path, walk):
    assert drawn(tmp_path / "a", walk) == drawn(tmp_path / "b", walk)


def test_the_settings_of_a_user_do_not_change_the_figures(tmp_path, walk):
    import matplotlib

    plain = drawn(tmp_path / "a", walk)
    with matplotlib.rc_context({"font.size": 20, "axes.grid": False, "axes.facecolor": "pink"}):
        assert drawn(tmp_path / "b", walk) == plain


def test_an_interrupted_report_leaves_the_result_as_it_was(tmp_path, walk):
    before = sorted(p.name for p in written(tmp_path / "walk", walk).path.iterdir())

    def interrupt(*_told):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        written(tmp_path / "walk", walk, interrupt)
    assert sorted(p.name for p in (tmp_path / "walk").iterdir()) == before
    assert [p.name for p in tmp_path.iterdir()] == ["walk"]
    results.read(tmp_path / "walk")


def test_a_report_needs_a_summary(tmp_path):
    writer = results.ResultWriter(tmp_path / "out")
    with pytest.raises(results.ResultError, match="has no summary"):
        report.add(writer)
    writer.discard()
