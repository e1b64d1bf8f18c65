"""Table of the figures of a page in order: drawing function and roles of the arrays it uses."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import xarray as xr

from robins.report import (
    bounds,
    comparing,
    curves,
    instruments,
    maps,
    scatter,
    sensitivity,
    sweeps,
    updates,
)
from robins.report.lateness import lateness
from robins.report.numbers import Summary
from robins.report.style import Picture
from robins.report.suspects import suspects
from robins.report.tuning import tuning
from robins.results import find


class Figure(NamedTuple):
    """A picture, or one for each block or sensor that has an array of the first role."""

    draw: Callable[..., Picture | None]  # takes a solution; with `each` also a block or sensor
    roles: str  # shown, separated by blanks; drawn where the first exists
    each: bool = False
    when: Callable[[xr.Dataset, str], bool] | None = None  # further condition

    def of(self, solution: xr.Dataset, only: Sequence[str] = ()) -> Iterator[tuple[str, ...]]:
        """Arguments after the solution of each drawing, or of those in `only`."""
        found = find(solution, self.roles.split()[0])
        if not self.each:
            named = not only or getattr(self.draw, "__name__", "") in only
            yield from [()] if found and named else []
            return
        for of, one in found.items():
            named = not only or one.name in only
            if named and (self.when is None or self.when(solution, of)):
                yield (of,)


def _scatters(solution: xr.Dataset, block: str) -> bool:
    """True for several runs: the RMS of one run is only the absolute error."""
    return find(solution, "rms")[block].attrs.get("runs", 2) != 1


def _shows_more_than_error(solution: xr.Dataset, block: str) -> bool:
    """True if an estimate shows more than its error, such as one that should become constant."""
    return block not in find(solution, "error") or "bias" in block or "scale" in block


EACH = True
FIGURES = (
    Figure(maps.track, "track reference gnss gnss_quality"),
    Figure(bounds.sigmas, "bound_prior bound bound_unaided bound_without", EACH),
    Figure(bounds.information, "information gramian_rank"),
    Figure(curves.errors, "error sigma bound bounds", EACH),
    Figure(curves.campaign, "rms mean_sigma mean_error bound bounds", EACH, _scatters),
    Figure(scatter.percentiles, "percentile", EACH),
    Figure(curves.within, "within", EACH),
    Figure(curves.worst_case, "note"),
    Figure(suspects, "wrong mean_wrong truly_wrong"),
    Figure(curves.estimates, "estimate sigma", EACH, _shows_more_than_error),
    Figure(curves.values, "value sigma", EACH),
    Figure(curves.height, "track reference gnss"),
    Figure(updates.innovations, "innovation innovation_sigma nis nis_dof refused", EACH),
    Figure(updates.consistency, "consistency consistency_dof", EACH),
    Figure(instruments.allan, "allan allan_low allan_high allan_fit allan_slope", EACH),
    Figure(sweeps.errors, "sweep_rms sweep_low sweep_high sweep_stated", EACH),
    Figure(tuning, "tuned_factor tuned_low tuned_high judged_before judged_after"),
    Figure(
        sensitivity.budget,
        "sobol_first sobol_first_low sobol_first_high sobol_total sobol_total_low sobol_total_high",
    ),
    Figure(sensitivity.scatter, "sobol_rms sobol_share", EACH),
    Figure(comparing.trade_off, "trade_off_h2 trade_off_hinf kalman_h2 kalman_hinf"),
    Figure(lateness, "lateness_steps lateness_edge"),
    Figure(instruments.planes, "field_calibrated field_measured"),
    Figure(instruments.size, "field_calibrated field_measured"),
)


def drawings(
    solution: xr.Dataset | None, summary: Summary, only: Sequence[str] = ()
) -> list[Callable[[], Picture | None]]:
    """Functions that draw, in the order of the page; the comparison of a summary comes last.

    `only` selects by name: that of the array, or else of the function.
    """
    found: list[Callable[[], Picture | None]] = []
    if solution is not None:
        found += [partial(f.draw, solution, *of) for f in FIGURES for of in f.of(solution, only)]
    # Columns of a summary without filters are something else, such as the axes of a sensor.
    if not only and (solution is None or "filter" in solution.sizes):
        found.append(partial(comparing.comparison, summary))
    return found
