"""Faults that a scenario can inject into a link, as parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
import pydantic

from robins.bench.wire.fields import Values
from robins.bench.wire.schema import BARE, PROTOCOL, Wire
from robins.scenario import Parameters, Quantity, default

Direction = Literal["from", "to"]
Stage = Literal["sensed", "repeated", "said", "blind"]
"""Stage at which a fault changes the content of a frame, in this order: the measurement itself, its
repetition in later frames, the values that are sent, and values that are missing. A blind sensor
does not repeat its lost values."""

_PLACE = ("link", "direction", "message", "share")
_LINE: dict[str, tuple[str, ...]] = {
    "bit errors": (*_PLACE, "bits"),
    "loss": _PLACE,
    "duplication": _PLACE,
    "reorder": _PLACE,
    "delay": (*_PLACE, "delay"),
    "killed": ("link",),
    "power": ("link",),
    "silent": ("link", "direction"),
}
"""Faults of the line and of processes, with the parameters of each."""
_NEEDS = {"delay": "delay", "killed": "link", "power": "link"}
ParameterTable = Mapping[str, tuple[Any, Any]]
"""Parameters that a rig adds, by name: type and default."""
PROCESS = ("killed", "power")
"""Faults of processes, which do not act on frames."""


class DeviceFault(NamedTuple):
    """A fault of a sensor or an actuator: its frames are valid, their content is wrong.

    Attributes:
        link: of the faulty part.
        message: that carries the wrong values.
        stage: see `Stage`; a "repeated" fault sends the last values again.
        act: (values of the message, the fault, time of the run [ns]) -> values as they are sent.
        takes: names of its parameters, besides place and share.
        needs: the one of them that is required; "": none.
    """

    link: str
    message: str
    stage: Stage
    act: Callable[[Values, Any, int], Values] = lambda said, fault, now: said
    takes: tuple[str, ...] = ()
    needs: str = ""


DeviceFaults = tuple[Mapping[str, DeviceFault], ParameterTable]
"""Faults of the sensors and actuators of a rig, by kind, and their parameters."""


def nothing(said: Values, fault: LinkFault, now_ns: int) -> Values:
    """Values of a sensor without a measurement: NaN for every number."""
    return {name: np.full(np.shape(x), np.nan) for name, x in said.items()}


class FaultTable(NamedTuple):
    """Faults that can be injected into a rig.

    Attributes:
        wire: its messages.
        sends: messages by part.
        takes: messages by part.
        device_faults: faults of its sensors and actuators, by kind.
    """

    wire: Wire = BARE
    sends: Mapping[str, tuple[str, ...]] = {}
    takes: Mapping[str, tuple[str, ...]] = {}
    device_faults: Mapping[str, DeviceFault] = {}

    @property
    def kinds(self) -> dict[str, tuple[str, ...]]:
        """All kinds of faults, with the parameters of each."""
        return _LINE | {kind: (*_PLACE, *one.takes) for kind, one in self.device_faults.items()}

    def carried(self, link: str, direction: Direction) -> tuple[str, ...]:
        """Names of the messages on the link of a part, in one direction."""
        return (self.sends if direction == "from" else self.takes)[link]


class LinkFault(Parameters):
    """Fault on a link from `begin` (included) to `end` (excluded; omitted: permanent).

    Times are those of the clock of the run: a step has that of its end.

    - "bit errors": ``bits`` bits of a frame are inverted; its check fails.
    - "loss": a frame does not come. "silent": none comes, of no message.
    - "duplication": a frame comes twice.
    - "reorder": a frame comes after the next one of the same message, as what is late.
    - "delay": a frame comes ``delay`` later.
    - "killed": the part of the link is killed, at `begin`.
    - "power": the part of the link is off, and starts again at `end` without any memory.
    - and those of the sensors and actuators of a rig.

    ``link`` is that of a part, left out: of each; ``direction`` is "from" the part or "to" it;
    ``message`` left out: each but those of the clock, which no fault touches. ``share`` is that of
    the frames that are hit, at random.
    """

    table: ClassVar[FaultTable] = FaultTable()

    if TYPE_CHECKING:  # parameters that a rig adds, see `faults_of`

        def __getattr__(self, name: str) -> Any: ...

    kind: str
    begin: Annotated[float, Quantity("time", least="0 s")]
    end: Annotated[float, Quantity("time", above="0 s")] | None = None
    link: str | None = None
    direction: Direction = "from"
    message: str | None = None
    share: Annotated[float, Quantity("ratio", above="0", most="1")] = default("100 %")
    bits: Annotated[int, pydantic.Field(ge=1, le=64)] = 1
    delay: Annotated[float, Quantity("time", above="0 s")] | None = None

    @pydantic.model_validator(mode="before")
    @classmethod
    def _fill_in_link(cls, given: Any) -> Any:
        """Add link and message to a fault of a sensor or an actuator that leaves them out."""
        if isinstance(given, Mapping) and (
            said := cls.table.device_faults.get(given.get("kind", ""))
        ):
            return {"link": said.link, "message": said.message, **given}
        return given

    @pydantic.model_validator(mode="after")
    def _check_consistency(self) -> LinkFault:
        if self.end is not None and self.end <= self.begin:
            raise ValueError(f"end ({self.end:g} s) must come after begin ({self.begin:g} s)")
        said = self.table.device_faults.get(self.kind)
        allowed = ("kind", "begin", "end", *self.table.kinds[self.kind])
        if "end" in self.model_fields_set and self.kind == "killed":
            raise ValueError("end: a part is killed once, at begin: leave end out")
        if more := sorted(self.model_fields_set - set(allowed)):
            raise ValueError(
                f"{more[0]}: a fault of kind '{self.kind}' has none; it takes {', '.join(allowed)}"
            )
        need = said.needs if said else _NEEDS.get(self.kind)
        if need and getattr(self, need) is None:
            raise ValueError(f"{need}: a fault of kind '{self.kind}' needs it")
        _check_place(self)
        return self

    @property
    def begin_ns(self) -> int:
        """First time of the run at which it is active [ns]."""
        return round(self.begin * 1e9)

    @property
    def end_ns(self) -> float | int:
        """First time at which it is no longer active [ns]; infinite: never."""
        return math.inf if self.end is None else round(self.end * 1e9)

    def holds(self, now_ns: int) -> bool:
        """True if the fault is active at that time of the run."""
        return self.begin_ns <= now_ns < self.end_ns


def faults_of(table: FaultTable, more: ParameterTable) -> type[LinkFault]:
    """The faults of a rig as parameters.

    Args:
        table: the faults of the rig.
        more: parameters of the faults of its sensors and actuators: type and default.
    """
    fields: dict[str, Any] = {"kind": (Literal[tuple(table.kinds)], ...), **more}
    made = pydantic.create_model("Fault", __base__=LinkFault, **fields)
    made.__doc__, made.table = LinkFault.__doc__, table
    return made


def _check_place(fault: LinkFault) -> None:
    """Check that the message of a fault goes over its link.

    Raises:
        ValueError: no such link or message, or the link does not carry it.
    """
    table = fault.table
    if fault.link is not None and fault.link not in table.sends:
        raise ValueError(f"link: there is no part '{fault.link}', only {', '.join(table.sends)}")
    names = [m.name for m in table.wire.data]
    if fault.message is not None and fault.message not in names:
        clock = any(fault.message == m.name for m in PROTOCOL)
        spared = " (those of the clock are spared)" if clock else ""
        raise ValueError(
            f"message: there is no '{fault.message}' to meet{spared}, only {', '.join(names)}"
        )
    said = table.device_faults.get(fault.kind)
    if said is not None and fault.message != said.message:
        raise ValueError(f"message: a fault of kind '{fault.kind}' is one of '{said.message}'")
    if fault.link is not None and fault.message is not None:
        carried = table.carried(fault.link, fault.direction)
        if fault.message not in carried:
            raise ValueError(
                f"message: '{fault.message}' never goes {fault.direction} '{fault.link}', "
                f"only {', '.join(carried)}"
            )
