"""Driver of filters: a run is one scan, a batch of runs one `vmap` of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from robins.errors import require
from robins.filters.belief import Belief, Code, StepInfo
from robins.filters.checks import one_of
from robins.filters.kalman import Again, Filter, FilterState, Prediction
from robins.filters.model import Data, Model
from robins.filters.observation import as_measurement
from robins.filters.tally import Tally, warn_not_taken
from robins.filters.values import is_known, on_device, split_numbers, without_weak_types
from robins.manifold import State


class Step(NamedTuple):
    """One step of a run: predict, then every sensor in the model's order."""

    prediction: Prediction
    posterior: Belief
    info: dict[str, StepInfo]  # by sensor


class Solution(NamedTuple):
    """Result of a run."""

    steps: Data  # result of `keep` for each Step, leading axis T; by default the Step itself
    final: FilterState  # after the last step, from which a run can continue
    log_likelihood: Float[Array, ""]
    tally: Tally  # outcomes of all steps, whatever was kept

    @property
    def mean(self) -> State:
        """Filtered means."""
        return self.steps.posterior.mean

    @property
    def covariance(self) -> Array:
        """(T, n, n) filtered covariances."""
        return self.steps.posterior.covariance

    @property
    def sigma(self) -> Array:
        """(T, n) filtered standard deviations."""
        return self.steps.posterior.sigma


Rows = tuple[Data, dict[str, State], dict[str, Data]]  # u, y and aux, the last two by sensor
RunMachine = Literal["jax", "vm"]
Keep = Callable[[Step], Data]  # part of a step that is kept


def everything(step: Step) -> Step:
    """Keep the whole step."""
    return step


def nothing(step: Step) -> tuple[()]:
    """Keep nothing of a step."""
    return ()


def _by_sensor(model: Model, data: Data) -> dict[str, State]:
    """Measurements by sensor name; a bare array means the only sensor."""
    if data is None:
        return {}
    if not isinstance(data, Mapping):
        names = sorted(model.dims)
        one = len(model.sensors) == 1
        require(one, f"this model has {names}: give measurements as a dict by sensor name")
        data = {model.sensors[0].name: data}
    check_names(model, data)
    return {name: as_measurement(name, values) for name, values in data.items()}


def checked(
    model: Model, y: Data, u: Data, aux: Mapping[str, Data] | None
) -> tuple[dict[str, State], dict[str, Data]]:
    """Measurements and further inputs by sensor, checked; arguments and errors are those of `run`.

    The first result is the measurements, the second the further inputs.
    """
    measurements, extra = _by_sensor(model, y), dict(aux or {})
    check_names(model, extra)
    _check_lengths(measurements, u, extra)
    return measurements, extra


def check_names(model: Model, data: Mapping[str, Data]) -> None:
    """Refuse data of sensors that the model does not have."""
    unknown = set(data) - set(model.dims)
    require(not unknown, f"no sensor {sorted(unknown)}; this model has {sorted(model.dims)}")


def _check_lengths(y: Mapping[str, Data], u: Data, aux: Mapping[str, Data]) -> None:
    """Refuse data of different lengths in time."""
    named = {"u": u, **{f"y['{k}']": v for k, v in y.items()}}
    named |= {f"aux['{k}']": v for k, v in aux.items()}
    lengths: dict[str, int] = {}
    for name, data in named.items():
        for leaf in jax.tree_util.tree_leaves(data):
            timed = jnp.ndim(leaf) > 0
            require(timed, f"{name} holds a single number: a leading axis of time is wanted")
            lengths[name] = jnp.shape(leaf)[0]
            same = len(set(lengths.values())) == 1
            require(same, "measurements and inputs must have one length", lengths)
    require(u is not None or y, "nothing to run over: neither a measurement nor an input")


def filter_step(
    filter_: Filter, model: Model, state: FilterState, u: Data, y: Mapping[str, Data], aux: Data
) -> tuple[FilterState, Step]:
    """Predict over one step, then update with each sensor in y."""
    state, prediction = filter_.predict(state, model.motion, u)
    info = {}
    for sensor in model.sensors:
        if sensor.name in y:
            extra = aux.get(sensor.name)
            state, info[sensor.name] = filter_.update(state, sensor, y[sensor.name], extra)
    return state, Step(prediction, state.belief, info)


Carry = tuple[FilterState, Array, Tally]


def _body(filter_: Filter, model: Model, keep: Keep, carry: Carry, row: Rows) -> tuple[Carry, Data]:
    state, total, tally = carry
    state, step = filter_step(filter_, model, state, *row)
    gained = sum((i.log_likelihood for i in step.info.values()), jnp.zeros(()))
    moved = step.prediction.code == int(Code.DONE)
    total = total + jnp.where(moved, gained, -jnp.inf)
    return (state, total, tally.add_step(step.prediction.code, step.info)), keep(step)


def _round(
    joined: Callable[[Array], tuple[Filter, Model]],
    keep: Keep,
    carry: tuple[Array, Carry],
    row: Rows,
) -> tuple[tuple[Array, Carry], Data]:
    """`_body` with the numbers of filter and model in the carry, so that its program has none."""
    numbers, begun = carry
    after, kept = _body(*joined(numbers), keep, begun, row)
    return (numbers, after), kept


def _begun(state: FilterState, rows: Rows) -> Carry:
    return state, jnp.zeros(()), Tally.blank(tuple(rows[1]))


@partial(jax.jit, static_argnames=("keep",))
def _scan(filter_: Filter, model: Model, state: FilterState, rows: Rows, keep: Keep) -> Solution:
    body = partial(_body, filter_, model, keep)
    (state, total, tally), steps = jax.lax.scan(body, _begun(state, rows), rows)
    return Solution(steps, state, total, tally)


def _interpreted(
    filter_: Filter, model: Model, state: FilterState, rows: Rows, keep: Keep
) -> Solution:
    # Imported here: a filter needs no programs.
    from robins.program.scanned import scan

    numbers, joined, key = split_numbers((filter_, model))
    carry = numbers, _begun(without_weak_types(state), rows)
    (_, found), steps = scan(partial(_round, joined, keep), (key, keep), carry, rows)
    return Solution(steps, *found)


def report_run(
    filter_: Filter,
    start: FilterState,
    final: FilterState,
    tally: Tally,
    again: Again,
    time_s: ArrayLike | None,
) -> None:
    """Raise the errors of a filter's `report` and warn of its tally, unless they are traced."""
    if is_known(final):
        filter_.report(start, final, again, time_s)
    if is_known(tally):
        warn_not_taken(tally)


def run(
    filter_: Filter,
    model: Model,
    start: Belief | FilterState,
    y: Data,
    u: Data = None,
    aux: Mapping[str, Data] | None = None,
    keep: Keep = everything,
    time_s: ArrayLike | None = None,
    machine: str = "jax",
) -> Solution:
    """Run a filter over measurements: for each step k predict, then update with row k of y.

    With JAX it is one compiled scan, open to `jax.vmap` over any of the data and to `jax.grad`.
    Runs share it if shapes are equal and the user's functions and `keep` are the same objects.

    Args:
        filter_: the filter, such as `kalman` returns.
        model: the motion and the sensors.
        start: belief before the first prediction, or the final state of another run.
        y: measurements, (T, m) for a model of one sensor, else a dict by sensor name; NaN is
            missing, per component. Row 0 is measured one step after start.
        u: input of the motion at each step, a pytree of arrays with leading axis T.
        aux: further inputs of sensors, by sensor name, leading axis T.
        keep: part of each `Step` to keep; long campaigns keep little.
        time_s: (T,) time of each step [s], stated in errors.
        machine: "jax", or "vm" for the interpreter, which compiles nothing and does not work in
            code that JAX transforms.

    Raises:
        Exception: error raised by `Filter.report`; in transformed code see the codes.
        robins.program.ProgramError: "vm" cannot represent the filter or the model as a program.
        robins.program.BuildError: "vm" has no interpreter.
        TypeError: a measurement is not a real number.
        ValueError: there is no such machine; lengths differ; measurements are for an unknown
            sensor, or have another shape than its readings.

    Warns:
        StepWarning: steps were not taken, or measurements contradict what is known exactly; in
            transformed code see `Solution.tally`.
    """
    one_of("machine", machine, RunMachine)
    measurements, extra = checked(model, y, u, aux)
    state = filter_.init(start, model.dims) if isinstance(start, Belief) else start
    rows = u, measurements, extra
    scan = _interpreted
    if machine == "jax":  # not for "vm": JAX compiles a program for each new shape of an array
        scan, (state, rows) = _scan, on_device((state, rows))
    solution = scan(filter_, model, state, rows, keep)

    def again(other: Filter) -> FilterState:
        return _scan(other, model, state, rows, nothing).final

    report_run(filter_, state, solution.final, solution.tally, again, time_s)
    if keep is everything and is_known(solution.tally):
        tally = solution.tally.with_innovations(solution.steps.info, measurements)
        solution = solution._replace(tally=tally)
    return solution
