"""The bank turn and the linear system of attitude matching, against rotation matrices."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from interpreted import run
from scipy.spatial.transform import Rotation as R

from robins import rotation, scenario
from robins.filters import kalman
from robins.filters.rules.h_infinity import h_infinity, with_gamma
from robins.sim.flexure import Flexure
from robins.systems import transfer_alignment
from robins.systems.transfer_alignment.attitude_matching.model import (
    ATTITUDE,
    attitude_enu,
    error_dynamics,
    heading_rad,
    linear_system,
    load_factor,
    matching_matrix,
    mean_attitude_enu,
    rate_in_enu,
    roll_rad,
)
from robins.systems.transfer_alignment.attitude_matching.parameters import AttitudeMatching
from robins.systems.transfer_alignment.attitude_matching.study import central_filter, existence
from robins.systems.transfer_alignment.attitude_matching.world import lay_out

S0 = Path(transfer_alignment.__file__).parent / "scenarios" / "s0.toml"
GIVEN = scenario.load(AttitudeMatching, S0)
TURN, COURSE, PERIOD_S, UPDATES = GIVEN.manoeuvre, lay_out(GIVEN), 0.05, 400
SYSTEM = linear_system(GIVEN, UPDATES)
DEG = np.pi / 180.0
UNITS = {"rad": 1.0, "deg": DEG, "arcmin": DEG / 60.0}


def exp(v):
    return R.from_rotvec(v).as_matrix()


def log(C):
    return R.from_matrix(C).as_rotvec()


def slope(f, h):
    """Derivative at zero, good to h^4."""
    return (8.0 * (f(h) - f(-h)) - (f(2.0 * h) - f(-2.0 * h))) / (12.0 * h)


def jacobian(f, n, h=1e-3):
    return np.stack([slope(lambda d, i=i: f(d * np.eye(n)[i]), h) for i in range(n)], axis=-1)


# ----------------------------------------------------------------------------------- the bank turn


def test_the_manoeuvre_is_the_one_of_the_paper():
    t_s = np.array([0.0, 0.5, 1.0, 6.0, 12.0, 12.5, 13.0, 20.0])
    np.testing.assert_allclose(
        roll_rad(TURN, t_s)[[1, 2, 4, 6]] / DEG, [35.78, 71.57, 71.57, 0], atol=0.01
    )
    rate = 3.0 * 9.80665 / 240.0
    np.testing.assert_allclose(
        heading_rad(TURN, t_s), rate * np.array([0, 0, 0, 5, 11, 11, 11, 11])
    )
    assert heading_rad(TURN, 20.0) / DEG == pytest.approx(77.3, abs=0.1)
    np.testing.assert_allclose(load_factor(TURN, t_s)[[0, 3, 7]], [1.0, np.sqrt(10.0), 1.0])
    # a coordinated turn: the force of the wings along the aircraft's own up, in ENU
    force = attitude_enu(TURN, 6.0)[:, 2] * load_factor(TURN, 6.0)
    heading = heading_rad(TURN, 6.0)
    np.testing.assert_allclose(force, [3 * np.cos(heading), -3 * np.sin(heading), 1.0], atol=1e-12)


def test_attitudes_are_those_of_the_house_relabelled():
    t_s = np.linspace(0.0, 20.0, 41)
    ned = rotation.from_euler(roll_rad(TURN, t_s), 0.0, heading_rad(TURN, t_s))
    T = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    np.testing.assert_allclose(
        attitude_enu(TURN, t_s), T @ np.asarray(rotation.to_dcm(ned)) @ T, atol=1e-15
    )
    left = TURN.model_copy(update={"acceleration": -TURN.acceleration, "heading": 0.4})
    assert heading_rad(left, 3.0) < 0.4
    assert roll_rad(left, 3.0) < 0.0


def test_the_frame_turns_with_the_earth_and_the_aircraft():
    h = heading_rad(TURN, 7.0)
    w = 1.0 - 0.00669437999014 * np.sin(34.0 * DEG) ** 2
    RN = 6378137.0 / np.sqrt(w)
    RM = RN * (1.0 - 0.00669437999014) / w
    east, north = 240.0 * np.sin(h), 240.0 * np.cos(h)
    want = [
        -north / RM,
        7.292115e-5 * np.cos(34.0 * DEG) + east / RN,
        7.292115e-5 * np.sin(34.0 * DEG) + east * np.tan(34.0 * DEG) / RN,
    ]
    np.testing.assert_allclose(rate_in_enu(TURN, 7.0), want, rtol=1e-12)
    assert rate_in_enu(TURN, np.zeros((2, 3))).shape == (2, 3, 3)


def test_a_mean_attitude_is_the_integral():
    begin_s = np.array([0.3, 0.97, 5.0])
    points, weights = np.polynomial.legendre.leggauss(20)
    for k, begin in enumerate(begin_s):
        pieces = (
            [(begin, min(begin + PERIOD_S, 1.0)), (1.0, begin + PERIOD_S)]
            if k == 1
            else [(begin, begin + PERIOD_S)]
        )
        total = sum(
            (b - a)
            / 2
            * np.tensordot(weights, attitude_enu(TURN, a + (points + 1) * (b - a) / 2), 1)
            for a, b in pieces
        )
        np.testing.assert_allclose(
            mean_attitude_enu(TURN, begin_s, PERIOD_S)[k],
            total / PERIOD_S,
            atol=2e-5 if k == 1 else 1e-7,
        )


# --------------------------------------------------------------------------------- F, H, Q and P0


@pytest.mark.parametrize("seed", range(5))
def test_F_is_what_rotation_matrices_do(seed):
    rng = np.random.default_rng(seed)
    C = R.random(rng=rng).as_matrix()
    omega_in, omega_ib = rng.normal(size=3), rng.normal(size=3)

    def phi_after(x, h):
        computed = exp(-omega_in * h) @ exp(-x[:3]) @ C @ exp((omega_ib + x[3:6]) * h)
        true = exp(-omega_in * h) @ C @ exp(omega_ib * h)
        return -log(computed @ true.T)

    def rate(x):
        return slope(lambda h: phi_after(x, h), 3e-3)

    F = error_dynamics(C, omega_in)
    scale = np.max(np.abs(F[:3]), axis=1, keepdims=True)
    np.testing.assert_array_less(np.abs(jacobian(rate, 9) - F[:3]) / scale, 1e-7)
    assert not np.any(F[3:])  # drift and mounting stay


@pytest.mark.parametrize("seed", range(5))
def test_H_is_what_rotation_matrices_do(seed):
    rng = np.random.default_rng(seed)
    C_mn, nominal = (R.random(rng=rng).as_matrix() for _ in range(2))

    def Z(x):
        true = C_mn @ exp(x[9:12]) @ nominal @ exp(x[6:9])
        M = C_mn @ nominal @ (exp(-x[:3]) @ true).T
        return 0.5 * np.array([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]])

    measured = jacobian(Z, 15)
    np.testing.assert_allclose(matching_matrix(C_mn, nominal, True), measured, atol=1e-8)
    np.testing.assert_allclose(matching_matrix(C_mn, nominal), measured[:, :9], atol=1e-8)


def test_a_period_is_integrated_with_its_own_attitude():
    # through the roll-in, against a hundred rotations a period
    x = np.concatenate([[2e-5, -1e-5, 3e-5], [2e-6, 3e-6, -1e-6], np.zeros(3)])
    fine = PERIOD_S / 100
    for k in (0, 7, 19, 100):
        C, computed = (
            attitude_enu(TURN, k * PERIOD_S),
            exp(-x[:3]) @ attitude_enu(TURN, k * PERIOD_S),
        )
        for j in range(100):
            t_s = k * PERIOD_S + j * fine
            n = exp(-rate_in_enu(TURN, t_s + fine / 2) * fine)
            after = attitude_enu(TURN, t_s + fine)
            theta = log(C.T @ n.T @ after)
            computed = n @ computed @ exp(theta + x[3:6] * fine)
            C = after
        np.testing.assert_allclose(-log(computed @ C.T), (SYSTEM.F[k] @ x)[:3], atol=2e-10)


def test_noise_and_start_are_those_asked_for():
    Q = SYSTEM.G @ SYSTEM.G.T
    np.testing.assert_allclose(np.diag(Q)[:3], (0.1 * DEG / 60.0) ** 2 * PERIOD_S)
    assert np.count_nonzero(Q) == 3
    P0 = np.diag(np.repeat([0.5, 1 / 3600, 0.3], 3) * DEG) ** 2
    np.testing.assert_allclose(SYSTEM.start().covariance, P0)


def test_flexure_swings_by_itself_and_enters_z_once():
    sigma, tau, zeta = np.array([20.0, 10.0, 0.0]) * DEG / 60.0, np.array([1.0, 3.0, 2.0]), 0.7
    flexible = linear_system(GIVEN, 30, Flexure(sigma, tau, zeta))
    Q, P0 = flexible.G @ flexible.G.T, np.diag(flexible.sigma) ** 2
    assert flexible.F.shape == (30, 15, 15)
    np.testing.assert_array_equal(flexible.F[:, :9, :9], SYSTEM.F[:30])
    assert not np.any(flexible.F[:, :9, 9:])  # it drives no other state,
    assert not np.any(flexible.F[:, 9:, :9])  # and none drives it
    np.testing.assert_array_equal(flexible.H[:, :, 9:12], flexible.H[:, :, 6:9])  # identity mount
    assert not np.any(flexible.H[:, :, 12:])
    for axis in range(3):
        both = np.ix_([9 + axis, 12 + axis], [9 + axis, 12 + axis])
        wn = 2.146 / tau[axis]
        A = np.array([[0.0, 1.0], [-(wn**2), -2.0 * zeta * wn]])
        Phi = scipy.linalg.expm(A * PERIOD_S)
        S = sigma[axis] ** 2 * np.diag([1.0, wn**2])
        np.testing.assert_allclose(flexible.F[0][both], Phi, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(Q[both], S - Phi @ S @ Phi.T, rtol=1e-7, atol=1e-17)
        np.testing.assert_allclose(P0[both], S, rtol=1e-9, atol=1e-15)


def test_what_the_model_linearises_to_is_what_it_does():
    model, (u, aux) = SYSTEM.model(0.3), SYSTEM.inputs()
    x = jnp.arange(1.0, 10.0)
    moved, F, G = model.motion.linear(x, u[5])
    np.testing.assert_array_equal(moved, model.motion.step(x, u[5]))
    np.testing.assert_array_equal(F, u[5])
    np.testing.assert_array_equal(G, SYSTEM.G)
    z, H = model.sensors[0].linear(x, aux[ATTITUDE][5])
    np.testing.assert_array_equal(z, model.sensors[0].read(x, aux[ATTITUDE][5]))
    np.testing.assert_array_equal(H, SYSTEM.H[5])


# ------------------------------------------------------------------------------------------- units


def mean_and_sigma(step):
    return step.posterior.mean, step.posterior.sigma


def estimates(one, system, sigma, gamma, z):
    model, (u, aux) = system.model(sigma), system.inputs()
    found = run(with_gamma(one, gamma), model, system.start(), z, u, aux, keep=mean_and_sigma)
    return [np.asarray(a) for a in found.steps]


def test_the_paper_in_a_unit_is_its_weights_in_radians():
    z = 0.01 * np.sin(np.arange(UPDATES)[:, None] * [0.1, 0.2, 0.3])
    by_unit = {}
    for name, one in UNITS.items():
        literal = estimates(central_filter(), SYSTEM.in_unit(name), 1.0, 200.0, z / one)
        weighted = estimates(central_filter(), SYSTEM, one, 200.0 * one, z)
        for a, b in zip(literal, weighted, strict=True):
            np.testing.assert_allclose(a * one, b, rtol=1e-9, atol=1e-13)
        by_unit[name] = weighted[0][-1, 0]
    # and these are filters of their own
    assert abs(by_unit["rad"]) < 0.05 * abs(by_unit["deg"])
    assert abs(by_unit["arcmin"] - by_unit["deg"]) > 0.1 * abs(by_unit["deg"])


def test_with_physical_weights_the_unit_makes_no_difference():
    one = kalman(rules=[h_infinity(np.inf, np.eye(9)[:3])])
    z = 0.01 * np.cos(np.arange(UPDATES)[:, None] * [0.1, 0.2, 0.3])
    minute = UNITS["arcmin"]
    found = [
        [
            size * a
            for a in estimates(
                one, SYSTEM.in_unit(name), minute / size, 75.0 * minute / size, z / size
            )
        ]
        for name, size in UNITS.items()
    ]
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-13)
    free = estimates(one, SYSTEM, minute, np.inf, z)[0]
    assert np.max(np.abs(free - found[0][0])) > 1e-6  # gamma acts


@pytest.mark.parametrize(
    ("unit", "identity", "least", "exists"),
    [
        ("rad", False, 0.172, True),
        ("deg", False, 4.656, True),
        ("arcmin", False, 100.69, False),
        ("rad", True, 15.71, True),
        ("deg", True, 15.71, True),
        ("arcmin", True, 15.84, True),
    ],
)
def test_gamma_min_in_each_unit(unit, identity, least, exists):
    system = SYSTEM.in_unit(unit)
    if identity:
        system = system._replace(sigma=np.ones(9))
    found = existence(central_filter(), system, 1.0, COURSE, 50.0)
    assert found["gamma_min"] == pytest.approx(least, rel=0.01 if unit == "rad" else 1e-3)
    assert found["feasible"] == exists
    if not exists:
        assert found["infeasible_at_update"] == 6
        assert found["infeasible_at_s"] == pytest.approx(0.30)
        assert np.isnan(found["margin"])


def test_an_outage_counts_for_nothing():
    # local bounds only grow while nothing is measured, but the cost is not counted there
    heard = COURSE.received.copy()
    heard[100:200] = False
    system = SYSTEM.in_unit("deg")
    with_gap = existence(central_filter(), system, 1.0, COURSE._replace(received=heard), 50.0)
    whole = existence(central_filter(), system, 1.0, COURSE, 50.0)
    assert with_gap["feasible"]
    assert with_gap["gamma_min"] != pytest.approx(whole["gamma_min"], rel=1e-2)
    none = existence(
        central_filter(), system, 1.0, COURSE._replace(received=~COURSE.received), 50.0
    )
    assert (none["gamma_min"], none["margin"]) == (0.0, 1.0)
