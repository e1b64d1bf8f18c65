"""Designs by LMI: tables, the inequalities by eigenvalues, units, bad answers."""

import subprocess
import sys
from functools import cache

import numpy as np
import pytest
from design_plants import attitude_axis, quaternion, two_states

from robins.filters.synthesis import (
    NotCertified,
    Unreachable,
    certify,
    error_system,
    h2_norm,
    kalman_gain,
    lmi,
    programs,
    spectral_radius,
)
from robins.filters.synthesis.lmi import full, observer
from robins.filters.synthesis.scaling import balanced


@cache
def on_two_states(gamma, form="common"):
    return full(two_states(), gamma) if form == "full" else observer(two_states(), gamma, form)


@cache
def on_axis(gamma, form):
    return observer(attitude_axis(), gamma, form)


# ------------------------------------------------------------------------------------ the tables


@pytest.mark.parametrize(
    ("gamma", "bound", "true_h2", "true_hinf"),
    [
        (5.0, 0.6623110, 0.65715, 1.68498),
        (2.0, 0.7024540, 0.66110, 1.55597),
        (1.0, 1.2603915, 0.98380, 0.95739),
        (0.8, 2.1827261, 1.62766, 0.77846),
        (0.7, 3.4650439, 2.59164, 0.68947),
    ],
)
def test_full_and_observer_form_have_one_bound(gamma, bound, true_h2, true_hinf):
    own, inside = on_two_states(gamma, "full"), on_two_states(gamma)
    for design in (own, inside):
        assert design.bound == pytest.approx(bound, rel=1e-6)
        assert design.h2 == pytest.approx(true_h2, rel=1e-4)
        assert design.hinf == pytest.approx(true_hinf, rel=1e-4)
    assert own.order == "full"
    assert own.filter is not None
    Ah, Bh, Gh = own.filter
    # with R near nothing the filter of full order is nearly an observer
    np.testing.assert_allclose(Ah, two_states().A - Bh @ two_states().C, rtol=0, atol=1e-3)
    np.testing.assert_allclose(Gh, np.eye(2), rtol=0, atol=1e-3)
    np.testing.assert_allclose(Bh, inside.gain, rtol=0, atol=2e-3)


@pytest.mark.parametrize(
    ("gamma", "common", "slack", "bound"),
    [
        (5.0, (3.7660, 1.6922), (3.7637, 1.7707), 3.8050),
        (1.5, (3.9514, 1.1880), (3.8594, 1.3275), 4.2075),
        (1.0, (4.3472, 0.8963), (4.2310, 0.9577), 4.6785),
        (0.7, (5.0747, 0.6690), (4.9689, 0.6921), 5.3690),
        (0.52, (6.1367, 0.5174), (6.1116, 0.5199), 6.1957),
    ],
)
def test_quaternion_designs_turn_the_measurement_with_the_plant(gamma, common, slack, bound):
    whole = quaternion()
    assert observer(whole, gamma).bound == pytest.approx(bound, rel=1e-4)
    for form, wanted in (("common", common), ("slack", slack)):
        found = observer(whole, gamma, form)
        assert (found.h2, found.hinf) == pytest.approx(wanted, rel=1e-4)
        part = found.gain @ whole.A.T  # A is orthogonal: this is a multiple of I
        np.testing.assert_allclose(part, np.mean(np.diag(part)) * np.eye(4), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("gamma", "common", "slack"),
    [
        (4.9576, (3.0198, 3.5148), (2.9781, 3.7962)),
        (3.8559, (3.1423, 2.9458), (3.0873, 3.1690)),
        (2.7542, (3.4032, 2.2342), (3.3303, 2.3947)),
        (1.6525, (4.0087, 1.3975), (3.9063, 1.4998)),
        (1.1017, (4.6355, 0.9448), (4.5068, 1.0195)),
        (0.5508, (5.8806, 0.4779), (5.7113, 0.5228)),
    ],
)
def test_attitude_designs_of_both_forms(gamma, common, slack):
    for form, wanted in (("common", common), ("slack", slack)):
        found = on_axis(gamma, form)
        assert (found.h2, found.hinf) == pytest.approx(wanted, rel=2e-4)
        assert found.h2 < found.bound
    assert on_axis(gamma, "slack").bound < on_axis(gamma, "common").bound


# -------------------------------------------------------------------- without H-infinity: Kalman


@pytest.mark.parametrize("given", [two_states(), attitude_axis(), quaternion()], ids=len)
def test_without_a_modelling_error_it_is_the_kalman_filter(given):
    best = certify(given, kalman_gain(given), method="kalman").h2
    for found in (observer(given, np.inf, form) for form in ("common", "slack")):
        assert found.h2 == pytest.approx(best, rel=1e-8)
        assert found.bound == pytest.approx(best, rel=1e-6)
        assert found.gamma == np.inf
        scale = np.abs(kalman_gain(given)).max()
        np.testing.assert_allclose(found.gain, kalman_gain(given), rtol=0, atol=1e-3 * scale)


# ------------------------------------------------------------- the inequalities, by their blocks


def least_eigenvalue(*rows):
    """Over the greatest, of the symmetric matrix with these blocks; None for zero or symmetry."""
    size = [next(b.shape[0] for b in row if b is not None) for row in rows]
    whole = [
        [np.zeros((size[i], size[j])) if b is None else b for j, b in enumerate(row)]
        for i, row in enumerate(rows)
    ]
    M = np.triu(np.block(whole))
    values = np.linalg.eigvalsh(M + np.triu(M, 1).T)
    return values[0] / values[-1]


def scaled_answer(form, gamma, given):
    scales = balanced(given, gamma)
    scaled = scales.plant(given)
    return scaled, programs.solve(scaled, form, "mixed")


@pytest.mark.parametrize("given", [two_states(), attitude_axis()], ids=["two states", "axis"])
def test_answers_meet_the_inequalities_of_the_observer(given):
    p, answer = scaled_answer("common", 0.8, given)
    X, Y, H = (answer.unknowns[name] for name in "XYH")
    r = len(p.L)
    nine = least_eigenvalue([H, (X @ p.Bw - Y @ p.Dw).T], [None, X])
    q = p.Bn.shape[1]
    ten = least_eigenvalue(
        [X, X @ p.A - Y @ p.C, X @ p.Bn - Y @ p.Dn, None],
        [None, X, None, p.L.T],
        [None, None, np.eye(q), None],
        [None, None, None, np.eye(r)],
    )
    assert min(nine, ten) > -1e-8
    assert answer.value == pytest.approx(np.trace(H), rel=1e-9)
    # and no less: a trace smaller by a thousandth breaks (9)
    assert least_eigenvalue([0.999 * H, (X @ p.Bw - Y @ p.Dw).T], [None, X]) < -1e-5


def test_answers_meet_the_inequalities_of_the_slack_form():
    p, answer = scaled_answer("slack", 0.8, two_states())
    G, Y, H, X2, Xi = (answer.unknowns[name] for name in ("G", "Y", "H", "X2", "Xi"))
    F, q, r = G @ p.A - Y @ p.C, p.Bn.shape[1], len(p.L)
    noise = least_eigenvalue([H, (G @ p.Bw - Y @ p.Dw).T], [None, G + G.T - X2])
    energy = least_eigenvalue([G + G.T - X2, F, None], [None, X2, p.L.T], [None, None, np.eye(r)])
    gain = least_eigenvalue(
        [G + G.T - Xi, F, G @ p.Bn - Y @ p.Dn, None],
        [None, Xi, None, p.L.T],
        [None, None, np.eye(q), None],
        [None, None, None, np.eye(r)],
    )
    assert min(noise, energy, gain) > -1e-8
    assert np.linalg.norm(X2 - Xi) > 0.1  # the two channels have matrices of their own


def test_answers_meet_the_inequalities_of_the_full_order():
    p, answer = scaled_answer("full", 0.8, two_states())
    R, P, S, Q, U, H = (answer.unknowns[name] for name in "RPSQUH")
    q, r = p.Bn.shape[1], len(p.L)
    PA = P @ p.A + Q @ p.C
    six = least_eigenvalue(
        [H, (R @ p.Bw).T, (P @ p.Bw + Q @ p.Dw).T], [None, R, R], [None, None, P]
    )
    seven = least_eigenvalue(
        [R, R, R @ p.A, R @ p.A, R @ p.Bn, None],
        [None, P, PA + S, PA, P @ p.Bn + Q @ p.Dn, None],
        [None, None, R, R, None, (p.L - U).T],
        [None, None, None, P, None, p.L.T],
        [None, None, None, None, np.eye(q), None],
        [None, None, None, None, None, np.eye(r)],
    )
    assert min(six, seven) > -1e-8
    # an observer's solution lies inside: X = P, Y = -Q
    within = least_eigenvalue(
        [P, PA, P @ p.Bn + Q @ p.Dn, None],
        [None, P, None, p.L.T],
        [None, None, np.eye(q), None],
        [None, None, None, np.eye(r)],
    )
    assert within > -1e-8  # as a principal submatrix of (7)


# ----------------------------------------------------------------------------------------- units


def in_units(given, x, y, n, z):
    """The plant with states, measurements, n and z told in other units."""
    return given._replace(
        A=given.A / x[:, None] * x,
        Bw=given.Bw / x[:, None],
        Bn=given.Bn / x[:, None] * n,
        C=given.C / y[:, None] * x,
        Dw=given.Dw / y[:, None],
        Dn=given.Dn / y[:, None] * n,
        L=z * given.L * x,
    )


@pytest.mark.parametrize("form", ["common", "slack"])
def test_units_do_not_matter(form):
    rng = np.random.default_rng(2)
    arcsec = on_axis(2.7542, form)
    for _ in range(4):
        x, y = 10.0 ** rng.uniform(-6, 6, 2), 10.0 ** rng.uniform(-6, 6, 1)
        n, z = 10.0 ** rng.uniform(-6, 6, 2)
        found = observer(in_units(attitude_axis(), x, y, n, z), 2.7542 * n * z, form)
        assert found.status == "optimal"
        assert (found.bound, found.h2) == pytest.approx((z * arcsec.bound, z * arcsec.h2), rel=1e-5)
        assert found.hinf == pytest.approx(z * n * arcsec.hinf, rel=1e-4)


def test_scales_do_not_depend_on_the_units_and_make_numbers_of_order_one():
    rng, given = np.random.default_rng(3), attitude_axis(axes=3, rate_rad_s=(0.02, 0.0, -0.01))
    scaled = balanced(given, 2.0).plant(given)
    x, y, n, z = 10.0 ** rng.uniform(-6, 6, 6), 10.0 ** rng.uniform(-6, 6, 3), 1e-5, 1e4
    other = in_units(given, x, y, n, z)
    for ours, theirs in zip(scaled, balanced(other, 2.0 * n * z).plant(other), strict=True):
        np.testing.assert_allclose(theirs, ours, rtol=0.1, atol=1e-3)
        assert np.abs(ours).max() < 5.0


# -------------------------------------------------------------------- what solvers say and do not


RATES = [(0.1, 0.1, "1.0000125"), (1.0, 0.5, "1.03077641")]


@pytest.mark.parametrize(("rate", "step", "radius"), RATES)
def test_full_order_is_refused_for_the_published_plant_before_any_solver_is_asked(
    rate, step, radius, monkeypatch
):
    published = quaternion(rate_rad_s=rate * step, euler=True)
    monkeypatch.setattr(lmi, "solve", lambda *_: pytest.fail("a solver was asked"))
    with pytest.raises(ValueError, match=rf"spectral radius {radius}.*observer form"):
        full(published, 3.0)


@pytest.mark.parametrize(("rate", "step", "radius"), RATES)
def test_the_solver_would_have_called_it_optimal(rate, step, radius):
    """Reason for the early refusal: R is driven to the tolerance and the answer looks well."""
    published = quaternion(rate_rad_s=rate * step, euler=True)
    scales = balanced(published, 3.0)
    assert programs.solve(scales.plant(published), "full", "mixed").status.startswith("optimal")
    assert spectral_radius(published.A) == pytest.approx(float(radius), rel=1e-8)


def answers(monkeypatch, *given):
    """Let the solver give these answers in turn; functions change what it would have said."""
    turn = iter(given)

    def solve(scaled, form, aim):
        return next(turn)(programs.solve(scaled, form, aim))

    monkeypatch.setattr(lmi, "solve", solve)


def wrong(answer):
    return answer._replace(unknowns=answer.unknowns | {"Y": 5.0 * answer.unknowns["Y"]})


def boastful(answer):
    return answer._replace(value=0.5 * answer.value)


def silent(answer):
    return programs.SolverAnswer("solver_error", np.nan, {})


def doubtful(answer):
    return answer._replace(status="optimal_inaccurate")


def true(answer):
    return answer


def test_an_inaccurate_answer_is_taken_if_its_true_norms_are_right(monkeypatch):
    want = on_two_states(1.0)
    answers(monkeypatch, doubtful)
    found = observer(two_states(), 1.0)
    assert found.status == "optimal_inaccurate"
    assert found.gain == pytest.approx(want.gain)


@pytest.mark.parametrize("first", [wrong, boastful, silent])
def test_an_answer_that_fails_is_sought_again_in_other_units(monkeypatch, first):
    want = on_two_states(1.0)
    answers(monkeypatch, first, true)
    assert observer(two_states(), 1.0).h2 == pytest.approx(want.h2, rel=1e-4)


def test_no_good_answer_is_an_error_that_tells_status_and_test(monkeypatch):
    answers(monkeypatch, wrong, silent)
    with pytest.raises(
        NotCertified,
        match=r"spectral radius .*'optimal'.*; then .*'solver_error'.*No proof .* has 0\.594542",
    ):
        observer(two_states(), 1.0)
    answers(monkeypatch, boastful, boastful)
    with pytest.raises(NotCertified, match=r"true H2 norm .* above the promised"):
        observer(two_states(), 1.0)


def test_a_filter_that_r_spoils_is_taken_in_the_limit(monkeypatch):
    """R and S at the solver's tolerance may make an (8) that is no filter."""

    def spoilt(answer):
        return answer._replace(unknowns=answer.unknowns | {"S": 3.0 * answer.unknowns["S"]})

    want = on_two_states(1.0)
    answers(monkeypatch, spoilt)
    found = full(two_states(), 1.0)
    assert found.filter is not None
    Ah, Bh, Gh = found.filter
    np.testing.assert_allclose(Ah, two_states().A - Bh @ two_states().C, rtol=0, atol=1e-14)
    np.testing.assert_allclose(Gh, np.eye(2), rtol=0, atol=1e-14)
    assert found.h2 == pytest.approx(want.h2, rel=1e-3)


@pytest.mark.parametrize("design", [observer, full])
def test_a_gamma_out_of_reach_is_told_with_the_least(design):
    with pytest.raises(Unreachable, match=r"gamma 0\.59 is below the least .* 0\.594542 ") as told:
        design(two_states(), 0.59)
    assert told.value.least == pytest.approx(0.594542, rel=1e-5)


def test_bad_arguments_are_refused():
    with pytest.raises(ValueError, match="gamma must be positive"):
        observer(two_states(), 0.0)
    with pytest.raises(ValueError, match="gamma must be positive"):
        full(two_states(), -1.0)


# --------------------------------------------------------------------------- programs and packages


def test_a_second_plant_of_the_same_shape_builds_nothing():
    observer(attitude_axis(), 2.0)
    built = programs.build.cache_info().misses
    other = attitude_axis(unit=1e-3)
    found = observer(other, 1.7)
    assert programs.build.cache_info().misses == built
    assert found.h2 == pytest.approx(h2_norm(*error_of(other, found.gain)), rel=1e-12)
    program = programs.build("common", "mixed", 2, 3, 1, 1, 1)
    assert program.is_dcp(dpp=True)


def error_of(given, K):
    error = error_system(given, K)
    return error.A, error.Bw, error.L


def test_without_the_solvers_a_design_says_what_to_install(monkeypatch):
    for name in ("cvxpy", "clarabel"):
        with monkeypatch.context() as without:
            without.setitem(sys.modules, name, None)
            with pytest.raises(programs.MissingExtra, match=r"pip install 'robins\[design\]'"):
                observer(two_states(), 1.0)


def test_importing_the_designs_imports_no_solver():
    code = (
        "import sys, robins.filters.synthesis.lmi;"
        "print('cvxpy' in sys.modules, 'clarabel' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]
