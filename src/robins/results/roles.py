"""The roles of a solution's arrays, in one table.

A row gives the names of arrays, their dimensions and their required attributes. The
rest follows from it: `robins.results.array` builds one with its name and its attributes ``role``
and ``of``, `find` reads by these attributes, `fault` states why a writer refuses one, `recognised`
serves files written before there were roles, and the documents print the table.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import xarray as xr

_PLACES = "{lat_rad|lon_rad|alt_m|north_m|east_m}"
_PARTS = re.compile(r"(\w*)(?:\{(.+)\})?(\w*)")
_MORE = "..."  # or other dimensions, of any number


class Role(NamedTuple):
    """Role of some arrays, each *of* something: a block of the state, a sensor, a limit."""

    variable: str  # name of an array; in braces its object, as a word or as choices
    dims: str  # by position; any time axis in seconds since the start may replace time
    text: str  # default long name of an array; after a semicolon, remarks
    unit: str = ""  # default unit; empty: each array must have one
    attrs: tuple[str, ...] = ()  # further attributes required of an array
    named: str = ""  # the role, if the name of the variable does not begin with it

    @property
    def name(self) -> str:
        """Value of the attribute ``role``."""
        return self.named or self._parts[0].strip("_")

    @property
    def _parts(self) -> tuple[str, str, str]:
        head, of, tail = _PARTS.fullmatch(self.variable).groups("")  # type: ignore[union-attr]
        return head, of, tail

    def long_name(self, of: str) -> str:
        """Default long name of an array of an object."""
        return self.text.partition(";")[0].format(of=of.replace("_", " "))

    def array_name(self, of: str) -> str:
        """Name of the array of an object."""
        head, _, tail = self._parts
        return f"{head}{of}{tail}"

    def of(self, variable: str) -> str | None:
        """Object of an array of this name; None if the name is not of this role."""
        head, of, tail = self._parts
        found = re.fullmatch(f"{head}({of if '|' in of else of and '.+'}){tail}", variable)
        return found[1] if found else None


_FT, _FTA = "filter time", "filter time axis_{of}"
_AT, _ATA = "filter {of}_time", "filter {of}_time axis_{of}"
_SWEEP = "filter sweep_1 sweep_2"
_TA, _TAU = "time axis_{of}", "tau axis_{of}"

ROLES = (
    Role("{lat_rad|lon_rad|alt_m}", _FT, "position of each filter", named="track"),
    Role("track_{north_m|east_m}", _FT, "the same on a map; else made of latitude and longitude"),
    Role(f"reference_{_PLACES}", "time", "true or best known path; on the map if the track is"),
    Role(f"gnss_{_PLACES}", "gnss_time", "fixes; on the map if the track is"),
    Role(
        "gnss_quality",
        "gnss_time",
        "quality of the fixes; by `flag_values` and `flag_meanings` (CF conventions), or as RTKLIB",
        "1",
    ),
    Role("outage", "time", "aids withheld; nonzero where they were; shaded in all figures", "1"),
    Role("estimate_{block}", _FTA, "estimated {of}"),
    Role(
        "error_{block}",
        _FTA,
        "error of {of}; true minus estimated; an error of the vehicle has a caption in `comment`",
    ),
    Role(
        "q_nb",
        f"{_FT} axis_q_nb",
        "estimated attitude; unit quaternion of Hamilton, scalar first: v_n = q v_b conj(q); at "
        "the times of the filter or of the samples",
        "1",
        named="attitude",
    ),
    Role("value_{name}", _FTA, "{of}; what the vehicle does besides; caption in `comment`"),
    Role("sigma_{block}", _FTA, "standard deviation of {of}; as the filter states it"),
    Role("innovation_{sensor}", _ATA, "innovation of {of}; NaN where missing"),
    Role("innovation_sigma_{sensor}", _ATA, "expected {of}; one standard deviation"),
    Role("nis_{sensor}", _AT, "NIS of {of}; with `degrees_of_freedom`, or array `nis_dof`", "1"),
    Role("nis_dof_{sensor}", _AT, "degrees of freedom of {of}", "1"),
    Role("refused_{sensor}", _AT, "{of} refused by a rule; nonzero where it was", "1"),
    Role(
        "{nees|anees}",
        _FT,
        "normalised estimation error squared; of one run, or the mean over `runs`; with "
        "`degrees_of_freedom`, or array `consistency_dof`; `normalised=1` if divided by these",
        "1",
        named="consistency",
    ),
    Role("{nees|anees}_dof", _FT, "state dimension", "1", named="consistency_dof"),
    Role("rms_{block}", _FTA, "RMS error of {of}", attrs=("runs",)),
    Role("mean_sigma_{block}", _FTA, "stated sigma of {of}; root of the mean stated variance"),
    Role("mean_error_{block}", _FTA, "mean error of {of}; over the `runs`", attrs=("runs",)),
    Role(
        "covariance_{block}",
        "filter thinned_time axis_{of} other_{of}",
        "covariance of the errors of {of}; over the `runs`; infinite if one diverged",
        attrs=("runs",),
    ),
    Role(
        "percentile_{block}",
        "filter thinned_time percentile",
        "length of the error of {of}; that so many percent of the `runs` do not exceed; at some "
        "epochs; to the share `bins` of it",
        attrs=("runs", "bins"),
    ),
    Role("within_{limit}", _FT, "runs within {of}; share of the `runs`", "1", ("runs",)),
    Role("wrong", "filter time suspect", "probability that a suspect is wrong; of one run", "1"),
    Role(
        "mean_wrong", "filter time suspect", "mean probability of being wrong", "1", attrs=("runs",)
    ),
    Role("truly_wrong", "time suspect", "instruments, or motion, that are truly wrong", "1"),
    Role("bounds", "filter", "states bounds, not standard deviations; nonzero where it does", "1"),
    Role("note_{note}", _FT, "{of}, first run; what a rule noted", "1"),
    Role("bound_{block}", _TA, "covariance bound of {of}; one standard deviation"),
    Role("bound_prior_{block}", "axis_{of}", "prior sigma of {of}"),
    Role(
        "bound_left_{block}",
        "axis_{of}",
        "share of the start's {of} that the measurements leave, process noise aside",
        "1",
    ),
    Role("bound_unaided_{block}", _TA, "bound of {of} with no sensor"),
    Role("bound_without_{block}", f"sensor {_TA}", "bound of {of} without; one sensor each"),
    Role("information", "state time", "information about the start [bit]", "1"),
    Role(
        "gramian",
        "direction",
        "least eigenvalues of the observability Gramian, in units of the prior; "
        "not seen below `nothing`",
        "1",
        ("nothing",),
    ),
    Role("gramian_rank", "", "rank of the observability Gramian", "1"),
    Role("allan_{sensor}", _TAU, "Allan deviation of the {of}; `confidence` is of its bounds"),
    Role("allan_low_{sensor}", _TAU, "lower bound; of its confidence"),
    Role("allan_high_{sensor}", _TAU, "upper bound; of its confidence"),
    Role("allan_fit_{sensor}", _TAU, "fit; the fitted model"),
    Role("allan_slope_{sensor}", f"process {_TAU}", "terms; parts of the model, by name"),
    Role("field_measured", "time axis_field", "magnetic field, measured", "T"),
    Role(
        "field_calibrated",
        "time axis_field",
        "magnetic field, calibrated; `strength` is the size it should have [T]",
        "T",
        ("strength",),
    ),
    Role("lateness_steps", "lateness_bin", "steps that began so late; one more than edges", "1"),
    Role("lateness_edge", "lateness_edge_number", "edges of the bins", "us"),
    Role("trade_off_h2", "design gamma", "true H2 norm; NaN where there is no design"),
    Role(
        "trade_off_hinf",
        "design gamma",
        "true H-infinity norm; `least` is the least norm of the designs `least_of`",
        attrs=("least", "least_of"),
    ),
    Role("trade_off_bound", "design gamma", "bound on the H2 norm"),
    Role("kalman_h2", "", "H2 norm of the Kalman filter"),
    Role("kalman_hinf", "", "H-infinity norm of the Kalman filter"),
    Role(
        "sweep_rms_{block}",
        _SWEEP,
        "RMS error of {of}; length over its components, over runs and epochs that count",
        attrs=("runs",),
    ),
    Role("sweep_low_{block}", _SWEEP, "lower bound; of 95 % confidence, by the spread of the runs"),
    Role("sweep_high_{block}", _SWEEP, "upper bound; likewise"),
    Role("sweep_stated_{block}", _SWEEP, "stated sigma of {of}; root of the mean stated variance"),
    Role("tuned_factor", "parameter", "factor on a parameter; what was found", "1"),
    Role("tuned_low", "parameter", "lower bound; of 95 % confidence", "1"),
    Role("tuned_high", "parameter", "upper bound; likewise", "1"),
    Role(
        "judged_before",
        "part",
        "objective as written; of each run or segment held out; less is better",
        "1",
        ("comment", "parts"),
    ),
    Role("judged_after", "part", "objective tuned; likewise", "1"),
    Role(
        "sobol_first_{block}",
        "parameter",
        "first-order Sobol index of {of}; share of the variance of its RMS error",
        "1",
        ("of_filter", "samples", "runs"),
    ),
    Role("sobol_first_low_{block}", "parameter", "lower bound; of 95 % confidence", "1"),
    Role("sobol_first_high_{block}", "parameter", "upper bound; likewise", "1"),
    Role("sobol_total_{block}", "parameter", "total Sobol index of {of}; with interactions", "1"),
    Role("sobol_total_low_{block}", "parameter", "lower bound; of 95 % confidence", "1"),
    Role("sobol_total_high_{block}", "parameter", "upper bound; likewise", "1"),
    Role("sobol_rms_{block}", "point", "RMS error of {of}; over runs and epochs that count"),
    Role(
        "sobol_share",
        "point parameter",
        "place between the ends of a parameter; 0 to 1, `ends` of each as texts",
        "1",
        ("ends",),
    ),
    Role("{name}", f"time {_MORE}", "{of}; what else is known of a run", named="context"),
)


def dims(role: Role, of: str) -> list[str]:
    """Default names of the dimensions of an array."""
    return role.dims.removesuffix(_MORE).format(of=of).split()


def row(role: str, of: str) -> Role:
    """Row of a role for an object.

    Raises:
        ValueError: there is no such row.
    """
    rows = [r for r in ROLES if r.name == role]
    for one in rows:
        if one.of(one.array_name(of)) == of:
            return one
    known = ", ".join(r.variable for r in rows)
    names = ", ".join(dict.fromkeys(r.name for r in ROLES))
    raise ValueError(
        f"no array of role {role!r} is of {of!r}: its names are {known}"
        if rows
        else f"there is no role {role!r}; use one of {names}"
    )


def fault(name: str, array: xr.Variable | xr.DataArray) -> str:
    """Fault of an array by the row of its role; empty if there is none."""
    if "role" not in array.attrs:
        return "the attribute 'role' is missing; build it with robins.results.array"
    try:
        one = row(array.attrs["role"], array.attrs.get("of", ""))
    except ValueError as error:
        return str(error)
    array_name = one.array_name(array.attrs.get("of", ""))
    if name != array_name:
        return f"by its role it is called {array_name}"
    if _MORE not in one.dims and len(one.dims.split()) != array.ndim:
        return f"has dimensions {', '.join(map(str, array.dims))}, not {one.dims}"
    missing = [attr for attr in one.attrs if attr not in array.attrs]
    return f"the attribute {missing[0]!r} is missing" if missing else ""


def find(solution: xr.Dataset, role: str) -> dict[str, xr.DataArray]:
    """Arrays of a role by their objects (empty if the role has one array only)."""
    return {
        array.attrs.get("of", ""): solution[name]
        for name, array in solution.variables.items()
        if array.attrs.get("role") == role
    }


def recognised(solution: xr.Dataset) -> xr.Dataset:
    """Give roles to arrays of a file written before there were any, by their names.

    The longest name counts: ``innovation_sigma_gnss`` is not the innovation of ``sigma_gnss``.
    """
    for name, array in solution.data_vars.items():
        if "role" not in array.attrs:
            fits = [(r, of) for r in ROLES if (of := r.of(str(name))) is not None]
            best, of = min(fits, key=lambda fit: len(fit[1]))
            array.attrs.update({"role": best.name} | ({"of": of} if of else {}))
    return solution
