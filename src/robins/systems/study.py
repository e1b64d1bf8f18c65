"""Study: simulation, filters and claims of a kind of scenario; and the problem made from it.

A study is a chain: parameters -> `lay_out` (what all runs share) -> `simulate` (one run) -> a
`Contender` for each filter -> metrics -> verdicts. `Study.problem` builds that chain; the campaign
runs any `Problem` and does not know which system it came from.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Generic, Literal, NamedTuple, TypeVar

import numpy as np
import xarray as xr
from jaxtyping import Array

from robins.errors import require_known
from robins.filters import Belief, Filter, Loop, Model
from robins.filters.values import kind, value
from robins.manifold import State
from robins.results import Outcome
from robins.scenario import Parameters
from robins.systems.catalogue import listed
from robins.systems.judgement import Claim, Judge, claim_judge, standard_metrics
from robins.systems.parts import HowMany, Names, RunNumber, Runs


class StateBlock(NamedTuple):
    """A named group of components of the tangent space."""

    name: str
    where: slice
    units: str  # SI
    display_unit: str  # of figures and metrics
    frame: str
    axes: tuple[str, ...]


class SensorAxes(NamedTuple):
    """Units and names of the components of a sensor's innovation."""

    units: str
    frame: str
    axes: tuple[str, ...]
    display_unit: str = ""  # of figures, if not `units`


class Case(NamedTuple):
    """One simulated run: inputs and measurements of a filter, and the truth.

    In closed loop, `loop` provides all but the start.
    """

    start: Belief  # or a filter state
    u: Any  # input of the motion, leading axis E epochs
    y: Mapping[str, Any]
    aux: Mapping[str, Any]
    truth: State | None  # leading axis E
    # (E, r, n) reported = rows @ tangent error, if the reported components vary with time;
    # replaces `Contender.reported`
    rows: Array | None = None
    outputs: Mapping[str, Array] = {}  # (E, k) further outputs of the run, by name
    loop: Loop | None = None


WorldT = TypeVar("WorldT")  # a simulated run: a `Case`, or a type of the study's own


def as_simulated(world: Any) -> Case:
    """The simulated world itself, if it already is the case of every filter."""
    return world


@dataclass(frozen=True)
class Contender(Generic[WorldT]):
    """A filter with its model.

    Filters of one problem may have different states: each makes its own case of the simulated
    world, and all report the same components.
    """

    filter: Filter
    model: Model
    case: Callable[[WorldT], Case] = as_simulated  # makes the case of a simulated world
    # (r, n) reported = this matrix @ tangent error; None: the tangent error itself
    reported: np.ndarray | Array | None = None
    bounds: bool = False  # its sigmas are bounds of an H-infinity filter, not standard deviations
    lasting: bool = False  # its gain is not the optimal one, so innovations are correlated
    # figures known without a run, added to its metrics
    facts: Mapping[str, Any] = field(default_factory=dict)
    # reason why its steps call Python, "it solves ... in Python"; such a filter needs JAX
    on_host: str = ""


@value
class Recipe:
    """``function(*kinds, numbers, world)`` as a function of the world alone.

    Kinds (names, flags, None) choose what is compiled and are compared by `==`; numbers are data.
    Recipes of one function and equal kinds share what was compiled.
    """

    function: Callable[..., Case] = kind()
    kinds: tuple[Any, ...] = kind()
    numbers: Any

    def __call__(self, world: Any) -> Case:
        """The case of a world."""
        return self.function(*self.kinds, self.numbers, world)


class Limit(NamedTuple):
    """An upper limit for the errors of a block."""

    name: str  # "5_arcmin"
    block: str
    value: float  # SI, for the largest component


class Output(NamedTuple):
    """Output of a vehicle besides the estimated states: pointing error, momentum of its wheels."""

    name: str
    units: str  # SI
    display_unit: str
    frame: str
    axes: tuple[str, ...]
    text: str  # a sentence for the caption of its figure
    is_error: bool = False  # it should be zero, so its RMS over the runs is meaningful


class Norm(NamedTuple):
    """Norm of some reported components of the error, such as the horizontal ones."""

    name: str
    components: tuple[int, ...]


class Instrument(NamedTuple):
    """A sensor of a vehicle, declared in one place."""

    name: str
    axes: SensorAxes
    # (parameters, course, key of a component, true motion) -> its reading, leading axis E, NaN
    # where there is none; None: it uses the reading of another instrument
    measure: Any
    # (parameters, course) -> `Sensor`: h(x) and R of the filters; None: the vehicle lacks it
    believed: Callable[..., Any]
    # world -> (measurement, input of h besides the state or None); None: the reading alone
    taken: Any = None


@dataclass(frozen=True)
class View:
    """Contents of the report of every filter: data for figures and metrics."""

    epoch_s: np.ndarray  # (E,)
    blocks: Sequence[StateBlock]  # of the reported components
    sensors: Mapping[str, SensorAxes]
    metrics: Callable[[Any], dict[str, Any]] = standard_metrics  # campaign statistics -> metrics
    # truth, fixes, outages: shown in figures in addition to the filters
    context: xr.Dataset = field(default_factory=xr.Dataset)
    # means of the first run by filter -> further variables of the solution, such as the track;
    # each mean is a state of its own filter
    shown: Callable[[Mapping[str, State]], dict[str, Any]] = lambda means: {}
    count_from: int = 0  # first epoch that counts for figures pooled over time
    limits: Sequence[Limit] = ()
    count_to: int | None = None  # epoch after the last that counts; None: to the end
    bound_of: str | None = None  # contender whose model gives the covariance bound in figures
    norms: Sequence[Norm] = ()  # mean and spread over time are kept for each run
    windows: Sequence[slice] = ()  # spans of epochs; their largest errors are kept for each run
    notes: Sequence[str] = ()  # sentences for the reader of the report
    outputs: Sequence[Output] = ()  # of the cases, see `Case.outputs`
    # (E,) bool by instrument, or "motion": true while it is at fault; None if unknown
    faults: Mapping[str, np.ndarray] | None = None


@dataclass(frozen=True, kw_only=True)
class Problem(View):
    """A simulated scenario, ready to be run any number of times.

    Raises:
        ValueError: names clash, or one part names something that no other part defines; raised
            now, since the result of a campaign could not be written.
    """

    simulate: Callable[[Array], Any]  # run number (traced) -> world; pure, so it can be batched
    contenders: Mapping[str, Contender]
    claims: Judge
    # meaning of inputs in an exported library, by (struct, field), where no axes are declared
    fields: Mapping[tuple[str, str], str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that all names agree."""
        named: dict[str, str] = {}  # names with an axis of their own in the result
        for what, names in (
            ("block", [b.name for b in self.blocks]),
            ("output", [o.name for o in self.outputs]),
            ("sensor", list(self.sensors)),
            ("context", [str(c).removeprefix("axis_") for c in self.context.coords]),
        ):
            for name in names:
                if other := named.get(name):
                    raise ValueError(
                        f"{name}: names a {what} and a {other}, whose axes could not be told "
                        "apart in the result; rename one of them"
                    )
                named[name] = what
        for limit in self.limits:
            if named.get(limit.block) != "block":
                raise ValueError(f"limit {limit.name}: there is no block '{limit.block}'")
        for name, contender in self.contenders.items():
            for sensor, dim in contender.model.dims.items():
                if sensor not in self.sensors:
                    raise ValueError(
                        f"filter '{name}' has a sensor '{sensor}' whose axes nobody declares; "
                        f"declared are {', '.join(self.sensors)}"
                    )
                if dim != len(self.sensors[sensor].axes):
                    raise ValueError(
                        f"filter '{name}': sensor '{sensor}' has {dim} components and "
                        f"{len(self.sensors[sensor].axes)} declared axes; sensors that differ "
                        "need names of their own"
                    )


class Scenario(Parameters):
    """Parameters of every simulated scenario; a study adds its own and sets `study`, its name."""

    system: str = ""
    study: str = ""
    title: str = ""
    runs: Runs = 50
    filters: Names = ()  # empty: the usual ones of the study
    claims: tuple[str, ...] | None = None  # ids of the claims checked; None: all of the study
    # campaign in a folder: runs whose histories are kept, and how many diverged ones are kept
    keep: tuple[RunNumber, ...] = ()
    keep_diverged: HowMany = 0


ParametersT = TypeVar("ParametersT", bound=Scenario)
CourseT = TypeVar("CourseT")  # what all runs share


def _nothing_shared(given: Scenario) -> Any:
    return None


@dataclass(frozen=True)
class Study(Generic[ParametersT, CourseT, WorldT]):
    """One kind of scenario of a system: its parts, from which `problem` makes a problem.

    A type checker infers the types of parameters, course and world from its functions, and checks
    that they agree.

    `lay_out` and the later steps may raise a ValueError on parameters that do not fit together.
    """

    parameters: type[ParametersT]
    filters: tuple[str, ...]
    # (parameters, course, seed, run number) -> world, or a `Case` if it is the same for all
    # filters; pure, the run number may be traced
    simulate: Callable[[ParametersT, CourseT, int, Array], WorldT]
    # (parameters, course, name of the filter)
    contender: Callable[[ParametersT, CourseT, str], Contender[WorldT]]
    view: Callable[[ParametersT, CourseT], View]  # (parameters, course)
    # parameters -> course: what all runs share
    lay_out: Callable[[ParametersT], CourseT] = _nothing_shared
    claims: Mapping[str, Claim] = field(default_factory=dict)  # by id
    on_request: tuple[str, ...] = ()  # filters too slow to run unless named

    @property
    def usual(self) -> tuple[str, ...]:
        """Filters that run if none are named."""
        return tuple(name for name in self.filters if name not in self.on_request)

    def problem(self, given: ParametersT, filters: Sequence[str], seed: int) -> Problem:
        """Build the problem of these parameters and filters (by name) for a campaign.

        Raises:
            ValueError: the parameters do not fit together, or a filter or claim is not known.
        """
        for name in filters:
            require_known("filter", name, self.filters)
        course = self.lay_out(given)
        return Problem(
            simulate=partial(self.simulate, given, course, seed),
            contenders={name: self.contender(given, course, name) for name in filters},
            claims=claim_judge(self.claims, given.claims),
            **vars(self.view(given, course)),
        )


class PairAlignment(NamedTuple):
    """Transfer alignment of recorded master and slave data instead of a simulation."""

    study: str  # whose scenarios serve as configurations
    parameters: type[Parameters]
    filters: tuple[str, ...]
    align: Callable[..., Outcome]  # (dataset with a master, parameters, filters, progress)


class System(NamedTuple):
    """One entry of the registry."""

    name: str  # as in the catalogue, which has its summary and its scenarios
    studies: Mapping[str, Study]
    # filter to use if nothing is known of possible faults; every run includes it in addition to
    # its own
    default: str = ""
    replay_filters: tuple[str, ...] = ()
    replay_parameters: type[Parameters] | None = None
    replay_default: Path | None = None  # configuration of a log that comes without one
    # replay of a log that was examined and cleaned by `robins.logs`: (dataset, parameters, filters
    # by name (none: those of the parameters), progress) -> outcome
    replay: Callable[..., Outcome] | None = None
    # the same log prepared for its filters: (dataset, parameters) -> `replaying.PreparedLog`; a
    # system without it cannot be tuned on logs
    recorded: Callable[..., Any] | None = None
    reads: Literal["dataset", "ranges"] = "dataset"  # type of its logs: `Dataset` or `RangeLog`
    # scope of the examination of a log; "attitude": the sensor may be mounted in any orientation
    use: Literal["any", "attitude"] = "any"
    # roles of the arrays of a replay that can be exported
    replay_finds: tuple[str, ...] = ("attitude", "track")
    # replay parameters -> roll, pitch, yaw [rad] of the body axes relative to the sensor axes
    orientation: Callable[[Any], tuple[float, float, float]] = lambda parameters: (0.0, 0.0, 0.0)
    alignment: PairAlignment | None = None
    # for a system without a scenario: (replay parameters, seed) -> simulated runs that test an
    # exported filter
    aboard: Callable[[Any, int], Problem] | None = None

    @property
    def scenarios(self) -> dict[str, Path]:
        """Packaged scenario files by name."""
        return {name: scenario.path for name, scenario in listed(self.name).items()}

    @property
    def filters(self) -> tuple[str, ...]:
        """Names of all filters, each once."""
        named = [name for study in self.studies.values() for name in study.filters]
        return tuple(dict.fromkeys([*named, *self.replay_filters]))

    @property
    def claims(self) -> tuple[Mapping[str, str], ...]:
        """Ids and texts of all claims, each once: studies may share claims."""
        every = (item for study in self.studies.values() for item in study.claims.items())
        texts = dict.fromkeys((key, claim.text) for key, claim in every)
        return tuple({"id": key, "text": text} for key, text in texts)
