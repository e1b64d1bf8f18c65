"""Solution as tables: a row for each time of a clock, columns with their units in the name."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from robins import units
from robins.errors import require_known
from robins.gps_time import dated, utc_of

_OWN_UNIT = re.compile(r"(.*) \[(.*)\]")  # label of a component with its own unit
_FIRST = ("track", "attitude", "estimate", "sigma")  # roles, in the order of their columns


def clocks(solution: xr.Dataset) -> list[str]:
    """Names of the time axes of a solution, such as "time", "gnss_time", "sample_time"."""
    named = (str(dim) for dim in solution.dims if dim in solution.coords)
    return [dim for dim in named if dim == "time" or dim.endswith("_time")]


def stamps_ns(solution: xr.Dataset, clock: str) -> np.ndarray | None:
    """(E,) int64 stamps of the log [ns] at the times of a clock; None if it is not from a log."""
    origin = solution.attrs.get("origin_ns")
    if origin is None:
        return None
    return int(origin) + np.round(solution[clock].values * 1e9).astype(np.int64)


def utc(solution: xr.Dataset, clock: str) -> np.ndarray | None:
    """(E,) datetime64[ns], UTC at the times of a clock; None where the stamps have no date."""
    known = dated(int(solution.attrs.get("origin_ns", 0)))
    stamps = stamps_ns(solution, clock)
    return utc_of(stamps) if known and stamps is not None else None


def to_dataframe(
    solution: xr.Dataset, filter: str | None = None, clock: str = "time", *, si: bool = False
) -> pd.DataFrame:
    """All arrays on one clock, a column for each component, named by array, component and unit.

    The column of the array ``estimate_velocity``, component north, is called
    ``estimate_velocity_north_m_per_s``. Where there is an attitude as a quaternion (``q_nb_w`` ...)
    without its angles, roll, pitch and heading are added. The index is ``time_s``, time since
    the start. Where the stamps of the log have a date, ``utc`` is the first column; leap seconds
    are taken off the stamps, which count GPS time.

    Args:
        solution: of a result or an outcome.
        filter: its name; default: all, stacked, with an index (filter, time_s).
        clock: name of the time axis (`clocks`): each sensor has its own.
        si: in SI units and radians; else in the units of the figures.

    Raises:
        ValueError: there is no such filter or clock.
    """
    require_known("clock", clock, clocks(solution), "the solution")
    names = [str(name) for name in solution["filter"].values] if "filter" in solution.dims else []
    if filter is not None:
        require_known("filter", filter, names, "the solution")
        return _table(solution.sel(filter=filter), clock, si)
    if not names:
        return _table(solution, clock, si)
    return pd.concat(
        {n: _table(solution.sel(filter=n), clock, si) for n in names}, names=["filter"]
    )


def _table(solution: xr.Dataset, clock: str, si: bool) -> pd.DataFrame:
    """Table of a solution of one filter."""
    columns: dict[str, Any] = {}
    if (date := utc(solution, clock)) is not None:
        columns["utc"] = pd.DatetimeIndex(date, tz="UTC")
    arrays = {str(name): a for name, a in solution.data_vars.items() if clock in a.dims}
    for name, array in sorted((arrays | _angles(arrays)).items(), key=_rank):
        axes = [str(dim) for dim in array.dims if dim != clock]
        if not axes or (len(axes) == 1 and axes[0].startswith("axis")):
            columns |= _columns(name, array.transpose(clock, ...), si)
    return pd.DataFrame(columns, index=pd.Index(solution[clock].values, name="time_s"))


def _rank(item: tuple[str, xr.DataArray]) -> int:
    role = item[1].attrs.get("role")
    return _FIRST.index(role) if role in _FIRST else len(_FIRST)


def _angles(arrays: Mapping[str, xr.DataArray]) -> dict[str, xr.DataArray]:
    """Roll, pitch and heading of quaternions that have no angles in the solution."""
    name = "estimate_euler"
    if name in arrays or "q_nb" not in arrays:
        return {}
    import jax.numpy as jnp  # slow to import, and not needed to read most results

    from robins import rotation

    q = arrays["q_nb"]
    values = np.stack(rotation.to_euler(jnp.asarray(q.values)), axis=-1)
    about = {"role": "estimate", "units": "rad", "display_unit": "deg"}
    angles = ["roll", "pitch", "heading"]
    return {
        name: xr.DataArray(values, {"axis_euler": angles}, (q.dims[0], "axis_euler"), attrs=about)
    }


def _columns(name: str, array: xr.DataArray, si: bool) -> dict[str, np.ndarray]:
    """Components of an array by the names of their columns."""
    unit = str(array.attrs.get("units", "1"))
    stem = name.removesuffix(f"_{units.as_ending(unit)}")
    shown = unit if si else str(array.attrs.get("display_unit", unit))
    values = array.values
    if shown != unit:
        values = np.asarray(units.convert(values, unit, shown))
    if array.ndim == 1:
        return {_named(stem, shown): values}
    of = array.dims[1]
    labels = array[of].values if of in array.coords else range(1, array.shape[1] + 1)
    found = {}
    for label, column in zip(labels, values.T, strict=True):
        own = _OWN_UNIT.fullmatch(str(label))
        part, its = own.groups() if own else (str(label), shown)
        found[_named(f"{stem}_{part.replace(' ', '_')}", its)] = column
    return found


def _named(stem: str, unit: str) -> str:
    return stem if unit == "1" else f"{stem}_{units.as_ending(unit)}"
