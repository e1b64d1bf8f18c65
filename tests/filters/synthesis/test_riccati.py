"""Kalman gains and the least inflation that meets gamma, against tables and searches."""

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from design_plants import attitude_axis, kinematics, quaternion, two_states

from robins.filters.synthesis import (
    Unreachable,
    certify,
    current_form,
    error_system,
    h2_norm,
    hinf_norm,
    inflated_gain,
    kalman_design,
    kalman_gain,
    least_riccati_gamma,
    plant,
    riccati,
)

RADIAN = np.pi / 648000.0  # of an arcsecond


def iterated_gain(p, steps):
    """The Kalman gain after many steps of the Riccati recursion."""
    P = np.eye(len(p.A))
    for _ in range(steps):
        S = p.C @ P @ p.C.T + p.Dw @ p.Dw.T
        K = (p.A @ P @ p.C.T + p.Bw @ p.Dw.T) @ np.linalg.inv(S)
        e = error_system(p, K)
        P = e.A @ P @ e.A.T + e.Bw @ e.Bw.T
    return K


def random_plants(count):
    rng = np.random.default_rng(0)
    for _ in range(count):
        n, m, p, q = rng.integers(1, 5), rng.integers(1, 3), rng.integers(2, 5), rng.integers(1, 3)
        A = rng.normal(size=(n, n)) / np.sqrt(n)
        yield plant(
            A,
            rng.normal(size=(n, p)),
            rng.normal(size=(n, q)),
            rng.normal(size=(m, n)),
            np.hstack([rng.normal(size=(m, p - 1)), rng.normal(size=(m, 1))]),
            rng.normal(size=(m, q)),
        )


# ------------------------------------------------------------------------------ Kalman filter


def test_the_kalman_gain_is_the_limit_of_the_recursion_cross_terms_and_all():
    for p in (two_states(), *random_plants(10)):
        np.testing.assert_allclose(kalman_gain(p), iterated_gain(p, 1000), rtol=1e-8, atol=1e-9)


def test_no_gain_has_a_smaller_h2_norm():
    rng = np.random.default_rng(1)
    for p in (two_states(), attitude_axis(), *random_plants(4)):
        K = kalman_gain(p)
        best = kalman_design(p).h2
        for _ in range(20):
            e = error_system(p, K * (1.0 + 1e-3 * rng.normal(size=K.shape)))
            assert h2_norm(e.A, e.Bw, e.L) >= best * (1.0 - 1e-12)


def test_the_kalman_filters_of_the_specification():
    design = kalman_design(two_states())
    assert (design.h2, design.hinf) == pytest.approx((0.6571125579, 1.70093599), rel=5e-9)
    design = kalman_design(attitude_axis())
    assert (design.h2, design.hinf) == pytest.approx((2.884756, 5.508426), abs=5e-7)
    np.testing.assert_allclose(design.gain, [[0.083218], [-0.0003385]], atol=5e-7)
    assert (design.method, design.gamma, design.lambda_, design.order) == (
        "kalman", np.inf, 0.0, "observer",
    )  # fmt: skip


def test_small_units_do_not_drown():
    # Radians: variances of 1e-10 and 1e-16 beside each other.
    arcsec, radian = kalman_design(attitude_axis()), kalman_design(attitude_axis(unit=RADIAN))
    np.testing.assert_allclose(radian.gain, arcsec.gain, rtol=1e-9)
    assert radian.h2 == pytest.approx(RADIAN * arcsec.h2, rel=1e-10)
    assert radian.hinf == pytest.approx(arcsec.hinf, rel=1e-9)
    # and states, noises and measurements of units of their own
    p = two_states()
    T, M = np.diag([1e6, 1e-7]), np.array([[1e9]])
    inverse = np.linalg.inv(T)
    q = plant(
        T @ p.A @ inverse, T @ p.Bw, T @ p.Bn, M @ p.C @ inverse, M @ p.Dw, None, p.L @ inverse
    )
    for gamma in (np.inf, 1.0):
        one, other = riccati(p, gamma), riccati(q, gamma)
        np.testing.assert_allclose(inverse @ other.gain @ M, one.gain, rtol=1e-8)
        assert (other.h2, other.hinf) == pytest.approx((one.h2, one.hinf), rel=1e-8)


def test_a_measurement_without_noise():
    # Each state measured at once and exactly: the gain is A, what is left is one step's noise.
    p = plant([[1.0, 1.0], [0.0, 1.0]], np.diag([2.0, 3.0]), np.eye(2), np.eye(2))
    design = kalman_design(p)
    np.testing.assert_allclose(design.gain, p.A, atol=1e-12)
    assert design.h2 == pytest.approx(np.sqrt(13.0), rel=1e-12)
    assert design.hinf == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize(
    ("blocks", "why"),
    [
        # a constant that nothing drives: its gain goes to zero and never gets there
        (([[1.0]], [[0.0, 0.0]], [[1.0]], [[1.0]], [[0.0, 1.0]]), "no steady state.*in Bw"),
        # the same noise-free sum measured twice
        (
            (0.5 * np.eye(1), [[1.0]], [[1.0]], [[1.0], [1.0]]),
            "Dw has rank 0, not 2, and .* one combination .* free of noise.* in Dw",
        ),
        # two noise-free sensors of a stable plant that one noise drives
        (
            ([[0.9, 0.2], [-0.1, 0.8]], [[1.0], [0.5]], [[0.0], [1.0]], np.eye(2)),
            "Dw has rank 0, not 2, and .* one combination .* free of noise.* in Dw",
        ),
        # the same sensor noise in two sensors
        (
            (0.5 * np.eye(1), [[1.0, 0.0]], [[1.0]], [[1.0], [1.0]], [[0.0, 1.0], [0.0, 1.0]]),
            "Dw has rank 1, not 2, and .* one combination .* free of noise",
        ),
        # a difference without noise: what is constant is not in it
        (
            ([[0.0, 0.0], [1.0, 0.0]], [[1.0], [0.0]], [[0.0], [1.0]], [[1.0, -1.0]]),
            r"Dw has rank 0, not 1, and near z = exp\(0 i\)",
        ),
    ],
)
def test_no_kalman_filter(blocks, why):
    with pytest.raises(ValueError, match=why):
        kalman_gain(plant(*blocks))


# -------------------------------------------------------------------------------- lambda form

# Section 3.1: gamma, H2, lambda, each as it is printed.
AXIS = [
    (4.9576, 2.8924, 0.6746),
    (3.8559, 2.9706, 2.932),
    (2.7542, 3.1983, 8.136),
    (1.6525, 3.7716, 25.09),
    (1.1017, 4.3788, 53.65),
    (0.5508, 5.6129, 169.7),
]


@pytest.mark.parametrize(("gamma", "h2", "lambda_"), AXIS)
def test_the_attitude_axis_of_the_specification(gamma, h2, lambda_):
    design = riccati(attitude_axis(), gamma)
    assert design.h2 == pytest.approx(h2, abs=1.2e-4)
    assert design.lambda_ == pytest.approx(lambda_, rel=1e-3)
    assert design.hinf == pytest.approx(gamma, rel=1e-8)
    assert design.hinf <= gamma * (1.0 + 1e-9)
    assert design.radius < 1.0


def test_the_gain_of_the_attitude_axis_and_its_limit():
    design = riccati(attitude_axis(), 2.7542)
    np.testing.assert_allclose(design.gain, [[0.15365], [-0.000325]], atol=1e-5)
    raw = riccati(attitude_axis(), 1e-4)
    np.testing.assert_allclose(raw.gain, [[1.0], [0.0]], atol=2e-4)


def test_the_least_lambda_is_taken():
    for p, gamma in ((two_states(), 1.0), (attitude_axis(), 2.7542)):
        design = riccati(p, gamma)
        np.testing.assert_allclose(design.gain, inflated_gain(p, design.lambda_), rtol=1e-12)
        e = error_system(p, inflated_gain(p, 0.999 * design.lambda_))
        assert hinf_norm(e.A, e.Bn, e.L) > gamma * (1.0 + 1e-6)
        # 1 as large as w: noise [w, n] itself
        both = plant(p.A, np.hstack([p.Bw, p.Bn]), p.Bn, p.C, np.hstack([p.Dw, p.Dn]), p.Dn, p.L)
        np.testing.assert_allclose(inflated_gain(p, 1.0), kalman_gain(both), rtol=1e-9)


@pytest.mark.parametrize(("gamma", "h2"), [(1.0, 0.9420), (0.8, 1.6678)])
def test_where_it_is_not_the_best(gamma, h2):
    assert riccati(two_states(), gamma).h2 == pytest.approx(h2, abs=1e-4)


def test_the_least_of_the_curve_is_sought_as_far_as_it_falls():
    # A sensor of its own sees n, at a millionth: K = [., 1e6] keeps it out, at a great lambda.
    p = plant([[0.9]], [[1.0, 0, 0]], [[1.0]], [[1], [0]], [[0, 1.0, 0], [0, 0, 1]], [[0], [1e-6]])
    assert least_riccati_gamma(p) < 1e-9
    assert riccati(p, 0.1).hinf == pytest.approx(0.1, rel=1e-9)


def test_where_it_cannot():
    p = two_states()
    with pytest.raises(
        Unreachable, match=r"cannot reach gamma 0\.7 for any lambda tried: the least is"
    ) as e:
        riccati(p, 0.7)
    least = least_riccati_gamma(p)
    assert e.value.least == least
    assert f"{least:.6g}" in str(e.value)

    # the least of the curve, found by another search
    def norm(exponent):
        error = error_system(p, inflated_gain(p, float(np.exp(exponent))))
        return hinf_norm(error.A, error.Bn, error.L)

    found = scipy.optimize.minimize_scalar(norm, bracket=(3.0, 7.0))
    assert least == pytest.approx(found.fun, rel=1e-6)
    # what it names can be had
    assert riccati(p, least * (1.0 + 1e-6)).hinf <= least * (1.0 + 2e-6)


def test_no_bound_and_one_that_is_met_anyway_give_the_kalman_filter():
    p = two_states()
    for gamma in (np.inf, 1.7010):
        design = riccati(p, gamma)
        assert np.array_equal(design.gain, kalman_gain(p))
        assert (design.lambda_, design.gamma) == (0.0, gamma)
    assert riccati(p, 1.7).lambda_ > 0.0


@pytest.mark.parametrize("gamma", [0.0, -1.0, np.nan])
def test_gamma_must_be_positive(gamma):
    with pytest.raises(ValueError, match="gamma must be positive"):
        riccati(two_states(), gamma)


@pytest.mark.parametrize("lambda_", [-1.0, np.inf, np.nan])
def test_lambda_must_be_a_number(lambda_):
    with pytest.raises(ValueError, match="lambda must be a number from 0 on"):
        inflated_gain(two_states(), lambda_)


def test_a_modelling_error_that_nothing_can_keep_out():
    # n is in the measurement of the only state: a gain lets it in, none lets the state's own in.
    p = plant([[0.9]], [[1.0, 0.0]], [[1.0, 0.0]], [[1.0]], [[0.0, 1.0]], [[0.0, 1.0]])
    least = least_riccati_gamma(p)
    k = np.linspace(-0.09, 1.89, 4001)
    norms = np.sqrt(1.0 + k**2) / (1.0 - np.abs(0.9 - k))
    assert least >= np.min(norms) * (1.0 - 1e-9)
    with pytest.raises(Unreachable):
        riccati(p, 0.99 * np.min(norms))


# ------------------------------------------------------------------- quaternion, rotating body


@pytest.mark.parametrize(
    ("gamma", "h2", "hinf"),
    [
        (5.0, 3.7637, 1.7707),
        (1.5, 3.7947, 1.5),
        (1.0, 4.1634, 1.0),
        (0.7, 4.9352, 0.7),
        (0.52, 6.1106, 0.52),
    ],
)
def test_the_quaternion_of_the_specification(gamma, h2, hinf):
    design = riccati(quaternion(), gamma)
    assert design.h2 == pytest.approx(h2, rel=1e-4)
    assert design.hinf == pytest.approx(hinf, rel=1e-4)


def test_the_placement_of_the_document_gives_the_raw_star_reading():
    # All star noise in n: the best gain is A whatever gamma is, and the least gamma is there too.
    q = quaternion()
    for b, ss in ((0.5, 0.5), (0.5, 0.1)):
        Bn = np.hstack([b * kinematics([0.5, 0.1, -0.7, 0.5]), np.zeros((4, 4))])
        Bn[:, :3] /= np.sqrt(0.25 + 0.01 + 0.49 + 0.25)
        p = plant(
            q.A, np.eye(4), Bn, np.eye(4), None, np.hstack([np.zeros((4, 3)), ss * np.eye(4)])
        )
        for gamma in (3.0, 30.0):
            design = riccati(p, gamma)
            np.testing.assert_allclose(design.gain, p.A, atol=1e-9)
            assert design.h2 == pytest.approx(2.0, rel=1e-9)
            assert design.hinf == pytest.approx(np.hypot(b, ss), rel=1e-9)


@pytest.mark.parametrize(
    ("rate_rad_s", "h2", "hinf"),
    [
        (0.0, 3.19833, 2.75413),
        (0.005, 3.19833, 2.75437),
        (0.02, 3.19832, 2.75486),
        (0.1, 3.19826, 2.75545),
        (0.5, 3.19692, 2.75553),
    ],
)
def test_the_gain_of_one_axis_on_a_turning_body(rate_rad_s, h2, hinf):
    gain = riccati(attitude_axis(), 2.7542).gain
    turning = attitude_axis(axes=3, rate_rad_s=rate_rad_s * np.array([1.0, 2.0, -2.0]) / 3.0)
    design = certify(turning, np.kron(gain, np.eye(3)), method="one axis thrice")
    assert design.h2 / np.sqrt(3.0) == pytest.approx(h2, rel=1e-5)
    assert design.hinf == pytest.approx(hinf, rel=5e-5)


def test_a_current_estimator_and_a_predictor_are_the_same_filter():
    # Gains differ by A; the filters' errors are one step apart, so the worst case is not the same.
    A, Bw, C, Dv = np.array([[0.9, 0.2], [-0.1, 0.8]]), 0.3 * np.eye(2), [[1.0, 0.0]], [[0.5]]
    current = kalman_gain(current_form(A, Bw, Bw, C, Dv))
    np.testing.assert_allclose(kalman_gain(two_states()), A @ current, rtol=1e-9)
    P = scipy.linalg.solve_discrete_are(A.T, np.transpose(C), Bw @ Bw.T, np.square(Dv))
    P = P - current @ np.asarray(C) @ P  # after the update
    e = error_system(current_form(A, Bw, Bw, C, Dv), current)
    assert h2_norm(e.A, e.Bw, e.L) ** 2 == pytest.approx(np.trace(P), rel=1e-9)
