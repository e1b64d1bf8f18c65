"""Certification: true norms of an observer and of a full-order filter, and which test is failed."""

import numpy as np
import pytest
from design_plants import attitude_axis, two_states

from robins.filters.synthesis import (
    NotCertified,
    certify,
    certify_full,
    design,
    error_system,
    h2_norm,
    hinf_norm,
    kalman_design,
    kalman_gain,
)

K = kalman_gain(two_states())
H2, HINF = 0.6571125579, 1.70093599


def test_a_design_holds_what_was_asked_and_what_is_true():
    made = certify(
        two_states(),
        K.tolist(),
        method="m",
        gamma=2,
        bound=0.7,
        lambda_=3.0,
        status="ok",
        seconds=1.0,
    )
    assert made[:2] == ("m", 2.0)
    assert np.array_equal(made.gain, K)
    assert (made.order, made.filter, made.bound, made.lambda_) == ("observer", None, 0.7, 3.0)
    assert (made.status, made.seconds) == ("ok", 1.0)
    assert (made.h2, made.hinf, made.hinf_sweep) == pytest.approx((H2, HINF, HINF), rel=5e-9)
    A = two_states().A - K @ two_states().C
    assert made.radius == pytest.approx(np.max(np.abs(np.linalg.eigvals(A))), rel=1e-14)


def test_an_observer_written_as_a_filter_of_full_order_has_the_same_norms():
    p = two_states()
    full = certify_full(p, (p.A - K @ p.C, K, p.L), method="m", gamma=1.71, bound=0.66)
    observer = kalman_design(p)
    assert (full.h2, full.hinf) == pytest.approx((observer.h2, observer.hinf), rel=1e-9)
    assert (full.order, len(full.filter)) == ("full", 3)
    assert np.array_equal(full.gain, K)
    # the plant itself decays more slowly than the error
    assert full.radius == pytest.approx(np.max(np.abs(np.linalg.eigvals(p.A))), rel=1e-12)


def test_a_filter_of_full_order_that_estimates_nothing_errs_by_the_plant():
    p = two_states()
    made = certify_full(p, (0.5 * np.eye(2), np.zeros((2, 1)), np.zeros((2, 2))), method="m")
    assert made.h2 == pytest.approx(h2_norm(p.A, p.Bw, p.L), rel=1e-12)
    assert made.hinf == pytest.approx(hinf_norm(p.A, p.Bn, p.L), rel=1e-9)


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        ({"gain": 0.0 * K - 1.0}, r"its error does not decay, spectral radius 2\.04462"),
        ({"bound": H2 / 1.0011}, "true H2 norm 0.657113 above the promised 0.65639"),
        ({"gamma": HINF / 1.0000011}, "true H-infinity norm 1.70093599 above gamma 1.70093412"),
        ({"bound": np.nan, "gamma": 1.0, "status": "optimal"}, r"\(the solver said 'optimal'\)"),
    ],
)
def test_a_broken_promise_is_named(asked, why):
    gain = asked.pop("gain", K)
    with pytest.raises(NotCertified, match=f"lmi: the answer is not certified: .*{why}"):
        certify(two_states(), gain, method="lmi", **asked)


def test_promises_are_kept_within_what_a_solver_can_do():
    certify(two_states(), K, method="m", bound=H2 / 1.0009, gamma=HINF / 1.0000009)


def test_two_computations_that_differ_are_not_believed(monkeypatch):
    monkeypatch.setattr(design.norms, "peak_gain", lambda A, B, C: 0.99999 * hinf_norm(A, B, C))
    with pytest.raises(NotCertified, match=r"1\.70093599 by .* but 1\.70091898 by a sweep"):
        certify(two_states(), K, method="m")


def test_a_plant_that_does_not_decay_has_no_certified_filter_of_full_order():
    p = attitude_axis()
    gain = kalman_gain(p)
    e = error_system(p, gain)
    with pytest.raises(NotCertified, match="its error does not decay, spectral radius 1"):
        certify_full(p, (e.A, gain, p.L), method="m")
