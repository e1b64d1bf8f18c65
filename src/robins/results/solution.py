"""`solution.nc`: arrays with named dimensions, units and frames, as netCDF-4."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from robins import units
from robins.foreign import decoding, within
from robins.results import roles
from robins.results.errors import ResultError

Variables = dict[str, xr.Variable]
"""Arrays and coordinates of a solution, by name."""


def variable(
    dims: str | Sequence[str], values: Any, unit: str, long_name: str, frame: str = "", **attrs: Any
) -> xr.Variable:
    """Make a variable with unit, name and frame: a coordinate, such as the time.

    Args:
        dims: names of the axes of `values`.
        values: anything NumPy takes.
        unit: in the spelling of `robins.units`; "1" for a pure number.
        long_name: for axes and captions, without the unit.
        frame: axes of the components, e.g. "NED"; required if there are components along axes.
        attrs: further attributes for figures, e.g. ``display_unit="deg/h"``.
    """
    named = {"units": unit, "long_name": long_name} | ({"frame": frame} if frame else {}) | attrs
    return xr.Variable(dims, np.asarray(values), named)


def array(
    role: str,
    values: Any,
    of: str = "",
    *,
    unit: str = "",
    long_name: str = "",
    frame: str = "",
    axes: Sequence[str] = (),
    dims: str | None = None,
    **attrs: Any,
) -> dict[str, xr.Variable]:
    """Make an array of a solution, by its name, and the coordinate of its axes.

    Args:
        role: of a row of `robins.results.ROLES`.
        values: anything NumPy takes.
        of: its object: a block of the state, a sensor, ...; empty if the row has one array.
        unit: as in `variable`; default: that of the row.
        long_name: likewise.
        frame: as in `variable`.
        axes: names of the components along the last dimension.
        dims: names of the dimensions, separated by blanks; default: those of the row.
        attrs: as in `variable`; must include those that the row requires.

    Raises:
        ValueError: there is no such role, or the array lacks what its row requires.
    """
    row = roles.row(role, of)
    names = roles.dims(row, of) if dims is None else dims.split()
    text = long_name or row.long_name(of)
    about = {"role": role} | ({"of": of} if of else {}) | attrs
    made = variable(names, values, unit or row.unit, text, frame, **about)
    name = row.array_name(of)
    if wrong := roles.fault(name, made) or ("" if made.attrs["units"] else "has no unit"):
        raise ValueError(f"{name}: {wrong}")
    labels = {names[-1]: xr.Variable(names[-1], list(axes))} if axes else {}
    return {name: made} | labels


def check(solution: xr.Dataset) -> None:
    """Refuse a dataset that a reader could misread.

    Raises:
        ValueError: a numeric array has no units or no name, components along axes have no frame,
            a unit for figures is not of its kind, an attribute is of a type that netCDF cannot
            hold, or the array does not fit its role. The message names the array.
    """
    for name, array in solution.variables.items():
        if array.dtype.kind in "biuf":
            for attr in ("units", "long_name"):
                if not isinstance(array.attrs.get(attr), str):
                    raise ValueError(f"{name}: the attribute {attr!r} is missing")
        elif array.dtype.kind not in "UO" or name not in solution.dims:
            raise ValueError(f"{name}: arrays of {array.dtype} are not stored")
        has_axes = any(str(dim) == "axis" or str(dim).startswith("axis_") for dim in array.dims)
        if has_axes and "frame" not in array.attrs and name not in solution.dims:
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
        if name in solution.data_vars and (wrong := roles.fault(str(name), array)):
            raise ValueError(f"{name}: {wrong}")


def pack(solution: xr.Dataset) -> bytes:
    """The content of the file: compressed netCDF-4; numbers come back bit for bit.

    Built in memory, so that a disk error arises in a plain write of bytes: HDF5 reports a full disk
    in several ways, some of them only when the interpreter ends.
    """
    packed = {"zlib": True, "complevel": 1, "shuffle": True}
    encoding = {
        # By default xarray declares NaN as fill value, but NaN already has a meaning.
        name: {"_FillValue": None} | (packed if array.ndim and array.size else {})
        for name, array in solution.variables.items()
        if array.dtype.kind in "biuf"
    }
    # A dataset read from a file may carry the encodings of that file.
    solution = solution.drop_encoding()
    return bytes(solution.to_netcdf(engine="h5netcdf", format="NETCDF4", encoding=encoding))


def read(path: str | os.PathLike[str]) -> xr.Dataset:
    """Load everything into memory; the file is closed again. Every array has its role."""

    def refuse(why: str) -> ResultError:
        return ResultError(path, f"is damaged: {why}", "make the result again")

    with decoding(refuse):
        import h5py

        sizes: list[int] = []

        def add(_name: str, one: h5py.HLObject) -> None:
            if isinstance(one, h5py.Dataset):
                numbers = max(one.size or 0, math.prod(one.chunks or ()))
                sizes.append(numbers * one.dtype.itemsize)

        with h5py.File(path) as file:
            file.visititems(add)
    within(sum(sizes), os.path.getsize(path), "it", refuse)
    with decoding(refuse), xr.open_dataset(path, engine="h5netcdf", decode_times=False) as solution:
        loaded = solution.load()
    return roles.recognised(loaded)
