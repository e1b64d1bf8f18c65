"""Designs by LMI for random plants, and for the plant as the patent prints it."""

import numpy as np
import pytest
from design_plants import kinematics, quaternion

from robins.filters.synthesis import (
    Unreachable,
    certify,
    error_system,
    h2_norm,
    kalman_gain,
    least_gamma,
    peak_gain,
    plant,
    spectral_radius,
)
from robins.filters.synthesis.lmi import full, gain_of, observer
from robins.filters.synthesis.programs import solve
from robins.filters.synthesis.scaling import balanced


def test_patent_as_printed_passes_the_star_sensor_through():
    """w moves the state alone and the star error is in n: K = A whatever gamma is."""
    b, ss = 0.5, 0.5
    letter = quaternion(Bn=np.hstack([0.5 * kinematics([1, 0, 0, 0]), np.zeros((4, 4))]))
    letter = plant(
        letter.A,
        np.eye(4),
        letter.Bn,
        np.eye(4),
        None,
        np.hstack([np.zeros((4, 3)), ss * np.eye(4)]),
    )
    assert least_gamma(letter).proved == pytest.approx(np.hypot(b, ss), rel=1e-7)
    for gamma in (1.0, 30.0):
        scales = balanced(letter, gamma)
        K = gain_of(solve(scales.plant(letter), "common", "mixed"), scales)
        np.testing.assert_allclose(K, letter.A, rtol=0, atol=5e-6)
        error = error_system(letter, K)
        assert h2_norm(error.A, error.Bw, error.L) == pytest.approx(2.0, rel=1e-9)
        assert peak_gain(error.A, error.Bn, error.L) == pytest.approx(np.hypot(b, ss), rel=1e-5)
    with pytest.raises(Unreachable, match=r"gamma 0\.6 is below the least .* 0\.7071") as told:
        observer(letter, 0.6)
    assert told.value.least == pytest.approx(np.sqrt(0.5), rel=1e-4)


def random_plants(count, seed):
    """Stable plants of 2 or 3 states with 1 or 2 measurements, and a gamma each that is tight."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        n, m = rng.integers(2, 4), rng.integers(1, 3)
        A = rng.normal(size=(n, n))
        made = plant(
            A=A * rng.uniform(0.4, 0.95) / spectral_radius(A),
            Bw=np.hstack([rng.normal(size=(n, n)), np.zeros((n, m))]),
            Bn=rng.normal(size=(n, 1)),
            C=rng.normal(size=(m, n)),
            Dw=np.hstack([np.zeros((m, n)), 0.7 * np.eye(m)]),
        )
        kalman = certify(made, kalman_gain(made), method="kalman")
        least = least_gamma(made).reached
        yield made, 0.5 * (least + kalman.hinf), kalman


@pytest.mark.parametrize("count", [4, 25])
def test_on_random_plants_the_forms_are_ordered_and_no_promise_is_broken(count):
    for made, gamma, kalman in random_plants(count, seed=10):
        own, common, slack = (
            full(made, gamma),
            observer(made, gamma),
            observer(made, gamma, "slack"),
        )
        assert own.bound == pytest.approx(common.bound, rel=1e-6)
        assert slack.bound <= common.bound * (1.0 + 1e-7)
        for found in (own, common, slack):
            assert kalman.h2 < found.h2 <= found.bound * (1.0 + 1e-7)
            assert found.hinf <= gamma * (1.0 + 1e-6)
        # the matrices give the same norms by another way: a sum over the impulse response
        error = error_system(made, slack.gain)
        power, total = error.Bw, 0.0
        for _ in range(1000):
            total += np.sum(power**2)
            power = error.A @ power
        assert slack.h2 == pytest.approx(np.sqrt(total), rel=1e-9)
