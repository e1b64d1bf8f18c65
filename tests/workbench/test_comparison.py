"""Two results side by side, and whether one is whole."""

import json

import numpy as np
import pytest

from robins.results import Outcome, Probability, ResultError
from robins.workbench import publish
from robins.workbench.compare import compare, lines, ratios, verify


def made(folder, rms, *, runs=2, text='system = "x"\n[imu]\nbias = "1 deg/h"\n', verdict="partly"):
    outcome = Outcome(
        metrics={"kf": {"rms_m": rms, "nees": 1.0}, "ekf" if runs == 2 else "ukf": {"nees": 2.0}},
        claims=[{"id": "C1", "text": "t", "verdict": verdict, "value": 1.0, "band": None}],
        scenario="x/y",
        runs=runs,
        parameters=text,
    )
    return publish(outcome, folder).path


def test_what_differs_is_told(tmp_path):
    a = made(tmp_path / "a", [1.0, 2.0])
    b = made(
        tmp_path / "b",
        [2.0, 1.0],
        runs=3,
        text='system = "x"\n[imu]\nbias = "2 deg/h"\nnoise = "1 deg/h"\n',
        verdict="not",
    )
    found = compare(a, b)
    assert found.asked == {
        "runs": (2, 3),
        "imu.bias": ("1 deg/h", "2 deg/h"),
        "imu.noise": (None, "1 deg/h"),
    }
    assert found.metrics == {"kf": {"rms_m": ([1.0, 2.0], [2.0, 1.0]), "nees": (1.0, 1.0)}}
    assert found.changed == {"kf": {"rms_m": ([1.0, 2.0], [2.0, 1.0])}}
    assert found.missing == (["ekf"], ["ukf"])
    assert found.claims == {"C1": ("partly", "not")}
    text = "\n".join(lines(found))
    assert "rms_m  [1, 2] -> [2, 1]   (2, 0.5 times)" in text
    assert "imu.noise: None -> 1 deg/h" in text
    assert text.endswith("1 of 2 metrics differ.")
    assert json.loads(json.dumps(found._asdict()))["asked"]["runs"] == [2, 3]


def test_a_result_is_equal_to_itself(tmp_path):
    a = made(tmp_path / "a", [1.0, 2.0])
    found = compare(a, a)
    assert not found.asked
    assert not found.changed
    assert lines(found) == ["x/y and x/y", "0 of 3 metrics differ."]


def test_probabilities_are_compared_by_their_shares(tmp_path):
    few, more = (Probability.among(np.arange(50) < n) for n in (10, 15))
    found = compare(made(tmp_path / "a", few), made(tmp_path / "b", more))
    text = "\n".join(lines(found))
    assert "rms_m  0.2 (0.1 to 0.34) -> 0.3 (0.18 to 0.45)   (1.5 times)" in text


def test_ratios_of_what_is_no_number_are_none():
    assert ratios((0.0, 0.0)) == [1.0]
    assert np.isnan(ratios((0.0, 1.0))).all()
    assert np.isnan(ratios((None, 1.0))).all()
    assert np.isnan(ratios((True, False))).all()
    assert np.isnan(ratios(([1.0], [1.0, 2.0]))).all()


def test_damage_is_found(tmp_path):
    a = made(tmp_path / "a", [1.0, 2.0])
    assert verify(a) == {"scenario": "x/y", "files": len(list(a.rglob("*.*"))) - 1, "whole": True}
    (a / "summary.json").write_text("{}")
    with pytest.raises(ResultError, match=r"summary\.json is damaged"):
        verify(a)
    with pytest.raises(ResultError):
        compare(a, a)
