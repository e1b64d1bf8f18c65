"""A vehicle on the bench: its parts, messages and wiring, its faults, its page.

A rig is a class of a few tables and one function: its messages, their senders and receivers, its
parameters, and the preparation of a run. All else has a default that follows from its messages.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Generic,
    NamedTuple,
    Protocol,
    TypeVar,
    cast,
    runtime_checkable,
)

from robins.bench.parts.station import Part
from robins.bench.wire.fields import Message, Values
from robins.bench.wire.schema import Wire
from robins.errors import RobinsError, hint, moved

if TYPE_CHECKING:
    import numpy as np

    from robins.bench.broker.console import Console, OperatorMessage
    from robins.bench.broker.faults import DeviceFaults, FaultTable, LinkFault, ParameterTable
    from robins.bench.evaluation import PageView, RunFigures, RunResult
    from robins.bench.recording.topics import Topic


__getattr__ = moved(__name__)


class RigError(RobinsError, ValueError):
    """Inconsistent definition of a rig."""


def named(where: str) -> Any:
    """Import an object by its place, "package.module:name".

    Raises:
        RigError: the module has no such name.
    """
    module, _, name = where.partition(":")
    try:
        return getattr(importlib.import_module(module), name)
    except AttributeError:
        raise RigError(f"there is no '{name}' in the module {module}") from None


def later(where: str) -> Any:
    """Method of a rig that is a function of another module, imported when it is called.

    So the process of a part imports only what it needs, and starts sooner. The function does not
    take the rig.
    """
    return staticmethod(lambda *args: named(where)(*args))


@runtime_checkable
class RunConfig(Protocol):
    """Input of the parts of a run, pickled so that processes can have a copy."""

    @property
    def step_ns(self) -> int:
        """Length of a step."""
        ...

    @property
    def frames(self) -> Iterable[int]:
        """Numbers of the steps to compile before the run: one for each path through the code."""
        ...


class Timing(NamedTuple):
    """Steps of a run, by the parameters of a rig."""

    step_s: float
    steps: int
    counted_from: int  # first step that counts in figures of merit


class ExportSources(NamedTuple):
    """Sources of a program that replaces the exported part.

    Attributes:
        problem: a `robins.systems.study.Problem` of one contender, whose filter is exported.
        library: name of the C of the filter, by which its loop calls it.
        files: of the loop, by name, in addition to those of the wire.
    """

    problem: Any
    library: str
    files: Mapping[str, str]


GivenT = TypeVar("GivenT")  # parameters of what flies
KitT = TypeVar("KitT", bound=RunConfig)
_NEEDED = ("name", "wire", "sends", "takes", "parameters")


class Rig(Generic[GivenT, KitT]):
    """A vehicle on the bench.

    Subclasses give the first five attributes and `prepare`; the others have defaults. Parts are
    named as data, so that a process imports the code of its own part alone.

    Attributes:
        name: of the rig.
        wire: its parts and messages.
        sends: messages sent, by part; each message has one sender.
        takes: messages received, by part.
        parameters: the parameter class of the vehicle, or its place, "package.module:Name".
        code: module with a function of the name of each part, which makes the part from a config;
            default: the module of the class.
        build: by part, another function that makes it, or its place, "package.module:name".
        console: messages that no part sends: the operator sends them through the bench, and parts
            that take them do so with a lag of one step.
        truth: the message without which a run cannot be evaluated; "": there is none.
        kept: messages recorded for figures and page; default: all.
        example: the part that example commands name; default: its last.
        exported: the part that an exported filter can replace, by the loop of that name among the
            files of `robins.bench.wire.c_header.firmware` or of `aboard`; "": none.
        aboard: (flight) -> its filter and its loop, where these depend on the run; default: the
            filter of the scenario.
        address: by which processes find it; default: its name.
    """

    name: str
    wire: Wire
    sends: ClassVar[Mapping[str, tuple[str, ...]]]
    takes: ClassVar[Mapping[str, tuple[str, ...]]]
    parameters: type[GivenT] | str | Callable[[], type[GivenT]]
    code: str = ""
    build: ClassVar[Mapping[str, Callable[[Any], Part] | str]] = {}
    console: tuple[str, ...] = ()
    truth: str = ""
    kept: tuple[str, ...] = ()
    example: str = ""
    exported: str = ""
    aboard: Callable[[LoadedRun], ExportSources] | None = None
    address: str = ""

    def __init__(self, **changed: Any):
        """Check that the tables agree.

        Args:
            changed: attributes and functions that replace those of the class.

        Raises:
            RigError: the tables contradict each other.
        """
        known = [name for name in (*Rig.__annotations__, *vars(Rig)) if not name.startswith("_")]
        if strange := sorted(set(changed) - set(known)):
            raise RigError(f"a rig has no '{strange[0]}'{hint(strange[0], known)}")
        self._changed = changed
        vars(self).update(changed)
        missing = [name for name in _NEEDED if not hasattr(self, name)]
        if getattr(self.prepare, "__func__", None) is Rig.prepare:
            missing.append("prepare")
        if missing:
            what = f"the rig {type(self).__name__} has no {' and no '.join(missing)}"
            raise RigError(what, fix="define it in the subclass of robins.bench.Rig")
        self._check()
        self.example = self.example or self.parts[-1]

    def _check(self) -> None:
        parts = self.parts
        if strange := sorted(set(self.build) - set(parts)):
            raise RigError(f"build is of {', '.join(strange)}, the wire has {', '.join(parts)}")
        home = sys.modules.get(type(self).__module__)
        lost = [part for part in parts if not (part in self.build or hasattr(home, part))]
        if lost and not self.code:
            what = f"no function makes the part '{lost[0]}'"
            raise RigError(what, type(self).__module__, "define one of its name before the rig")
        for what, table in (("sends", self.sends), ("takes", self.takes)):
            if set(table) != set(parts):
                raise RigError(f"{what} is of {', '.join(table)}, the wire has {', '.join(parts)}")
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

    def varied(self, **changed: Any) -> Rig[GivenT, KitT]:
        """Copy of the rig with other attributes or functions.

        Raises:
            RigError: they contradict the others.
        """
        return type(self)(**{**self._changed, **changed})

    # ------------------------------------------------------------------------ of a run: defaults

    def prepare(self, setup: Any, given: GivenT) -> KitT:
        """Config of a run: plain numbers, the same for the same setup and parameters."""
        raise NotImplementedError

    def timing(self, given: Any) -> Timing:
        """Steps of a run, by the parameters ``duration``, ``step``, ``counted_from`` (or 0) [s]."""
        steps = round(given.duration / given.step)
        return Timing(given.step, steps, round(getattr(given, "counted_from", 0.0) / given.step))

    def once(self, setup: Any, part: str) -> str:
        """Reason why the input of a part cannot be sent to it again, from a record or after its
        death; "": it can.
        """
        return ""

    def refuses(self, message: str, values: Values) -> str:
        """Reason to refuse an operator message although each number is within its limits;
        "": it can be sent.
        """
        return ""

    def inside(self, config: KitT, steps: int) -> Mapping[str, np.ndarray] | None:
        """First steps of the same run inside one program, fields named as in `MessageSeries`.

        For a rig with a console it also takes the messages sent. None: no such comparison exists.
        """
        return None

    def judge(self, flight: LoadedRun, result: RunResult) -> RunFigures:
        """Figures of merit of a run; by default none, and all numbers as arrays."""
        from robins.bench.evaluation import RunFigures, arrays_of

        return RunFigures(arrays=arrays_of(self.noted, result.series))

    def view(self) -> PageView:
        """Contents of its page; by default all numbers of its messages."""
        from robins.bench.evaluation import view_of

        return view_of(self.noted)

    def topics(self, config: KitT) -> Sequence[Topic]:
        """Conversions of its messages for viewers and ROS 2, in the record; others become JSON."""
        return ()

    # ------------------------------------------------------------------ of what there is: defaults

    def flies(self) -> Mapping[str, Path]:
        """Scenarios of its system, by name; the first is the default."""
        return {}

    def filters(self) -> Sequence[str]:
        """Filters that can be run with its parameters; the first is the default."""
        return ("",)

    def scenarios(self) -> Mapping[str, Path]:
        """Scenarios of the bench, by name: those in the folder next to the file of its class."""
        file = getattr(sys.modules[type(self).__module__], "__file__", None)
        found = sorted((Path(file).parent / "scenarios").glob("*.toml")) if file else []
        return {path.stem: path for path in found}

    def options(self) -> ParameterTable:
        """Parameters of a run besides those of all rigs, each with type and default."""
        return {}

    def device_faults(self) -> DeviceFaults:
        """Faults of its sensors and actuators, by kind, and their parameters."""
        return {}, {}

    # -------------------------------------------------------------------------------- what follows

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of its parts, without the bench."""
        return self.wire.parts[1:]

    @property
    def noted(self) -> list[Message]:
        """Messages recorded for figures and page."""
        return [m for m in self.wire.data if m.name in self.kept or not self.kept]

    def part(self, name: str, config: KitT) -> Part:
        """Part of a run.

        Raises:
            RigError: no function makes it.
        """
        make = self.build.get(name, f"{self.code or type(self).__module__}:{name}")
        return (named(make) if isinstance(make, str) else make)(config)

    @cached_property
    def given(self) -> type[GivenT]:
        """Parameter class of the vehicle."""
        made: Any = named(self.parameters) if isinstance(self.parameters, str) else self.parameters
        return cast("type[GivenT]", made if isinstance(made, type) else made())

    @cached_property
    def table(self) -> FaultTable:
        """Faults that can be injected into it."""
        from robins.bench.broker.faults import FaultTable

        return FaultTable(self.wire, self.sends, self.takes, self.device_faults()[0])

    @cached_property
    def fault(self) -> type[LinkFault]:
        """The parameters of a fault."""
        from robins.bench.broker.faults import faults_of

        return faults_of(self.table, self.device_faults()[1])

    @cached_property
    def operator_console(self) -> Console:
        """Operator messages that it takes."""
        from robins.bench.broker.console import Console

        return Console(self.wire, self.console, self.refuses)

    @cached_property
    def operator_message(self) -> type[OperatorMessage]:
        """Parameters of an operator message."""
        from robins.bench.broker.console import operator_messages_of

        return operator_messages_of(self.operator_console)

    @cached_property
    def shown(self) -> PageView:
        """Contents of its page, with the faults that it offers."""
        from robins.bench.evaluation import offers_of

        view = self.view()
        return view if view.offered else view._replace(offered=offers_of(self.table))


class LoadedRun(NamedTuple):
    """A run as read from its scenarios."""

    name: str
    rig: Rig
    setup: Any  # of the class of the rig
    given: Any  # parameters of the vehicle
    text: str  # of the scenario of the bench, for the record

    @property
    def timing(self) -> Timing:
        """Steps of a complete run."""
        return self.rig.timing(self.given)
