"""A design problem: a TOML file with the matrices of a plant, or one that comes with robins."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

from robins.filters.synthesis import Plant, current_form, plant
from robins.foreign import decoding
from robins.workbench.errors import InputError
from robins.workbench.list import designs

_FORMS = {
    "prediction": ("A", "Bw", "Bn", "C", "Dw", "Dn", "L"),
    "current": ("A", "Bw", "Bn", "C", "Dv", "Dn", "L"),
}
_NEEDED = {"prediction": ("A", "Bw", "Bn", "C"), "current": ("A", "Bw", "Bn", "C", "Dv")}
_OTHERS = {"title", "form", "gamma", "units"}


class DesignProblem(NamedTuple):
    """Design problem."""

    name: str  # of the file or example
    title: str
    form: str  # what the gain does: "prediction" or "current"
    plant: Plant
    blocks: dict[str, Any]  # the matrices as they were given
    gammas: list[float] | None
    unit_z: str  # of what is estimated; "1" if it was not given
    unit_n: str  # of the modelling error
    text: str  # of the file

    @property
    def unit_gain(self) -> str:
        """Unit of gamma."""
        if self.unit_n == "1":
            return self.unit_z
        return f"{self.unit_z}/({self.unit_n})"


def read_problem(given: str) -> DesignProblem:
    """Read a problem by the path of its file or by its name.

    Raises:
        InputError: there is no such file or example, it is not TOML, or something in it does not
            fit; the message names the block and its shape.
    """
    path = Path(given)
    if given in designs():
        text = (files("robins.workbench") / "problems" / f"{given}.toml").read_text("utf-8")
    else:
        try:
            text = path.read_text("utf-8")
        except FileNotFoundError as error:
            known = ", ".join(designs())
            raise InputError(
                f"no such file, and no example of that name; there are {known}.", given
            ) from error
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"cannot be read: {error}.", given) from error
    with decoding(lambda why: InputError(f"is not TOML: {why}.", given)):
        table = tomllib.loads(text)
    try:
        return _problem(path.name.removesuffix(".toml"), table, text)
    except (ValueError, TypeError) as error:
        raise InputError(f"{error}.", given) from error


def _problem(name: str, table: Mapping[str, Any], text: str) -> DesignProblem:
    form = table.get("form")
    if form not in _FORMS:
        raise ValueError(
            f'form must be "current" (the gain corrects a prediction by its measurement) or '
            f'"prediction" (it predicts the next state), got {form!r}'
        )
    known = _FORMS[form]
    if missing := [block for block in _NEEDED[form] if block not in table]:
        raise ValueError(f"{missing[0]} is missing; form {form!r} takes {', '.join(known)}")
    if unknown := sorted(set(table) - set(known) - _OTHERS):
        raise ValueError(
            f"there is no {unknown[0]!r}; form {form!r} takes the matrices {', '.join(known)} and "
            f"{', '.join(sorted(_OTHERS))}"
        )
    blocks = {block: table[block] for block in known if block in table}
    made = plant(**blocks) if form == "prediction" else current_form(**blocks)
    units = table.get("units", {})
    if not isinstance(units, Mapping) or not set(units) <= {"z", "n"}:
        raise ValueError('units must be a table with z and n, such as {z = "m", n = "m/s^2"}')
    if not all(isinstance(unit, str) and unit for unit in units.values()):
        raise ValueError("units must be text")
    return DesignProblem(
        name, str(table.get("title", name)), form, made, blocks, _gammas(table.get("gamma")),
        units.get("z", "1"), units.get("n", "1"), text,
    )  # fmt: skip


def _gammas(given: Any) -> list[float] | None:
    if given is None:
        return None
    listed = given if isinstance(given, list) else [given]
    numbers = [g for g in listed if isinstance(g, int | float) and not isinstance(g, bool)]
    if not listed or len(numbers) < len(listed):
        raise ValueError(f"gamma must be a number or a list of numbers, got {given!r}")
    return [float(g) for g in numbers]
