"""Common parts of live objects: refusal of samples, status of answers, the saved file.

A live object takes a sample and answers at once. A malformed sample (wrong shape, text) raises an
error; a faulty one (not finite, absurdly large, out of order) is refused, counted, and answered
from the present state. A lasting jump of the stamps means that the clock was set or paused for
long: the object then starts again.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from copy import deepcopy
from enum import IntFlag
from functools import partial
from typing import Any, ClassVar, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import PyTree

from robins.errors import RobinsError
from robins.filters import Belief, Code, Filter, FilterState, Model, OnlineFilter
from robins.filters.kalman import WRONG
from robins.filters.online import WatchedStep
from robins.filters.run import Step
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

_STILL = 0.01  # largest relative scatter of the specific force at rest


class LiveError(RobinsError, ValueError):
    """An unusable sample or constructor argument; the live object remains usable."""


def online(
    filter_: Filter, model: Model, start: Belief | FilterState, machine: str
) -> OnlineFilter:
    """Online filter of robins, whose initial state is computed without a compiler."""
    if isinstance(start, Belief):
        start = evaluated(partial(filter_.init, dims=model.dims), start)
    return OnlineFilter(filter_, model, start, machine=machine)


class Flag(IntFlag):
    """Status of an answer; several may hold."""

    STARTING = 1  # the first attitude is not known yet: no numbers
    REFUSED = 2  # this sample was not used; `counts` gives the reason
    REST = 4  # the unit lies still
    SATURATED = 8  # a sensor is at the end of its range in this sample
    DISTURBED = 16  # the last magnetometer measurement was refused
    DOUBTFUL = 32  # states or innovations contradict the assumptions
    BEHIND = 64  # the filter waits for later samples; the gyros propagate
    OUTLIER = 128  # the filter refused a measurement of its last step, or of one for this answer


class MeasurementOutcome(NamedTuple):
    """Outcome of a measurement in the filter."""

    code: Code
    nis: float  # normalised innovation squared
    dof: int  # components that were measured


def with_outcomes(step: Step, vector: jax.Array) -> WatchedStep:
    """A vector, then outcomes of the sensors (see `outcomes_of`); the updates count for doubts."""
    last = [info.notes[WRONG] for info in step.info.values() if WRONG in info.notes][-1:]
    seen = [
        jnp.stack([jnp.asarray(x, float) for x in (info.code, info.nis, info.dof)])
        for _, info in sorted(step.info.items())
    ]
    return WatchedStep.of(step, jnp.concatenate([vector, *seen, *last]))


def outcomes_of(
    rest: np.ndarray, sensors: Sequence[str], suspects: Sequence[str]
) -> tuple[dict[str, MeasurementOutcome], dict[str, float]]:
    """Outcome of each sensor, and probability that each suspect of a bank is at fault.

    Args:
        rest: what `with_outcomes` adds to its vector.
        sensors: of the step, sorted.
        suspects: of the filter; those without a probability are left out.
    """
    rows, last = np.split(rest, [3 * len(sensors)])
    seen = {
        name: MeasurementOutcome(Code(int(code)), nis, int(dof))
        for name, (code, nis, dof) in zip(sensors, rows.reshape(-1, 3).tolist(), strict=True)
    }
    return seen, dict(zip(suspects, last.tolist(), strict=False))


def outliers_of(seen: Mapping[str, MeasurementOutcome], wrong: Mapping[str, float]) -> list[str]:
    """Sensors whose measurement a filter refused, or a bank took for faulty, in its last step."""
    return [
        name
        for name, one in seen.items()
        if one.code == Code.REFUSED or (one.dof > 0 and wrong.get(name, 0.0) > 0.5)
    ]


class TimestampGate:
    """Gate that accepts or refuses samples by their stamps and magnitudes."""

    def __init__(self, longest_gap_s: float, patience: int):
        """Create a gate without a stamp.

        Args:
            longest_gap_s: [s]; a stamp further ahead is refused, as one of another clock.
            patience: number of refused stamps in a row, consecutive among themselves, after which
                they are accepted as the new time.
        """
        self._gap_ns, self._patience = round(longest_gap_s * 1e9), patience
        self.last_ns: int | None = None
        self._elsewhere_ns, self._row = 0, 0

    def check(self, time_ns: int, values: np.ndarray) -> str:
        """Reason for refusing a sample: "" if it is accepted, "anew" if it restarts the object.

        Args:
            time_ns: its stamp [ns].
            values: (6,) rates [rad/s] and specific forces [m/s^2].
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
        LiveError: it is not an integer.
    """
    if isinstance(time_ns, bool) or not isinstance(time_ns, int | np.integer):
        what = f"a stamp must be a whole number of nanoseconds, got {time_ns!r}"
        raise LiveError(what, "time_ns", "of seconds give round(1e9 * seconds)")
    if abs(int(time_ns)) >= 2**62:
        what = f"{time_ns} ns is no time: it is beyond 146 years"
        raise LiveError(what, "time_ns", "give nanoseconds since 1970, or since a start")
    return int(time_ns)


def numbers(name: str, values: Any, size: int) -> np.ndarray:
    """The values as floats (size,).

    Raises:
        LiveError: they are not `size` real numbers.
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
    """Refuse samples (K, 3) whose magnitudes indicate another unit, as the doctor of logs does.

    Raises:
        LiveError: rates beyond any gyro in rad/s, or beyond any bias at rest; or a mean specific
            force that is gravity in another unit.
    """
    spin = float(np.max(np.linalg.norm(gyro, axis=1), initial=0.0))
    fix = "if it is in deg/s, give np.radians of it"
    if spin > FASTEST:
        raise LiveError(f"reads up to {spin:.0f}, which is no rate in rad/s", "gyro", fix)
    force = np.mean(accel, axis=0)
    size = float(np.linalg.norm(force))
    # A true specific force may reach the size of gravity in ft/s^2, but not in other units.
    if (unit := force_unit(size)) and unit[0] != "ft/s^2":
        what = f"the mean reads {size:.4g}, which is gravity in {unit[0]}, not in m/s^2"
        raise LiveError(what, "accel", unit[1])
    if float(np.linalg.norm(np.std(accel, axis=0))) < _STILL * size:
        across = rate_across(np.mean(gyro, axis=0), force)
        if across > REST_RATE:
            what = f"reads {across:.2g} across gravity, which stands still: no bias in rad/s"
            raise LiveError(what, "gyro", fix)


def refuse_field_unit(strength: float) -> None:
    """Refuse a typical magnetic field strength beyond the range of any sensor in tesla.

    Raises:
        LiveError: it is beyond `STRONGEST_T`.
    """
    if strength > STRONGEST_T:
        unit, fix = field_unit(strength) or ("another unit", "take it from the data sheet")
        what = f"reads {strength:.4g}, which is no field in tesla, but one in {unit}"
        raise LiveError(what, "field", fix)


Part = Any  # an object with attributes
LiveT = TypeVar("LiveT", bound="Live")


class Live:
    """Base of the live objects: counts, and a file that keeps their whole state.

    Attributes:
        counts: numbers of refused samples by reason, and of other events.
    """

    _parameters: ClassVar[type[Any]]  # class of the constructor's parameters
    _kept: ClassVar[tuple[str, ...]]  # names of attributes that change, plain values or arrays
    _parts: ClassVar[tuple[str, ...]]  # names of objects with such attributes
    _assumed: ClassVar[Collection[str]] = ()  # sensors whose noise is a guess, as in a replay
    _on: Callable[[Belief | FilterState], OnlineFilter]  # the filter from an initial state
    _compiled_state: PyTree = None  # a filter state, for its structure and shapes
    _online: OnlineFilter | None = None  # set at the start
    _declares_gaps: ClassVar[bool] = False  # counts a gap that is too long under another name

    def __init__(self, parameters: Parameters, gap_s: float, patience: int, **made_with: Any):
        """Store the constructor's arguments, for the file, and those of the `TimestampGate`."""
        self.parameters: Any = parameters
        self.counts: Counter[str] = Counter()
        self._made_with, self._gate_settings = made_with, (gap_s, patience)

    def start_over(self) -> None:
        """Reset the object: discard samples, measurements, state and counts."""
        self._gate = TimestampGate(*self._gate_settings)
        self.counts.clear()
        self._restart()

    def _restart(self) -> None:
        """Reset all but the counts and the stamps."""
        raise NotImplementedError

    def _accepts(self, kind: str, time_ns: int, values: np.ndarray) -> bool:
        """Count a refused sample; start again after a long gap, or where the clock was set."""
        last_ns = self._gate.last_ns
        why = self._gate.check(time_ns, values)
        if why == "anew":
            is_gap = self._declares_gaps and last_ns is not None and time_ns > last_ns
            self.counts["imu_gaps_declared" if is_gap else "begun_anew"] += 1
            self._restart()
        elif why:
            self.counts[f"{kind}_{why}"] += 1
        return why in ("", "anew")

    def doubts(self) -> list[str]:
        """Sentences on reasons to doubt the last 400 updates of each sensor, as in a replay.

        The window begins again with a new start, and in an object that was loaded.
        """
        return [] if self._online is None else self._online.doubts(assumed=self._assumed)

    def _known_states(self) -> list[PyTree]:
        """States of the filter, the present one last; empty before the start."""
        return [] if self._online is None else [self._online.state]

    def _resume_from(self, states: list[PyTree]) -> None:
        """Set the states of the filter, as given by `_known_states`."""
        self._online = self._on(states[-1])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the whole state into one file, atomically.

        Raises:
            ResultError: it cannot be written; the message gives the reason.
        """
        snapshot.write(path, type(self).__name__, *self._saved_state())

    @classmethod
    def load(cls: type[LiveT], path: str | os.PathLike[str]) -> LiveT:
        """Load an object written by `save`; it continues bit for bit.

        Raises:
            ResultError: the file cannot be read, is damaged, or of another version or class.
        """
        found = snapshot.read(path, cls.__name__)
        try:
            return _rebuilt(cls, found.parameters, found.state)
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
            what = f"it does not hold what a {cls.__name__} of this robins keeps ({error})"
            fix = "use the robins that wrote it, or start without it"
            raise ResultError(path, what, fix) from error

    def __reduce__(self) -> tuple:
        """Pickle the saved state; compiled code is compiled again on loading."""
        return _rebuilt, (type(self), *self._saved_state())

    def __copy__(self: LiveT) -> LiveT:
        """Deep copy, independent of the original."""
        return deepcopy(self)

    def _saved_state(self) -> tuple[str, dict[str, Any]]:
        """Parameters as TOML, and the rest of the state."""
        leaves = [np.asarray(x) for x in jax.tree_util.tree_leaves(self._known_states())]
        state = {
            "made_with": self._made_with,
            "counts": dict(self.counts),
            "own": {name: getattr(self, name) for name in self._kept},
            "parts": {name: _state_of(getattr(self, name)) for name in self._parts},
            "filter": leaves or None,
        }
        return text_of(self.parameters.model_dump(exclude_none=True)), state


def _rebuilt(cls: type[LiveT], parameters: str, state: Mapping[str, Any]) -> LiveT:
    """Rebuild an object from its parameters (TOML) and state, as of `_saved_state`."""
    given = cls._parameters.model_validate(mapping_of(parameters), strict=False)
    made = cls(given, **state["made_with"])
    _compare(cls.__name__, cls._kept, state["own"])
    _compare(cls.__name__, cls._parts, state["parts"])
    made.counts.update(state["counts"])
    for name, value in state["own"].items():
        setattr(made, name, value)
    for name, part in state["parts"].items():
        _restore(getattr(made, name), part)
    if (leaves := state["filter"]) is not None:
        each = len(jax.tree_util.tree_leaves(made._compiled_state))
        pieces = [leaves[k : k + each] for k in range(0, len(leaves), each)]
        made._resume_from([restored(made._compiled_state, piece) for piece in pieces])
    return made


def _state_of(part: Part) -> dict[str, Any]:
    """Attributes of an object and of its parts, without parameters and counts."""
    return {
        name: _state_of(value) if _is_part(value) else value
        for name, value in vars(part).items()
        if not isinstance(value, Parameters | Counter)
    }


def _compare(what: str, own: Iterable[str], known: Iterable[str]) -> None:
    """Refuse a state with other attributes, as written by another version of robins."""
    if differ := sorted({*own} ^ {*known}):
        raise ValueError(f"{what} differs in {', '.join(differ)}")


def _restore(part: Part, known: Mapping[str, Any]) -> None:
    """Set the attributes found by `_state_of`."""
    _compare(type(part).__name__, _state_of(part), known)
    for name, value in known.items():
        if _is_part(getattr(part, name)):
            _restore(getattr(part, name), value)
        else:
            setattr(part, name, value)


def _is_part(value: Part) -> bool:
    return type(value).__module__.startswith("robins.") and hasattr(value, "__dict__")


def restored(like: PyTree, leaves: Sequence[ArrayLike]) -> PyTree:
    """A state with the structure of `like` and these leaves.

    Raises:
        ValueError: the shapes of the leaves differ from those of `like`.
    """
    own, structure = jax.tree_util.tree_flatten(like)
    if [np.shape(x) for x in own] != [np.shape(x) for x in leaves]:
        raise ValueError("the filter's state has other components")
    return jax.tree_util.tree_unflatten(structure, list(map(jnp.asarray, leaves)))
