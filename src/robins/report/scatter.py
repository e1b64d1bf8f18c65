"""Sizes of the errors of a campaign's runs, by percentiles."""

from __future__ import annotations

import numpy as np
import xarray as xr

from robins.report import series, style
from robins.report.numbers import words
from robins.report.style import Picture

_WHOLE = 100  # runs below which the highest percentile is the largest of them


@style.styled
def percentiles(solution: xr.Dataset, block: str) -> Picture:
    """Median, central 90 % range, and highest percentile of the length of an error."""
    data = series.required(solution, "percentile", block)
    filters = series.filters(solution)
    tinted = len(filters) <= style.TINTED
    label = f"length of the error [{data.unit}]" if data.unit else "length of the error"
    figure, axes, clock = series.single_axes(solution, data.x, label, 3.2)
    low, middle, high, highest = range(4)
    # Zero and infinity have no logarithm: a line ends where a percentile diverged.
    lengths = np.where(np.isfinite(data.values) & (data.values > 0.0), data.values, np.nan)
    for i, of in enumerate(lengths):
        clock.plot(axes, data.x, of[:, middle], **style.filter_style(i))
        clock.plot(axes, data.x, of[:, highest], **style.filter_style(i, linewidth=0.7))
        if tinted:
            tint = {"color": style.colour(i), "alpha": 0.15, "linewidth": 0}
            axes.fill_between(data.x / clock.seconds, of[:, low], of[:, high], **tint)
    if np.any(np.isfinite(lengths)):
        style.decades(axes, float(np.nanmin(lengths)), float(np.nanmax(lengths)))
    runs = int(data.attrs["runs"])
    few = runs < _WHOLE
    thin = f"largest of {runs} runs" if few else f"{data.axes[highest]} of the runs"
    more = [style.key(thin, color=style.GREY, linewidth=0.7)]
    style.legend(figure, [*style.filter_keys(filters), *more])
    most = "the largest" if few else f"what {data.axes[highest]} of them do not exceed"
    caption = (
        f"Length of the error over all components: the median of {runs} runs "
        f"(line) and {most} (thin)."
    )
    if tinted:
        caption += f" Tint: from {data.axes[low]} to {data.axes[high]} of the runs."
    caption += f" Read from a histogram, to {100 * data.attrs['bins']:.1f}\u00a0%."
    if np.any(np.isinf(data.values)):
        caption += " A line ends where so many runs have diverged."
    name = words(block)
    return Picture(f"percentile_{block}", f"Size of the error of the {name}", caption, figure)
