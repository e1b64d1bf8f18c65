"""The airship's filters against the reference figures: even wind, gusts, and outliers.

Figures are means over 200 to 800 s of 20 runs, bands those of the specification.
"""

import jax
import numpy as np
import pytest
from airship_runs import flights, found


@pytest.fixture(scope="module")
def calm():
    return flights("s0")


@pytest.fixture(scope="module")
def gusts():
    return flights("s1")


@pytest.fixture(scope="module")
def ukf(calm, gusts):
    return {"s0": found(calm, "ukf"), "s1": found(gusts, "ukf")}


@pytest.mark.parametrize("name", ["s0", "s1"])
def test_the_unscented_filter_is_as_accurate_as_the_reference(ukf, name):
    assert 9.4 < ukf[name].position_m < 11.5
    assert 0.56 < ukf[name].velocity_m_s < 0.68


def test_gusts_that_the_accelerometers_feel_do_no_harm(ukf):
    pair = np.stack([ukf[name].error[:, ukf[name].counted] for name in ("s0", "s1")])
    by_run = np.mean(np.linalg.norm(pair[..., 6:8], axis=3), axis=2)
    assert abs(np.mean(by_run[1] - by_run[0])) < 0.05


def test_linearising_by_derivatives_is_as_good(calm, ukf):
    ekf = found(calm, "ekf")
    assert abs(ekf.position_m - ukf["s0"].position_m) < 1e-3
    assert abs(ekf.velocity_m_s - ukf["s0"].velocity_m_s) < 1e-4


def test_the_robust_filter_bears_outliers(calm):
    robust = found(calm, "raukf")
    assert 8.7 < robust.position_m < 10.7
    assert 0.43 < robust.velocity_m_s < 0.58
    struck = flights("s3")
    assert found(struck, "raukf").position_m < 0.8 * found(struck, "ukf").position_m


def test_a_velocity_known_exactly_is_exploited(calm):
    exact = found(calm, "cukf-exact")
    assert 1.0 < exact.position_m < 1.9
    assert exact.velocity_m_s < 0.02


def test_a_hard_constraint_on_a_wrong_wind_fails(calm):
    """Its error of 0.3 m/s lasts 50 s, and is believed to be none."""
    assert found(calm, "cukf-hard").position_m > 25.0


def test_the_guard_takes_the_harm_out_of_it(calm, ukf):
    guarded = found(calm, "cukf-hard-gated")
    assert guarded.position_m < 1.05 * ukf["s0"].position_m
    assert guarded.velocity_m_s < 1.05 * ukf["s0"].velocity_m_s


def speed_error(error: np.ndarray) -> np.ndarray:
    """(runs, E), infinite where it is no number any more."""
    size = np.linalg.norm(error[..., 3:6], axis=2)
    return np.where(np.isfinite(size), size, np.inf)


def test_the_printed_constraint_diverges_at_once(calm):
    begin = jax.tree.map(lambda x: x[:, :20] if x.ndim > 1 and x.shape[1] == 800 else x, calm.batch)
    error = speed_error(found(calm, "cukf-printed", begin).error)
    assert error.shape == (20, 20)
    assert np.all(np.max(error[:, :10], axis=1) > 1e4)


def test_the_printed_attitude_rows_diverge_before_the_end(calm):
    """To the speed of a satellite, where the Earth falls away below; every run."""
    error = speed_error(found(calm, "ukf-printed-h").error)
    assert np.all(np.max(error, axis=1) > 5e3)
    assert np.all(error[:, 0] < 1.0)
