"""The bound of a problem against its Kalman filter, on a problem small enough to know by heart."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from jaxtyping import Array

from robins.campaign.bound import bound, bound_sigma
from robins.campaign.monte_carlo import complete_case
from robins.filters import Belief, Model, Motion, Sensor, kalman, run
from robins.manifold import Angle
from robins.results import solution as stored
from robins.rotation import Rotation
from robins.systems.study import Case, Contender, Problem, SensorAxes, StateBlock

STEPS = 30
F = jnp.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
MODEL = Model(
    Motion(lambda x, u: F @ x, jnp.array([0.02, 0.03, 0.0])),
    (
        Sensor(lambda x, a: x[:1], jnp.array([0.4]), 1, "fix"),
        Sensor(lambda x, a: x[1:2] ** 2 / 2.0, jnp.array([0.3]), 1, "energy"),
        Sensor(lambda x, a: x[2:], jnp.array([0.3]), 1, "broken"),
    ),
)
START = Belief(jnp.zeros(3), jnp.diag(jnp.array([2.0, 1.0, 5.0])))
TURNED = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])


def simulate(index):
    """Run 0 stands still, so that its energy tells nothing; run 1 moves."""
    x0 = jnp.stack([jnp.zeros(()), index.astype(float), jnp.zeros(())])
    _, truth = jax.lax.scan(lambda x, _: (F @ x, F @ x), x0, None, STEPS)
    y = {k: jnp.zeros((STEPS, 1)) for k in ("fix", "energy")}
    y["broken"] = jnp.full((STEPS, 1), jnp.nan)
    return Case(START, None, y, {}, truth)


@pytest.fixture(scope="module")
def problem():
    blocks = (
        StateBlock("speed", slice(0, 1), "m/s", "km/h", "W", ("west",)),
        StateBlock("place", slice(1, 2), "m", "m", "E", ("east",)),
    )
    return Problem(
        simulate=simulate,
        contenders={"kf": Contender(kalman(), MODEL, reported=TURNED)},
        epoch_s=np.arange(1.0, STEPS + 1),
        blocks=blocks,
        sensors={k: SensorAxes("m", "E", ("east",)) for k in ("fix", "energy", "broken", "y")},
        context=xr.Dataset(),
        metrics=lambda s: {},
        claims=lambda m: [],
    )


@pytest.fixture(scope="module")
def found(problem):
    return bound(problem, "kf")


def test_what_stands_still_is_bounded_by_the_kalman_filter(found):
    y = {"fix": np.zeros((STEPS, 1))}
    sigma = run(kalman(), MODEL, START, y, aux=None, u=np.zeros(STEPS)).sigma
    np.testing.assert_allclose(found.bound_speed[:, 0], sigma[:, 1], rtol=1e-12)
    np.testing.assert_allclose(found.bound_place[:, 0], sigma[:, 0], rtol=1e-12)
    assert found.bound_prior_speed.item() == 1.0
    assert found.bound_prior_place.item() == 2.0


def test_a_sensor_that_is_left_out_tells_nothing(found):
    assert list(found.sensor.values) == ["fix", "energy"]  # the third never spoke
    without = found.bound_without_place.sel(sensor="fix")
    np.testing.assert_allclose(without, found.bound_unaided_place, rtol=1e-14)
    t = found.time.values
    walk = 0.5**2 * 0.03**2 * (t - 1) * t * (2 * t - 1) / 6
    want = np.sqrt(2.0**2 + (0.5 * t) ** 2 + 0.02**2 * t + walk)
    np.testing.assert_allclose(found.bound_unaided_place[:, 0], want, rtol=1e-12)
    np.testing.assert_allclose(
        found.bound_without_place.sel(sensor="energy"), found.bound_place, rtol=1e-12
    )


def test_variances_are_averaged_over_the_runs(problem, found):
    both = bound(problem, "kf", runs=2)
    other = bound(replace(problem, simulate=lambda i: simulate(i + 1)), "kf")
    assert other.bound_speed[-1, 0] < 0.9 * found.bound_speed[-1, 0]
    mean = np.sqrt((found.bound_speed**2 + other.bound_speed**2) / 2.0)
    np.testing.assert_allclose(both.bound_speed, mean, rtol=1e-12)


def test_states_and_directions_are_named_by_what_reports_them(found):
    assert list(found.state.values) == ["place east", "speed west", "state 3"]
    assert found.direction.values[0] == "1: 100 % state 3"
    assert int(found.gramian_rank) == 2
    assert abs(found.gramian.values[0]) < 1e-13
    # A place to the east and a speed to the west make up for each other in what is measured.
    assert " with " in found.direction.values[1]
    assert np.all(found.information[2] < 1e-13)
    np.testing.assert_allclose(
        2.0 ** -found.information[:2, -1],
        [found.bound_left_place.item(), found.bound_left_speed.item()],
        rtol=1e-12,
    )


class Ship(NamedTuple):
    attitude: Rotation
    wind_error: Array
    rest: dict


def test_states_that_nothing_reports_are_named_by_their_fields(problem):
    state = Ship(Rotation.identity(), jnp.zeros(2), {"drift": Angle(jnp.zeros(()))})
    start = Belief(state, jnp.eye(6))
    still = Motion(lambda x, u: x, jnp.zeros(6))
    course = Sensor(lambda x, a: x.wind_error[:1] - x.rest["drift"].local(Angle(0.0)), [1.0], 1)
    truth = jax.tree_util.tree_map(lambda x: jnp.broadcast_to(x, (STEPS, *x.shape)), state)
    case = Case(start, None, {"y": jnp.zeros((STEPS, 1))}, {}, truth)
    turned = np.eye(6)[:2]
    ship = replace(
        problem,
        simulate=lambda i: case,
        contenders={"kf": Contender(kalman(), Model(still, (course,)), reported=turned)},
    )
    found = bound(ship, "kf")
    assert list(found.state.values) == [
        *("speed west", "place east", "attitude 3", "wind error 1", "wind error 2", "drift")
    ]
    assert int(found.gramian_rank) == 1
    assert "50 % wind error 1 against 50 % drift" in [d[3:] for d in found.direction.values]
    assert found.bound_left_speed.item() == pytest.approx(1.0, abs=1e-13)  # nothing tells of it


def test_the_dataset_can_be_stored(found):
    stored.check(found)
    assert stored.pack(found)


def test_bad_input_is_named(problem):
    with pytest.raises(ValueError, match=r"no filter 'ukf'; this problem has \['kf'\]"):
        bound(problem, "ukf")
    with pytest.raises(ValueError, match=r"'kf' has no sensor 'sonar'; this model has \['broken'"):
        bound(problem, "kf", without=["sonar"])
    with pytest.raises(ValueError, match="no sensor of filter 'kf' is left that measures"):
        bound(problem, "kf", without=["fix", "energy"])


def test_a_model_that_does_not_hold_along_the_truth_is_named(problem):
    nowhere = jnp.full((STEPS, 3), jnp.nan)
    broken = replace(problem, simulate=lambda i: simulate(i)._replace(truth=nowhere))
    with pytest.raises(ValueError, match="cannot be linearised along the true states"):
        bound(broken, "kf")


@pytest.mark.parametrize("run", [0, 1])
def test_the_bound_of_a_report_is_that_of_jax(problem, run):
    world = simulate(jnp.asarray(run))
    found, wanted = (bound_sigma(problem, "kf", world, machine) for machine in ("vm", "jax"))
    np.testing.assert_allclose(found, wanted, rtol=1e-13)
    assert found.shape == (STEPS, 2)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"y": {"fax": jnp.zeros((STEPS, 1))}}, "no sensor"),
        ({"u": jnp.zeros(STEPS - 1)}, "one length"),
    ],
)
def test_a_case_that_no_run_takes_is_refused(problem, change, says):
    case = simulate(jnp.asarray(0))._replace(**change)
    with pytest.raises(ValueError, match=says):
        complete_case(problem.contenders["kf"].filter, MODEL, case)
