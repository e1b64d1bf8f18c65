"""`solution.nc`: arrays with named dimensions, units and frames, as netCDF-4."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from robins import units


def variable(
    dims: str | Sequence[str],
    values: Any,
    unit: str,
    long_name: str,
    frame: str = "",
    **attrs: Any,
) -> xr.Variable:
    """An array with what a reader must know about it.

    Args:
        dims: names of the axes of `values`.
        values: anything NumPy takes.
        unit: in the spelling of `robins.units`; "1" for a pure number.
        long_name: for axes and captions, without the unit.
        frame: axes along which the components are given, e.g. "NED"; needed where there are some.
        attrs: anything else a figure needs, e.g. ``display_unit="deg/h"``.
    """
    named = {"units": unit, "long_name": long_name} | ({"frame": frame} if frame else {}) | attrs
    return xr.Variable(dims, np.asarray(values), named)


def check(solution: xr.Dataset) -> None:
    """Refuse a dataset that a reader could misread.

    Raises:
        ValueError: a numeric array has no units or no name, components along axes have no frame,
            a unit for figures is not of its kind, or an attribute is of a type that netCDF cannot
            hold. The message names the array.
    """
    for name, array in solution.variables.items():
        if array.dtype.kind in "biuf":
            for attr in ("units", "long_name"):
                if not isinstance(array.attrs.get(attr), str):
                    raise ValueError(f"{name}: the attribute {attr!r} is missing")
        elif array.dtype.kind not in "UO" or name not in solution.dims:
            raise ValueError(f"{name}: arrays of {array.dtype} are not stored")
        if _has_axes(array.dims) and "frame" not in array.attrs and name not in solution.dims:
            raise ValueError(f"{name}: has components along axes, but no attribute 'frame'")
        if "display_unit" in array.attrs:
            try:
                units.convert(1.0, array.attrs["units"], array.attrs["display_unit"])
            except units.UnitError as error:
                raise ValueError(f"{name}: the attribute 'display_unit': {error}") from None
        for attr, value in array.attrs.items():
            if np.asarray(value).dtype.kind not in "iufU":
                raise ValueError(
                    f"{name}: the attribute {attr!r} is {value!r}; use text or numbers"
                )


def _has_axes(dims: Sequence[Any]) -> bool:
    return any(str(dim) == "axis" or str(dim).startswith("axis_") for dim in dims)


def pack(solution: xr.Dataset) -> bytes:
    """The content of the file: compressed netCDF-4; numbers come back bit for bit.

    Built in memory, so that whatever the disk refuses is refused to a plain write of bytes: HDF5
    reports a full disk in several ways, some of them when the interpreter ends.
    """
    packed = {"zlib": True, "complevel": 1, "shuffle": True}
    encoding = {
        # Without a fill value of its own xarray would declare one, and NaN has its meaning already.
        name: {"_FillValue": None} | (packed if array.ndim and array.size else {})
        for name, array in solution.variables.items()
        if array.dtype.kind in "biuf"
    }
    # What a dataset was read from may have left encodings of another file.
    solution = solution.drop_encoding()
    return bytes(solution.to_netcdf(engine="h5netcdf", format="NETCDF4", encoding=encoding))


def read(path: str | os.PathLike[str]) -> xr.Dataset:
    """Load everything into memory; the file is closed again."""
    with xr.open_dataset(path, engine="h5netcdf", decode_times=False) as solution:
        return solution.load()
