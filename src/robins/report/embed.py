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
# Dots per inch and colours of a PNG, from the best to the least that can still be read; 120 is one
# dot a pixel of the page.
_LADDER = ((DPI, 64), (120, 48), (120, 20), (90, 20), (75, 12))
_FEW = 8  # pictures
_SIMPLE = 1000  # points; a drawing with more is never smaller than its dots
_NUMBER = re.compile(rb"-?\d+\.\d{3,}")


class Drawn(NamedTuple):
    """A picture and its dots, drawn once for all uses."""

    picture: Picture
    dots: Image.Image

    def png(self) -> bytes:
        """A PNG file in full colour."""
        return _png(self.dots)


class Embedded(NamedTuple):
    """A picture as the source of an image; empty if there was no room for it."""

    picture: Picture
    source: str
    width: int  # of the drawing, for the page's layout
    height: int


@styled
def draw(picture: Picture) -> Drawn:
    """Draw a picture; its layout stays as it is from here on."""
    dots = _dots(picture.figure, DPI)
    # Arranging the axes anew would double the time of every other drawing.
    picture.figure.set_layout_engine("none")
    return Drawn(picture, dots)


@styled
def _dots(figure: Figure, dpi: int) -> Image.Image:
    figure.set_dpi(dpi)
    canvas: Any = figure.canvas
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")


def _png(image: Image.Image) -> bytes:
    out = io.BytesIO()
    image.save(out, format="png", optimize=image.mode == "P", dpi=(DPI, DPI))
    return out.getvalue()


def packed(image: Image.Image, colours: int) -> bytes:
    """A PNG with a palette, a third of the size of one in full colour."""
    dots = np.asarray(image, np.int32)
    found, where, count = np.unique(
        (dots[..., 0] << 16) | (dots[..., 1] << 8) | dots[..., 2],
        return_inverse=True,
        return_counts=True,
    )
    rgb = np.stack([found >> 16, found >> 8 & 255, found & 255], axis=1)
    palette, nearest = _palette(rgb, count, colours)
    indexed = Image.fromarray(nearest[where].reshape(dots.shape[:2]))
    indexed.putpalette(palette.astype(np.uint8).tobytes())
    return _png(indexed)


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

    def __init__(self, drawn: Drawn, first: int):
        self.drawn = drawn
        self.rungs = list(_LADDER[first:])
        self.source = self._next()
        if _points(drawn.picture.figure) <= _SIMPLE:
            lines = _svg_source(svg(drawn.picture.figure))
            if len(lines) < len(self.source):
                self.source = lines

    def _next(self) -> str:
        dpi, colours = self.rungs.pop(0)
        picture, dots = self.drawn
        # Drawn anew, not shrunk: letters are then fitted to the dots.
        return _png_source(packed(dots if dpi == DPI else _dots(picture.figure, dpi), colours))

    def shrink(self) -> None:
        self.source = min(self.source, self._next(), key=len)


def embed(drawn: Sequence[Drawn], limit: int) -> list[Embedded]:
    """Sources for the pictures, together at most `limit` characters.

    The largest is made coarser until all fit; only what is coarse already is left out.
    """
    # Many pictures would not fit in the best form anyway; not trying saves half of the time.
    first = 0 if len(drawn) <= _FEW else 1
    choices = [_Choice(one, first) for one in drawn]
    while sum(len(c.source) for c in choices) > limit:
        if able := [c for c in choices if c.rungs]:
            max(able, key=lambda c: len(c.source)).shrink()
        else:
            max(choices, key=lambda c: len(c.source)).source = ""
    return [Embedded(c.drawn.picture, c.source, *_pixels(c.drawn.dots)) for c in choices]


def _pixels(image: Image.Image) -> tuple[int, int]:
    return round(image.width * 120 / DPI), round(image.height * 120 / DPI)
