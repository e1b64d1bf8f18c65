"""When a scenario's instruments are truly wrong, against its worlds and its text."""

import jax
import numpy as np
import pytest

from robins.workbench.scenarios import beside, read_scenario


def problem(name, *settings):
    one = read_scenario(name, settings)
    return one.problem((one.system.default,), 0)


def begins_and_ends(of, name):
    """First and last time at which something is wrong; nothing where it never is."""
    found = of.epoch_s[of.faults[name]]
    return (round(float(found[0]), 6), round(float(found[-1]), 6)) if len(found) else None


@pytest.mark.parametrize("length_s", [0.1, 1.0])
def test_the_magnetometer_is_wrong_where_its_readings_are(length_s):
    """A flight with disturbances beside the same one without."""
    disturbed = problem("rocket/a1", f'magnetometer.disturbance.length="{length_s} s"')
    one, other = (
        jax.jit(p.simulate)(0).readings["magnetic"] for p in (disturbed, problem("rocket/a8"))
    )
    differ = [np.abs(np.asarray(a.rad) - np.asarray(b.rad)) > 1e-9 for a, b in zip(one, other, strict=True)]
    np.testing.assert_array_equal(np.any(differ, axis=0), disturbed.faults["magnetic"])
    assert not np.any(disturbed.faults["motion"])
    assert np.all(problem("rocket/a4").faults["motion"])


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("satellite/s1", {"gyro": None, "star": None}),
        ("satellite/s2", {"gyro": (0.1, 1500.0), "star": None}),
        ("satellite/s4", {"gyro": (0.1, 1500.0)}),
        ("satellite/star-sign", {"star": None}),
        ("satellite/star-stuck", {"star": (600.0, 659.9), "gyro": None}),
        ("airship/s1", {"accelerometers": None}),
        ("airship/s4", {"accelerometers": (200.0, 799.0)}),
        ("transfer-alignment/a", {"gyros": None, "flexure": None, "mounting": None}),
        ("transfer-alignment/c", {"gyros": (40.0, 120.0), "flexure": None}),
        ("transfer-alignment/b", {"gyros": None, "flexure": (0.1, 120.0)}),
        ("transfer-alignment/e", {"mounting": (0.1, 120.0)}),
        ("transfer-alignment/s1", {"flexure": None, "attitude_matching": (0.05, 20.0)}),
        ("transfer-alignment/s0", {"flexure": (0.05, 20.0), "attitude_matching": (0.05, 20.0)}),
    ],
)
def test_faults_are_those_of_the_text(name, wrong):
    of = problem(name)
    assert {key: begins_and_ends(of, key) for key in wrong} == wrong


def test_a_drive_has_no_faults_and_every_default_bank_has_names_for_some():
    assert problem("ins-gnss/drive").faults == {}
    for name in ("airship/s1", "rocket/a1", "rocket/b1", "satellite/s1", "transfer-alignment/a"):
        of = problem(name)
        (contender,) = of.contenders.values()
        assert set(contender.filter.suspects) & set(of.faults)
    assert "adaptive" in beside(read_scenario("rocket/a1", ()))
