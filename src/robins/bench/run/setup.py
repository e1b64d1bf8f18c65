"""The parameters of a run on the bench, with units: a scenario of the bench.

flies = "satellite/s1"        # what flies: a scenario of the satellite, or a file of one
filter = "mekf-gate"
seconds = "900 s"

[[faults]]
kind = "turned"
begin = "600 s"
end = "601 s"
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import pydantic

from robins import scenario
from robins.bench.broker.faults import LinkFault
from robins.bench.wire.schema import PARTS
from robins.errors import hint
from robins.scenario import Parameters, Quantity, ScenarioError, default
from robins.sim.rate_table import RateTable, rate_table
from robins.systems.satellite import SYSTEM
from robins.systems.satellite.parameters import AttitudeLoop
from robins.systems.satellite.study import FILTERS

Clock = Literal["lockstep", "realtime"]
NODES = PARTS[1:]
_HERE = Path(__file__).parent / "scenarios"


class Carrier(Parameters):
    """A rate table that is a little late; without one the gyro turns with the craft exactly."""

    lag: Annotated[float, Quantity("time", above="0 s")] = default("20 ms")
    rate_limit: Annotated[float, Quantity("angle rate", above="0 deg/s")] = default("100 deg/s")
    acceleration_limit: Annotated[float, Quantity("angular acceleration", above="0 rad/s^2")] = (
        default("10 rad/s^2")
    )

    def table(self) -> RateTable:
        """As the simulation has it."""
        return rate_table(self.lag, self.rate_limit, self.acceleration_limit)


class Setup(Parameters):
    """A run on the bench.

    - ``flies``: a scenario of the satellite, by its name or a path that ends in .toml; ``set``
      changes its parameters, ``"gyro.bias=5 deg/h"``.
    - ``clock``: "lockstep", as fast as it goes and always the same; "realtime", ``rate`` steps a
      second of the wall clock (left out: as many as the scenario has).
    - ``overrun``, in real time, when a step is not over at the next one's deadline: "continue"
      with the next one at once, "skip" to the deadline after, or "abort".
    - ``patience``, in real time: periods for which a step waits for a part before it goes on
      without it.
    - ``on_death``: what becomes of a run whose process dies: it "fail"s, or the process is
      "restart"ed and told again what it has forgotten, for which the run waits; in real time it
      misses deadlines. ``restarts``: how often, of all processes together; one more fails the run.
    - ``baud``: of a virtual line that each link without a real port has; left out: no delay.
    - ``ports``: parts that are boards, with their ports, ``gyro = "/dev/ttyUSB0,460800"``.
    """

    bench: Literal["satellite"] = "satellite"
    title: str = ""
    flies: str = "satellite/s1"
    set: tuple[str, ...] = ()
    filter: str = "mekf"
    seed: Annotated[int, pydantic.Field(ge=0, lt=2**63)] = 0
    seconds: Annotated[float, Quantity("time", above="0 s")] | None = None
    clock: Clock = "lockstep"
    rate: Annotated[float, Quantity("frequency", above="0 Hz")] | None = None
    overrun: Literal["continue", "skip", "abort"] = "continue"
    patience: Annotated[float, pydantic.Field(gt=0.0, le=1e6)] = 1.0
    on_death: Literal["fail", "restart"] = "fail"
    restarts: Annotated[int, pydantic.Field(ge=1, le=100_000)] = 10
    fifo: bool = False  # ask for the scheduler SCHED_FIFO
    baud: Annotated[int, pydantic.Field(ge=300, le=100_000_000)] | None = None
    table: Carrier | None = None
    ports: dict[str, str] = pydantic.Field(default_factory=dict)
    faults: tuple[LinkFault, ...] = ()

    @pydantic.model_validator(mode="after")
    def _sound(self) -> Setup:
        if unknown := sorted(set(self.ports) - set(NODES)):
            raise ValueError(f"ports: there is no part '{unknown[0]}', only {', '.join(NODES)}")
        if self.rate is not None and self.clock == "lockstep":
            raise ValueError('rate: a clock in lock-step has none; choose the clock "realtime"')
        if self.filter not in FILTERS:
            guess = f"{hint(self.filter, FILTERS)} It has {', '.join(FILTERS)}"
            raise ValueError(f"filter: no filter '{self.filter}' for the satellite{guess}")
        return self


class Flight(NamedTuple):
    """A run that has been read."""

    name: str
    setup: Setup
    loop: AttitudeLoop
    text: str  # of the scenario of the bench, for the record


def built_in() -> dict[str, Path]:
    """Scenarios of the bench that come with robins, by name."""
    return {path.stem: path for path in sorted(_HERE.glob("*.toml"))}


def read(name: str, settings: tuple[str, ...] = ()) -> Flight:
    """A run by the name of a scenario of the bench, of one of the satellite, or a file of either.

    Args:
        name: "noisy-line", "satellite/s1", "mine.toml".
        settings: changes, ``"faults.0.angle=20 deg"``; of a scenario of the satellite those of
            `Setup.set`.

    Raises:
        ScenarioError: there is none of this name, or it cannot be used.
    """
    text, own = _text(name)
    if not own:
        setup = Setup(flies=name, set=settings)
        return Flight(name, setup, _loop(setup), "")
    setup = scenario.parse(Setup, text, settings, source=name)
    title = name if name in built_in() else Path(name).stem
    return Flight(title, setup, _loop(setup), text)


def _text(name: str) -> tuple[str, bool]:
    """The text of a scenario, and whether it is one of the bench."""
    if name in (ours := built_in()):
        return ours[name].read_text("utf-8"), True
    if name.endswith(".toml"):
        text = scenario.read_text(name)
        return text, "bench" in scenario.mapping_of(text, source=name)
    theirs = [f"satellite/{k}" for k in SYSTEM.scenarios]
    if name not in theirs:
        known = [*ours, *theirs]
        guess = f"{hint(name, known)} It has {', '.join(known)}"
        raise ScenarioError([f"no scenario '{name}' for the bench{guess}"])
    return "", False


def _loop(setup: Setup) -> AttitudeLoop:
    """The satellite that flies."""
    packaged = {f"satellite/{k}": p for k, p in SYSTEM.scenarios.items()}
    if setup.flies in packaged:
        text = packaged[setup.flies].read_text("utf-8")
    elif setup.flies.endswith(".toml"):
        text = scenario.read_text(setup.flies)
    else:
        there = ", ".join(packaged)
        raise ScenarioError(
            [f"flies: no scenario '{setup.flies}'; there are {there}, or a .toml file"]
        )
    return scenario.parse(AttitudeLoop, text, setup.set, source=setup.flies)


def changed(flight: Flight, options: Mapping[str, Any]) -> Flight:
    """The same run with other options of its setup, in SI; ``ports`` are added to.

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
        setup = Setup(**{**given, **options, "ports": ports})
    except pydantic.ValidationError as error:
        told = [
            str(e["ctx"]["error"] if "ctx" in e and "error" in e["ctx"] else e["msg"])
            for e in error.errors(include_url=False)
        ]
        raise ScenarioError(told) from None
    return flight._replace(setup=setup)


def counted_from(flight: Flight, steps: int) -> int:
    """First step of which figures of merit count: as the scenario says, else the second half."""
    first = round(flight.loop.counted_from / flight.loop.step)
    return first if first < steps else steps // 2


def steps_of(flight: Flight) -> int:
    """Steps of a run.

    Raises:
        ScenarioError: longer than the scenario, or not a step long.
    """
    most = round(flight.loop.duration / flight.loop.step)
    if flight.setup.seconds is None:
        return most
    steps = round(flight.setup.seconds / flight.loop.step)
    if not 1 <= steps <= most:
        raise ScenarioError(
            [
                f"seconds: {flight.setup.seconds:g} s is not from a step ({flight.loop.step:g} s) "
                f"to the end of the scenario ({flight.loop.duration:g} s); "
                "set its duration to make that longer"
            ]
        )
    return steps


def recorded_flight(header: Mapping[str, Any], filter_: str | None = None) -> Flight:
    """The run of a record, from its header; or the same with another filter.

    Raises:
        ScenarioError: the header is of another version of robins.
    """
    try:
        # JSON has lists where parameters have tuples.
        setup = Setup.model_validate(header["setup"], strict=False)
        loop = AttitudeLoop.model_validate(header["loop"], strict=False)
    except (KeyError, TypeError, pydantic.ValidationError) as error:
        raise ScenarioError(
            [f"the record was made by another version of robins ({header.get('robins')}): {error}"]
        ) from None
    flight = Flight(str(header["name"]), setup, loop, "")
    return flight if filter_ is None else changed(flight, {"filter": filter_})
