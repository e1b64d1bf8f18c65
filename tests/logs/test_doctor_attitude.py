"""The doctor on attitudes: every convention that is not the one stated is told by its name."""

import dataclasses

import numpy as np
import pytest
from made_nine_axis import tumble_dataset

from robins.logs import Mounting, examine, load_dataset
from robins.logs.mounting import turned

TRIALS = ("broad_15_undisturbed_fast_translation_A", "broad_24_disturbed_tapping_A")
ORDERS = {
    "scalar last (x, y, z, w): put the last column first": lambda q: q[:, [1, 2, 3, 0]],
    "navigation to body: turn the sign of x, y and z": lambda q: q * [1, -1, -1, -1],
    "scalar last and navigation to body: put": lambda q: q[:, [1, 2, 3, 0]] * [-1, -1, -1, 1],
}


@pytest.fixture(scope="module", params=["made", *TRIALS])
def data(request):
    """One that is made, and two as they were recorded."""
    if request.param == "made":
        return tumble_dataset()
    return load_dataset([request.getfixturevalue("data_dir") / f"{request.param}.npz"])


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


@pytest.mark.parametrize("words", ORDERS)
def test_orders_and_senses(data, words):
    (f,) = about_attitude(data, q_nb=ORDERS[words](data.attitude.q_nb))
    assert (f.severity, f.code) == ("error", "attitude_order")
    assert words in f.sentence
    assert f.sentence.endswith(".")
    assert "(attitude): the attitudes do not turn as the gyros say" in f.sentence


def test_a_body_with_other_axes(data):
    """Attitudes of a body whose x is the sensor's y, and y its -x."""
    body = turned(data.attitude, Mounting(0.0, 0.0, 90.0))
    (f,) = about_attitude(data, q_nb=body.q_nb)
    assert (f.severity, f.code) == ("error", "attitude_axes")
    assert "with the gyros (gyro_y, -gyro_x, gyro_z)" in f.sentence


def test_the_other_navigation_frame(data):
    (f,) = about_attitude(data, nav="NED")
    assert (f.severity, f.code) == ("error", "attitude_frame")
    assert "where NED has up at (0, 0, -1). The attitudes are probably to ENU." in f.sentence


def test_a_frame_that_does_not_stand_upright(data):
    """Cameras calibrated to a wall: a quarter turn about north of all that is seen."""
    w, x, y, z = data.attitude.q_nb.T
    tipped = np.sqrt(0.5) * np.stack([w - y, x + z, y + w, z - x], axis=1)  # (1, 0, 1, 0) times
    (f,) = about_attitude(data, q_nb=tipped)
    assert (f.severity, f.code) == ("error", "attitude_frame")
    assert "points along (+1.00, " in f.sentence
    assert "The frame they refer to does not stand upright" in f.sentence


def test_attitudes_of_another_recording(data):
    (f,) = about_attitude(data, q_nb=data.attitude.q_nb[::-1])
    assert (f.severity, f.code) == ("warning", "attitude_disagrees")


def test_without_attitudes_or_turning_nothing_is_claimed(data):
    (f,) = about_attitude(data, q_nb=np.nan * data.attitude.q_nb)
    assert (f.severity, f.code) == ("warning", "attitude_missing")
    few = data.attitude.q_nb.copy()
    few[np.flatnonzero(~np.isnan(few[:, 0]))[300:]] = np.nan
    assert about_attitude(data, q_nb=few) == []
    (g,) = about_attitude(data, q_nb=np.zeros_like(few))
    assert g == f
