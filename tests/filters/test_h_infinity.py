"""The H-infinity rule against dense recursions, its limit, its policies and what it refuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rule_table as table
from attitude_matching import PERIOD_S, in_unit, run_with
from dense_h_infinity import (
    compensated,
    greatest,
    h_infinity_filter,
    joseph_riccati,
    krein_riccati,
    least_gamma,
)
from dense_kalman import SPLIT_W, kalman_filter, random_system, simulate, split
from interpreted import run

from robins.filters import Belief, Code, OnlineFilter, kalman
from robins.filters.composite.imm import imm
from robins.filters.rules import gate
from robins.filters.rules.h_infinity import Infeasible, h_infinity, with_gamma
from robins.manifold import Angle

T = 20
# Much is known at first and little in the long run, so that bounds break late.
SYSTEM = random_system(3)
SYSTEM = SYSTEM._replace(F=SYSTEM.F / 0.98, W=3.0 * SYSTEM.W, P0=0.01 * SYSTEM.P0)
MODEL, START = SYSTEM.model(), SYSTEM.start()
Y = simulate(SYSTEM, 2, T, 0.2)[1]
Y[6] = Y[13] = np.nan  # whole rows as well as components
L = np.array([[1.0, 0.5, 0.0, -0.3], [0.0, 2.0, 1.0, 0.0]])
ONE = kalman(rules=[h_infinity(np.inf, L)])


def at(gamma):
    """The filter with another gamma; nothing compiles anew."""
    return with_gamma(ONE, gamma)


def agrees(solution, dense, rtol=1e-9):
    predicted = solution.steps.prediction
    for got, want in (
        (predicted.belief.mean, dense.m_pred),
        (predicted.belief.covariance, dense.P_pred),
        (solution.mean, dense.m),
        (solution.covariance, dense.P),
        (predicted.origin.covariance[1:], dense.P_wide[:-1]),
    ):
        np.testing.assert_allclose(got, want, rtol=rtol, atol=rtol * np.max(np.abs(want)))


@pytest.fixture(scope="module")
def least():
    """Least gamma of the standard problem, from the dense recursion."""
    return least_gamma(SYSTEM, Y, L)


# ---------------------------------------------------------------------------------- the recursion


@pytest.mark.parametrize("share", [1.02, 1.5, 4.0])
def test_the_recursion_is_that_of_the_book(share, least):
    solution = run(at(share * least), MODEL, START, Y)
    dense = h_infinity_filter(SYSTEM, Y, L, share * least)
    agrees(solution, dense)
    notes = solution.steps.info["y"].notes
    np.testing.assert_allclose(notes["h_infinity.bound"], dense.bound, rtol=1e-9)
    np.testing.assert_allclose(notes["h_infinity.gamma"], dense.gamma, rtol=1e-14)
    margin = 1.0 - (dense.bound / dense.gamma) ** 2
    np.testing.assert_allclose(notes["h_infinity.margin"], margin, atol=1e-9)
    assert np.max(np.abs(dense.m - kalman_filter(SYSTEM, Y)[0])) > 0.01  # it is another filter


@pytest.mark.parametrize("huge", [1e12, 1e200, 1e300])
def test_a_huge_gamma_comes_near_the_kalman_filter(huge):
    far, want = run(at(huge), MODEL, START, Y), run(kalman(), MODEL, START, Y)
    np.testing.assert_allclose(far.mean, want.mean, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(far.covariance, want.covariance, rtol=1e-9, atol=1e-12)


@pytest.fixture(scope="module")
def matching():
    """The filter of attitude matching: units and gamma are data, so one compilation serves all."""
    return kalman(rules=[h_infinity(np.inf, np.eye(9))])


def test_three_forms_agree_to_1e_13(matching):
    # 400 updates, scaled by standard deviations
    s = in_unit("deg")
    gamma = 1.05 * 4.656093988
    model, start, F, aux = run_with(s)
    solution = run(with_gamma(matching, gamma), model, start, np.zeros((400, 3)), F, aux)
    root = np.asarray(solution.steps.prediction.belief.covariance)
    joseph, krein = (
        form(s.F, s.G @ s.G.T, s.H, np.eye(3), np.diag(s.sigma**2), np.eye(9), gamma)
        for form in (joseph_riccati, krein_riccati)
    )
    sigma = np.sqrt(np.diagonal(joseph, axis1=1, axis2=2))
    scale = sigma[:, :, None] * sigma[:, None, :]
    worst = [np.max(np.abs(a - b) / scale) for a, b in ((root, joseph), (root, krein))]
    assert max(worst) < 1e-13, worst


def test_the_paper_in_arcminutes_is_refused_at_its_sixth_update(matching):
    model, start, F, aux = run_with(in_unit("arcmin"))
    one, time_s = with_gamma(matching, 50.0), PERIOD_S * np.arange(1, 401)
    with pytest.raises(Infeasible) as caught:
        run(one, model, start, np.zeros((400, 3)), F, aux, time_s=time_s)
    assert caught.value.step == 5
    assert caught.value.time_s == pytest.approx(0.30)
    assert caught.value.gamma_min == pytest.approx(100.69, rel=1.1e-4)


def test_a_known_state_may_be_weighted():
    # P0 and Q singular: nothing of the square-root form asks for P^-1.
    known = SYSTEM._replace(P0=np.diag([1.0, 0.0, 2.0, 0.0]), G=np.zeros((4, 4)), F=np.eye(4))
    gamma, P = 12.0, known.P0
    solution = run(at(gamma), known.model(), known.start(), Y)
    for k, row in enumerate(Y):
        here = np.isfinite(row)
        H, R = known.H[here], known.R[np.ix_(here, here)]
        Pf = P - P @ H.T @ np.linalg.solve(H @ P @ H.T + R, H @ P)
        np.testing.assert_allclose(solution.covariance[k], Pf, rtol=1e-9, atol=1e-12)
        inner = gamma**2 * np.eye(2) - L @ Pf @ L.T
        P = Pf + Pf @ L.T @ np.linalg.solve(inner, L @ Pf) if np.any(here) else Pf


def test_a_weight_may_follow_the_mean(least):
    def varying(mean):
        return jnp.stack([jnp.cos(mean), jnp.array([0.0, 1.0, 0.0, 0.0])])

    solution = run(kalman(rules=[h_infinity(4.0 * least, varying)]), MODEL, START, Y)
    agrees(solution, h_infinity_filter(SYSTEM, Y, lambda m: np.array(varying(m)), 4.0 * least))


def test_a_diagonal_weight_is_its_matrix():
    d = np.array([1.0, 0.0, -2.0, 0.0])
    weighted = h_infinity(3.0, d).init(START, MODEL.dims).weighted
    np.testing.assert_allclose(weighted, (d[:, None] * np.asarray(START.factor))[[0, 2]])


# --------------------------------------------------------------------------- what counts as a step


def test_a_step_without_a_measurement_counts_only_if_asked_for(least):
    gamma = 3.0 * least
    counted = run(kalman(rules=[h_infinity(gamma, L, count_missing=True)]), MODEL, START, Y)
    agrees(counted, h_infinity_filter(SYSTEM, Y, L, gamma, count_missing=True))
    left_out = run(at(gamma), MODEL, START, Y)
    origin, posterior = left_out.steps.prediction.origin, left_out.steps.posterior
    np.testing.assert_array_equal(origin.factor[7], posterior.factor[6])
    assert np.all(origin.factor[6] != posterior.factor[5], where=np.tri(4, dtype=bool))
    np.testing.assert_array_equal(counted.steps.prediction.origin.factor[0], START.factor)


@pytest.mark.parametrize("estimate", ["a-priori", "predictor"])
def test_several_sensors_are_one_step(estimate):
    y = {"near": Y[:, :2], "far": Y[:, 2:]}
    solution = run(kalman(rules=[h_infinity(9.0, L, estimate=estimate)]), split(SYSTEM), START, y)
    dense = h_infinity_filter(SYSTEM._replace(W=SPLIT_W), Y, L, 9.0, estimate)
    agrees(solution, dense)
    last = solution.steps.info["far"].notes["h_infinity.bound"]
    np.testing.assert_allclose(last, dense.bound, rtol=1e-9)
    first = np.asarray(solution.steps.info["near"].notes["h_infinity.bound"])
    if estimate == "a-priori":
        np.testing.assert_array_equal(first, last)
    else:
        assert np.all(first >= last * (1.0 - 1e-12))


def test_an_a_priori_estimate_turns_through_pi():
    # The others are held to it by test_rule_laws.py, on the same circle.
    one = kalman(rules=[h_infinity(300.0, table.L, "raise_gamma", estimate="a-priori")])
    flat = run(one, table.line(), table.START, table.Y)
    around = run(one, table.CIRCLE, table.FACING, table.AROUND)
    np.testing.assert_allclose(around.mean["rest"], flat.mean[:, 1:], rtol=1e-9, atol=1e-10)
    turned = Angle(flat.mean[:, 0] + table.SEAM).local(around.mean["heading"])
    np.testing.assert_allclose(turned, np.zeros((table.T, 1)), atol=1e-10)
    np.testing.assert_allclose(around.covariance, flat.covariance, rtol=1e-9, atol=1e-12)
    plain = flat.steps.prediction.origin.factor[1:] == flat.steps.posterior.factor[:-1]
    assert not np.all(plain)  # it acts


# ------------------------------------------------------------------------------------- infeasible


def first_broken(gamma):
    """First row whose bound is too large, which the recursion reaches without breaking."""
    done = h_infinity_filter(SYSTEM, Y, L, gamma)
    here = np.isfinite(Y).any(axis=1)
    return int(np.argmax(here & ~(done.bound < gamma))), done


@pytest.mark.parametrize("share", [0.97, 0.9999])  # in the middle, and at the last step
def test_what_is_not_feasible_is_refused_by_name(share, least):
    gamma = share * least
    row, dense = first_broken(gamma)
    assert row == {0.97: 14, 0.9999: T - 1}[share]
    with pytest.raises(Infeasible) as caught:
        run(at(gamma), MODEL, START, Y, time_s=10.0 + np.arange(T))
    error = caught.value
    assert isinstance(error, ValueError)
    assert (error.step, error.time_s) == (row, 10.0 + row)
    assert error.gamma == pytest.approx(gamma, rel=1e-14)
    assert error.local_bound == pytest.approx(dense.bound[row], rel=1e-9)
    assert least * (1.0 - 1e-8) <= error.gamma_min <= least * 1.0001
    for part in (f"step {row}", f"t = {10 + row} s", f"{gamma:.6g}", "policy='raise_gamma'"):
        assert part in str(error)
    run(at(error.gamma_min), MODEL, START, Y)


def test_a_run_that_goes_on_counts_its_own_steps(least):
    half = run(at(2.0 * least), MODEL, START, Y)
    assert int(half.final.memory[0].steps) == T
    with pytest.raises(Infeasible) as caught:
        run(at(0.5 * least), MODEL, half.final, Y)
    assert caught.value.step == -1  # what the first run ended with
    fresh = half.final._replace(belief=START)
    with pytest.raises(Infeasible) as caught:
        run(at(0.5 * least), MODEL, fresh, Y)
    assert caught.value.step == first_broken(0.5 * least)[0]


def test_events_of_a_gamma_are_not_those_of_another(least):
    # In compiled code nothing is raised, and what was refused stays in the memory.
    refused = jax.jit(lambda one: run(one, MODEL, START, Y).final)(at(0.9 * least))
    assert int(refused.memory[0].events) > 0
    begun = refused._replace(belief=START, memory=(refused.memory[0]._replace(measured=False),))
    np.testing.assert_array_equal(
        run(at(2.0 * least), MODEL, begun, Y).mean, run(at(2.0 * least), MODEL, START, Y).mean
    )
    row, dense = first_broken(0.97 * least)
    with pytest.raises(Infeasible) as caught:
        run(at(0.97 * least), MODEL, begun, Y)
    assert caught.value.step == row
    assert caught.value.local_bound == pytest.approx(dense.bound[row], rel=1e-9)
    assert least * (1.0 - 1e-8) <= caught.value.gamma_min <= least * 1.0001


def test_where_nothing_can_be_raised_the_codes_say_it(least):
    row, _ = first_broken(0.97 * least)
    gammas = jnp.array([0.97, 1.5, jnp.inf]) * least
    filters = jax.vmap(at)(gammas)
    batch = jax.jit(jax.vmap(lambda one: run(one, MODEL, START, Y)))(filters)
    code = np.asarray(batch.steps.prediction.code)
    np.testing.assert_array_equal(code[1:], Code.DONE)
    assert code[0].tolist()[: row + 2] == [Code.DONE] * (row + 1) + [Code.INFEASIBLE]
    assert float(batch.log_likelihood[0]) == -np.inf
    assert np.all(np.isfinite(batch.mean))
    for k, gamma in ((1, 1.5 * least), (2, np.inf)):
        alone = run(at(gamma), MODEL, START, Y)
        np.testing.assert_allclose(batch.mean[k], alone.mean, rtol=1e-10, atol=1e-12)
    # a step that was refused leaves the belief where it was
    kept = batch.steps.prediction.belief.factor[0, row + 1]
    np.testing.assert_array_equal(kept, batch.steps.posterior.factor[0, row])


def test_a_stream_is_refused_when_the_step_is_closed(least):
    broken, _ = first_broken(0.97 * least)
    live = OnlineFilter(at(0.97 * least), MODEL, START, "vm")
    for row in Y[: broken + 1]:
        live.predict()
        live.update(row)
    with pytest.raises(Infeasible, match=f"at step {broken}") as caught:
        live.predict()
    assert caught.value.gamma_min is None
    with pytest.raises(Infeasible, match=f"at step {broken}"):
        live.predict()
    other = OnlineFilter(at(2.0 * least), MODEL, live.state, "vm")
    assert int(other.predict().code) == Code.DONE


# --------------------------------------------------------------------------------------- policies


def test_raising_gamma_takes_the_least_that_leaves_the_margin(least):
    asked, margin = 0.8 * least, 0.1

    def raised(k, P, weight, nis, dof):
        return max(asked, greatest(weight @ P @ weight.T) / np.sqrt(1.0 - margin))

    rule = h_infinity(asked, L, policy="raise_gamma", margin=margin)
    solution = run(kalman(rules=[rule]), MODEL, START, Y)
    dense = h_infinity_filter(SYSTEM, Y, L, raised)
    agrees(solution, dense)
    notes = solution.steps.info["y"].notes
    np.testing.assert_allclose(notes["h_infinity.gamma"], dense.gamma, rtol=1e-9)
    acted = (dense.gamma > asked) & np.isfinite(Y).any(axis=1)
    np.testing.assert_array_equal(notes["h_infinity.raised"], acted)
    assert 0 < acted.sum() < T
    assert int(solution.final.memory[0].events) == acted[:-1].sum()  # the last step is still open
    assert np.min(notes["h_infinity.margin"]) >= margin - 1e-12


def test_compensating_cuts_what_is_too_much(least):
    asked = 0.8 * least
    rule = h_infinity(asked, L, policy="compensate")
    solution = run(kalman(rules=[rule]), MODEL, START, Y)
    dense = h_infinity_filter(SYSTEM, Y, L, asked, mend=compensated)
    agrees(solution, dense)
    acted = (dense.bound**2 > 0.95 * asked**2) & np.isfinite(Y).any(axis=1)
    np.testing.assert_array_equal(solution.steps.info["y"].notes["h_infinity.compensated"], acted)
    assert 0 < acted.sum() < T
    assert int(solution.final.memory[0].events) == acted[:-1].sum()


# ------------------------------------------------------------------------------------- derivatives


def test_derivatives_are_right_and_finite_where_nothing_is_feasible(least):

    def total(gamma, scale):
        start = Belief(START.mean, scale * START.factor)
        solution = run(at(gamma), MODEL, start, Y)
        return jnp.sum(solution.mean**2) + jnp.sum(solution.covariance)

    slope = jax.jit(jax.grad(total, argnums=(0, 1)))
    gammas = np.array([1.3 * least, 0.97 * least, np.inf, 1.3 * least])
    scales = np.array([1.0, 1.0, 1.0, 0.0])  # the last one knows its start exactly
    found = np.array([slope(*given) for given in zip(gammas, scales, strict=True)]).T
    assert np.all(np.isfinite(found))
    assert found[0, 2] == 0.0
    h = 1e-5
    moves = [(h * least, 0.0), (-h * least, 0.0), (0.0, h), (0.0, -h)]
    up = [float(total(1.3 * least + a, 1.0 + b)) for a, b in moves]
    want = [(up[0] - up[1]) / (2 * h * least), (up[2] - up[3]) / (2 * h)]
    np.testing.assert_allclose(found[:, 0], want, rtol=1e-6)


# ------------------------------------------------------------------------------------- boundaries


def test_infinity_in_the_place_of_a_gamma_is_the_kalman_filter_bit_for_bit():
    one, plain = run(at(np.inf), MODEL, START, Y), run(kalman(), MODEL, START, Y)
    np.testing.assert_array_equal(one.mean, plain.mean)
    np.testing.assert_array_equal(one.steps.posterior.factor, plain.steps.posterior.factor)
    assert float(one.log_likelihood) == float(plain.log_likelihood)


def test_a_gamma_is_exchanged_wherever_the_rule_lies():
    parts = imm([ONE, kalman(rules=[gate(), h_infinity(2.0, L)])], np.full((2, 2), 0.5))
    first, second = with_gamma(parts, 4.0).modes.modes
    assert float(first.filter_.rules[0].inverse) == 0.25
    assert float(second.filter_.rules[1].inverse) == 0.25
    assert float(ONE.rules[0].inverse) == 0.0


def test_a_weight_must_be_given_and_a_rule_be_there():
    with pytest.raises(TypeError, match="weight"):
        h_infinity(50.0)
    with pytest.raises(ValueError, match="no h_infinity rule"):
        with_gamma(kalman(rules=[gate()]), 3.0)
    with pytest.raises(ValueError, match="gamma must be positive"):
        with_gamma(ONE, 0.0)
    with pytest.raises(TypeError, match="gamma must be one real number"):
        with_gamma(ONE, [1.0, 2.0])
