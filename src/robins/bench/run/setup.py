"""The parameters of a run on the bench, with units: a scenario of the bench.

bench = "satellite"           # the rig
flies = "satellite/s1"        # what flies: a scenario of its system, or a file of one
filter = "mekf-gate"
seconds = "900 s"

[[faults]]
kind = "loss"
begin = "600 s"
end = "601 s"
"""

from __future__ import annotations

import contextlib
import os
import traceback
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import pydantic

from robins import scenario
from robins.bench.broker.console import OperatorMessage
from robins.bench.broker.faults import LinkFault
from robins.bench.broker.link import BenchError
from robins.bench.ports.port import program
from robins.bench.rig import LoadedRun, Rig, RunConfig
from robins.bench.rigs import RIGS, rig_of
from robins.errors import RobinsError, hint
from robins.scenario import Parameters, Quantity, ScenarioError
from robins.systems import trust
from robins.systems.catalogue import is_file

Clock = Literal["lockstep", "realtime"]


class Setup(Parameters):
    """A run on the bench.

    - ``bench``: the rig, by its name or as "file.py:rig" of the user's own.
    - ``flies``: a scenario of its system, by its name or a path that ends in .toml; ``set`` changes
      its parameters, ``"gyro.bias=5 deg/h"``.
    - ``clock``: "lockstep", as fast as it goes and always the same; "realtime", ``rate`` steps a
      second of the wall clock (left out: as many as the scenario has).
    - ``overrun``, in real time, when a step is not over at the next one's deadline: "continue"
      with the next one at once, "skip" to the deadline after, or "abort".
    - ``patience``, in real time: periods for which a step waits for a part before it goes on
      without it.
    - ``on_death``: what becomes of a run whose process dies: it "fail"s, or the process is
      "restart"ed and sent again the input that it has lost, for which the run waits; in real time
      it misses deadlines. ``restarts``: how often, of all processes together; one more fails the
      run, and so does the third death of a part within a minute that no fault has killed.
    - ``baud``: of a virtual line that each link without a real port has; left out: no delay.
    - ``ports``: parts that are boards, with their ports, ``gyro = "/dev/ttyUSB0,460800"``, or
      programs, which are given the path of a port: ``adm = "adm-c/adm_board"``.
    - ``faults``: injected faults. ``says``: messages of the operator to the parts.
    """

    rig: ClassVar[Rig]

    if TYPE_CHECKING:  # parameters that a rig adds, see `setup_of`

        def __getattr__(self, name: str) -> Any: ...

    bench: str
    title: str = ""
    flies: str = ""
    set: tuple[str, ...] = ()
    filter: str = ""
    seed: Annotated[int, pydantic.Field(ge=0, lt=2**63)] = 0
    seconds: Annotated[float, Quantity("time", above="0 s")] | None = None
    clock: Clock = "lockstep"
    rate: Annotated[float, Quantity("frequency", above="0 Hz")] | None = None
    overrun: Literal["continue", "skip", "abort"] = "continue"
    patience: Annotated[float, pydantic.Field(gt=0.0, le=1e6)] = 1.0
    on_death: Literal["fail", "restart"] = "fail"
    restarts: Annotated[int, pydantic.Field(ge=1, le=100_000)] = 10
    fifo: bool = False  # request the scheduler SCHED_FIFO
    baud: Annotated[int, pydantic.Field(ge=300, le=100_000_000)] | None = None
    ports: dict[str, str] = pydantic.Field(default_factory=dict)
    faults: tuple[LinkFault, ...] = ()
    says: tuple[OperatorMessage, ...] = ()

    @pydantic.model_validator(mode="after")
    def _check_consistency(self) -> Setup:
        parts, filters = self.rig.parts, self.rig.filters()
        if unknown := sorted(set(self.ports) - set(parts)):
            raise ValueError(f"ports: there is no part '{unknown[0]}', only {', '.join(parts)}")
        if self.rate is not None and self.clock == "lockstep":
            raise ValueError('rate: a clock in lock-step has none; choose the clock "realtime"')
        once = [why for part in parts if (why := self.rig.once(self, part))]
        if once and self.on_death == "restart":
            raise ValueError(f"on_death: {once[0]}; leave on_death out")
        if self.filter not in filters:
            if not any(filters):
                raise ValueError(f"filter: the {self.rig.name} has none to choose: leave it out")
            guess = f"{hint(self.filter, filters)} It has {', '.join(filters)}"
            raise ValueError(f"filter: no filter '{self.filter}' for the {self.rig.name}{guess}")
        return self


@cache
def setup_of(rig: Rig) -> type[Setup]:
    """The parameters of a run of a rig: those of all, with its names, its faults and its own."""
    fields: dict[str, Any] = {
        "bench": (str, rig.name),
        "flies": (str, next(iter(rig.flies()), "")),
        "filter": (str, rig.filters()[0]),
        "faults": (tuple[rig.fault, ...], ()),
        "says": (tuple[rig.operator_message, ...], ()),
        **rig.options(),
    }
    made = pydantic.create_model("Setup", __base__=Setup, **fields)
    made.__doc__, made.rig = Setup.__doc__, rig
    return made


@contextlib.contextmanager
def calling(rig: Rig, name: str, otherwise: str = "") -> Iterator[None]:
    """Context in which a function of a rig, perhaps the user's own, is called.

    Args:
        rig: the rig.
        name: of the function.
        otherwise: advice in addition to correcting it.

    Raises:
        BenchError: it failed; names the line.
    """
    try:
        yield
    except RobinsError:
        raise
    except Exception as error:
        at = traceback.extract_tb(error.__traceback__)[-1]
        raise BenchError(
            f"the {name} of the rig '{rig.name}' fails ({type(error).__name__}: {error})",
            f"{Path(at.filename).name}, line {at.lineno}",
            ", ".join(filter(None, ("correct it", otherwise))),
        ) from error


def config_of(flight: LoadedRun) -> RunConfig:
    """Config from which the parts of a run are made.

    Raises:
        BenchError: the rig cannot prepare it; names the line that failed.
    """
    with calling(flight.rig, "prepare"):
        return flight.rig.prepare(flight.setup, flight.given)


def built_in() -> dict[str, Path]:
    """Scenarios of the bench that come with robins, by name."""
    return {name: path for rig in RIGS for name, path in rig_of(rig).scenarios().items()}


def read(name: str, settings: tuple[str, ...] = ()) -> LoadedRun:
    """Read a run, named by a scenario of the bench or of a system, a file of either, or a rig.

    Args:
        name: "noisy-line", "satellite/s1", "satellite" (its first), "mine.toml", "pendulum.py:rig".
        settings: changes, ``"faults.0.angle=20 deg"``; of a scenario of a system those of
            `Setup.set`.

    Raises:
        ScenarioError: there is no scenario of this name, or it cannot be used.
        robins.bench.rigs.UnknownRig: it names an unknown rig.
    """
    text, rig = _text(name)
    if not text:
        flies = "" if is_file(name) or name in RIGS else name
        setup = setup_of(rig).model_validate(
            {"set": settings} | ({"flies": flies} if flies else {})
        )
        title = Path(name).name.replace(".py:", ":") if is_file(name) else name
        return LoadedRun(title, rig, setup, _flies(rig, setup), "")
    setup = scenario.parse(setup_of(rig), text, settings, source=name)
    _require_programs(setup.ports, name)
    title = name if name in built_in() else Path(name).stem
    return LoadedRun(title, rig, setup, _flies(rig, setup), text)


def _require_programs(ports: Mapping[str, str], named_in: str | os.PathLike[str]) -> None:
    """Refuse programs that a file names to replace parts, unless the user has confirmed them.

    Raises:
        RobinsError: a program is not confirmed.
    """
    for port in ports.values():
        if (path := program(port)) is not None:
            trust.require(path, named_in)


def _text(name: str) -> tuple[str, Rig]:
    """Text of a scenario of the bench, empty for other names; and the rig."""
    if is_file(name) or name in RIGS:
        return "", rig_of(name)
    ours = built_in()
    theirs = {series: rig for rig in RIGS for series in rig_of(rig).flies()}
    if name in theirs:
        return "", rig_of(theirs[name])
    if name not in ours and not name.endswith(".toml"):
        known = [*ours, *theirs]
        guess = f"{hint(name, known)} It has {', '.join(known)}"
        raise ScenarioError([f"no scenario '{name}' for the bench{guess}"])
    text = ours[name].read_text("utf-8") if name in ours else scenario.read_text(name)
    said = scenario.mapping_of(text, source=name)
    if "bench" in said:
        return text, rig_of(str(said["bench"]), Path(name).parent, name)
    return "", rig_of(str(said.get("system", RIGS[0])), Path(name).parent, name)


def _flies(rig: Rig, setup: Setup) -> Parameters:
    """Parameters of the vehicle and its flight."""
    packaged, flies = rig.flies(), setup.flies
    if flies in packaged:
        text = packaged[flies].read_text("utf-8")
    elif flies.endswith(".toml"):
        text = scenario.read_text(flies)
    elif not flies:
        text = ""
    else:
        there = ", ".join([*packaged, "a .toml file"])
        raise ScenarioError([f"flies: no scenario '{flies}'; there are {there}"])
    return scenario.parse(rig.given, text, setup.set, source=flies or rig.name)


def changed(flight: LoadedRun, options: Mapping[str, Any]) -> LoadedRun:
    """Copy of a run with other options of its setup, in SI; ``ports`` extend those there are.

    Raises:
        ScenarioError: an option that does not fit.
    """
    if not options:
        return flight
    given = {name: getattr(flight.setup, name) for name in flight.setup.model_fields_set}
    ports = {**flight.setup.ports, **options.get("ports", {})}
    if "clock" in options and options["clock"] == "lockstep":
        given.pop("rate", None)
    try:
        setup = setup_of(flight.rig).model_validate({**given, **options, "ports": ports})
    except pydantic.ValidationError as error:
        faults_found = [
            str(e["ctx"]["error"] if "ctx" in e and "error" in e["ctx"] else e["msg"])
            for e in error.errors(include_url=False)
        ]
        raise ScenarioError(faults_found) from None
    return flight._replace(setup=setup)


def counted_from(flight: LoadedRun, steps: int) -> int:
    """First step that counts in figures of merit: that of the scenario, else of the second half."""
    first = flight.timing.counted_from
    return first if first < steps else steps // 2


def steps_of(flight: LoadedRun) -> int:
    """Steps of a run.

    Raises:
        ScenarioError: longer than the scenario, or not a step long.
    """
    step_s, most, _ = flight.timing
    if flight.setup.seconds is None:
        return most
    steps = round(flight.setup.seconds / step_s)
    if not 1 <= steps <= most:
        wanted = f"duration={flight.setup.seconds:g} s"
        longer = f'set = ["{wanted}"] in it' if flight.text else f'--set "{wanted}"'
        raise ScenarioError(
            [
                f"seconds: {flight.setup.seconds:g} s is not from a step ({step_s:g} s) "
                f"to the end of the scenario ({most * step_s:g} s); "
                f"{longer} makes that longer"
            ]
        )
    return steps


def recorded_flight(
    header: Mapping[str, Any], record: str | os.PathLike[str], filter_: str | None = None
) -> LoadedRun:
    """Run of a record, from its header; or the same run with another filter.

    Raises:
        ScenarioError: the header is of another version of robins.
        RobinsError: the header names code that the user has not confirmed.
    """
    rig = recorded_rig(header, record)
    try:
        # JSON has lists where parameters have tuples.
        setup = setup_of(rig).model_validate(header["setup"], strict=False)
        given = rig.given.model_validate(header["loop"], strict=False)
    except (KeyError, TypeError, pydantic.ValidationError) as error:
        raise ScenarioError(
            [f"the record was made by another version of robins ({header.get('robins')}): {error}"]
        ) from None
    _require_programs(setup.ports, record)
    flight = LoadedRun(str(header["name"]), rig, setup, given, "")
    return flight if filter_ is None else changed(flight, {"filter": filter_})


def recorded_rig(header: Mapping[str, Any], record: str | os.PathLike[str]) -> Rig:
    """The rig that the header of a record names; headers of old records name none.

    Raises:
        RobinsError: it is in a file that the user has not confirmed.
    """
    return rig_of(str(header.get("rig", RIGS[0])), named_in=record)
