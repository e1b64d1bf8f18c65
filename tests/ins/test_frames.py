"""The two conventions: exact both ways, and the rotation they claim to be."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robins import rotation
from robins.dataset import AttitudeTable, GnssTable, ImuTable, MagTable, Trajectory
from robins.ins import frames

T = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
rng = np.random.default_rng(1)
Q = rng.normal(size=(200, 4))
Q /= np.linalg.norm(Q, axis=1, keepdims=True)
V = rng.normal(size=(200, 3)) * 10.0 ** rng.uniform(-300, 300, (200, 3))
TIME, AT_ZERO = np.arange(200, dtype=np.int64), np.zeros((3, 200))  # latitude, longitude, height
MIXED = pytest.mark.parametrize(("nav", "body"), [("ENU", "FRD"), ("NED", "RFU")])

finite = st.floats(allow_nan=False, allow_infinity=False)


@given(st.tuples(finite, finite, finite))
def test_swapping_twice_returns_every_bit(v):
    v = np.array(v)
    assert frames.swap(frames.swap(v)).tobytes() == v.tobytes()
    q = np.append(v, 1.0)
    assert frames.swap_q(frames.swap_q(q)).tobytes() == q.tobytes()


def test_swap_is_the_relabelling_of_axes():
    # north-east-down of (1, 2, 3) is two metres east, one north, three down
    np.testing.assert_array_equal(frames.swap(np.array([1.0, 2.0, 3.0])), [2.0, 1.0, -3.0])
    np.testing.assert_array_equal(frames.swap(V), V @ T.T)


def test_swap_works_on_jax_arrays_alike():
    np.testing.assert_array_equal(frames.swap(jnp.asarray(V)), frames.swap(V))
    np.testing.assert_array_equal(frames.swap_q(jnp.asarray(Q)), frames.swap_q(Q))


def test_swapped_quaternion_is_the_matrix_between_swapped_axes():
    C = np.asarray(rotation.to_dcm(jnp.asarray(Q)))
    C_swapped = np.asarray(rotation.to_dcm(jnp.asarray(frames.swap_q(Q))))
    np.testing.assert_allclose(C_swapped, T @ C @ T.T, rtol=0, atol=4e-15)


def trajectory() -> Trajectory:
    return Trajectory(TIME, *AT_ZERO, v_n=V, q_nb=Q)


def tables():
    yield ImuTable(TIME, V, V[::-1], "rate")
    yield GnssTable(TIME, *AT_ZERO, np.abs(V), V, np.abs(V[::-1]))
    yield GnssTable(TIME, *AT_ZERO, np.abs(V))
    yield trajectory()
    yield MagTable(TIME, V)
    yield AttitudeTable(TIME, Q, moving=V[:, 0] > 0.0)


@pytest.mark.parametrize("table", list(tables()), ids=lambda t: type(t).__name__)
def test_tables_go_there_and_back_without_rounding(table):
    there = frames.to_enu_rfu(table)
    back = frames.to_ned_frd(there)
    assert frames.to_enu_rfu(there) is there or isinstance(table, Trajectory | AttitudeTable)
    for name, value in vars(table).items():
        np.testing.assert_array_equal(getattr(back, name), value, err_msg=name)
    for name in ("nav", "body"):
        if hasattr(table, name):
            assert getattr(there, name) in ("ENU", "RFU")


def test_sigmas_keep_their_sign():
    there = frames.to_enu_rfu(next(t for t in tables() if isinstance(t, GnssTable)))
    assert (there.sigma_m > 0).all()
    assert (there.sigma_v > 0).all()
    np.testing.assert_array_equal(there.sigma_m[:, 0], np.abs(V)[:, 1])


def test_a_field_is_relabelled_with_its_axes():
    there = frames.to_enu_rfu(MagTable(np.arange(len(V)), V))
    np.testing.assert_array_equal(there.field_t, V[:, [1, 0, 2]] * [1, 1, -1])


@MIXED
def test_mixed_attitudes_are_those_of_a_trajectory(nav, body):
    mixed = replace(trajectory(), nav=nav, body=body)
    bare = AttitudeTable(mixed.time_ns, mixed.q_nb, nav=nav, body=body)
    for turn in (frames.to_ned_frd, frames.to_enu_rfu):
        np.testing.assert_array_equal(turn(bare).q_nb, turn(mixed).q_nb)


@MIXED
def test_mixed_trajectory_against_matrices(nav, body):
    mixed = replace(trajectory(), nav=nav, body=body)
    C = np.asarray(rotation.to_dcm(jnp.asarray(Q)))
    expected = C @ T.T if body == "RFU" else T @ C  # what NED/FRD would read
    got = frames.to_ned_frd(mixed)
    C_ned_frd = rotation.to_dcm(jnp.asarray(got.q_nb))
    np.testing.assert_allclose(C_ned_frd, expected, rtol=0, atol=4e-15)
    np.testing.assert_array_equal(got.v_n, V if nav == "NED" else frames.swap(V))


def test_angles_of_an_enu_attitude_from_its_axes():
    """Heading, pitch and roll read off the east-north-up components of the body axes."""
    roll, pitch, heading = (np.asarray(a) for a in frames.euler_enu_rfu(Q))
    C = np.asarray(rotation.to_dcm(jnp.asarray(Q)))  # ENU from RFU
    right, forward, up = C[..., 0], C[..., 1], C[..., 2]
    np.testing.assert_allclose(heading, np.arctan2(forward[:, 0], forward[:, 1]), atol=1e-12)
    np.testing.assert_allclose(pitch, np.arcsin(forward[:, 2]), atol=1e-7)
    np.testing.assert_allclose(roll, np.arctan2(-right[:, 2], up[:, 2]), atol=1e-12)
