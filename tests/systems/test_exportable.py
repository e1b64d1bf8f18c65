"""Laws of what `robins export` writes, over filters of all studies: nothing is compiled."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from exported import primitives

import robins.program.primitives  # noqa: F401
from robins import manifold
from robins.campaign.monte_carlo import run_case
from robins.export.field_notes import MEAN, field_notes, tangent_axes, tangent_fields
from robins.export.runs import entry_functions, reset_function
from robins.filters import Belief
from robins.program.walk import RULES
from robins.systems import SYSTEMS
from robins.systems.catalogue import SUMMARIES
from robins.workbench.scenarios import read_scenario

# Of each study one whose state differs from the others'; and two that are filters of filters.
SOME = [
    ("airship/s1", "centralised-errors"),
    ("gnss/city", "ekf"),
    ("ins-gnss/drive", "ekf"),
    ("rocket/a1", "federated-scalar-ukf"),
    ("rocket/a1", "federated-vector-stukf"),
    ("rocket/b1", "gate-scale-factor"),
    ("satellite/s1", "mekf"),
    ("transfer-alignment/aircraft", "product"),
]


def one_of_each_study():
    found = {}
    for system in SUMMARIES:
        for name in SYSTEMS[system].scenarios:
            study = read_scenario(f"{system}/{name}", ()).study
            found.setdefault(id(study), (f"{system}/{name}", study))
    return list(found.values())


class Given:
    """A filter of a scenario, a state that is there, and shapes of what it is given in a step."""

    def __init__(self, name, filter_):
        self.problem = read_scenario(name, ("runs=1",)).problem((filter_,), 0)
        self.contender = c = self.problem.contenders[filter_]

        def given(run):
            case = c.case(self.problem.simulate(run))
            if case.loop is not None:
                case = run_case(c.filter, c.model, case, lambda step: ())[1]
            return case.start, case.rows, case.u, dict(case.y), dict(case.aux)

        start, turning, *rows = jax.eval_shape(given, jnp.asarray(0))
        self.reported = c.reported if turning is None else np.zeros(turning.shape)
        # Halves are a quaternion of length one, and a latitude.
        start = jax.tree.map(lambda x: jnp.full(x.shape, 0.5, x.dtype), start)
        self.state = c.filter.init(start, c.model.dims) if isinstance(start, Belief) else start
        u, y, aux = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), rows)
        self.rows = {"predict": (u,)}
        for sensor in c.model.sensors:
            if sensor.name in y:
                self.rows[f"update_{sensor.name}"] = y[sensor.name], aux.get(sensor.name)


def without_a_rule(given):
    """Primitives of the entry points that cannot be exported."""
    c = given.contender
    functions = entry_functions(c.filter, c.model, given.rows)
    calls = [(function, given.rows[name]) for name, function in functions.items()]
    calls.append((reset_function(c.filter, given.state), (given.state.belief,)))
    found = set()
    for function, row in calls:
        found |= set(primitives(jax.make_jaxpr(function)(given.state, *row).jaxpr))
    return found - set(RULES)


def of_another_kind(point, places, notes, struct, units):
    """Fields of a point whose units are not those in which its numbers move with its error.

    The error is in `units`, one a component; None where that is not known.
    """
    n, wrong = manifold.dim(point), []
    moved = jax.jacfwd(lambda d: jax.tree.leaves(manifold.retract(point, d)))(jnp.zeros(n))
    for (name, first, end, own), slope in zip(places, moved, strict=True):
        note, slope = notes.get((struct, name)), np.asarray(slope).reshape(-1, n)
        if note is None or "unit quaternion" in note:
            continue
        if own is None:  # in the units and the axes of the error
            right = np.array_equal(slope[:, first:end], np.eye(end - first))
        else:
            here = {units[k] for k in range(first, end)}
            one = np.allclose(np.sum(np.abs(slope), axis=1), 1.0, rtol=1e-12)
            said = re.split("[,:]", note)[0]
            right = None in here or said.startswith("errors") or (said in here) == one
        wrong += [] if right else [(struct, name, note)]
    return wrong


def undeclared(given):
    """Fields of another unit than is declared, of the mean and of the readings."""
    problem, mean = given.problem, given.state.belief.mean
    axes = tangent_axes(problem, given.reported, manifold.dim(mean))
    readings = jax.tree.map(lambda x: np.full(x.shape, 0.5, x.dtype), given.rows)
    notes = field_notes(problem, axes, given.state, readings)
    units = [axis and axis[1].partition("]")[0][1:] for axis in axes]
    wrong = of_another_kind(mean, tangent_fields(mean, MEAN), notes, "state", units)
    for entry, (reading, *_) in readings.items():
        if entry != "predict":
            sensor = problem.sensors[entry.removeprefix("update_")]
            units = [axis.partition("[")[2].rstrip("]") or sensor.units for axis in sensor.axes]
            places = tangent_fields(reading, "")
            wrong += of_another_kind(reading, places, notes, f"{entry}_reading", units)
    return wrong


@pytest.mark.parametrize(("name", "filter_"), SOME)
def test_a_filter_has_a_place_in_c_and_its_fields_their_units(name, filter_):
    given = Given(name, filter_)
    assert without_a_rule(given) == set()
    assert undeclared(given) == []


@pytest.mark.filterwarnings("ignore:feedback='full' gives every local filter")  # one is such
def test_every_filter_of_every_study_has():
    wrong = {}
    for name, study in one_of_each_study():
        # A smoother runs the filter that it is named after.
        for filter_ in (f for f in study.filters if not f.endswith("+rts")):
            problem = read_scenario(name, ("runs=1",)).problem((filter_,), 0)
            if problem.contenders[filter_].on_host:
                continue
            given = Given(name, filter_)
            wrong[name, filter_] = without_a_rule(given), undeclared(given)
    assert not {which: found for which, found in wrong.items() if any(found)}
