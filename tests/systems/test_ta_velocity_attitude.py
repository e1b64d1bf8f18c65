"""The twelve-state model against the navigation equations themselves, written out in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from robins.earth import Geodetic
from robins.ins.frames import swap, swap_q
from robins.ins.increments import Increments
from robins.ins.mechanise import Nav, mechanise
from robins.ins.state import InsState
from robins.rotation import Rotation, from_euler
from robins.systems.transfer_alignment.velocity_attitude import model as va

navigate = jax.jit(va.navigate)

W = 7.292115e-5  # rad/s
A_M, E2 = 6378137.0, 0.0066943799901413
# errors of the size that alignment deals with: rad, m/s, m/s^2, rad/s
TYPICAL = np.array([1e-6, 1e-6, 0.3, 0.3, 1e-2, 1e-2, 1e-2, 1e-2, 1e-2, 2e-5, 2e-5, 2e-5])


def skew(v):
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def vee(M):
    return np.array([M[2, 1], M[0, 2], M[1, 0]])


def exp(phi):
    angle = np.linalg.norm(phi)
    if angle == 0.0:
        return np.eye(3)
    K = skew(phi / angle)
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K


def dcm(heading, pitch, roll):
    """Body RFU to ENU: Rz(-H) Rx(P) Ry(R)."""
    return exp([0.0, 0.0, -heading]) @ exp([pitch, 0.0, 0.0]) @ exp([0.0, roll, 0.0])


def angles(C):
    """Heading, pitch, roll of a matrix."""
    return np.array(
        [np.arctan2(C[0, 1], C[1, 1]), np.arcsin(C[2, 1]), np.arctan2(-C[2, 0], C[2, 2])]
    )


class Mechanisation:
    """Navigation in ENU with VU = 0 and h = 0; the radii are those of the point."""

    def __init__(self, lat, lon, v, C, f_b, omega_ib_b):
        self.at = (lat, lon, *v)
        self.C, self.f_b, self.omega = C, f_b, omega_ib_b
        across = 1.0 - E2 * np.sin(lat) ** 2
        self.RN = A_M / np.sqrt(across)
        self.RM = self.RN * (1.0 - E2) / across

    def derivative(self, at, C, f_b, omega):
        """Rates of latitude, longitude and velocity, and C' as C omega_ib - omega_in C."""
        lat, _, ve, vn = at
        rate = np.array(
            [
                -vn / self.RM,
                W * np.cos(lat) + ve / self.RN,
                W * np.sin(lat) + ve * np.tan(lat) / self.RN,
            ]
        )
        earth = np.array([0.0, W * np.cos(lat), W * np.sin(lat)])
        acceleration = C @ f_b - np.cross(earth + rate, [ve, vn, 0.0])
        moved = [vn / self.RM, ve / (self.RN * np.cos(lat)), *acceleration[:2]]
        return np.array(moved), C @ skew(omega) - skew(rate) @ C

    def error_rate(self, x):
        """Rate of the error x: computed minus true, both by `derivative`."""
        true, C_rate = self.derivative(self.at, self.C, self.f_b, self.omega)
        C_hat = exp(-x[4:7]) @ self.C
        f_b, omega = self.f_b + np.append(x[7:9], 0.0), self.omega + x[9:]
        moved, C_hat_rate = self.derivative(self.at + x[:4], C_hat, f_b, omega)
        # E = C_hat C' is exp(-phi x), whose odd part is -phi x to second order
        E_rate = C_hat_rate @ self.C.T + C_hat @ C_rate.T
        phi_rate = -vee(E_rate - E_rate.T) / 2.0
        return np.concatenate([moved - true, phi_rate, np.zeros(5)])


def random_point(rng):
    C = dcm(*rng.uniform(-1.0, 1.0, 3))
    lat = rng.uniform(-1.2, 1.2)
    v, f_n = rng.uniform(-250.0, 250.0, 2), rng.uniform([-5.0, -5.0, 5.0], [5.0, 5.0, 15.0])
    return Mechanisation(lat, rng.uniform(-3.0, 3.0), v, C, C.T @ f_n, rng.uniform(-0.2, 0.2, 3))


def test_F_is_the_derivative_of_the_navigation_equations():
    rng = np.random.default_rng(4)
    for _ in range(50):
        point = random_point(rng)
        lat, _, *v = point.at
        flight = va.SlaveFlight(lat, 0.0, np.append(v, 0.0), point.C @ point.f_b, point.C)
        F = np.asarray(va.error_dynamics(flight))
        steps = np.array([1e-4, 1e-4, 10.0, 10.0, *[1e-4] * 3, *[1.0] * 2, *[1e-3] * 3])
        columns = [
            (point.error_rate(h * e) - point.error_rate(-h * e)) / (2.0 * h)
            for h, e in zip(steps, np.eye(12), strict=True)
        ]
        contribution = np.array(columns).T * TYPICAL
        scale = np.maximum(np.max(np.abs(contribution), axis=1, keepdims=True), 1e-300)
        assert_allclose(F * TYPICAL / scale, contribution / scale, rtol=0, atol=1e-7)
        assert np.count_nonzero(F) == 36


def test_H1_is_the_derivative_of_the_euler_angles():
    rng = np.random.default_rng(5)
    for _ in range(50):
        C = dcm(rng.uniform(-np.pi, np.pi), rng.uniform(-1.0, 1.0), rng.uniform(-2.0, 2.0))
        H = np.asarray(va.measurement_matrix(jnp.asarray(C)))
        h = 1e-4
        # fourth order, so that 1e-8 is reached without drowning in rounding
        for k in range(3):
            e = h * np.eye(3)[k]
            one = (angles(exp(-e) @ C) - angles(exp(e) @ C) + np.pi) % (2 * np.pi) - np.pi
            two = (angles(exp(-2 * e) @ C) - angles(exp(2 * e) @ C) + np.pi) % (2 * np.pi) - np.pi
            assert_allclose(H[2:, 4 + k], (8.0 * one - two) / (12.0 * h), rtol=0, atol=1e-8)
        assert_allclose(H[:2], np.eye(12)[2:4], rtol=0, atol=0)
        assert not H[2:, :4].any()
        assert not H[2:, 7:].any()


def test_a_heading_counted_the_other_way_is_caught():
    C = dcm(0.7, 0.3, -0.4)
    phi = 1e-3 * np.array([1.0, -2.0, 3.0])
    by_model = np.asarray(va.measurement_matrix(jnp.asarray(C)))[2:, 4:7] @ phi
    measured = angles(exp(-phi) @ C) - angles(C)
    assert_allclose(by_model, measured, rtol=0, atol=1e-5)
    anticlockwise = measured * [-1.0, 1.0, 1.0]
    assert abs(by_model[0] - anticlockwise[0]) > 5e-3
    # and the heading that is measured by the package is the clockwise one
    q = [swap_q(np.asarray(from_euler(r, p, h))) for h, p, r in (angles(exp(-phi) @ C), angles(C))]
    assert_allclose(va.euler_difference(*q), measured, rtol=0, atol=1e-12)


def test_headings_on_both_sides_of_north_differ_by_little():
    slave, master = (swap_q(np.asarray(from_euler(0.0, 0.0, np.deg2rad(h)))) for h in (359.9, 0.1))
    assert_allclose(va.euler_difference(slave, master), np.deg2rad([-0.2, 0, 0]), atol=1e-12)
    assert_allclose(va.euler_difference(master, slave), np.deg2rad([0.2, 0, 0]), atol=1e-12)


def test_transition_is_the_second_order_of_the_exponential():
    point = random_point(np.random.default_rng(6))
    lat, _, *v = point.at
    flight = va.SlaveFlight(lat, 0.0, np.append(v, 0.0), point.C @ point.f_b, point.C)
    F = np.asarray(va.error_dynamics(flight))
    Phi = va.transition(va.Interval(flight, np.array(0.1), np.zeros(12)))
    assert_allclose(Phi, np.eye(12) + 0.1 * F + 0.005 * F @ F, rtol=1e-13, atol=1e-18)


def test_a_steep_nose_is_refused_with_time_and_mend():
    time_s = np.array([0.0, 0.1, 0.2])
    q = np.asarray(from_euler(np.zeros(3), np.deg2rad([0.0, 84.9, -86.0]), np.zeros(3)))
    va.refuse_steep(time_s[:2], q[:2])
    with pytest.raises(ValueError, match=r"pitch is -86\.0 deg at 0\.2 s.*'product'"):
        va.refuse_steep(time_s, q)


def turning(count=200, per_block=5):
    """A banked slave that turns, level at 1000 m, as blocks of increments."""
    E = count // per_block
    rate, force = np.array([0.02, 0.03, 0.05]), np.array([0.2, 0.3, -11.0])
    dt = np.full((E, per_block), 0.02)
    ones = np.ones((E, per_block, 1))
    start = Nav(
        Rotation(from_euler(0.5, 0.03, 1.0)),
        np.array([60.0, 80.0, 0.0]),
        Geodetic(np.array(0.56), np.array(0.1), np.array(1000.0)),
    )
    return start, Increments(dt, ones * rate * 0.02, ones * force * 0.02)


def test_open_loop_holds_the_vertical_and_else_navigates():
    start, blocks = turning()
    found, _ = navigate(start, blocks)
    assert_allclose(found.position.alt, 1000.0, rtol=0, atol=0)
    assert_allclose(found.v_n[:, 2], 0.0, rtol=0, atol=0)
    flat = Increments(*(np.reshape(a, (-1, *a.shape[2:])) for a in blocks[:3]))
    free = mechanise(start, flat)
    # 4 s with the vertical free: it enters the horizontal by rates of 1e-5 rad/s only
    assert_allclose(found.v_n[-1, :2], free.v_n[-1, :2], rtol=0, atol=2e-3)
    angle = Rotation(found.q_nb.wxyz[-1]).local(Rotation(free.q_nb.wxyz[-1]))
    assert_allclose(angle, 0.0, rtol=0, atol=1e-6)


def test_errors_of_the_open_loop_run_as_the_model_says():
    start, blocks = turning()
    size = 1e-2  # of typical errors: what is left is of second order in them
    e = size * np.array([4e-3, -3e-3, 6e-3, 0.1, -0.2, 9.0, 3.0, 2.0, 9.0])
    gyro_bias, accel_bias = (
        size * np.array([2e-5, -1e-5, 3e-5]),
        size * np.array([1e-2, -5e-3, 0.0]),
    )
    dt = blocks.dt[..., None]
    raw = blocks._replace(theta=blocks.theta + gyro_bias * dt, dv=blocks.dv + accel_bias * dt)
    truth, _ = navigate(va.start_with_error(start, np.zeros(9)), blocks)
    wrong, flown = navigate(va.start_with_error(start, e), raw)

    E = len(blocks.dt)
    given = [np.broadcast_to(b, (E, 3)) for b in (gyro_bias, accel_bias)]
    x = np.asarray(va.true_errors(wrong, InsState(*truth, *given)))
    # one interval after the other from the true error, against the model's transition
    for k in range(1, E):
        flight = va.SlaveFlight(*(np.asarray(a)[k] for a in flown))
        Phi = np.asarray(va.transition(va.Interval(flight, np.array(0.1), np.zeros(12))))
        assert_allclose(Phi @ x[k - 1] / TYPICAL, x[k] / TYPICAL, rtol=0, atol=2e-6)


def test_true_errors_are_computed_minus_true_in_the_frames_of_the_model():
    q = np.asarray(from_euler(0.1, 0.2, 0.3))
    phi_enu = np.array([1e-3, 2e-3, -3e-3])
    computed = Nav(
        Rotation(jnp.asarray(q)).retract(-jnp.asarray(swap(phi_enu))),
        np.array([11.0, 22.0, 0.0]),
        Geodetic(np.array(0.6), np.array(0.2), np.array(0.0)),
    )
    true = InsState(
        Rotation(jnp.asarray(q)),
        np.array([10.0, 20.0, 0.0]),
        Geodetic(np.array(0.5), np.array(0.1), np.array(0.0)),
        np.array([1.0, 2.0, 3.0]),
        np.array([4.0, 5.0, 6.0]),
    )
    x = va.true_errors(computed, true)
    expected = [0.1, 0.1, 2.0, 1.0, *phi_enu, 5.0, 4.0, 2.0, 1.0, -3.0]
    assert_allclose(x, expected, rtol=0, atol=1e-15)


def test_the_flight_is_turned_and_shifted_to_what_the_master_reports():
    start, blocks = turning(count=40)
    e = np.array([0.02, -0.03, 0.05, 1.0, -2.0, 0.0, 30.0, 20.0, 0.0])
    truth, flown = navigate(va.start_with_error(start, np.zeros(9)), blocks)
    wrong, astray = navigate(va.start_with_error(start, e), blocks)
    flight, C_nb = va.corrected_by_master(wrong, astray, truth)
    assert_allclose(C_nb, va.dcm_enu(truth.q_nb.wxyz), rtol=0, atol=1e-12)
    # within an interval the difference hardly moves
    assert_allclose(flight.C_nb, flown.C_nb, rtol=0, atol=1e-5)
    assert_allclose(flight.f_enu, flown.f_enu, rtol=0, atol=1e-4)
    assert_allclose(flight.v_enu[:, :2], flown.v_enu[:, :2], rtol=0, atol=0.05)
    assert_allclose(flight.lat_rad, flown.lat_rad, rtol=0, atol=1e-7)

    silent = jax.tree.map(lambda a: a.at[3].set(jnp.nan), truth)
    flight, C_nb = va.corrected_by_master(wrong, astray, silent)
    assert_allclose(C_nb[3], va.dcm_enu(wrong.q_nb.wxyz)[3], rtol=0, atol=0)
    assert_allclose(flight.f_enu[3], astray.f_enu[3], rtol=0, atol=0)
    assert_allclose(flight.v_enu[3], astray.v_enu[3], rtol=0, atol=0)
    assert_allclose(flight.lat_rad[3], astray.lat_rad[3], rtol=0, atol=0)
