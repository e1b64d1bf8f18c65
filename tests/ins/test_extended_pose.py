"""SE_2(3) against 5 x 5 matrices, their exponentials, and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from robins import manifold
from robins.ins.extended_pose import ExtendedPose
from robins.rotation import Rotation, left_jacobian

SIDES = pytest.mark.parametrize("side", ["right", "left"])


def tangents() -> np.ndarray:
    """Error vectors with angles of zero, tiny, about the switch of the series, large, near pi."""
    rng = np.random.default_rng(0)
    angles = np.array([0.0, 1e-12, 1e-5, 0.0999999, 0.1000001, 0.7, 2.0, 3.0, np.pi - 1e-6])
    way = rng.normal(size=(len(angles), 3))
    way *= (angles / np.linalg.norm(way, axis=1))[:, None]
    return np.concatenate([way, 3.0 * rng.normal(size=(len(angles), 6))], axis=1)


def hat(xi):
    """The tangent vector as a matrix."""
    x, y, z = xi[:3]
    out = np.zeros((5, 5))
    out[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    out[:3, 3], out[:3, 4] = xi[3:6], xi[6:]
    return out


def matrix(pose) -> np.ndarray:
    out = np.eye(5)
    out[:3, :3] = pose.rotation.as_dcm()
    out[:3, 3], out[:3, 4] = pose.velocity, pose.position
    return out


@pytest.fixture(scope="module")
def made():
    xi = jnp.array(tangents())
    group = jax.jit(jax.vmap(ExtendedPose.exp))(xi)
    return xi, [jax.tree.map(lambda a, i=i: a[i], group) for i in range(len(xi))]


def test_exp_is_that_of_matrices_and_log_undoes_it(made):
    log = jax.jit(ExtendedPose.log)
    for xi, pose in zip(*made, strict=True):
        np.testing.assert_allclose(matrix(pose), expm(hat(xi)), atol=1e-13)
        np.testing.assert_allclose(log(pose), xi, atol=1e-12)
    back = jax.jit(jax.vmap(lambda x: ExtendedPose.exp(x).log()))(made[0])
    np.testing.assert_allclose(back[:-1], made[0][:-1], atol=1e-13)


def test_group_laws(made):
    one = ExtendedPose.identity()
    np.testing.assert_array_equal(matrix(one), np.eye(5))
    for a, b in zip(made[1], made[1][::-1], strict=True):
        np.testing.assert_allclose(matrix(a @ b), matrix(a) @ matrix(b), atol=1e-13)
        np.testing.assert_allclose(matrix(a @ a.inverse()), np.eye(5), atol=1e-13)
        np.testing.assert_allclose(matrix(a.inverse()), np.linalg.inv(matrix(a)), atol=1e-13)


def test_adjoint_takes_errors_across(made):
    for pose, xi in zip(made[1], made[0][::-1], strict=True):
        X = matrix(pose)
        want = X @ expm(hat(np.asarray(xi))) @ np.linalg.inv(X)
        np.testing.assert_allclose(expm(hat(pose.adjoint() @ xi)), want, atol=1e-11)


@SIDES
def test_retract_and_local_are_opposite_and_stand_on_their_side(made, side):
    turn = jax.jit(lambda x, d: (x.retract(d), x.local(x.retract(d))))
    for pose, xi in zip(made[1][::-1], made[0], strict=True):
        x = ExtendedPose(pose.rotation, pose.velocity, pose.position, side)
        moved, back = turn(x, xi)
        E = expm(hat(np.asarray(xi)))
        want = E @ matrix(x) if side == "right" else matrix(x) @ E
        np.testing.assert_allclose(matrix(moved), want, atol=1e-12)
        np.testing.assert_allclose(back, xi, atol=1e-12)
        assert moved.error == side


def test_the_attitude_part_of_a_right_error_is_that_of_rotation(made):
    for pose, xi in zip(made[1], made[0][::-1], strict=True):
        want = pose.rotation.retract(xi[:3]).as_dcm()
        np.testing.assert_allclose(pose.retract(xi).rotation.as_dcm(), want, atol=1e-15)


def test_left_jacobian_is_the_slope_of_the_rotation(made):
    h = 1e-6

    @jax.jit
    def both(phi):
        def moved(d):
            return Rotation.from_rotvec(phi).local(Rotation.from_rotvec(phi + d))

        ahead, back = (jax.vmap(moved)(way) for way in (h * jnp.eye(3), -h * jnp.eye(3)))
        return left_jacobian(phi), (ahead - back).T / (2 * h)

    for xi in made[0][:-1]:
        np.testing.assert_allclose(*both(xi[:3]), atol=1e-9)


@SIDES
def test_slopes_are_finite_at_the_identity(side):
    one = ExtendedPose.identity(side)
    for slope in (jax.jacfwd, jax.jacrev):
        found = jax.jit(slope(lambda d: one.local(one.retract(d))))(jnp.zeros(9))
        np.testing.assert_allclose(found, np.eye(9), atol=1e-15)


def test_in_a_state_it_is_one_element_of_dimension_nine():
    state = {"bias": jnp.zeros(3), "pose": ExtendedPose.identity("left")}
    assert manifold.dim(state) == 12
    d = jnp.arange(12.0) / 10
    np.testing.assert_allclose(manifold.local(state, manifold.retract(state, d)), d, atol=1e-14)
    with pytest.raises(ValueError, match="right error against one of left"):
        manifold.local({**state, "pose": ExtendedPose.identity()}, state)
