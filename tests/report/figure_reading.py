"""Content of a figure as a reader sees it: its lines, and its texts with their places."""

import itertools

import numpy as np
from matplotlib.transforms import Bbox


def lines_of(axes, colour):
    """Line data of a colour, by how they were drawn: x, y."""
    return [
        (np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float))
        for line in axes.lines
        if line.get_color() == colour
    ]


def visible_texts(figure):
    """Every text a reader sees, with its box in pixels."""
    texts = [text for legend in figure.legends for text in legend.texts]
    for axes in figure.axes:
        if axes.get_visible():
            texts += [*axes.texts, axes.xaxis.label, axes.yaxis.label, axes._left_title]
            for axis in (axes.xaxis, axes.yaxis):
                texts.append(axis.get_offset_text())
                # Matplotlib keeps labels of ticks out of range; this lists the ones it draws.
                texts += [tick.label1 for tick in axis._update_ticks()]
    seen = [(t.get_text(), t.get_window_extent()) for t in texts if t.get_visible()]
    return [(text, box) for text, box in seen if text.strip()]


def collisions(figure):
    """Texts that stick out of the figure or cover another."""
    texts = visible_texts(figure)
    bad = []
    for text, box in texts:
        outside = (-box.x0, -box.y0, box.x1 - figure.bbox.x1, box.y1 - figure.bbox.y1)
        if max(outside) > 1.0:
            bad.append(text)
    for (a, first), (b, second) in itertools.combinations(texts, 2):
        shared = Bbox.intersection(first, second)
        if shared is not None and shared.width > 1.0 and shared.height > 1.0:
            bad.append(f"{a!r} covers {b!r}")
    return bad
