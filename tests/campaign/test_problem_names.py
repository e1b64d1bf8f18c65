"""Names that clash are refused when a problem is made; numbers that cannot be written are kept."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

from robins import results
from robins.campaign import simulate
from robins.filters import Belief, Model, Motion, Sensor, kalman
from robins.systems.study import Case, Contender, Limit, Output, Problem, SensorAxes, StateBlock

XV = ("x", "v")


def contender(dim=1, sensor="y"):
    sensors = (Sensor(lambda x, a: x[:dim], jnp.ones(dim), dim, sensor),)
    return Contender(kalman(), Model(Motion(lambda x, u: x, jnp.ones(2)), sensors))


def a_problem(**changes):
    start = Belief(jnp.zeros(2), jnp.eye(2))
    case = Case(start, None, {"y": jnp.ones((4, 1))}, {}, jnp.zeros((4, 2)))
    given = {
        "simulate": lambda index: case._replace(y={"y": jnp.ones((4, 1)) * index.astype(float)}),
        "contenders": {"kf": contender()},
        "epoch_s": np.arange(4.0),
        "blocks": (StateBlock("line", slice(0, 2), "m", "m", "E", XV),),
        "sensors": {"y": SensorAxes("m", "E", ("x",))},
        "context": xr.Dataset(),
        "metrics": lambda s: {"rms_m": 1.0},
        "claims": lambda m: [],
    }
    return Problem(**{**given, **changes})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensors": {"line": SensorAxes("m", "E", ("x",))}}, "line: names a sensor and a block"),
        ({"outputs": (Output("line", "m", "m", "E", XV, ""),)}, "line: names a output and a block"),
        ({"context": xr.Dataset(coords={"axis_y": ["x"]})}, "y: names a context and a sensor"),
        ({"limits": (Limit("1_m", "lines", 1.0),)}, "limit 1_m: there is no block 'lines'"),
        (
            {"contenders": {"kf": contender(sensor="z")}},
            "filter 'kf' has a sensor 'z' whose axes nobody declares; declared are y",
        ),
        (
            {"contenders": {"kf": contender(), "wide": contender(dim=2)}},
            "filter 'wide': sensor 'y' has 2 components and 1 declared axes",
        ),
    ],
)
def test_names_that_do_not_fit_are_refused_at_once(changes, message):
    with pytest.raises(ValueError, match=message):
        a_problem(**changes)


def failing(statistics):
    raise KeyError("a metric that a study forgot")


def test_statistics_that_nothing_can_be_made_of_are_kept(tmp_path):
    with pytest.raises(results.NotWritten, match="numbers are kept in") as error:  # noqa: SIM117
        with results.rescued(tmp_path / "out"):
            simulate(a_problem(metrics=failing), 3)
    (kept,) = tmp_path.iterdir()
    assert str(kept / "arrays.npz") in str(error.value)
    assert "a metric that a study forgot" in str(error.value)
    with np.load(kept / "arrays.npz") as found:
        rms = np.sqrt(found["kf.sums.square"] / found["kf.runs"])
    whole = simulate(a_problem(), 3).solution
    np.testing.assert_array_equal(rms, whole["rms_line"][0])


def test_a_disk_that_takes_nothing_is_told_as_it_is(tmp_path, monkeypatch):
    monkeypatch.setattr(np, "savez", lambda *a, **k: (_ for _ in ()).throw(OSError("disk full")))
    kept = {"a": np.ones(2)}
    with pytest.raises(KeyError), results.rescued(tmp_path / "out"), results.keep_on_error(kept):
        raise KeyError("first")


def test_an_interrupt_takes_along_what_was_computed(tmp_path):
    kept = {"a": np.ones(2)}
    with pytest.raises(KeyboardInterrupt) as stop:  # noqa: SIM117
        with results.rescued(tmp_path / "out"), results.keep_on_error(kept):
            raise KeyboardInterrupt
    (found,) = tmp_path.rglob("arrays.npz")
    assert str(found) in "".join(stop.value.__notes__)


def test_what_fails_before_anything_is_computed_fails_as_it_is(tmp_path):
    with pytest.raises(KeyError), results.rescued(tmp_path / "out"):
        raise KeyError("early")
    assert not list(tmp_path.iterdir())


def test_only_a_gain_that_is_not_held_is_doubted_for_the_order_of_innovations():
    y, held = {"y": 5.0 * jnp.arange(60.0)[:, None]}, replace(contender(), lasting=True)
    case = Case(Belief(jnp.zeros(2), jnp.eye(2)), None, y, {}, jnp.zeros((60, 2)))
    given = {"contenders": {"kf": contender(), "held": held}, "epoch_s": np.arange(60.0)}
    problem = a_problem(simulate=lambda index: case, **given)
    said = simulate(problem, 1).warnings
    assert any(one.startswith("kf: ") and "on one side" in one for one in said)
    assert any(one.startswith("held: ") and "mean NIS" in one for one in said)
    assert not any(one.startswith("held: ") and "on one side" in one for one in said)
