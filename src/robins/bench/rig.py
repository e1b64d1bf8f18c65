"""A vehicle on the bench, as data: its parts, messages and wiring, its faults, its page.

A rig needs a wire, parts, who sends what, and how a run of it is prepared; all else has a default
that follows from its messages.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

from robins.bench.parts.station import Part
from robins.bench.wire.schema import Wire
from robins.errors import RobinsError

if TYPE_CHECKING:
    import numpy as np

    from robins.bench.broker.faults import LinkFault, Said, Table
    from robins.bench.broker.says import Desk, Saying
    from robins.bench.live.feed import Signal
    from robins.bench.recording.topics import Topic
    from robins.bench.run.session import Ran
    from robins.bench.run.setup import Flight, Setup
    from robins.bench.run.telemetry import Flown
    from robins.scenario import Parameters


class RigError(RobinsError, ValueError):
    """A rig that contradicts itself."""


def named(where: str) -> Any:
    """Object with a name in a module: "package.module:name".

    So processes of parts import what they need alone, and start sooner.
    """
    module, _, name = where.partition(":")
    return getattr(importlib.import_module(module), name)


def later(where: str) -> Callable[..., Any]:
    """A function that is imported when it is called; as of `named`."""
    return lambda *args: named(where)(*args)


def packaged(file: str) -> Callable[[], dict[str, Path]]:
    """The scenarios of the bench in the folder next to a file, by name."""
    found = sorted((Path(file).parent / "scenarios").glob("*.toml"))
    return lambda: {path.stem: path for path in found}


@runtime_checkable
class Kit(Protocol):
    """Input of the parts of a run, pickled so that processes can have a copy."""

    @property
    def step_ns(self) -> int:
        """Length of a step."""
        ...

    @property
    def frames(self) -> Iterable[int]:
        """A step of each kind that parts compute otherwise, to be compiled before the first."""
        ...


class Timing(NamedTuple):
    """Steps of a run, by the parameters of a rig."""

    step_s: float
    steps: int
    counted_from: int  # first step that counts in figures of merit


def timing(given: Any) -> Timing:
    """Steps by parameters with ``duration``, ``step`` and perhaps ``counted_from``, in seconds."""
    steps = round(given.duration / given.step)
    return Timing(given.step, steps, round(getattr(given, "counted_from", 0.0) / given.step))


class Judged(NamedTuple):
    """Evaluation of a run by its rig.

    Attributes:
        metrics: figures of merit by name, which ends in the unit.
        counts: of what was odd.
        warnings: why a reader should doubt the figures.
        arrays: of the solution, as `robins.results.array` makes them.
        lines: figures for a terminal.
    """

    metrics: Mapping[str, float | None] = MappingProxyType({})
    counts: Mapping[str, int] = MappingProxyType({})
    warnings: Sequence[str] = ()
    arrays: Mapping[str, Any] = MappingProxyType({})
    lines: Sequence[str] = ()


class Told(NamedTuple):
    """A notice for the user; levels are those of the page."""

    level: Any
    text: str


@runtime_checkable
class Alarms(Protocol):
    """Listens to one step after another."""

    def hear(self, flown: Flown, step: int) -> list[Told]:
        """Notices of a step."""
        ...


Offer = dict[str, Any]
"""A fault on the page: its ``label``, and the ``fault`` as a scenario gives it, without a time."""


class View(NamedTuple):
    """Contents of the page of a rig.

    Attributes:
        signals: plotted signals, by the parameters of the vehicle.
        sample: (arrays, kit, first step since the last sample, step) -> their values.
        alarms: a listener for a run.
        counts: (arrays, steps done) -> what was counted, by name.
        offered: faults that can be injected, each with its label; left out: those of every line,
            and those of sensors and actuators that need no parameter.
        says: operator messages, by label: (arrays, kit, last step that was done) -> the
            message and its values.
    """

    signals: Callable[[Any], list[Signal]]
    sample: Callable[[Flown, Any, int, int], Sequence[float]]
    alarms: Callable[[], Alarms | None] = lambda: None
    counts: Callable[[Flown, int], dict[str, int]] = lambda flown, done: {}
    offered: tuple[Offer, ...] = ()
    says: Mapping[str, Callable[[Flown, Any, int], tuple[str, Mapping[str, Any]]]] = (
        MappingProxyType({})
    )


class Aboard(NamedTuple):
    """Sources of a program that replaces the exported part.

    Attributes:
        problem: a `robins.systems.study.Problem` of one contender, whose filter is exported.
        library: name of the C of the filter, by which its loop calls it.
        files: of the loop, by name, in addition to those of the wire.
    """

    problem: Any
    library: str
    files: Mapping[str, str]


class Spoken(NamedTuple):
    """A message that the operator sent through the bench."""

    step: int  # the first whose parts received it
    message: str
    values: Mapping[str, Any]


@dataclass(frozen=True)
class Rig:
    """A vehicle on the bench.

    Attributes:
        name: of it.
        wire: its parts and messages.
        build: how a part is made of a kit, by part.
        sends: messages by part, each of one part alone.
        takes: messages by part.
        console: messages that no part sends: the operator sends them through the bench, and parts
            take them, if they do, with a lag of one.
        refuses: (message, values) -> why the operator cannot send this, though each number is
            within its limits; "": it can be sent.
        parameters: () -> the class of what flies.
        prepare: (setup, parameters) -> the kit of a run; the same for the same.
        truth: the message without which nothing can be judged; "": there is none.
        kept: messages that are noted for figures and page; left out: all.
        timing: of the parameters.
        flies: scenarios of its system, by name; the first is flown where none is named.
        filters: that its parameters can be flown with; the first where none is named.
        scenarios: of the bench, by name.
        options: parameters of a run besides those of all rigs, each with type and default.
        said: faults of its sensors and actuators, by kind, and their parameters.
        view: of the page; left out: all numbers of its messages.
        topics: (kit) -> what viewers and ROS 2 get of its messages, in the record; JSON of those
            that it leaves out.
        inside: (kit, steps) -> arrays of so many first steps of the same run inside one program,
            named as `Flown` names them. With a console: (kit, steps, messages sent) -> the same, or
            None where it cannot be compared.
        judge: figures of merit of a run; left out: none, and all numbers in its arrays.
        once: (setup, part) -> why the input of the part cannot be sent to it again, from a record
            or after its death; "": it can.
        example: the part with which commands are shown; left out: its last.
        exported: the part that an exported filter can be, by the loop of that name among the files
            of `robins.bench.wire.c_header.firmware` or of `aboard`; "": none.
        aboard: (flight) -> its filter and its loop, where these depend on the run; left out: the
            filter of the scenario.
        address: by which processes find it; left out: its name.
    """

    name: str
    wire: Wire
    build: Mapping[str, Callable[[Any], Part]]
    sends: Mapping[str, tuple[str, ...]]
    takes: Mapping[str, tuple[str, ...]]
    parameters: Callable[[], type[Parameters]]
    prepare: Callable[[Any, Any], Kit]
    console: tuple[str, ...] = ()
    refuses: Callable[[str, Mapping[str, Any]], str] = lambda message, values: ""
    truth: str = ""
    kept: tuple[str, ...] = ()
    timing: Callable[[Any], Timing] = timing
    flies: Callable[[], Mapping[str, Path]] = dict
    filters: Callable[[], Sequence[str]] = lambda: ("",)
    scenarios: Callable[[], Mapping[str, Path]] = dict
    options: Callable[[], Mapping[str, Any]] = dict
    said: Callable[[], tuple[Mapping[str, Said], Mapping[str, Any]]] = lambda: ({}, {})
    view: Callable[[], View] | None = None
    topics: Callable[[Any], Sequence[Topic]] = lambda kit: ()
    inside: Callable[..., Mapping[str, np.ndarray] | None] | None = None
    judge: Callable[[Flight, Ran], Judged] | None = None
    once: Callable[[Any, str], str] = lambda setup, part: ""
    example: str = ""
    exported: str = ""
    aboard: Callable[[Flight], Aboard] | None = None
    address: str = ""

    def __post_init__(self) -> None:
        """Check that its tables agree.

        Raises:
            RigError: they do not; names the contradiction.
        """
        parts = self.parts
        for what, table in (("build", self.build), ("sends", self.sends), ("takes", self.takes)):
            if set(table) != set(parts):
                raise RigError(f"{what} is of {', '.join(table)}, the wire has {', '.join(parts)}")
        if not self.example:
            object.__setattr__(self, "example", parts[-1])
        named = {m.name for m in self.wire.data}
        said = [name for sent in (*self.sends.values(), self.console) for name in sent]
        if sorted(said) != sorted(named):
            console = " or said by the bench" if self.console else ""
            raise RigError(
                f"each message is sent by one part{console}: {sorted(said)} of {sorted(named)}"
            )
        if unheard := sorted(set(self.console) - {m for t in self.takes.values() for m in t}):
            raise RigError(f"the bench says '{unheard[0]}', but no part takes it")
        heard = {name for taken in self.takes.values() for name in taken} | {*self.kept}
        if unknown := sorted((heard | ({self.truth} - {""})) - named):
            raise RigError(f"there is no message '{unknown[0]}', only {', '.join(sorted(named))}")

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of its parts, without the bench."""
        return self.wire.parts[1:]

    @cached_property
    def table(self) -> Table:
        """Faults that it can have."""
        from robins.bench.broker.faults import Table

        return Table(self.wire, self.sends, self.takes, self.said()[0])

    @cached_property
    def fault(self) -> type[LinkFault]:
        """The parameters of a fault."""
        from robins.bench.broker.faults import faults_of

        return faults_of(self.table, **self.said()[1])

    @cached_property
    def desk(self) -> Desk:
        """Operator messages that it takes."""
        from robins.bench.broker.says import Desk

        return Desk(self.wire, self.console, self.refuses)

    @cached_property
    def saying(self) -> type[Saying]:
        """Parameters of an operator message."""
        from robins.bench.broker.says import sayings_of

        return sayings_of(self.desk)

    @cached_property
    def setup(self) -> type[Setup]:
        """The parameters of a run."""
        from robins.bench.run.setup import setup_of

        return setup_of(self)

    @cached_property
    def shown(self) -> View:
        """Contents of its page."""
        from robins.bench.run.numbers import faults_of, view_of

        view = self.view() if self.view is not None else view_of(self)
        return view if view.offered else view._replace(offered=faults_of(self))
