"""A study: what is simulated, who navigates it, what is claimed; and the problem made of it.

A study follows one course of work: parameters -> `lay_out` (what all runs share) -> `simulate` (one
run) -> a `Contender` for each filter -> metrics -> verdicts. `Study.problem` is that course; the
campaign runs any `Problem` and does not know which system it came from.
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
    """Some components of the tangent space, under a name."""

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
    display_unit: str = ""  # of figures, where it is another


class Case(NamedTuple):
    """One simulated run: what a filter is given, and what it should find.

    In closed loop the loop gives all of this but the start.
    """

    start: Belief  # or the state of a filter
    u: Any  # input of the motion, leading axis E epochs
    y: Mapping[str, Any]
    aux: Mapping[str, Any]
    truth: State | None  # leading axis E
    # (E, r, n) reported = rows @ tangent error, where what is reported turns with the time; it
    # takes the place of the contender's
    rows: Array | None = None
    outputs: Mapping[str, Array] = {}  # (E, k) what else is known of the run, by name
    loop: Loop | None = None


WorldT = TypeVar("WorldT")  # what is simulated of a run: a `Case`, or a type of the study's own


def as_simulated(world: Any) -> Case:
    """The case of a problem whose filters all take what is simulated as it is."""
    return world


@dataclass(frozen=True)
class Contender(Generic[WorldT]):
    """A filter with the model it believes in.

    Filters of one problem may have states of their own: each makes its own case of the simulated
    world, and all report the same components.
    """

    filter: Filter
    model: Model
    case: Callable[[WorldT], Case] = as_simulated  # from what the problem simulates
    # (r, n) reported = this @ tangent error; None: all of it
    reported: np.ndarray | Array | None = None
    bounds: bool = False  # it states bounds of an H-infinity filter, not standard deviations
    lasting: bool = False  # its gain is not that of least variance, so innovations are correlated
    # figures known without a run, put among its metrics
    facts: Mapping[str, Any] = field(default_factory=dict)
    # why its steps call Python, "it solves ... in Python": such a filter runs by JAX alone
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
    """A size that the errors of a block should stay below."""

    name: str  # "5_arcmin"
    block: str
    value: float  # SI, of the largest component


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
    """The length of some reported components of the error, such as the horizontal ones."""

    name: str
    components: tuple[int, ...]


class Instrument(NamedTuple):
    """A sensor of a vehicle, declared in one place."""

    name: str
    axes: SensorAxes
    # (parameters, course, key of a component, true motion) -> its reading, leading axis E, NaN
    # where there is none; None: it takes what another instrument has read
    measure: Any
    # (parameters, course) -> `Sensor`: h(x) and R, as a filter believes; None: the vehicle lacks it
    believed: Callable[..., Any]
    # world -> the measurement, and what h(x) needs besides the state; None: the reading, nothing
    taken: Any = None


@dataclass(frozen=True)
class View:
    """Report of every filter, with the data for figures and metrics."""

    epoch_s: np.ndarray  # (E,)
    blocks: Sequence[StateBlock]  # of the reported components
    sensors: Mapping[str, SensorAxes]
    metrics: Callable[[Any], dict[str, Any]] = standard_metrics  # campaign statistics -> metrics
    # truth, fixes, outages: what figures show in addition to the filters
    context: xr.Dataset = field(default_factory=xr.Dataset)
    # means of the first run by filter -> more variables of the solution, such as the track. A
    # mean is the state of its own filter.
    shown: Callable[[Mapping[str, State]], dict[str, Any]] = lambda means: {}
    count_from: int = 0  # first epoch that counts for figures pooled over time
    limits: Sequence[Limit] = ()
    count_to: int | None = None  # epoch after the last that counts; None: to the end
    bound_of: str | None = None  # the contender whose model's covariance bound is drawn in
    norms: Sequence[Norm] = ()  # whose mean and spread over time are kept of each run
    windows: Sequence[slice] = ()  # spans of epochs whose largest errors are kept of each run
    notes: Sequence[str] = ()  # sentences for the reader of the report
    outputs: Sequence[Output] = ()  # of its cases
    # (E,) bool by instrument, or "motion": when it is truly wrong; None where that is not known
    faults: Mapping[str, np.ndarray] | None = None


@dataclass(frozen=True, kw_only=True)
class Problem(View):
    """A simulated scenario, ready to be run any number of times.

    Raises:
        ValueError: names clash, or what one part names no other part has; raised before a
            campaign is computed whose result could not be written.
    """

    simulate: Callable[[Array], Any]  # run number (traced) -> world; pure, so it batches
    contenders: Mapping[str, Contender]
    claims: Judge
    # what inputs are in an exported library, by struct and field, where no axes are declared
    fields: Mapping[tuple[str, str], str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that all names fit each other."""
        named: dict[str, str] = {}  # what has an axis of its own, in the result
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
    """Parameters of every simulated scenario; a study adds its own, and `study`, its name."""

    system: str = ""
    study: str = ""
    title: str = ""
    runs: Runs = 50
    filters: Names = ()  # the usual ones of the study where none is named
    claims: tuple[str, ...] | None = None  # ids of those it checks; None: all of the study
    # of a campaign in a folder: runs whose histories it keeps, and of how many that diverge
    keep: tuple[RunNumber, ...] = ()
    keep_diverged: HowMany = 0


ParametersT = TypeVar("ParametersT", bound=Scenario)
CourseT = TypeVar("CourseT")  # what all runs share


def _nothing_shared(given: Scenario) -> Any:
    return None


@dataclass(frozen=True)
class Study(Generic[ParametersT, CourseT, WorldT]):
    """One kind of scenario of a system: its parts, from which one function makes a problem.

    A checker of types finds the parameters, the course and the world of its functions, and whether
    they fit each other.

    `lay_out` and what follows may raise a ValueError on parameters that do not fit together.
    """

    parameters: type[ParametersT]
    filters: tuple[str, ...]
    # (parameters, course, seed, run number) -> world, or a `Case` where all filters take the same;
    # pure, the run number may be traced
    simulate: Callable[[ParametersT, CourseT, int, Array], WorldT]
    # (parameters, course, name of the filter)
    contender: Callable[[ParametersT, CourseT, str], Contender[WorldT]]
    view: Callable[[ParametersT, CourseT], View]  # (parameters, course)
    # parameters -> course: what all runs share
    lay_out: Callable[[ParametersT], CourseT] = _nothing_shared
    claims: Mapping[str, Claim] = field(default_factory=dict)  # by id, what its scenarios check
    on_request: tuple[str, ...] = ()  # filters too slow to run where none is named

    @property
    def usual(self) -> tuple[str, ...]:
        """The filters that run where none is named."""
        return tuple(name for name in self.filters if name not in self.on_request)

    def problem(self, given: ParametersT, filters: Sequence[str], seed: int) -> Problem:
        """The scenario of these parameters with these filters, by name, ready for a campaign.

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
    """Use of a recorded master and slave in the place of a simulation."""

    study: str  # whose scenarios serve as configurations
    parameters: type[Parameters]
    filters: tuple[str, ...]
    align: Callable[..., Outcome]  # (dataset with a master, parameters, filters, progress)


class System(NamedTuple):
    """One entry of the registry."""

    name: str  # as in the catalogue, which knows its summary and its scenarios
    studies: Mapping[str, Study]
    # the filter to use where nothing is known of what may go wrong; a run has it in addition to its
    # own
    default: str = ""
    replay_filters: tuple[str, ...] = ()
    replay_parameters: type[Parameters] | None = None
    replay_default: Path | None = None  # configuration of a log that comes without one
    # of a log that was examined and cleaned by `robins.logs`: (dataset, parameters, what the files
    # do not contain, names of filters, where there are none those of the parameters, progress)
    replay: Callable[..., Outcome] | None = None
    # the same log before it is replayed, as its filters take it: (dataset, parameters) ->
    # `replaying.Recorded`; a system without it cannot be tuned on logs
    recorded: Callable[..., Any] | None = None
    reads: Literal["dataset", "ranges"] = "dataset"  # what its logs are: `Dataset` or `RangeLog`
    # what a log is examined for: "attitude" where the sensor may lie any way in its vehicle
    use: Literal["any", "attitude"] = "any"
    # roles of arrays that a replay finds, of which exports are made
    replay_finds: tuple[str, ...] = ("attitude", "track")
    # roll, pitch, yaw [rad] of the body axes as seen from the sensor's, from replay parameters
    orientation: Callable[[Any], tuple[float, float, float]] = lambda parameters: (0.0, 0.0, 0.0)
    alignment: PairAlignment | None = None
    # of a system without a scenario, (replay parameters, seed) -> simulated runs that try a filter
    # which is exported
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
        """Ids and texts of what scenarios check, each once: studies may share claims."""
        every = (item for study in self.studies.values() for item in study.claims.items())
        texts = dict.fromkeys((key, claim.text) for key, claim in every)
        return tuple({"id": key, "text": text} for key, text in texts)
