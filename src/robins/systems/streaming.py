"""Common parts of live objects: refusal of samples, status of answers, the saved file.

A live object takes a sample and answers at once. A sample that is no sample (another shape, text)
raises; one that is wrong as a sensor can be (no number, absurd, out of order) is refused, counted,
and answered from what is known. Stamps that stay elsewhere are a clock that was set, or a long
pause: the object then starts again.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import deepcopy
from enum import IntFlag
from functools import partial
from typing import Any, ClassVar, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import PyTree

from robins.errors import RobinsError
from robins.filters import Belief, Filter, FilterState, Model, OnlineFilter
from robins.ins.plausible import (
    ACCEL_LIMIT,
    FASTEST,
    GYRO_LIMIT,
    REST_RATE,
    STRONGEST_T,
    field_unit,
    force_unit,
    rate_across,
)
from robins.program.evaluated import evaluated
from robins.results import ResultError, snapshot
from robins.scenario import Parameters
from robins.scenario.text import mapping_of, text_of

_STILL = 0.01  # of the specific force: how little it may scatter at rest


class LiveError(RobinsError, ValueError):
    """A sample, or what a live object is made with, cannot be used; the object goes on."""


def online(
    filter_: Filter, model: Model, start: Belief | FilterState, machine: str
) -> OnlineFilter:
    """Online filter of robins' own, the state at its start computed without a compiler."""
    if isinstance(start, Belief):
        start = evaluated(partial(filter_.init, dims=model.dims), start)
    return OnlineFilter(filter_, model, start, machine=machine)


class Flag(IntFlag):
    """Status of an answer; several may hold."""

    STARTING = 1  # the first attitude is not known yet: no numbers
    REFUSED = 2  # this sample was not used, `counts` has the reason
    REST = 4  # the unit lies still
    SATURATED = 8  # a sensor is at the end of its range in this sample
    DISTURBED = 16  # the last look at the magnetometer was refused
    DOUBTFUL = 32  # states or innovations contradict what was assumed
    BEHIND = 64  # the filter waits for later samples; the gyros carry on
    OUTLIER = 128  # the filter refused a measurement of its last step, or of one for this answer


class TimestampGate:
    """Gate of samples, by their stamps and sizes."""

    def __init__(self, longest_gap_s: float, patience: int):
        """Begin.

        Args:
            longest_gap_s: s; a stamp further ahead is of another clock, or of a new beginning.
            patience: stamps in a row that continue each other elsewhere until they are believed.
        """
        self._gap_ns, self._patience = round(longest_gap_s * 1e9), patience
        self.last_ns: int | None = None
        self._elsewhere_ns, self._row = 0, 0

    def check(self, time_ns: int, values: np.ndarray) -> str:
        """Reason why a sample is refused; "" for one that is taken, "anew" for one that starts
        again.

        Args:
            time_ns: its stamp.
            values: (6,) rates and specific forces.
        """
        if not np.all(np.isfinite(values)):
            return "nan" if np.any(np.isnan(values)) else "inf"
        if np.max(np.abs(values[:3])) > GYRO_LIMIT or np.max(np.abs(values[3:])) > ACCEL_LIMIT:
            return "absurd"
        ahead = 1 if self.last_ns is None else time_ns - self.last_ns
        if 0 < ahead <= self._gap_ns:
            self.last_ns, self._row = time_ns, 0
            return ""
        goes_on = self._row > 0 and 0 < time_ns - self._elsewhere_ns <= self._gap_ns
        self._row = self._row + 1 if goes_on else 1
        self._elsewhere_ns = time_ns
        if self._row >= self._patience:
            self.last_ns, self._row = time_ns, 0
            return "anew"
        return "duplicate" if ahead == 0 else "backward" if ahead < 0 else "ahead"


def stamp(time_ns: Any) -> int:
    """A stamp in whole nanoseconds.

    Raises:
        LiveError: it is no whole number.
    """
    if isinstance(time_ns, bool) or not isinstance(time_ns, int | np.integer):
        what = f"a stamp must be a whole number of nanoseconds, got {time_ns!r}"
        raise LiveError(what, "time_ns", "of seconds give round(1e9 * seconds)")
    return int(time_ns)


def numbers(name: str, values: Any, size: int) -> np.ndarray:
    """(size,) floats.

    Raises:
        LiveError: it is something else.
    """
    try:
        found = np.asarray(values)
        if found.dtype.kind not in "fiu" or found.shape != (size,):
            raise TypeError
    except (TypeError, ValueError):
        what = f"must be {size} real numbers, got {values!r:.80}"
        raise LiveError(what, name, "NaN means that a number is missing") from None
    return found.astype(float)


def refuse_units(gyro: np.ndarray, accel: np.ndarray) -> None:
    """Refuse samples (K, 3) whose sizes are those of another unit, as the doctor of logs would.

    Raises:
        LiveError: rates that no gyro reads, also where the specific force stands still; or a mean
            specific force that is gravity in another unit.
    """
    spin = float(np.max(np.linalg.norm(gyro, axis=1), initial=0.0))
    fix = "if it is in deg/s, give np.radians of it"
    if spin > FASTEST:
        raise LiveError(f"reads up to {spin:.0f}, which is no rate in rad/s", "gyro", fix)
    force = np.mean(accel, axis=0)
    size = float(np.linalg.norm(force))
    # An acceleration may have the size of gravity in ft/s^2; of all other units it is far off.
    if (unit := force_unit(size)) and unit[0] != "ft/s^2":
        what = f"the mean reads {size:.4g}, which is gravity in {unit[0]}, not in m/s^2"
        raise LiveError(what, "accel", unit[1])
    if float(np.linalg.norm(np.std(accel, axis=0))) < _STILL * size:
        across = rate_across(np.mean(gyro, axis=0), force)
        if across > REST_RATE:
            what = f"reads {across:.2g} across gravity, which stands still: no bias in rad/s"
            raise LiveError(what, "gyro", fix)


def refuse_field_unit(strength: float) -> None:
    """Refuse a magnetic field whose usual strength is beyond that of any sensor in tesla.

    Raises:
        LiveError: it is.
    """
    if strength > STRONGEST_T:
        unit, fix = field_unit(strength) or ("another unit", "take it from the data sheet")
        what = f"reads {strength:.4g}, which is no field in tesla, but one in {unit}"
        raise LiveError(what, "field", fix)


Part = Any  # an object with attributes
LiveT = TypeVar("LiveT", bound="Live")


class Live:
    """Base of the live objects: counts, and a file that keeps all they know.

    Attributes:
        counts: samples refused by reason, and what else happened, so often.
    """

    _parameters: ClassVar[type[Any]]  # those it is made with
    _kept: ClassVar[tuple[str, ...]]  # names of attributes that change, plain values or arrays
    _parts: ClassVar[tuple[str, ...]]  # names of objects whose attributes are such
    _on: Callable[[Belief | FilterState], OnlineFilter]  # the filter, from a start on
    _compiled_state: PyTree = None  # some state of the filter
    _online: OnlineFilter | None = None  # from the start on

    def __init__(self, parameters: Parameters, **made_with: Any):
        """Remember what it is made with, for the file."""
        self.parameters: Any = parameters
        self.counts: Counter[str] = Counter()
        self._made_with = made_with

    def _known_states(self) -> list[PyTree]:
        """States of the filter, the present one last; none before there is one."""
        return [] if self._online is None else [self._online.state]

    def _go_on_from(self, states: list[PyTree]) -> None:
        """Take states of the filter, as of `_known_states`."""
        self._online = self._on(states[-1])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all that is known into one file, whole or not at all.

        Raises:
            ResultError: it cannot be written; the message gives the reason.
        """
        snapshot.write(path, type(self).__name__, *self._all_known())

    @classmethod
    def load(cls: type[LiveT], path: str | os.PathLike[str]) -> LiveT:
        """The object that `save` wrote; it goes on bit for bit.

        Raises:
            ResultError: the file cannot be read, is damaged, or of another version or class.
        """
        found = snapshot.read(path, cls.__name__)
        try:
            return _made_again(cls, found.parameters, found.state)
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
            what = f"it does not hold what a {cls.__name__} of this robins keeps ({error})"
            fix = "use the robins that wrote it, or start without it"
            raise ResultError(path, what, fix) from error

    def __reduce__(self) -> tuple:
        """Pickle as it is saved: compiled code is compiled again."""
        return _made_again, (type(self), *self._all_known())

    def __copy__(self: LiveT) -> LiveT:
        """An object of its own: neither hears the samples of the other."""
        return deepcopy(self)

    def _all_known(self) -> tuple[str, dict[str, Any]]:
        """Parameters as TOML, and all else."""
        leaves = [np.asarray(x) for x in jax.tree_util.tree_leaves(self._known_states())]
        state = {
            "made_with": self._made_with,
            "counts": dict(self.counts),
            "own": {name: getattr(self, name) for name in self._kept},
            "parts": {name: _state_of(getattr(self, name)) for name in self._parts},
            "filter": leaves or None,
        }
        return text_of(self.parameters.model_dump(exclude_none=True)), state


def _made_again(cls: type[LiveT], parameters: str, state: Mapping[str, Any]) -> LiveT:
    """The object of which this is known."""
    given = cls._parameters.model_validate(mapping_of(parameters), strict=False)
    made = cls(given, **state["made_with"])
    _compare(cls.__name__, cls._kept, state["own"])
    _compare(cls.__name__, cls._parts, state["parts"])
    made.counts.update(state["counts"])
    for name, value in state["own"].items():
        setattr(made, name, value)
    for name, part in state["parts"].items():
        _go_on(getattr(made, name), part)
    if (leaves := state["filter"]) is not None:
        each = len(jax.tree_util.tree_leaves(made._compiled_state))
        pieces = [leaves[k : k + each] for k in range(0, len(leaves), each)]
        made._go_on_from([restored(made._compiled_state, piece) for piece in pieces])
    return made


def _state_of(part: Part) -> dict[str, Any]:
    """Attributes of an object and of its parts, but for parameters and counts."""
    return {
        name: _state_of(value) if _is_part(value) else value
        for name, value in vars(part).items()
        if not isinstance(value, Parameters | Counter)
    }


def _compare(what: str, own: Iterable[str], known: Iterable[str]) -> None:
    """Refuse a state with other attributes, which another robins wrote."""
    if differ := sorted({*own} ^ {*known}):
        raise ValueError(f"{what} differs in {', '.join(differ)}")


def _go_on(part: Part, known: Mapping[str, Any]) -> None:
    """Set what `_state_of` found."""
    _compare(type(part).__name__, _state_of(part), known)
    for name, value in known.items():
        if _is_part(getattr(part, name)):
            _go_on(getattr(part, name), value)
        else:
            setattr(part, name, value)


def _is_part(value: Part) -> bool:
    return type(value).__module__.startswith("robins.") and hasattr(value, "__dict__")


def restored(like: PyTree, leaves: Sequence[ArrayLike]) -> PyTree:
    """A state of the structure of another, with these leaves.

    Raises:
        ValueError: the leaves of the other have other shapes.
    """
    own, structure = jax.tree_util.tree_flatten(like)
    if [np.shape(x) for x in own] != [np.shape(x) for x in leaves]:
        raise ValueError("the filter's state has other components")
    return jax.tree_util.tree_unflatten(structure, list(map(jnp.asarray, leaves)))
