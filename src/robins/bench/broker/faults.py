"""Faults that a scenario can inject into a link, as parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import pydantic

from robins.bench.wire.schema import FIRST_DATA, MESSAGES, WHEELS
from robins.scenario import Parameters, Quantity, default

Direction = Literal["from", "to"]
_CLOCK = frozenset(m.name for m in MESSAGES if m.number < FIRST_DATA)

ROUTES: dict[str, dict[Direction, tuple[str, ...]]] = {
    "plant": {"to": ("actuation",), "from": ("motion",)},
    "table": {"to": ("motion",), "from": ("mounted",)},
    "gyro": {"to": ("mounted",), "from": ("gyro",)},
    "star": {"to": ("motion", "gyro", "estimate"), "from": ("star",)},
    "adm": {"to": ("gyro", "star"), "from": ("estimate", "innovation")},
    "acm": {"to": ("estimate", "gyro", "wheels"), "from": ("command",)},
    "actuators": {"to": ("command",), "from": ("actuation", "wheels")},
}
"""What goes over the link of each part, to it and from it."""

# where the faults of a sensor and an actuator are: link and message
_SPEAKER: dict[str, tuple[str, str]] = {
    **dict.fromkeys(("turned", "stuck", "sign", "lost"), ("star", "star")),
    "wheel": ("actuators", "actuation"),
}
_PLACE = ("link", "direction", "message", "share")
_TAKES: dict[str, tuple[str, ...]] = {
    "bit errors": (*_PLACE, "bits"),
    "loss": _PLACE,
    "duplication": _PLACE,
    "reorder": _PLACE,
    "delay": (*_PLACE, "delay"),
    "stuck": _PLACE,
    "turned": (*_PLACE, "angle"),
    "lost": _PLACE,
    "sign": _PLACE,
    "wheel": (*_PLACE, "wheel"),
    "killed": ("link",),
    "silent": ("link", "direction"),
}
_NEEDS = {"delay": "delay", "wheel": "wheel", "killed": "link"}


_OfFrames = Literal["bit errors", "loss", "duplication", "reorder", "delay", "stuck"]
_OfParts = Literal["turned", "lost", "sign", "wheel", "killed", "silent"]


class LinkFault(Parameters):
    """Something goes wrong on a link from `begin` (included) to `end` (not; left out: for good).

    Times are those of the clock of the run: a step has that of its end.

    - "bit errors": ``bits`` bits of a frame are inverted; its check fails.
    - "loss": a frame does not come. "silent": none comes, of no message.
    - "duplication": a frame comes twice.
    - "reorder": a frame comes after the next one of the same message, as what is late.
    - "delay": a frame comes ``delay`` later.
    - "stuck": the star sensor says again and again what it said last.
    - "turned": its attitude is turned by ``angle`` about its boresight z.
    - "sign": in every other second its attitude has the opposite sign, which is no fault of it.
    - "lost": its frames come, without an attitude.
    - "wheel": the wheel of that number, from 0, gives no torque.
    - "killed": the part of the link is killed, at `begin`.

    ``link`` is that of a part, left out: of each; ``direction`` is "from" the part or "to" it;
    ``message`` left out: each but those of the clock, which no fault touches. ``share`` is that of
    the frames that are hit, at random.
    """

    kind: Literal[_OfFrames, _OfParts]
    begin: Annotated[float, Quantity("time", least="0 s")]
    end: Annotated[float, Quantity("time", above="0 s")] | None = None
    link: str | None = None
    direction: Direction = "from"
    message: str | None = None
    share: Annotated[float, Quantity("ratio", above="0", most="1")] = default("100 %")
    bits: Annotated[int, pydantic.Field(ge=1, le=64)] = 1
    delay: Annotated[float, Quantity("time", above="0 s")] | None = None
    angle: Annotated[float, Quantity("angle", above="0 deg", most="180 deg")] = default("10 deg")
    wheel: Annotated[int, pydantic.Field(ge=0, lt=WHEELS)] | None = None

    @pydantic.model_validator(mode="before")
    @classmethod
    def _at_its_speaker(cls, given: Any) -> Any:
        """Where the fault of a sensor or an actuator is, if it is left out."""
        if isinstance(given, Mapping) and given.get("kind") in _SPEAKER:
            link, said = _SPEAKER[given["kind"]]
            return {"link": link, "message": said, **given}
        return given

    @pydantic.model_validator(mode="after")
    def _sound(self) -> LinkFault:
        if self.end is not None and self.end <= self.begin:
            raise ValueError(f"end ({self.end:g} s) must come after begin ({self.begin:g} s)")
        allowed = ("kind", "begin", "end", *_TAKES[self.kind])
        if "end" in self.model_fields_set and self.kind == "killed":
            raise ValueError("end: a part is killed once, at begin: leave end out")
        if more := sorted(self.model_fields_set - set(allowed)):
            raise ValueError(
                f"{more[0]}: a fault of kind '{self.kind}' has none; it takes {', '.join(allowed)}"
            )
        if (need := _NEEDS.get(self.kind)) and getattr(self, need) is None:
            raise ValueError(f"{need}: a fault of kind '{self.kind}' needs it")
        _check_place(self)
        return self

    @property
    def begin_ns(self) -> int:
        """First time of the run at which it is there."""
        return round(self.begin * 1e9)

    @property
    def end_ns(self) -> float | int:
        """First time at which it is there no more; infinite: never."""
        return math.inf if self.end is None else round(self.end * 1e9)

    def holds(self, now_ns: int) -> bool:
        """Whether it is there at that time of the run."""
        return self.begin_ns <= now_ns < self.end_ns


def _check_place(fault: LinkFault) -> None:
    """That what the fault is to meet goes over that link."""
    if fault.link is not None and fault.link not in ROUTES:
        raise ValueError(f"link: there is no part '{fault.link}', only {', '.join(ROUTES)}")
    names = [m.name for m in MESSAGES if m.number >= FIRST_DATA]
    if fault.message is not None and fault.message not in names:
        spared = " (those of the clock are spared)" if fault.message in _CLOCK else ""
        raise ValueError(
            f"message: there is no '{fault.message}' to meet{spared}, only {', '.join(names)}"
        )
    said = _SPEAKER.get(fault.kind, (None, None))[1]
    if said is not None and fault.message != said:
        raise ValueError(f"message: a fault of kind '{fault.kind}' is one of '{said}'")
    if fault.link is not None and fault.message is not None:
        carried = ROUTES[fault.link][fault.direction]
        if fault.message not in carried:
            raise ValueError(
                f"message: '{fault.message}' never goes {fault.direction} '{fault.link}', "
                f"only {', '.join(carried)}"
            )
