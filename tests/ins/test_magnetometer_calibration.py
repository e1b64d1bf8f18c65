"""Hard and soft iron: found again in simulated samples, within their own sigmas; real logs."""

import jax
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from robins.ins.magnetometer_calibration import CalibrationError, calibrate, calibrated
from robins.sim.magnetometer import observe_field

FIELD_N = np.array([20e-6, 0.0, 43e-6])
STRENGTH = np.linalg.norm(FIELD_N)
HARD = np.array([12e-6, -25e-6, 8e-6])
SOFT = np.array([[1.08, 0.03, -0.02], [0.03, 0.95, 0.04], [-0.02, 0.04, 1.0]])
SOFT = SOFT / np.linalg.det(SOFT) ** (1.0 / 3.0)
SIGMA = 0.5e-6
COUNT = 1500
ENTRIES = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))

observe = jax.jit(observe_field)


def samples(attitude, seed=0, sigma=SIGMA, soft=SOFT):
    q = attitude.as_quat(scalar_first=True)
    there = np.ones(len(q), bool)
    key = jax.random.key(seed)
    return np.array(observe(key, q, FIELD_N, sigma, there, soft_iron=soft, hard_iron_t=HARD))


TURNED = Rotation.random(COUNT, rng=np.random.default_rng(1))


def test_without_noise_the_truth_comes_back():
    found = calibrate(samples(TURNED, sigma=0.0))
    np.testing.assert_allclose(found.offset_t, HARD, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(found.matrix, np.linalg.inv(SOFT), rtol=0.0, atol=1e-7)
    assert found.field_t == pytest.approx(STRENGTH, rel=1e-7)
    assert found.soft_iron
    assert found.after_t < 1e-12 < 1e-6 < found.before_t


def test_the_strength_of_the_field_sets_the_scale():
    z = samples(TURNED)
    free, held = calibrate(z), calibrate(z, strength_t=2.0 * STRENGTH)
    ratio = 2.0 * STRENGTH / free.field_t
    np.testing.assert_allclose(held.matrix, ratio * free.matrix, rtol=1e-9)
    np.testing.assert_allclose(held.offset_t, free.offset_t, rtol=1e-9)
    assert held.field_t == 2.0 * STRENGTH
    size = np.linalg.norm(calibrated(z, held.offset_t, held.matrix), axis=1)
    assert np.mean(size) == pytest.approx(held.field_t, rel=1e-3)


def test_oblique_axes_leave_a_rotation_and_nothing_else():
    """A soft iron matrix that is not symmetric: what is left of it after W is orthogonal."""
    A = SOFT @ Rotation.from_rotvec([0.05, -0.1, 0.08]).as_matrix()
    left = calibrate(samples(TURNED, sigma=0.0, soft=A)).matrix @ A
    np.testing.assert_allclose(left @ left.T, np.eye(3), rtol=0.0, atol=1e-7)


def errors_and_sigmas(found):
    inverse = np.linalg.inv(SOFT)
    error = [*(found.offset_t - HARD), *(found.matrix[e] - inverse[e] for e in ENTRIES)]
    return np.array(error), np.sqrt(np.diag(found.covariance))


@pytest.mark.parametrize("coverage", ["all directions", "tilted by 60 deg at most"])
def test_errors_are_as_large_as_their_sigmas_say(coverage):
    rng = np.random.default_rng(3)
    runs, ratios, nees = 40, [], []
    for run in range(runs):
        if coverage == "all directions":
            turned = Rotation.random(COUNT, rng=rng)
        else:
            heading, tilt = rng.uniform(-np.pi, np.pi, COUNT), rng.uniform(-1.05, 1.05, (2, COUNT))
            turned = Rotation.from_euler("ZYX", np.column_stack([heading, *tilt]))
        found = calibrate(samples(turned, seed=run))
        assert found.soft_iron
        error, sigma = errors_and_sigmas(found)
        ratios.append(error / sigma)
        # the determinant is one, so eight of the nine numbers are free
        scale = np.diag(1.0 / sigma)
        whitened = np.linalg.pinv(scale @ found.covariance @ scale, rtol=1e-6, hermitian=True)
        nees.append((error / sigma) @ whitened @ (error / sigma))
    low, high = stats.chi2.ppf([1e-4, 1.0 - 1e-4], 8 * runs) / (8 * runs)
    assert low < np.mean(nees) / 8 < high
    assert np.all(np.abs(np.mean(ratios, axis=0)) * runs**0.5 < 4.5)


def test_disturbed_samples_hardly_count():
    clean = samples(TURNED)
    dirty = clean.copy()
    dirty[::12] += np.array([15e-6, 10e-6, -20e-6])  # 8 %
    found, as_clean = calibrate(dirty), calibrate(clean)
    # the mean of the disturbance is 2 uT; what comes through is a tenth of it
    assert np.abs(found.offset_t - HARD).max() < 0.2e-6
    assert 0.05 < found.outliers < 0.1
    assert as_clean.outliers < 1e-3


def test_noise_that_lasts_makes_larger_sigmas():
    """The same white noise, each value held for ten samples: a tenth of the news."""
    slow = Rotation.concatenate([TURNED[i] for i in range(0, COUNT, 10)])
    held = np.repeat(np.arange(len(slow)), 10)
    white = calibrate(samples(slow[held]))
    stuck = calibrate(samples(slow)[held])
    ratio = stuck.offset_sigma_t / white.offset_sigma_t
    assert np.all((ratio > 0.7 * 10**0.5) & (ratio < 1.4 * 10**0.5))


def test_long_rest_does_not_outweigh_the_turns():
    resting = samples(TURNED[np.zeros(20 * COUNT, int)]) + 3e-6  # beside something of iron
    found = calibrate(np.concatenate([resting, samples(TURNED)]))
    assert np.abs(found.offset_t - HARD).max() < 0.3e-6


def test_missing_samples_are_left_out():
    z = samples(TURNED)
    holes = np.insert(z, np.arange(0, COUNT, 7), np.nan, axis=0)
    holes[3, 0] = np.inf
    kept = holes[np.isfinite(holes).all(axis=1)]
    np.testing.assert_array_equal(calibrate(holes).offset_t, calibrate(kept).offset_t)


def cone(half_angle, count=COUNT):
    """Attitudes that hold the field within a cone about the sensor's first axis."""
    rng = np.random.default_rng(6)
    to_x = Rotation.align_vectors([[1.0, 0.0, 0.0]], [FIELD_N / STRENGTH])[0]
    turn = rng.uniform(-np.pi, np.pi, count)
    tilt = half_angle * np.sqrt(rng.uniform(0.0, 1.0, count))
    away = Rotation.from_rotvec(tilt[:, None] * np.stack([0 * turn, np.cos(turn), np.sin(turn)], 1))
    return (away * to_x).inv()


def test_where_the_directions_do_not_tell_soft_iron_the_offset_alone_is_found():
    z = samples(cone(np.radians(50.0)), soft=np.eye(3), sigma=1e-6)
    found = calibrate(z)
    assert not found.soft_iron
    np.testing.assert_allclose(found.matrix, np.eye(3), rtol=0.0, atol=1e-12)
    assert np.all(np.abs(found.offset_t - HARD) < 4.0 * found.offset_sigma_t)
    assert found.covered < 0.5
    # the largest gap is opposite to where the field was
    assert found.gap[0] < -0.9
    assert np.pi * 100.0 / 180.0 < found.gap_rad < np.pi
    with pytest.raises(CalibrationError, match="its axes points up"):
        calibrate(z, soft_iron=True)


def test_axes_that_differ_by_more_than_two_are_found_where_the_samples_lie_on_them():
    for axes in ([1.9, 1.0, 0.8], [3.0, 1.0, 1.0], [8.0, 1.0, 1.0]):
        found = calibrate(samples(TURNED, soft=np.diag(axes), sigma=2e-7), strength_t=STRENGTH)
        assert found.soft_iron
        assert found.after_t < 0.02 * STRENGTH
        np.testing.assert_allclose(found.matrix, np.diag(1.0 / np.array(axes)), atol=0.01)


def test_no_sphere_stands_in_for_an_ellipsoid_without_a_look_at_what_is_left():
    """Stretched axes, and a sample in ten disturbed by most of the field."""
    gross = np.where(np.random.default_rng(1).random(COUNT) < 0.1, 3e-5, 0.0)[:, None]
    gross = gross + samples(TURNED, soft=np.diag([2.5, 1.0, 1.0]))
    with pytest.raises(CalibrationError, match=r"a sphere.* off, .*differ by a factor of 2"):
        calibrate(gross)


def test_a_sphere_may_be_asked_for():
    found = calibrate(samples(TURNED), soft_iron=False)
    assert not found.soft_iron
    assert found.after_t > 2.0 * calibrate(samples(TURNED)).after_t


def circle(share=1.0, tilt=0.0, **of):
    """Samples of a vehicle that turns about the vertical, by a share of a circle."""
    rng = np.random.default_rng(8)
    heading, lean = np.linspace(0.0, 2.0 * np.pi * share, COUNT), tilt * rng.normal(size=COUNT)
    return samples(Rotation.from_euler("ZYX", np.stack([heading, lean, 0.0 * lean], 1)), **of)


def test_a_vehicle_that_cannot_tilt_is_calibrated_in_the_horizontal_plane():
    """Soft iron couples the vertical field into the plane: there it is an offset."""
    soft = SOFT * [[1, 1, 0], [1, 1, 0], [0, 0, 1]]
    z = circle(soft=soft)
    found = calibrate(z, level=True)
    assert found.level
    assert found.soft_iron
    W = np.linalg.inv(soft[:2, :2])
    W /= np.sqrt(np.linalg.det(W))
    error = np.append(found.offset_t[:2] - HARD[:2], [(found.matrix[:2, :2] - W)[e] for e in
                      ((0, 0), (1, 1), (0, 1))])  # fmt: skip
    sigma = np.sqrt(np.diag(found.covariance))[[0, 1, 3, 4, 8]]
    assert np.all(np.abs(error) < 4.0 * sigma)
    assert np.all(sigma[:2] < 0.1e-6)
    np.testing.assert_array_equal(found.matrix[2], [0.0, 0.0, 1.0])
    assert found.offset_t[2] == 0.0
    b = calibrated(z, found.offset_t, found.matrix)
    heading = np.unwrap(np.arctan2(-b[:, 1], b[:, 0]))
    assert np.abs(heading - np.linspace(0.0, 2.0 * np.pi, COUNT)).max() < 0.12
    z = z - [0.0, 0.0, HARD[2]]
    given = calibrate(z, STRENGTH, level=True)
    down = np.median(z[:, 2])
    size = np.linalg.norm(calibrated(z, given.offset_t, given.matrix)[:, :2], axis=1)
    assert np.mean(size) == pytest.approx(np.sqrt(STRENGTH**2 - down**2), rel=1e-3)


FLAT = Rotation.from_euler("Z", np.linspace(0.0, 6.0, COUNT)[:, None])
REFUSED = {
    "in a plane": lambda: [samples(FLAT)],
    "at least 50": lambda: [samples(TURNED[:40])],
    "all samples of the field are equal": lambda: [np.ones((100, 3))],
    "do not tell the ellipsoid": lambda: [samples(cone(0.9, 60), sigma=6e-6)],
    "must have shape": lambda: [np.ones(3)],
    "strength_t must be": lambda: [samples(TURNED), -1.0],
    "not turned about the vertical only": lambda: [circle(tilt=0.5), None, None, True],
    "it has a hard iron of its own": lambda: [circle(), 40e-6, None, True],
    "the vehicle hardly turned": lambda: [circle(0.02, sigma=0.0), None, None, True],
}


@pytest.mark.parametrize("says", REFUSED)
def test_what_tells_no_calibration_is_refused(says):
    with pytest.raises(CalibrationError, match=says):
        calibrate(*REFUSED[says]())


def broad(data_dir, name, span_s=(0.0, np.inf)):
    with np.load(data_dir / f"broad_{name}.npz") as log:
        rate = float(log["sampling_rate"])
        first, last = (int(min(t * rate, 1e9)) for t in span_s)
        return log["imu_mag"][first:last] * 1e-6


def test_a_calibrated_sensor_needs_no_more(data_dir):
    found = calibrate(broad(data_dir, "01_undisturbed_slow_rotation_A"))
    assert found.soft_iron
    np.testing.assert_allclose(found.matrix, np.eye(3), rtol=0.0, atol=0.02)
    assert np.linalg.norm(found.offset_t) < 1.5e-6  # of 44 uT
    assert found.after_t <= found.before_t


def test_an_attached_magnet_is_hard_iron(data_dir):
    """It was on the sensor from 45 to 95 s; then the field is constant again without it."""
    found = calibrate(broad(data_dir, "33_disturbed_attached_magnet_2cm", (45.0, 95.0)))
    assert 25e-6 < np.linalg.norm(found.offset_t) < 35e-6
    assert found.after_t < 0.1 * found.before_t
    # the field of the room, as the undisturbed trial has it
    assert found.field_t == pytest.approx(44.3e-6, rel=0.06)
