"""Pictures inside a page: the smaller of SVG and PNG, and all of them within a limit."""

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
# Share of the dots, colours and effort (of zlib) of a PNG, from the best to the least that can
# still be read. The last effort gains an eighth of the bytes in six times the time.
_LADDER = ((1.0, 64, 6), (1.0, 20, 9), (0.75, 20, 9), (0.5625, 20, 9), (0.47, 12, 9))
_EXPECTED = (1.0, 0.72, 0.52, 0.34, 0.25)  # of the size of the first; 22 figures differ by 0.03
_SIMPLE = 1000  # points; a drawing with more is never smaller than its dots
_NUMBER = re.compile(rb"-?\d+\.\d{3,}")


class Drawn(NamedTuple):
    """A picture and its dots, drawn once for all uses."""

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


class Embedded(NamedTuple):
    """A picture as the source of an image; empty if there was no room for it."""

    picture: Picture
    source: str
    width: int  # of the drawing, for the page's layout
    height: int


def dpi_for(pictures: int) -> int:
    """Dots per inch at which each of so many pictures of a page is drawn."""
    return DPI if pictures <= _FEW else PAGE_DPI


@styled
def draw(picture: Picture, dpi: int = DPI) -> Drawn:
    """Draw a picture; its layout stays as it is from here on."""
    picture.figure.set_dpi(dpi)
    canvas: Any = picture.figure.canvas
    canvas.draw()
    # Arranging the axes again would double the time of a drawing as lines.
    picture.figure.set_layout_engine("none")
    return Drawn(picture, Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"), dpi)


def shrunk(image: Image.Image, share: float) -> Image.Image:
    """An image of fewer dots, each the mean of those it stands for."""
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
    of_colour = np.zeros(1 << 24, np.uint8)  # of which few pages are touched
    of_colour[found] = nearest
    indexed = Image.fromarray(of_colour[dots])
    indexed.putpalette(palette.astype(np.uint8).tobytes())
    return _png(indexed, effort=effort)


def _palette(rgb: np.ndarray, count: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Colours of a palette, all of them exact, and for each given colour the nearest of them.

    Taken one by one, each time the colour that is worst served, weighted by how often it occurs:
    a thin line in a colour of its own counts as much as a large area in a shade of another's.
    Palettes made by averaging would fade tints and let rare lines change colour.
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
    """How many points a drawing has."""
    count = 0
    for axes in figure.axes:
        for line in axes.lines:
            # Each marker is an element of its own, as long as three points.
            each = 3 if line.get_marker() not in ("None", "") else 1
            count += each * np.size(line.get_xdata())
        count += sum(np.size(p.vertices) // 2 for c in axes.collections for p in c.get_paths())
    return count


def _svg_source(content: bytes) -> str:
    # Quoting only what a URL or an attribute cannot hold costs less than base64.
    flat = content.decode().replace("\n", " ")
    return "data:image/svg+xml," + quote(flat, safe=" /:=;,.-+()'!*@?_~<>")


def _png_source(content: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(content).decode()


class _Choice:
    """The forms of one picture, each made only when it is asked for."""

    def __init__(self, drawn: Drawn):
        self.drawn = drawn
        self.rungs = list(_LADDER)
        self.source = self._next()
        if _points(drawn.picture.figure) <= _SIMPLE:
            lines = _svg_source(svg(drawn.picture.figure))
            if len(lines) < len(self.source):
                self.source = lines

    @property
    def size(self) -> int:
        """Number of characters."""
        return len(self.source)

    def _next(self, rungs: int = 1) -> str:
        share, *kept = self.rungs[rungs - 1]
        del self.rungs[:rungs]
        return _png_source(packed(shrunk(self.drawn.dots, share), *kept))

    def shrink(self, rungs: int = 1) -> None:
        """Take the form that stands so many rungs further down, if it is smaller."""
        self.source = min(self.source, self._next(rungs), key=len)


def _steps(sizes: Sequence[int], limit: int) -> list[int]:
    """How far each of some pictures is expected to go down, that all fit."""
    rungs = [0] * len(sizes)

    def expected(k: int) -> float:
        return sizes[k] * _EXPECTED[rungs[k]]

    while sum(map(expected, range(len(sizes)))) > limit:
        able = [k for k, rung in enumerate(rungs) if rung + 1 < len(_EXPECTED)]
        if not able:
            break
        rungs[max(able, key=expected)] += 1
    return rungs


def embed(drawn: Sequence[Drawn], limit: int) -> list[Embedded]:
    """Sources for the pictures, together at most `limit` characters.

    The largest is made coarser until all fit; only what is coarse already is left out.
    """
    choices = [_Choice(one) for one in drawn]
    for choice, rungs in zip(choices, _steps([c.size for c in choices], limit), strict=True):
        if rungs:
            choice.shrink(rungs)
    while sum(c.size for c in choices) > limit:
        if able := [c for c in choices if c.rungs]:
            max(able, key=lambda c: c.size).shrink()
        else:
            max(choices, key=lambda c: c.size).source = ""
    return [Embedded(c.drawn.picture, c.source, *c.drawn.pixels) for c in choices]
