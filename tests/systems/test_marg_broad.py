"""Real trials of BROAD, one default for all: no worse than VQF was measured to be.

`make test` replays the trial with a magnet on the sensor, `make certify` all six.
"""

from functools import cache

import numpy as np
import pytest

from robins import logs
from robins.systems.marg import MargReplay, replay

TRIALS = ("01", "07", "15", "24", "28", "33")
VQF_DEG, VQF_OFFLINE_DEG = 2.56, 2.21  # mean total RMSE of these six, measured with its own code
MADGWICK_DEG = 4.9  # published, with its one best parameter


@pytest.fixture(scope="module")
def found(data_dir):
    """Results of a replay of a trial, from its number."""

    @cache
    def of(number):
        paths = list(data_dir.glob(f"broad_{number}_*.npz"))
        if not paths:
            pytest.skip(f"needs a trial of BROAD, {data_dir} lacks number {number}")
        return replay(logs.clean(logs.load_dataset(paths)), MargReplay())

    return of


@pytest.mark.parametrize("number", TRIALS)
def test_no_trial_is_as_bad_as_the_filter_of_madgwick(found, number):
    outcome = found(number)
    for name in ("marg", "marg-smoothed"):
        assert outcome.metrics[name]["total_rmse_deg"] < MADGWICK_DEG
    assert outcome.counts["steps_not_taken"] == 0
    assert np.all(np.isfinite(outcome.solution["estimate_euler"].values))
    # noise that lasts is stated larger than it scatters, never smaller
    for sensor in ("travel", "rest", "magnetometer"):
        assert outcome.metrics["marg"][f"nis_{sensor}"] < 1.2, sensor


# A magnet was on the sensor for a minute, one passed by, none was near.
@pytest.mark.parametrize(
    ("number", "least", "most"), [("33", 20, 999), ("28", 5, 999), ("01", 0, 2)]
)
def test_magnets_are_noticed(found, number, least, most):
    assert least <= found(number).metrics["marg"]["refused_magnetometer"] <= most


@pytest.mark.parametrize(
    ("name", "reached", "peer"), [("marg", 1.6, VQF_DEG), ("marg-smoothed", 1.4, VQF_OFFLINE_DEG)]
)
def test_mean_error_is_below_that_of_vqf(found, name, reached, peer):
    metrics = [found(number).metrics[name] for number in TRIALS]
    assert np.mean([m["total_rmse_deg"] for m in metrics]) < reached < peer
    assert np.mean([m["inclination_rmse_deg"] for m in metrics]) < 0.9


def test_states_say_how_sure_they_are(found):
    within = []
    for number in TRIALS:
        one = found(number).solution.sel(filter="marg")
        ratio = np.abs(one["error_inclination"] / one["sigma_inclination"]).values
        within.append(np.mean(ratio[np.isfinite(ratio)] < 3.0))
    # somewhat narrow where the motion is fast: 0.91 in the mean, 0.78 at the least
    assert np.mean(within) > 0.88
    assert np.mean([found(number).metrics["marg"]["heading_nees"] for number in TRIALS]) < 2.0
