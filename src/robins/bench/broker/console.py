"""Messages from the operator to the parts, through the bench: those that no part sends.

A scenario sends them at set times of the run, the page and scripts at any time. Each is sent
between two steps, stamped with the end of the earlier one; parts receive it in the later one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, ClassVar, NamedTuple

import pydantic

from robins import units
from robins.bench.wire.fields import SIZES, Field, Values
from robins.bench.wire.records import RecordError
from robins.bench.wire.schema import BARE, Wire
from robins.errors import RobinsError, hint
from robins.scenario import Parameters, Quantity

_KINDS = {known[0]: kind for kind, known in reversed(units.KINDS.items())}  # by the unit of the SI


class OperatorMessageError(RobinsError, ValueError):
    """An operator message that the bench cannot send; names the message, field and limit."""


class Console(NamedTuple):
    """Operator messages of a rig.

    Attributes:
        wire: its messages.
        console: names of those that the bench sends.
        refuses: (message, values) -> reason to refuse it although each number is within its limits.
    """

    wire: Wire = BARE
    console: tuple[str, ...] = ()
    refuses: Callable[[str, Values], str] = lambda message, values: ""

    def payload(self, message: str, values: Values) -> bytes:
        """Encode an operator message.

        Args:
            message: its name.
            values: by field, in the units of the wire. A field left out is NaN where the message
                has NaN for missing, else 0.

        Raises:
            OperatorMessageError: the bench does not send this message, it has no such field, or a
                value is beyond its limits.
        """
        if message not in self.console:
            known = f"{hint(message, self.console)} It says {', '.join(self.console) or 'nothing'}"
            raise OperatorMessageError(f"message: the bench does not say '{message}'{known}")
        blank = {f.name: _blank(f) for f in self.wire.message(message).fields}
        try:
            payload = self.wire.encode(message, blank | dict(values))
        except RecordError as error:
            raise OperatorMessageError(str(error)) from None
        if why := self.wire.unsound(message, payload):
            raise OperatorMessageError(f"message '{message}': {why.text}")
        if no := self.refuses(message, self.wire.decode(message, payload)):
            raise OperatorMessageError(f"message '{message}': {no}")
        return payload


def _blank(f: Field) -> list[float | int]:
    nothing = float("nan") if f.missing else 0
    return [nothing] * f.length


class OperatorMessage(Parameters):
    """Operator message `at` a time of the run: at the first boundary of steps from then on, and not
    before the end of the first step.

    ``message`` is one that the bench sends; then follow its fields. One that is left out is missing
    where the message allows that, else 0. Of two in one step the later one stands.
    """

    operator_console: ClassVar[Console] = Console()

    at: Annotated[float, Quantity("time", least="0 s")]
    message: str

    @pydantic.model_validator(mode="after")
    def _check_consistency(self) -> OperatorMessage:
        _ = self.payload
        return self

    @property
    def payload(self) -> bytes:
        """Encoded message."""
        given = self.model_fields_set - set(OperatorMessage.model_fields)
        return self.operator_console.payload(
            self.message, {name: getattr(self, name) for name in given}
        )

    def step(self, step_ns: int) -> int:
        """First step whose parts receive it, from 1."""
        return max(1, -(-round(self.at * 1e9) // step_ns))


def operator_messages_of(operator_console: Console) -> type[OperatorMessage]:
    """Operator messages of a rig as parameters: every field of its messages.

    Raises:
        OperatorMessageError: two messages have a field of one name that is not the same.
    """
    fields: dict[str, Field] = {}
    for f in (
        f for name in operator_console.console for f in operator_console.wire.message(name).fields
    ):
        same = fields.setdefault(f.name, f)
        if (same.kind, same.length, same.unit) != (f.kind, f.length, f.unit) or hasattr(
            OperatorMessage, f.name
        ):
            raise OperatorMessageError(
                f"field '{f.name}' of the console is there twice and not the same"
            )
    typed: dict[str, Any] = {name: (_type(f) | None, None) for name, f in fields.items()}
    made = pydantic.create_model("OperatorMessage", __base__=OperatorMessage, **typed)
    made.__doc__, made.operator_console = OperatorMessage.__doc__, operator_console
    return made


def _type(f: Field) -> Any:
    """Type of a field in a scenario: a quantity with a unit where the unit of the wire is SI."""
    one: Any = float if f.kind == "f64" else int
    if f.unit in _KINDS and f.unit != "1":
        of = one if f.length == 1 else tuple[(one,) * f.length]
        return Annotated[of, Quantity(_KINDS[f.unit])]
    least, most = f.limits or ((0, 2 ** (8 * SIZES[f.kind]) - 1) if one is int else (None, None))
    one = Annotated[one, pydantic.Field(ge=least, le=most)]
    return one if f.length == 1 else tuple[(one,) * f.length]
