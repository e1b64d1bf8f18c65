"""A filter stepped one sample at a time, for benches and live programs."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping
from typing import NamedTuple, TypeVar

import numpy as np
from jax.tree_util import tree_map

from robins.errors import require
from robins.filters.belief import Belief, Code, StepInfo
from robins.filters.kalman import Filter, FilterState, Prediction
from robins.filters.machine import Machine, on
from robins.filters.model import Data, Model
from robins.filters.observation import as_measurement, as_real
from robins.filters.run import Step, everything
from robins.filters.tally import Tally, doubts
from robins.filters.values import Numbers, without_weak_types
from robins.manifold import State

T = TypeVar("T")
WINDOW = 400  # last updates of each sensor that are judged

_DONE = int(Code.DONE)
_NAMES = {int(code): code.name for code in Code}


class WatchedStep(NamedTuple):
    """Kept part of a step whose updates count for `OnlineFilter.doubts`."""

    value: Data  # returned by `OnlineFilter.step`
    info: dict[str, StepInfo]

    @classmethod
    def of(cls, step: Step, value: Data) -> WatchedStep:
        """Part ``value`` of a step, and of its updates what is judged."""
        judged = {k: i._replace(factor=(), gain=(), notes={}) for k, i in step.info.items()}
        return cls(value, judged)


class OnlineFilter:
    """Filter with a current state; `predict` and `update` are those of a run, compiled.

    Its results equal those of `robins.filters.run` to rounding. In C a call takes some ten
    microseconds where JAX takes a hundred, and returns NumPy arrays.

    Attributes:
        filter: the filter.
        model: its motion and sensors.
        counts: outcomes by `Code` name: of updates, and of predictions not taken.
    """

    def __init__(
        self,
        filter_: Filter,
        model: Model,
        start: Belief | FilterState,
        machine: Machine | str = "jax",
    ):
        """Start at a belief, or continue from a state.

        Args:
            filter_: the filter, such as `kalman` returns.
            model: the motion and the sensors.
            start: initial belief or saved state.
            machine: "jax"; "vm" for the interpreter, which compiles nothing; or "c" for compiled
                programs of scalars, which need a C compiler. The first call of each kind takes
                seconds to compile; programs are kept on disk. Or a function that makes a
                `robins.filters.machine.CompiledState` of a state.

        Raises:
            ValueError: there is no such machine.
            robins.program.BuildError: there is no C compiler, or no interpreter.
            robins.program.ProgramError: the state holds numbers that C cannot represent; a call
                raises it for an operation that C lacks, with the line of the model or the rule.
        """
        self.filter, self.model = filter_, model
        state = without_weak_types(
            filter_.init(start, model.dims) if isinstance(start, Belief) else start
        )
        self._machine = on(machine, self.filter, self.model, state)
        self._reports = filter_.reports
        self._start = self._copied(self.state)
        self.counts: Counter[str] = Counter()
        self._last: dict[str, deque[tuple[StepInfo, State]]] = {}

    @property
    def state(self) -> FilterState:
        """State of the filter, in C as NumPy arrays; assign to restore a saved one."""
        return self._machine.state

    @state.setter
    def state(self, state: FilterState) -> None:
        self._machine.state = state
        self._start = self._copied(self.state)

    @property
    def belief(self) -> Belief:
        """Current belief."""
        return self.state.belief

    def predict(self, u: Data = None) -> Prediction:
        """Predict over one step with input u."""
        prediction = self._machine.predict(u)
        self._count(prediction.code)
        return prediction

    def step(
        self,
        y: Mapping[str, Data],
        u: Data = None,
        aux: Mapping[str, Data] | None = None,
        keep: Callable[[Step], Data] = everything,
    ) -> Data:
        """Take a whole step in one compiled call: predict, then update with each sensor in y.

        Measurements have the same shapes at every call, with NaN where missing; unlike those of
        `update` they are not checked. `keep` is the part of the `Step` to return, as in `run`, or
        a `WatchedStep` of it.
        """
        kept, (moved, used) = self._machine.step(u, dict(y), dict(aux or {}), keep)
        self._count(moved, *used.values())
        if isinstance(kept, Step | WatchedStep):
            for sensor, info in kept.info.items():
                self._remember(sensor, info, y[sensor])
        return kept.value if isinstance(kept, WatchedStep) else kept

    def update(self, y: Data, sensor: str | None = None, aux: Data = None) -> StepInfo:
        """Update with a measurement; NaN is missing. A model of one sensor needs no `sensor` name.

        Raises:
            KeyError: the model has no sensor of this name.
            TypeError: the measurement is not of real numbers.
            ValueError: the name is missing, or the measurement has the wrong shape.
        """
        if sensor is None:
            names = sorted(self.model.dims)
            require(len(names) == 1, f"name one of the sensors {names}")
            (sensor,) = names
        self.model.sensor(sensor)
        numbers = (as_real if self._machine.is_numpy else as_measurement)(sensor, y)
        info = self._machine.update(sensor, numbers, aux)
        self._count(_DONE, info.code)
        self._remember(sensor, info, numbers)
        return info

    def doubts(self, bounds: bool = False, assumed: Collection[str] = ()) -> list[str]:
        """Sentences on reasons to doubt the last 400 updates of each sensor.

        Updates by `step` count if it keeps the whole `Step`, or a `WatchedStep`. The false-alarm
        probability holds for one call. Arguments are those of `robins.filters.doubts`.
        """
        tally = Tally.blank(tuple(self._last))
        info, readings = {}, {}
        for sensor, kept in self._last.items():
            info[sensor], readings[sensor] = tree_map(lambda *x: np.stack(x), *kept)
            code, dof = info[sensor].code, info[sensor].dof
            judged = (dof > 0) & (code != int(Code.REFUSED))
            tally.updates[sensor] = np.bincount(code, minlength=len(Code))
            tally.nis[sensor] = np.sum(np.where(judged, info[sensor].nis, 0.0))
            tally.dof[sensor] = np.sum(np.where(judged, dof, 0))
        return doubts(tally.with_innovations(info, readings), bounds, assumed)

    def forget(self, steps: int) -> None:
        """Let the last steps, from which the caller goes back, not count for `doubts`."""
        for kept in self._last.values():
            for _ in range(min(steps, len(kept))):
                kept.pop()

    def look(self, question: Callable[..., T], *args: Data) -> T:
        """Return ``question(filter, model, state, *args)``, compiled; the state is unchanged.

        The question is a pure function, the same object at every call, such as a prediction to
        another time than that of the next step.
        """
        return self._machine.look(question, *args)

    def _remember(self, sensor: str, info: StepInfo, y: State) -> None:
        """Keep an update for `doubts`."""
        kept = self._copied((info._replace(factor=(), gain=(), notes={}), y))
        self._last.setdefault(sensor, deque(maxlen=WINDOW)).append(kept)

    def _copied(self, tree: T) -> T:
        """Tree of the same numbers that the next call in C does not overwrite."""
        return tree_map(np.array, tree) if self._machine.is_numpy else tree

    def _count(self, moved: Numbers | int, *used: Numbers) -> None:
        """Count a prediction that was not taken, and updates; let the filter report."""
        # Python integers: comparing a NumPy one with a `Code` takes as long as a step
        if (code := int(moved)) != _DONE:
            self.counts[_NAMES[code]] += 1
        for one in used:
            self.counts[_NAMES[int(one)]] += 1
        if self._reports:
            self.filter.report(self._start, self.state, None, None)
