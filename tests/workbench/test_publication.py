"""From an outcome to a folder: held before, whole or not there after, and its numbers not lost."""

import sys

import numpy as np
import pytest
import xarray as xr

from robins import report, results, workbench
from robins.results import Outcome, array, variable


@pytest.fixture(autouse=True)
def no_figures(monkeypatch):
    monkeypatch.setattr(report, "add", lambda writer, *_: writer.save_report("<p>"))


def an_outcome(seed=0, **more):
    time = variable("time", np.arange(3.0), "s", "time since the start")
    solution = xr.Dataset(array("outage", np.array([0, 1, 0])), {"time": time})
    return Outcome(solution, {"kf": {"rms_m": 0.5}}, scenario="a", seed=seed, **more)


@pytest.mark.usefixtures("sketched")
def test_the_folder_holds_all_of_an_outcome(tmp_path):
    (tmp_path / "record").write_bytes(b"heard")
    outcome = an_outcome(
        seed=3,
        claims=[{"id": "C", "text": "t", "verdict": "not", "value": 1.0, "band": [0.0, 0.5]}],
        counts={"imu_nan": 2},
        files={"a.csv": b"1,2\n", "b.bin": tmp_path / "record"},
        warnings=["Doubt it."],
        parameters="x = 1\n",
        device="abacus",
        runs=7,
    )
    result = workbench.publish(outcome, tmp_path / "out", command="robins x")
    assert {k: result.summary[k] for k in outcome.summary} == outcome.summary
    assert result.manifest["scenario"]["text"] == "x = 1\n"
    assert (result.manifest["device"], result.manifest["command"]) == ("abacus", "robins x")
    np.testing.assert_array_equal(result.solution["outage"], [0, 1, 0])
    assert (result.path / "a.csv").read_bytes() == b"1,2\n"
    assert (result.path / "b.bin").read_bytes() == b"heard"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]  # the record was moved in


@pytest.mark.usefixtures("sketched")
def test_an_outcome_without_arrays_is_one(tmp_path):
    result = workbench.publish(Outcome(scenario="a"), tmp_path / "out")
    assert (result.solution, result.summary["filters"]) == (None, {})


def test_a_folder_is_refused_before_anything_is_computed(tmp_path):
    (tmp_path / "out").write_text("a thesis")
    with (
        pytest.raises(results.ResultError, match="is a file, not a folder"),
        workbench.publishing(tmp_path / "out"),
    ):
        pytest.fail("it would have been computed in vain")
    assert (tmp_path / "out").read_text() == "a thesis"


@pytest.mark.parametrize("error", [None, KeyError("x"), KeyboardInterrupt()])
@pytest.mark.usefixtures("sketched")
def test_without_an_outcome_the_earlier_result_stays(tmp_path, error):
    workbench.publish(an_outcome(seed=1), tmp_path / "out")
    caught = None
    try:
        with workbench.publishing(tmp_path / "out"):
            if error is not None:
                raise error
    except (KeyError, KeyboardInterrupt) as other:
        caught = other
    assert caught is error
    assert results.read(tmp_path / "out").summary["seed"] == 1
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("where", ["figures", "commit"])
@pytest.mark.usefixtures("sketched")
def test_numbers_that_cannot_be_written_are_kept(tmp_path, monkeypatch, where):
    def fail(*_):
        raise OSError(28, "No space left on device")

    workbench.publish(an_outcome(seed=1), tmp_path / "out")
    if where == "figures":
        monkeypatch.setattr(report, "add", fail)
    else:
        monkeypatch.setattr(results.folder, "commit", fail)
    with pytest.raises(results.NotWritten, match="No space left on device") as told:
        workbench.publish(an_outcome(seed=2), tmp_path / "out")
    (kept,) = tmp_path.glob("out-not-written-*")
    assert str(kept / "arrays.npz") in str(told.value)
    with np.load(kept / "arrays.npz") as arrays:
        np.testing.assert_array_equal(arrays["solution.outage"], [0, 1, 0])
        assert arrays["metrics.kf.rms_m"] == 0.5
    assert results.read(tmp_path / "out").summary["seed"] == 1


def test_every_function_is_where_it_is_said_to_be():
    for name in workbench.__all__:
        found = getattr(workbench, name)
        assert found.__name__ == name
        assert found.__doc__
    with pytest.raises(AttributeError, match="no attribute 'rnu'"):
        workbench.rnu  # noqa: B018


def test_a_file_takes_no_function_of_its_name_away():
    """Import of a file sets the attribute of its package, as here."""
    function = workbench.compare
    workbench.compare = sys.modules["robins.workbench.compare"]
    assert workbench.compare is function
