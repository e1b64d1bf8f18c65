"""What the page draws: signals, gathered in plots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, get_args

Role = Literal["value", "sigma", "limit"]


class Signal(NamedTuple):
    """A number of each sample, and how it is drawn.

    Signals of one plot share `plot`, its title, and their unit. Values of a plot get the colours
    of x, y, z and a fourth in the order in which they come.
    """

    name: str
    unit: str
    plot: str
    role: Role = "value"  # "sigma": a band of +-3 about zero; "limit": a dashed line
    of: str = ""  # for "sigma": the value whose deviation from zero it states


def check(signals: Sequence[Signal]) -> None:
    """Raise if signals cannot be drawn.

    Raises:
        ValueError: there are none, two of one name, a plot of two units, an unknown role, a sigma
            of something that is no value of the same plot, or an `of` where there is no sigma.
    """
    if not signals:
        raise ValueError("a live page needs at least one signal")
    by_name: dict[str, Signal] = {}
    units: dict[str, str] = {}
    for s in signals:
        if s.name in by_name:
            raise ValueError(f"two signals are named '{s.name}'; names tell them apart")
        if s.role not in get_args(Role):
            roles = ", ".join(get_args(Role))
            raise ValueError(f"signal '{s.name}': role '{s.role}' is none of {roles}")
        if units.setdefault(s.plot, s.unit) != s.unit:
            raise ValueError(
                f"signal '{s.name}' is in {s.unit}, but plot '{s.plot}' is in {units[s.plot]}; "
                "give it a plot of its own or another unit"
            )
        by_name[s.name] = s
    for s in signals:
        if s.role != "sigma":
            if s.of:
                raise ValueError(f"signal '{s.name}' is a {s.role}; only a sigma is `of` another")
            continue
        of = by_name.get(s.of)
        if of is None or of.role != "value" or of.plot != s.plot:
            raise ValueError(f"sigma '{s.name}' is of '{s.of}', which is no value of its plot")


def as_json(signals: Sequence[Signal]) -> list[dict[str, Any]]:
    """Signals as the page gets them."""
    return [s._asdict() for s in signals]
