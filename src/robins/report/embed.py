"""Pictures embedded in a page: the smaller of SVG and PNG, together within a size limit."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Sequence
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from robins.report.style import Picture, styled

DPI = 160  # 1.3 dots per pixel of the page: sharp on a screen, enough for paper
PAGE_DPI = 120  # one dot a pixel of the page
_FEW = 8  # pictures; more would not all fit into a page in the best form
# Share of the dots, number of colours and zlib level of a PNG, from the best to the coarsest that
# is still legible, and its expected size relative to the first (22 figures differ by 0.03). The
# highest level saves an eighth of the bytes in six times the time.
_LADDER = (
    (1.0, 64, 6, 1.0),
    (1.0, 20, 9, 0.72),
    (0.75, 20, 9, 0.52),
    (0.5625, 20, 9, 0.34),
    (0.47, 12, 9, 0.25),
)
_SLACK = 0.9  # of the limit; a page below it was expected too large
_SIMPLE = 1000  # points; a drawing with more is never smaller than its dots
_NUMBER = re.compile(rb"-?\d+\.\d{3,}")


class RenderedPicture(NamedTuple):
    """A picture and its pixels, drawn once for all uses."""

    picture: Picture
    dots: Image.Image
    dpi: int = DPI

    def png(self) -> bytes:
        """A PNG file in full colour."""
        return _png(self.dots, self.dpi)

    @property
    def pixels(self) -> tuple[int, int]:
        """Width and height on the page."""
        width, height = (round(side * PAGE_DPI / self.dpi) for side in self.dots.size)
        return width, height


def dpi_for(pictures: int) -> int:
    """Dots per inch at which each of so many pictures of a page is drawn."""
    return DPI if pictures <= _FEW else PAGE_DPI


@styled
def draw(picture: Picture, dpi: int = DPI) -> RenderedPicture:
    """Draw a picture and freeze its layout."""
    picture.figure.set_dpi(dpi)
    canvas: Any = picture.figure.canvas
    canvas.draw()
    # Arranging the axes again would double the time of a drawing as lines.
    picture.figure.set_layout_engine("none")
    return RenderedPicture(
        picture, Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"), dpi
    )


def shrunk(image: Image.Image, share: float) -> Image.Image:
    """An image of fewer pixels, each the mean of those it replaces."""
    if share == 1.0:
        return image
    size = (round(image.width * share), round(image.height * share))
    return image.resize(size, Image.Resampling.BOX)


def _png(image: Image.Image, dpi: int = DPI, effort: int = 6) -> bytes:
    out = io.BytesIO()
    image.save(out, format="png", compress_level=effort, dpi=(dpi, dpi))
    return out.getvalue()


def packed(image: Image.Image, colours: int, effort: int = 9) -> bytes:
    """A PNG with a palette, a third of the size of one in full colour."""
    dots = np.asarray(image, np.int32) @ np.array([1 << 16, 1 << 8, 1], np.int32)
    found, count = np.unique(dots, return_counts=True)
    rgb = np.stack([found >> 16, found >> 8 & 255, found & 255], axis=1)
    palette, nearest = _palette(rgb, count, colours)
    of_colour = np.zeros(1 << 24, np.uint8)  # few of its memory pages are used
    of_colour[found] = nearest
    indexed = Image.fromarray(of_colour[dots])
    indexed.putpalette(palette.astype(np.uint8).tobytes())
    return _png(indexed, effort=effort)


def _palette(rgb: np.ndarray, count: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Colours of a palette, each one exact, and for each given colour the nearest of them.

    Chosen one by one, each time the colour of the largest error weighted by its frequency, so a
    thin line of a distinct colour counts as much as a large area of a slightly different shade.
    Palettes made by averaging would fade tints and change the colour of rare lines.
    """
    chosen = [int(np.argmax(count))]
    error = np.full(len(rgb), np.iinfo(np.int64).max)
    nearest = np.zeros(len(rgb), np.uint8)
    weight = np.sqrt(count)
    while True:
        distance = np.sum((rgb - rgb[chosen[-1]]).astype(np.int64) ** 2, axis=1)
        nearest[distance < error] = len(chosen) - 1
        error = np.minimum(error, distance)
        if len(chosen) == min(size, len(rgb)):
            return rgb[chosen], nearest
        chosen.append(int(np.argmax(weight * error)))


@styled
def svg(figure: Figure) -> bytes:
    """The figure as SVG, its coordinates rounded to a hundredth of a point."""
    out = io.BytesIO()
    figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    text = _NUMBER.sub(lambda m: b"%.2f" % float(m[0]), out.getvalue())
    text = re.sub(rb"<metadata>.*?</metadata>|<!--.*?-->", b"", text, flags=re.DOTALL)
    return re.sub(rb"\s*\n\s*", b"\n", text)


def _points(figure: Figure) -> int:
    """Number of points of a drawing."""
    count = 0
    for axes in figure.axes:
        for line in axes.lines:
            # Each marker is a separate element, as long as three points.
            each = 3 if line.get_marker() not in ("None", "") else 1
            count += each * np.size(line.get_xdata())
        count += sum(np.size(p.vertices) // 2 for c in axes.collections for p in c.get_paths())
    return count


def _svg_source(content: bytes) -> str:
    # Quoting only what a URL or an attribute cannot hold costs less than base64.
    flat = content.decode().replace("\n", " ")
    return "data:image/svg+xml," + quote(flat, safe=" /:=;,.-+()'!*@?_~<>")


class Embedded:
    """A picture as the source of an image, in one of its forms, made only when it is needed.

    Attributes:
        picture: that is embedded.
        source: the current form; empty if there was no room for it.
        width: of the drawing, for the page's layout.
        height: likewise.
        rung: place of the form on the ladder, from fine to coarse.
    """

    def __init__(self, drawn: RenderedPicture):
        self.picture, self._dots, self.rung = drawn.picture, drawn.dots, 0
        self.width, self.height = drawn.pixels
        self._sources: dict[int, str] = {}
        self.source = self._form(0)
        if _points(drawn.picture.figure) <= _SIMPLE:
            self.source = min(self.source, _svg_source(svg(drawn.picture.figure)), key=len)
        self._first = self.source

    @property
    def size(self) -> int:
        """Number of characters."""
        return len(self.source)

    def _form(self, rung: int) -> str:
        if rung not in self._sources:
            share, colours, effort, _ = _LADDER[rung]
            made = packed(shrunk(self._dots, share), colours, effort)
            self._sources[rung] = "data:image/png;base64," + base64.b64encode(made).decode()
        return self._sources[rung]

    def take(self, rung: int) -> None:
        """Take the form at a place of the ladder, or the first one if that is smaller."""
        self.rung = rung
        self.source = min(self._first, self._form(rung), key=len) if rung else self._first


def _steps(sizes: Sequence[int], limit: int) -> list[int]:
    """Places on the ladder at which some pictures are expected to fit together."""
    rungs = [0] * len(sizes)

    def expected(k: int) -> float:
        return sizes[k] * _LADDER[rungs[k]][-1]

    while sum(map(expected, range(len(sizes)))) > limit:
        able = [k for k, rung in enumerate(rungs) if rung + 1 < len(_LADDER)]
        if not able:
            break
        rungs[max(able, key=expected)] += 1
    return rungs


def _refine(choices: Sequence[Embedded], limit: int) -> None:
    """Take finer forms, the smallest picture first, as long as all fit."""
    left = [c for c in choices if c.rung]
    while left and sum(c.size for c in choices) < _SLACK * limit:
        one = min(left, key=lambda c: c.size)
        one.take(one.rung - 1)
        if sum(c.size for c in choices) > limit:
            one.take(one.rung + 1)
            left.remove(one)
        elif not one.rung:
            left.remove(one)


def embed(drawn: Sequence[RenderedPicture], limit: int) -> list[Embedded]:
    """Sources for the pictures, together at most `limit` characters.

    The largest is made coarser until all fit; pictures are left out only in their coarsest form.
    """
    choices = list(map(Embedded, drawn))
    for choice, rung in zip(choices, _steps([c.size for c in choices], limit), strict=True):
        choice.take(rung)
    _refine(choices, limit)
    while sum(c.size for c in choices) > limit:
        if able := [c for c in choices if c.rung + 1 < len(_LADDER) and c.source]:
            one = max(able, key=lambda c: c.size)
            one.take(one.rung + 1)
        else:
            max(choices, key=lambda c: c.size).source = ""
    return choices
