"""The doctor on attitudes as they were recorded: every convention but the one stated is told."""

import dataclasses

import numpy as np
import pytest
from test_findings import ROWS

from robins.logs import Mounting, examine, load_dataset
from robins.logs.mounting import turned

TRIALS = ("broad_15_undisturbed_fast_translation_A", "broad_24_disturbed_tapping_A")


@pytest.fixture(scope="module", params=TRIALS)
def data(request, data_dir):
    """Two as they were recorded; one that is made is in `test_findings`."""
    return load_dataset([data_dir / f"{request.param}.npz"])


def about_attitude(data, **columns):
    attitude = dataclasses.replace(data.attitude, **columns)
    found = examine(dataclasses.replace(data, attitude=attitude))
    return [f for f in found if f.code.startswith("attitude")]


def test_what_is_right_is_not_spoken_of(data):
    assert about_attitude(data) == []
    # A quaternion and its negative are one attitude, in any mixture.
    sign = np.where(np.arange(len(data.attitude)) % 3, 1.0, -1.0)[:, None]
    assert about_attitude(data, q_nb=sign * data.attitude.q_nb) == []
    other = turned(data, Mounting(90.0, 0.0, -90.0))
    assert about_attitude(other) == []


@pytest.mark.parametrize(
    "row", [row for row in ROWS if row.check == "check_attitude"], ids=lambda row: row.code
)
def test_what_is_wrong_is_told_of_each(data, row):
    (f,) = [f for f in examine(row.log(data)) if f.code.startswith("attitude")]
    assert (f.severity, f.code) == (row.severity, row.code)
    words = row.says.partition(": ")[2]
    assert all(part in f.sentence for part in words.split(" ... "))


def test_without_attitudes_or_turning_nothing_is_claimed(data):
    few = data.attitude.q_nb.copy()
    few[np.flatnonzero(~np.isnan(few[:, 0]))[300:]] = np.nan
    assert about_attitude(data, q_nb=few) == []
    (f,) = about_attitude(data, q_nb=np.zeros_like(few))
    assert f.code == "attitude_missing"
