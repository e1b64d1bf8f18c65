"""Fault probability of each instrument and of the motion model, from a bank of hypotheses."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from robins.report import series, style
from robins.report.style import Picture

_VISIBLE = 0.01  # probability below which a line lies on zero


@style.styled
def suspects(solution: xr.Dataset) -> Picture | None:
    """Fault probability by suspect over time; None if there is none above zero."""
    first, mean = series.required(solution, "wrong"), series.get(solution, "mean_wrong")
    true = series.one(solution, "truly_wrong")
    names = [name.replace("_", " ") for name in first.axes]
    filters = series.filters(solution)
    stating = [i for i in range(len(filters)) if np.isfinite(first.values[i]).any()]
    shown = [one.values[stating] for one in (first, mean) if one is not None]
    suspected = any(np.nanmax(values, initial=0.0) > _VISIBLE for values in shown)
    if not suspected and (true is None or not np.any(true)):
        return None
    figure, stack, clock = series.stacked(solution, first._replace(axes=names))
    for k, axes in enumerate(stack):
        if true is not None:
            style.shade(axes, first.x / clock.seconds, np.asarray(true)[:, k] != 0, style.BAND)
        for i in stating:
            look = style.filter_style(i) if mean is None else style.filter_style(i, linewidth=0.5)
            clock.plot(axes, first.x, first.values[i, :, k], **look)
            if mean is not None:
                clock.plot(axes, mean.x, mean.values[i, :, k], **style.filter_style(i))
        axes.set(ylim=(-0.03, 1.03))
    keys: list[Line2D | Patch] = [style.filter_keys(filters)[i] for i in stating]
    if true is not None and np.any(true):
        keys.append(Patch(color=style.BAND, label="truly wrong"))
    series.legend(figure, solution, keys)
    caption = "Probability that it is wrong, as the hypotheses of the filter state it at each step."
    if mean is not None:
        caption += f" Mean over {mean.attrs['runs']} runs; thin: the first run."
    return Picture("wrong", "What the filter finds wrong", caption, figure)
