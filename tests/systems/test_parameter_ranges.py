"""Every number of every parameter class is refused beyond its range, with its path (F30)."""

import importlib
import math
import pkgutil
from typing import Annotated, get_args, get_origin

import annotated_types
import pytest
from pydantic.fields import FieldInfo

import robins.systems
from robins import scenario, units
from robins.bench.run import setup
from robins.scenario import Parameters, Quantity, ScenarioError
from robins.systems import SYSTEMS
from robins.systems.parts import motion_of
from robins.systems.transfer_alignment.product.world import motion_of as pair_motion_of

DRIVE = SYSTEMS["ins-gnss"].scenarios["drive"]


def parameter_classes(base=Parameters):
    for found in pkgutil.walk_packages(robins.systems.__path__, "robins.systems."):
        importlib.import_module(found.name)
    assert setup.Setup in Parameters.__subclasses__()
    known, waiting = {}, [base]
    while waiting:
        for cls in waiting.pop().__subclasses__():
            waiting.append(cls)
            if cls.__module__.startswith("robins."):
                known[f"{cls.__module__}.{cls.__qualname__}"] = cls
    return known


def leaves(annotation, marks=(), wrap=lambda value: value, path=""):
    """The numbers within an annotation: path, marks, and how a value for all of it is written."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        yield from leaves(inner[0], (*marks, *inner[1:]), wrap, path)
    elif annotation in (float, int):
        yield path, annotation, marks, wrap
    elif origin is tuple and any(isinstance(mark, Quantity) for mark in marks):
        count = 1 if Ellipsis in inner else len(inner)
        yield (
            path + ".0" * (count == 1),
            float,
            marks,
            (lambda v: wrap([v])) if count == 1 else wrap,
        )
    elif origin is tuple:
        count = 1 if Ellipsis in inner else len(inner)
        yield from leaves(inner[0], (), lambda v: wrap([v] * count), path + ".0")
    elif origin is dict:
        yield from leaves(inner[1], (), lambda v: wrap({"key": v}), path + ".key")
    else:  # a choice; a class is walked by itself
        for one in inner:
            if one is not type(None) and get_origin(annotation) is not None:
                yield from leaves(one, marks, wrap, path)


NUMBERS = [
    (cls, name + path, kind, marks, wrap)
    for cls in parameter_classes().values()
    for name, info in cls.model_fields.items()
    if isinstance(info, FieldInfo)
    for path, kind, marks, wrap in leaves(info.annotation, tuple(info.metadata))
]


def absurd(kind, marks):
    """Values that no such number may have."""
    (quantity,) = [m for m in marks if isinstance(m, Quantity)] or [None]
    if quantity is None:
        yield from ([10**30, -(10**30)] if kind is int else [1e300, -1e300])
        yield from (math.nan, math.inf, -math.inf)
        marks = [one for m in marks for one in (m if hasattr(m, "__iter__") else [m])]
        for bound in marks:
            step = 1 if kind is int else 1e-9
            if isinstance(bound, annotated_types.Le | annotated_types.Lt):
                most = bound.le if isinstance(bound, annotated_types.Le) else bound.lt
                yield most + step * max(1, abs(most))
            if isinstance(bound, annotated_types.Ge | annotated_types.Gt):
                least = bound.ge if isinstance(bound, annotated_types.Ge) else bound.gt
                yield least - step * max(1, abs(least))
        return
    unit = units.KINDS[quantity.kind][0]
    yield from (f"{size} {unit}" for size in ("1e300", "-1e300", "nan", "inf", "-inf"))
    for bound, way in (
        (quantity.least, -1), (quantity.above, -1), (quantity.most, 1), (quantity.below, 1),
    ):  # fmt: skip
        if bound is not None:
            si = units.parse(bound, quantity.kind)
            yield f"{si + way * max(1e-9 * abs(si), 1e-15)!r} {unit}"


def test_the_walk_finds_what_there_is():
    paths = {f"{cls.__name__}.{path}" for cls, path, *_ in NUMBERS}
    assert paths >= {
        "Drive.settle", "InsGnssImu.gyro_noise", "InsGnssStart.tilt", "Gnss.sigma_factor.key",
        "Scenario.runs", "MargMagnetometer.matrix.0.0", "ReactionWheels.axes.0.0",
        "ReactionWheels.lost.0", "HInfinityRequirements.gamma", "InsGnssImu.gyro_bias_time",
        "Departure.height", "Span.begin", "Setup.patience", "LinkFault.bits",
    }  # fmt: skip
    assert len(NUMBERS) > 300


def test_every_number_is_refused_beyond_its_range_with_its_path():
    let_in = []
    for cls, path, kind, marks, wrap in NUMBERS:
        name = path.split(".")[0]
        for value in absurd(kind, marks):
            try:
                scenario.validate(cls, {name: wrap(value)})
                faults = []
            except ScenarioError as error:
                faults = error.faults
            told = [fault for fault in faults if fault.startswith(f"{path} = ")]
            if len(told) != 1 or "\n" in told[0]:
                let_in.append(f"{cls.__name__}.{path} = {value!r}: {faults}")
    assert not let_in, "\n".join(let_in[:20])


@pytest.mark.parametrize(
    ("setting", "line"),
    [
        ("settle=1e6 s", "settle = 1e+06 s leaves nothing to count of a run of "),
        ("filters=[]", "filters = []: should hold 1 or more"),
        ("legs=[]", "legs = []: should hold 1 or more"),
        ("gnss.rate=1e9 Hz", 'gnss.rate = "1e9 Hz": must be at most 1 kHz and above 0 Hz'),
        ("imu_rate=100 kHz", "imu_rate: at 100000 Hz a run of "),
        ("update.longest_block=1 us", "update.longest_block: at 1e+06 Hz a run of "),
        ("place.height=1e9 m", 'place.height = "1e9 m": must be at most 100 km and at least -1 km'),
        ("start.tilt=1e9 deg", 'start.tilt = "1e9 deg": must be at most 180 deg and above 0 deg'),
        (
            "runs=100000000000000000000",
            "runs = 100000000000000000000: should be less than or equal",
        ),
    ],
)
def test_what_cannot_be_simulated_is_refused_when_it_is_read(setting, line):
    drive = SYSTEMS["ins-gnss"].studies["drive"].parameters
    with pytest.raises(ScenarioError) as caught:
        scenario.load(drive, DRIVE, [setting])
    (fault,) = caught.value.faults
    assert fault.startswith(f"{DRIVE}: {line}")


def packaged():
    for system in SYSTEMS.values():
        for name, path in system.scenarios.items():
            mapping = scenario.mapping_of(scenario.read_text(path))
            study = mapping.get("study", next(iter(system.studies)))
            yield pytest.param(system.studies[study].parameters, path, id=name)


@pytest.mark.parametrize(("parameters", "path"), list(packaged()))
def test_packaged_scenarios_are_within_and_none_may_last_a_year(parameters, path):
    given = scenario.load(parameters, path)
    assert 1 <= given.runs < 1000
    # what the legs are said to last is what their motion does
    if hasattr(given, "legs"):
        lasts = sum(leg.lasts_s for leg in given.legs)
        assert motion_of(given.place, given.legs).duration_s == pytest.approx(lasts, rel=1e-12)
    elif hasattr(given, "slave") and hasattr(given.manoeuvre, "kind"):
        lasts = given.manoeuvre.lasts_s
        assert pair_motion_of(given.manoeuvre).duration_s == pytest.approx(lasts, rel=1e-9)
    legs = getattr(given, "manoeuvre", given)
    key = "manoeuvre." if hasattr(given, "manoeuvre") else ""
    key += next((k for k in ("duration", "seconds") if hasattr(legs, k)), "legs.0.seconds")
    with pytest.raises(ScenarioError, match=r"samples, of which 1e\+07 fit at most"):
        scenario.load(parameters, path, [f"{key}=365 d"])
