"""Rotations: the laws of the group near identity and near pi; scipy as an independent oracle."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy.spatial.transform import Rotation as Scipy

from robins import rotation as rot
from robins.rotation import Rotation
from robins.rotation.arithmetic import SMALL

EPS = np.finfo(float).eps
SIZES = {
    "zero": [0.0],
    "near identity": [1e-300, 1e-12, 1e-9, 1e-6, 1e-3],
    # The series end where the squared half angle is 1e-3 (exp) or its squared sine is (log).
    "at the switch": 2 * np.sqrt(1e-3) * (1 + np.array([-1e-3, -1e-9, 0.0, 1e-9, 1e-3])),
    "anywhere": np.linspace(0.05, 3.1, 12),
    "near pi": np.pi - np.array([1e-3, 1e-6, 1e-9, 1e-12, 0.0]),
}
BATCHES = [(), (7,), (2, 3)]


def directions(count, seed=0):
    v = np.random.default_rng(seed).normal(size=(count, 3))
    v[:3] = np.eye(3)[: len(v)]  # the axes, where components vanish
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def rotvecs(sizes):
    """Every size along eight directions, as one batch (n, 3)."""
    return np.concatenate([directions(8, seed) * a for seed, a in enumerate(np.ravel(sizes))])


EVERY = rotvecs(np.concatenate([np.ravel(s) for s in SIZES.values()]))
# Rounding is judged in the code that users run, which the other tests do without.
AS_USERS = {"xla_backend_optimization_level": 3, "xla_cpu_use_fusion_emitters": True}
compiled = partial(jax.jit, compiler_options=AS_USERS)
exp = compiled(rot.from_rotvec)
log = compiled(rot.to_rotvec)
product = compiled(rot.multiply)
rotate = compiled(rot.rotate)
dcm = compiled(rot.to_dcm)
euler = compiled(rot.to_euler)
from_euler = compiled(rot.from_euler)


def scalar_first(rotation):
    """Quaternion of a SciPy rotation with the scalar first; SciPy has it last."""
    return rotation.as_quat()[..., [3, 0, 1, 2]]


def angle_between(p, q):
    """Rotation angle that leads from one unit quaternion to the other, exact when it is small."""
    p, q = np.asarray(p), np.asarray(q)
    sign = np.sign(np.sum(p * q, -1, keepdims=True))
    return 2 * np.linalg.norm(p - sign * q, axis=-1)


@pytest.fixture(scope="module")
def quaternions():
    return exp(EVERY)


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("sizes", SIZES.values(), ids=SIZES)
def test_group_axioms(batch, sizes):
    rng = np.random.default_rng(len(batch))
    pool = exp(rotvecs(sizes))
    a, b, c = (pool[rng.integers(0, len(pool), batch)] for _ in range(3))
    identity = Rotation.identity().wxyz

    left = product(product(a, b), c)
    np.testing.assert_allclose(left, product(a, product(b, c)), atol=4 * EPS)
    np.testing.assert_array_equal(product(a, identity), a)
    np.testing.assert_array_equal(product(identity, a), a)
    np.testing.assert_allclose(
        product(a, rot.conjugate(a)), jnp.broadcast_to(identity, (*batch, 4)), atol=4 * EPS
    )
    np.testing.assert_allclose(jnp.linalg.norm(left, axis=-1), jnp.ones(batch), atol=4 * EPS)


@pytest.mark.parametrize("sizes", SIZES.values(), ids=SIZES)
def test_logarithm_inverts_exponential_to_relative_rounding(sizes):
    phi = rotvecs(sizes)
    size = np.linalg.norm(phi, axis=-1, keepdims=True)
    assert np.all(np.abs(log(exp(phi)) - phi) <= 4 * EPS * size)
    # The other quaternion of the same rotation. At pi itself the axis may come out reversed.
    error = np.abs(log(-exp(phi)) - phi)
    assert np.all((error <= 4 * EPS * size) | (size >= np.pi))


def test_exponential_is_that_of_scipy_and_of_the_matrix(quaternions):
    expected = scalar_first(Scipy.from_rotvec(EVERY))
    np.testing.assert_array_less(angle_between(quaternions, expected), 4 * EPS)
    matrices = scipy.linalg.expm(np.asarray(rot.skew(jnp.asarray(EVERY))))
    np.testing.assert_allclose(dcm(quaternions), matrices, atol=2e-14)  # the error of expm


def test_series_and_closed_form_are_both_exact_at_their_switch():
    # Extended precision beside the switch: the whole error must be rounding on either side.
    half = np.sqrt(1e-3) * (1 + np.linspace(-0.02, 0.02, 401))
    q = np.asarray(exp(np.outer(2 * half, [1.0, 0.0, 0.0])))
    wide = half.astype(np.longdouble)
    np.testing.assert_array_less(np.abs(q[:, 0] - np.cos(wide)), 2 * EPS * np.cos(wide))
    np.testing.assert_array_less(np.abs(q[:, 1] - np.sin(wide)), 2 * EPS * np.sin(wide))

    given = q.astype(np.longdouble)
    exact = 2 * np.arctan2(given[:, 1], given[:, 0])
    np.testing.assert_array_less(np.abs(np.asarray(log(q))[:, 0] - exact), 2.5 * EPS * exact)
    small = np.sum(q[:, 1:] ** 2, -1) < SMALL
    assert 0 < np.count_nonzero(small) < len(q)  # both branches were seen


def test_cosine_matrix_is_that_of_scipy_and_maps_as_the_quaternion_does(quaternions):
    matrices = np.asarray(dcm(quaternions))
    expected = Scipy.from_quat(np.asarray(quaternions)[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(matrices, expected, atol=4 * EPS)
    v = np.random.default_rng(1).normal(size=(len(matrices), 3))
    np.testing.assert_allclose(
        rotate(quaternions, jnp.asarray(v)), np.einsum("nij,nj->ni", matrices, v), atol=2e-15
    )


def test_quaternion_comes_back_from_its_matrix(quaternions):
    back = jax.jit(rot.from_dcm)(dcm(quaternions))
    np.testing.assert_array_less(angle_between(back, quaternions), 8 * EPS)
    assert np.all(np.asarray(back)[:, 0] >= 0)
    largest = np.argmax(np.abs(np.asarray(quaternions)), -1)
    assert set(largest) == {0, 1, 2, 3}  # all four cases of Shepperd


def test_euler_angles_are_those_of_scipy():
    rng = np.random.default_rng(2)
    roll, heading = rng.uniform(-np.pi, np.pi, (2, 200))
    pitch = np.deg2rad(rng.uniform(-89, 89, 200))
    q = from_euler(roll, pitch, heading)
    expected = Scipy.from_euler("ZYX", np.stack([heading, pitch, roll], -1))
    np.testing.assert_array_less(angle_between(q, scalar_first(expected)), 4 * EPS)
    for ours, given in zip(euler(q), (roll, pitch, heading), strict=True):
        np.testing.assert_allclose(ours, given, atol=1e-13)


@pytest.mark.parametrize("pitch_deg", [90, -90, 89.999999, -89.999999, 90 - 1e-10, 85, 0.0, 1e-12])
def test_euler_angles_describe_the_rotation_at_every_pitch(pitch_deg):
    roll, heading = (a.ravel() for a in np.meshgrid(np.linspace(-3.1, 3.1, 9), np.arange(-3, 4)))
    q = from_euler(roll, np.full(63, np.deg2rad(pitch_deg)), heading.astype(float))
    r, p, h = euler(q)
    np.testing.assert_allclose(p, np.deg2rad(pitch_deg), rtol=2 * EPS, atol=4 * EPS)
    np.testing.assert_array_less(angle_between(from_euler(r, p, h), q), 2e-14)
    assert np.all(r == 0.0) == (abs(pitch_deg) == 90)
    assert np.all(np.abs(h) <= np.pi)
    assert np.all(np.abs(r) <= np.pi)


def test_ninety_degrees_of_heading_point_east_and_show_a_swapped_order():
    q_nb = from_euler(0.0, 0.0, np.pi / 2)
    np.testing.assert_allclose(q_nb, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=EPS)
    forward = jnp.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(rotate(q_nb, forward), [0, 1, 0], atol=4 * EPS)  # east in NED
    scalar_last = jnp.array(Scipy.from_euler("z", 90, degrees=True).as_quat())
    np.testing.assert_allclose(scalar_last[jnp.array([3, 0, 1, 2])], q_nb, atol=EPS)
    taken_for_scalar_first = rotate(scalar_last, forward)
    assert not np.allclose(taken_for_scalar_first, [0, 1, 0], atol=0.5)


def test_product_rotates_by_the_right_factor_first():
    yaw, roll = from_euler(0.0, 0.0, np.pi / 2), from_euler(np.pi / 2, 0.0, 0.0)
    right = jnp.array([0.0, 1.0, 0.0])
    # Rolled first, the right wing points down; the turn about down then leaves it there.
    np.testing.assert_allclose(rotate(product(yaw, roll), right), [0, 0, 1], atol=4 * EPS)


@pytest.mark.parametrize("shapes", [((), (5,)), ((5,), ()), ((5,), (3, 5)), ((3, 1), (5,))])
def test_leading_axes_broadcast(shapes, quaternions):
    few, many = shapes
    q = np.asarray(quaternions)[: int(np.prod(few))].reshape(*few, 4)
    p = np.asarray(quaternions)[-int(np.prod(many)) :].reshape(*many, 4)
    full = np.broadcast_shapes(few, many)
    each = [np.broadcast_to(a, (*full, 4)).reshape(-1, 4)[:15] for a in (q, p)]
    got = np.asarray(product(q, p)).reshape(-1, 4)
    for i, (a, b) in enumerate(zip(*each, strict=True)):
        np.testing.assert_allclose(got[i], product(a, b), atol=EPS)
    got = np.asarray(rotate(q, p[..., 1:])).reshape(-1, 3)
    for i, (a, b) in enumerate(zip(*each, strict=True)):
        np.testing.assert_allclose(got[i], rotate(a, b[1:]), atol=2 * EPS)


def test_skew_is_the_cross_product():
    a, b = np.random.default_rng(3).normal(size=(2, 6, 3))
    got = np.einsum("nij,nj->ni", rot.skew(jnp.asarray(a)), b)
    np.testing.assert_allclose(got, np.cross(a, b), atol=4 * EPS)


def central_difference(f, x, step):
    columns = [
        (np.asarray(f(x + step * e)) - np.asarray(f(x - step * e))) / (2 * step)
        for e in np.eye(len(x))
    ]
    return np.stack(columns, -1)


SLOPES = {
    mode: (jax.jit(mode(rot.from_rotvec)), jax.jit(mode(rot.to_rotvec)))
    for mode in (jax.jacfwd, jax.jacrev)
}


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-5, 0.9 * 2 * np.sqrt(1e-3), 0.07, 1.0, 3.0])
@pytest.mark.parametrize("mode", SLOPES, ids=lambda mode: mode.__name__)
def test_gradients_of_exponential_and_logarithm(size, mode):
    phi = directions(5, 4)[4] * size
    slope_of_exp, slope_of_log = SLOPES[mode]
    d_exp = np.asarray(slope_of_exp(phi))
    np.testing.assert_allclose(d_exp, central_difference(exp, phi, 1e-4), atol=1e-8)
    q = exp(phi)
    d_log = slope_of_log(q)
    np.testing.assert_allclose(d_log, central_difference(log, np.asarray(q), 1e-4), atol=3e-7)
    np.testing.assert_allclose(d_log @ d_exp, np.eye(3), atol=1e-14)  # the chain rule


def test_second_derivative_of_the_exponential_at_zero():
    # exp(phi/2) = (1 - |phi|^2/8, phi/2) to second order.
    second = jax.jit(jax.hessian(rot.from_rotvec))(jnp.zeros(3))
    np.testing.assert_array_equal(second[0], -np.eye(3) / 4)
    np.testing.assert_array_equal(second[1:], np.zeros((3, 3, 3)))


slope_of_angles = jax.jit(jax.jacfwd(lambda q: jnp.stack(rot.to_euler(q))))


@pytest.mark.parametrize("pitch_deg", [0.0, 60.0, 90.0, -90.0])
def test_gradients_of_euler_angles(pitch_deg):
    q = from_euler(0.3, np.deg2rad(pitch_deg), -2.0)
    slope = slope_of_angles(q)
    assert np.all(np.isfinite(slope))
    if abs(pitch_deg) < 90:
        numeric = central_difference(lambda q: np.stack(euler(q)), np.asarray(q), 1e-5)
        np.testing.assert_allclose(slope, numeric, atol=1e-8)


def test_retract_and_local_are_inverse(quaternions):
    start = Rotation(quaternions[::-1])
    end = jax.jit(Rotation.retract)(start, EVERY)
    got = jax.jit(Rotation.local)(start, end)
    # Rounding is that of the quaternions, whatever the size of the step; at pi the step may come
    # back the other way round.
    error = np.max(np.abs(got - EVERY), -1)
    assert np.all((error <= 8 * EPS) | (np.linalg.norm(EVERY, axis=-1) > np.pi - 1e-14))
    again = jax.jit(Rotation.retract)(start, got)
    np.testing.assert_array_less(angle_between(again.wxyz, end.wxyz), 8 * EPS)


def test_retract_perturbs_on_the_left():
    start = Rotation.from_euler(0.4, -0.3, 2.0)
    delta = jnp.array([0.02, -0.01, 0.03])
    expected = scipy.linalg.expm(np.asarray(rot.skew(delta))) @ np.asarray(start.as_dcm())
    np.testing.assert_allclose(start.retract(delta).as_dcm(), expected, atol=4 * EPS)


def test_a_million_retractions_keep_the_length():
    def step(q, _):
        return Rotation(q).retract(jnp.array([1e-3, -2e-3, 5e-4])).wxyz, None

    q, _ = jax.jit(lambda q: jax.lax.scan(step, q, None, length=1_000_000))(
        Rotation.identity().wxyz
    )
    assert abs(np.linalg.norm(q) - 1) <= 2 * EPS


def test_value_type_agrees_with_its_functions():
    a = Rotation.from_euler(0.1, 0.2, 0.3)
    b = Rotation.from_rotvec([0, 0, 1])  # whole numbers are numbers
    v = [1, 2, 3]
    np.testing.assert_allclose((a @ b).apply(v), a.apply(b.apply(v)), atol=4 * EPS)
    np.testing.assert_allclose((a @ a.inverse()).as_rotvec(), np.zeros(3), atol=EPS)
    np.testing.assert_allclose(Rotation.from_dcm(a.as_dcm()).wxyz, a.wxyz, atol=4 * EPS)
    np.testing.assert_allclose(b.as_rotvec(), [0, 0, 1], atol=EPS)
    np.testing.assert_allclose(a.as_euler(), (0.1, 0.2, 0.3), atol=4 * EPS)


# -------------------------------------------------------------------------- errors in body axes


def test_body_rotation_errs_on_the_right():
    C = Scipy.random(5, random_state=3)
    delta = 0.3 * directions(5, seed=1)
    q = rot.BodyRotation(jnp.asarray(C.as_quat(scalar_first=True)))
    moved = jax.vmap(lambda a, d: a.retract(d))(q, jnp.asarray(delta))
    expected = C * Scipy.from_rotvec(delta)  # right: the error is turned before C
    np.testing.assert_allclose(rot.to_dcm(moved.wxyz), expected.as_matrix(), atol=1e-15)
    np.testing.assert_allclose(q.local(moved), delta, atol=1e-15)
    # seen in the frame that is mapped to, the same error is C delta
    left = Rotation(q.wxyz).local(Rotation(moved.wxyz))
    np.testing.assert_allclose(left, C.apply(delta), atol=1e-15)


def test_numpy_is_answered_by_numpy_with_the_same_numbers():
    rng = np.random.default_rng(11)
    p, q = (rot.normalise(jnp.asarray(rng.normal(size=(40, 4)))) for _ in range(2))
    v = rng.normal(size=(40, 3))
    q = q.at[:3].set(jnp.array([[1.0, 0.0, 0.0, 0.0], [1.0, 1e-9, 0.0, 0.0], [-1.0, 0.0, 0.1, 0]]))
    calls = [(rot.multiply, p, q), (rot.conjugate, q), (rot.to_rotvec, q), (rot.to_dcm, q)]
    calls += [(rot.rotate, q, jnp.asarray(v))]
    for f, *arguments in [*calls, (rot.skew, jnp.asarray(v))]:
        got = f(*map(np.asarray, arguments))
        assert type(got) is np.ndarray
        np.testing.assert_allclose(got, f(*arguments), rtol=0.0, atol=4 * EPS)


def test_the_jacobians_of_the_exponential_map():
    phi = jnp.asarray(np.random.default_rng(12).normal(size=(5, 3)))
    J = rot.left_jacobian(phi)
    # the integral of exp(s phi x) over s from 0 to 1
    share = (np.arange(400) + 0.5) / 400
    mean = sum(np.asarray(rot.to_dcm(rot.from_rotvec(s * phi))) for s in share) / 400
    np.testing.assert_allclose(J, mean, atol=1e-5)
    right = rot.left_jacobian(-phi)
    np.testing.assert_allclose(rot.to_dcm(rot.from_rotvec(phi)) @ right, J, atol=1e-14)
    small = 1e-4 * phi
    first = rot.left_jacobian(small, first_order=True)
    np.testing.assert_allclose(first, rot.left_jacobian(small), atol=1e-7)
