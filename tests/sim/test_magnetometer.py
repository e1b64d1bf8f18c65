"""The magnetometer: its parts read back one by one, with SciPy's rotations."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from robins.sim import magnetometer
from robins.sim.random import Component, stream

COUNT = 3000
KEY = stream(3, 1, Component.MAGNETOMETER)
TRUE = Rotation.random(COUNT, rng=np.random.default_rng(5))
Q_NB = TRUE.as_quat(scalar_first=True)
FIELD = np.array([20e-6, 1e-6, 44e-6])
IN_BODY = TRUE.inv().apply(FIELD)
ALL = np.ones(COUNT, bool)
SIGMA = np.array([1e-7, 2e-7, 4e-7])
TIME = np.arange(COUNT) * 0.1

observe = jax.jit(partial(magnetometer.observe_field, KEY, Q_NB, FIELD))


def test_the_field_comes_in_body_axes_with_white_noise_where_there_is_a_sample():
    present = np.arange(COUNT) % 7 != 0
    got = np.asarray(observe(SIGMA, present))
    assert np.all(np.isnan(got[~present]))
    error = (got - IN_BODY)[present] / SIGMA
    assert np.abs(np.corrcoef(error.T)[~np.eye(3, dtype=bool)]).max() < 4.0 / COUNT**0.5
    for axis in range(3):
        assert stats.kstest(error[:, axis], "norm").pvalue > 1e-3


def test_noise_may_differ_from_epoch_to_epoch():
    sigma = 1e-7 * (1.0 + np.arange(COUNT) / COUNT)
    steady = np.asarray(observe(1e-7, ALL)) - IN_BODY
    growing = np.asarray(observe(sigma, ALL)) - IN_BODY
    np.testing.assert_allclose(growing, steady * sigma[:, None] / 1e-7, rtol=0.0, atol=1e-18)


def test_iron_mounting_and_added_fields_one_after_the_other():
    rng = np.random.default_rng(2)
    M = np.eye(3) + 0.1 * rng.standard_normal((3, 3))
    mount = Rotation.from_euler("ZYX", [0.4, -1.1, 2.0])
    room, attached = 5e-6 * rng.standard_normal((COUNT, 3)), np.array([1e-6, -2e-6, 3e-6])
    hard = np.array([10e-6, -20e-6, 5e-6])
    got = observe(
        0.0,
        ALL,
        added_n_t=room,
        added_b_t=attached,
        q_bs=mount.as_quat(scalar_first=True),
        soft_iron=M,
        hard_iron_t=hard,
    )
    for k in range(0, COUNT, 100):
        b = TRUE[k].as_matrix().T @ (FIELD + room[k]) + attached
        expected = M @ (mount.as_matrix().T @ b) + hard
        np.testing.assert_allclose(got[k], expected, rtol=0.0, atol=1e-18)


def test_rounding_and_saturation():
    plain = np.asarray(observe(1e-7, ALL))
    coarse = np.asarray(observe(1e-7, ALL, quantum_t=0.15e-6))
    digits = coarse / 0.15e-6
    np.testing.assert_allclose(digits, np.rint(digits), rtol=0.0, atol=1e-9)
    assert np.abs(coarse - plain).max() <= 0.075e-6 * (1 + 1e-9)
    full = np.asarray(observe(1e-7, ALL, range_t=30e-6))
    np.testing.assert_array_equal(full, np.clip(plain, -30e-6, 30e-6))
    assert np.any(np.abs(full) == 30e-6)


def test_a_burst_turns_the_field_about_one_axis_perpendicular_to_it():
    size = np.radians(5.0)
    turn = magnetometer.field_bursts(KEY, TIME, size, 30.0, 1.0)
    inside = (TIME > 29.95) & ((TIME + 1e-6) % 30.0 < 0.95)
    assert inside.sum() == 10 * 9  # at 30, 60, ... 270 s
    got = TRUE.apply(np.array(observe(0.0, ALL, turn=turn)))  # navigation axes again
    np.testing.assert_allclose(got[~inside], np.tile(FIELD, (COUNT - 90, 1)), atol=1e-18)
    cosine = got[inside] @ FIELD / (FIELD @ FIELD)
    np.testing.assert_allclose(np.arccos(cosine), size, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(got, axis=1), np.linalg.norm(FIELD), rtol=1e-12)
    axes = np.cross(FIELD, got[inside]).reshape(9, 10, 3)
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    np.testing.assert_allclose(axes, np.broadcast_to(axes[:, :1], axes.shape), atol=1e-8)
    between = axes[:, 0] @ axes[:, 0].T
    assert np.abs(between[~np.eye(9, dtype=bool)]).max() < 0.9999  # no two bursts alike


def test_the_axis_of_a_burst_is_uniform_on_its_circle():
    turn = np.asarray(magnetometer.field_bursts(KEY, np.arange(3000.0), 0.1, 1.0, 0.5))
    unit = FIELD / np.linalg.norm(FIELD)
    east = np.cross(unit, [1.0, 0.0, 0.0])
    east /= np.linalg.norm(east)
    angle = np.arctan2(turn[1:] @ east, turn[1:] @ np.cross(unit, east))
    assert stats.kstest(angle / (2 * np.pi) + 0.5, "uniform").pvalue > 1e-3


@pytest.mark.parametrize("way", ["no turn", "along the field", "no field"])
def test_gradients_are_finite_where_a_turn_has_no_axis(way):
    turn = {"no turn": np.zeros(3), "along the field": 1e3 * FIELD, "no field": np.ones(3)}[way]
    field = np.zeros(3) if way == "no field" else FIELD

    def seen(turn, field):
        turns = jnp.broadcast_to(turn, (2, 3))
        got = magnetometer.observe_field(KEY, Q_NB[:2], field, 0.0, ALL[:2], turn=turns)
        return jnp.sum(got * got)

    for gradient in jax.grad(seen, argnums=(0, 1))(jnp.asarray(turn), jnp.asarray(field)):
        assert np.all(np.isfinite(gradient))


def test_angle_bursts_have_their_size_and_a_sign_for_each_angle_and_burst():
    got = np.asarray(magnetometer.angle_bursts(KEY, np.arange(6000) * 0.1, 0.2, 3.0, 0.1))
    assert set(np.unique(np.abs(got))) == {0.0, 0.2}
    hit = np.flatnonzero(got[:, 0])
    np.testing.assert_array_equal(hit, np.arange(30, 6000, 30))  # a sample of each, from 3 s on
    signs = np.sign(got[hit])
    n = len(signs)
    assert np.all(np.abs(signs.mean(axis=0)) < 4.0 / n**0.5)
    assert np.abs(np.corrcoef(signs.T)[~np.eye(3, dtype=bool)]).max() < 4.0 / n**0.5


def test_bursts_may_begin_at_once_last_and_come_only_once():
    lasting = magnetometer.angle_bursts(KEY, TIME, 0.2, np.inf, np.inf, first_s=12.0)
    np.testing.assert_array_equal(np.asarray(lasting[:, 0]) != 0.0, TIME > 11.95)
    once = magnetometer.angle_bursts(KEY, TIME, 0.2, np.inf, 2.0, first_s=0.0)
    np.testing.assert_array_equal(np.asarray(once[:, 0]) != 0.0, TIME < 1.95)
    none = magnetometer.angle_bursts(KEY, TIME, 0.2, np.inf, 2.0)
    assert not np.any(none)


def test_the_literal_magnetic_attitude_is_three_noisy_angles():
    euler = np.column_stack([np.linspace(-3.1, 3.1, COUNT)] * 3)
    wrong = np.asarray(magnetometer.angle_bursts(KEY, TIME, 0.1, 30.0, 1.0))
    present = np.arange(COUNT) % 4 != 0
    got = np.asarray(
        magnetometer.observe_magnetic_attitude(KEY, euler, [0.01, 0.02, 0.03], wrong, present)
    )
    assert np.all(np.isnan(got[~present]))
    assert np.all(np.abs(got[present]) <= np.pi)
    error = (got - euler - wrong)[present]
    error -= 2.0 * np.pi * np.rint(error / (2.0 * np.pi))
    for axis, sigma in enumerate([0.01, 0.02, 0.03]):
        assert stats.kstest(error[:, axis] / sigma, "norm").pvalue > 1e-3


BAD = {
    "q_nb must have shape (3000, 4)": {"q_nb": Q_NB[:5]},
    "field_n must have shape": {"field_n": np.zeros((2, 3))},
    "sigma_t must be a finite number from 0": {"sigma_t": -1.0},
    "sigma_t must have shape": {"sigma_t": np.ones(7)},
    "soft_iron must have shape (3, 3)": {"soft_iron": np.ones(3)},
    "range_t must be": {"range_t": 0.0},
    "quantum_t must be": {"quantum_t": -1e-9},
    "turn must have shape": {"turn": np.zeros(3)},
}


@pytest.mark.parametrize("says", BAD)
def test_what_does_not_fit_together_is_refused(says):
    given = {"q_nb": Q_NB, "field_n": FIELD, "sigma_t": 1e-7, "present": ALL} | BAD[says]
    with pytest.raises(ValueError, match=says.replace("(", r"\(").replace(")", r"\)")):
        magnetometer.observe_field(KEY, **given)
    with pytest.raises(ValueError, match="every_s must be"):
        magnetometer.field_bursts(KEY, TIME, 0.1, 0.0, 1.0)
    with pytest.raises(ValueError, match="present must have shape"):
        magnetometer.observe_magnetic_attitude(KEY, np.zeros((4, 3)), 0.1, None, ALL)
