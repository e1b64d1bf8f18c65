"""When a scenario's instruments are truly wrong, against its worlds and its text."""

import jax
import numpy as np
import pytest

from robins.systems.rocket import world as rocket
from robins.systems.satellite import study as satellite
from robins.systems.transfer_alignment.product import study as product
from robins.workbench.scenarios import read_scenario


def faults_of(name):
    """Times and faults of a scenario, which is not laid out."""
    given = read_scenario(name, ()).parameters
    if name.startswith("transfer"):
        time = 0.1 * np.arange(1, 1201)
        return time, product.faults(given, time)
    time = 0.1 * np.arange(1, 9001)
    if name.startswith("rocket"):
        return time, rocket.faults(given, time, "magnetic")
    return time, satellite.faults(given, time)


def problem(name):
    one = read_scenario(name, ())
    return one.problem((one.system.default,), 0)


def test_the_magnetometer_is_wrong_where_its_readings_are():
    """A flight with disturbances beside the same one without."""
    disturbed = problem("rocket/a1")
    one, other = (
        jax.jit(p.simulate)(0).readings["magnetic"] for p in (disturbed, problem("rocket/a8"))
    )
    differ = [
        np.abs(np.asarray(a.rad) - np.asarray(b.rad)) > 1e-9
        for a, b in zip(one, other, strict=True)
    ]
    np.testing.assert_array_equal(np.any(differ, axis=0), disturbed.faults["magnetic"])
    (contender,) = disturbed.contenders.values()
    assert set(contender.filter.suspects) == {"motion", "gyro", "magnetic"}


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("rocket/a1", {"motion": None, "magnetic": (30.0, 900.0)}),
        ("rocket/a4", {"motion": (0.1, 900.0), "magnetic": None}),
        ("satellite/s1", {"gyro": None, "star": None}),
        ("satellite/s2", {"gyro": (0.1, 900.0), "star": None}),
        ("satellite/s4", {"gyro": (0.1, 900.0), "star": None}),
        ("satellite/star-sign", {"gyro": None, "star": None}),
        ("satellite/star-stuck", {"star": (600.0, 659.9), "gyro": None}),
        ("transfer-alignment/a", {"gyros": None, "flexure": None, "mounting": None}),
        ("transfer-alignment/b", {"gyros": None, "flexure": (0.1, 120.0), "mounting": None}),
        ("transfer-alignment/c", {"gyros": (40.0, 120.0), "flexure": None, "mounting": None}),
        ("transfer-alignment/e", {"gyros": None, "flexure": None, "mounting": (0.1, 120.0)}),
    ],
)
def test_faults_are_those_of_the_text(name, wrong):
    time, found = faults_of(name)
    spans = {key: time[true][[0, -1]] if np.any(true) else None for key, true in found.items()}
    ends = {key: None if x is None else tuple(np.round(x, 6).tolist()) for key, x in spans.items()}
    assert ends == wrong


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("airship/s4", {"accelerometers": 600}),
        ("transfer-alignment/s0", {"flexure": 400, "attitude_matching": 400}),
    ],
)
def test_faults_of_a_problem_have_its_epochs_and_names_of_its_bank(name, wrong):
    of = problem(name)
    assert {key: int(np.sum(true)) for key, true in of.faults.items()} == wrong
    assert {len(true) for true in of.faults.values()} == {len(of.epoch_s)}
    (contender,) = of.contenders.values()
    assert set(contender.filter.suspects) >= set(wrong)
