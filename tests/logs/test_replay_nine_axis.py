"""A nine-axis log on its way to a system that navigates without fixes."""

import numpy as np
import pytest
import xarray as xr
from made_nine_axis import FIELD_ENU_UT, archive, tumble

from robins import systems, workbench
from robins.results import Outcome
from robins.scenario import Parameters
from robins.systems import System

ROLL = np.pi  # of the body as seen from the sensor


class Nothing(Parameters):
    """A configuration without a word in it."""


@pytest.fixture
def seen(monkeypatch):
    """Input of a system of attitude."""
    given = []

    def replay(dataset, parameters, filters, progress):
        given.append(dataset)
        progress(1.0, "done")
        return Outcome(xr.Dataset(), {name: {"total_rmse_deg": 1.0} for name in filters})

    system = System(
        name="compass",
        studies={},
        replay_filters=("plain",),
        replay_parameters=Nothing,
        replay=replay,
        orientation=lambda parameters: (ROLL, 0.0, 0.0),
    )
    monkeypatch.setattr(systems, "SYSTEMS", {"compass": system})
    return given


def test_field_and_attitude_arrive_clean_and_turned(tmp_path, seen):
    arrays = tumble(8.0)
    arrays["imu_mag"][5] = np.inf
    path = tmp_path / "trial.npz"
    path.write_bytes(archive(arrays))
    told = []
    found = workbench.replay([path], system="compass", filters=["plain"], findings=told.extend)
    (data,) = seen
    assert data.gnss is None
    assert data.imu_gaps == []
    turn = np.array([1.0, -1.0, -1.0])
    np.testing.assert_allclose(data.imu.gyro, arrays["imu_gyr"] * turn, rtol=1e-15)
    assert np.isnan(data.mag.field_t).all(axis=1).tolist() == [k == 5 for k in range(800)]
    np.testing.assert_allclose(data.mag.field_t[6], 1e-6 * arrays["imu_mag"][6] * turn)
    assert data.counts["mag_inf"] == 1
    assert data.counts["attitude_nan"] == 20
    # At rest the field by the true attitude is that of the place, so all were turned alike.
    w, v = data.attitude.q_nb[100, 0], data.attitude.q_nb[100, 1:]
    mean = data.mag.field_t[50:400].mean(axis=0)
    field_enu = mean + 2.0 * np.cross(v, np.cross(v, mean) + w * mean)
    np.testing.assert_allclose(field_enu * 1e6, FIELD_ENU_UT, atol=0.1)
    assert {f.severity for f in told} <= {"warning", "note"}
    assert (found.scenario, found.metrics) == ("compass/trial", {"plain": {"total_rmse_deg": 1.0}})


def test_what_the_doctor_calls_an_error_is_not_run(tmp_path, seen):
    arrays = tumble(8.0)
    path = tmp_path / "trial.npz"
    path.write_bytes(archive(arrays | {"imu_mag": 1e-2 * arrays["imu_mag"]}))
    with pytest.raises(workbench.InputError, match="probably in gauss where uT is said"):
        workbench.replay([path], system="compass")
    assert not seen


def test_who_needs_fixes_says_so(tmp_path):
    path = tmp_path / "trial.npz"
    path.write_bytes(archive(tumble(8.0)))
    with pytest.raises(workbench.InputError, match="needs GNSS fixes; this log has none"):
        workbench.replay([path], system="ins-gnss")
