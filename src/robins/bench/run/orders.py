"""Commands during a run: faults, by label, and messages of the operator."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from robins.bench.broker.faults import LinkFault
from robins.bench.broker.injector import Injector
from robins.bench.evaluation import OperatorEvent
from robins.bench.rig import LoadedRun
from robins.bench.wire.fields import Values

QueuedMessage = tuple[str, bytes, bool]
"""Name and payload of an operator message that is due, and true if the scenario planned it."""


class Orders:
    """Faults and operator messages of a run.

    Attributes:
        operator_events: messages sent.
    """

    def __init__(self, flight: LoadedRun, injector: Injector, step_ns: int):
        """Set up the faults of a run and the operator messages of its scenario."""
        self.operator_events: list[OperatorEvent] = []
        self._rig, self._injector, self._step_ns = flight.rig, injector, step_ns
        self._labels: list[tuple[str, LinkFault]] = []
        says = ((one.step(step_ns), one) for one in flight.setup.says)
        self._planned = sorted(says, key=lambda known: known[0])
        self._ordered: list[QueuedMessage] = []

    # ------------------------------------------------------------------------------------ faults

    def inject(
        self, label: str, fault: Mapping[str, Any], begin_s: float, length_s: float | None
    ) -> None:
        """Add a fault."""
        end = {} if length_s is None else {"end": begin_s + length_s}
        made = self._rig.fault.model_validate({**fault, "begin": begin_s, **end})
        self._injector.add(made)
        self._labels.append((label, made))

    def clear(self, label: str | None) -> None:
        """Remove the faults of a label, or all."""
        for one, fault in self._labels:
            if label in (None, one):
                self._injector.remove(fault)
        if label is None:
            self._injector.clear()
        self._labels = [x for x in self._labels if label is not None and x[0] != label]

    def active(self, now_ns: int) -> list[tuple[str, LinkFault]]:
        """Faults that are active at a time of the run, with their labels."""
        names = {id(fault): label for label, fault in self._labels}
        active = self._injector.active(now_ns)
        return [(names.get(id(f), f"{f.kind} at {f.link or 'all links'}"), f) for f in active]

    # ---------------------------------------------------------------------------------- messages

    def say(self, message: str, values: Values) -> None:
        """Queue a message for the next step; before the run, until the first step has ended.

        Raises:
            OperatorMessageError: it cannot be sent.
        """
        self._ordered.append((message, self._rig.operator_console.payload(message, values), False))

    def due(self, step: int) -> list[QueuedMessage]:
        """Messages due before a step, in order; of several of one name, parts use the last."""
        if step == 0:
            return []
        planned = [one for at, one in self._planned if at <= step]
        self._planned = [known for known in self._planned if known[0] > step]
        found = [(one.message, one.payload, True) for one in planned] + self._ordered
        self._ordered = []
        decode = self._rig.wire.decode
        self.operator_events += [
            OperatorEvent(step, name, decode(name, payload)) for name, payload, _ in found
        ]
        return found


def in_words(message: str, values: Values) -> str:
    """Text of an operator message for the user."""
    pairs = ((name, np.ravel(value).tolist()) for name, value in values.items())
    return f"'{message}': " + "; ".join(
        f"{name} {' '.join(f'{x:.6g}' for x in some)}" for name, some in pairs
    )
