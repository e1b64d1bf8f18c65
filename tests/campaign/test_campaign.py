"""Campaigns against plain loops and closed forms, on a problem small enough to know by heart."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from scipy import stats

from robins.campaign import Statistics, monte_carlo, record, rms_with_bounds, simulate, worlds
from robins.filters import Belief, Model, Motion, Sensor, kalman, run, taylor
from robins.filters.rules import h_infinity
from robins.results import Probability
from robins.sim.random import Component, stream
from robins.systems.judgement import Claim, claim_judge, ratio
from robins.systems.study import Case, Contender, Limit, Problem, SensorAxes, StateBlock

STEPS = 60
F = jnp.array([[1.0, 0.5], [0.0, 1.0]])
Q_FACTOR = jnp.array([[0.02, 0.0], [0.05, 0.03]])


def collect(records, blocks, **settings):
    """Statistics of all chunks."""
    statistics = Statistics(blocks, **settings)
    for one in records:
        statistics.add(one)
    return statistics


def _move(x, u):
    return F @ x


def _read(x, aux):
    return x[:1]


def _model(sigma, factor=Q_FACTOR, move=_move):
    # Functions of one name and numbers as data, so that all share what was compiled.
    return Model(Motion(move, factor), (Sensor(_read, jnp.array([sigma]), 1),))


def _simulate(index):
    key = stream(7, index, Component.TRAJECTORY)
    k0, k1, k2 = jax.random.split(key, 3)
    x0 = jax.random.normal(k0, (2,))

    def step(x, w):
        x = F @ x + Q_FACTOR @ w
        return x, x

    _, truth = jax.lax.scan(step, x0, jax.random.normal(k1, (STEPS, 2)))
    y = truth[:, :1] + 0.4 * jax.random.normal(k2, (STEPS, 1))
    start = Belief(jnp.zeros(2), jnp.eye(2))
    return Case(start, None, {"y": y}, {}, truth)


@pytest.fixture(scope="module")
def problem():
    return Problem(
        simulate=_simulate,
        contenders={
            "right": Contender(kalman(taylor()), _model(0.4)),
            "sure": Contender(kalman(taylor()), _model(0.2)),
            "wrong R": Contender(kalman(taylor()), _model(0.4 * np.sqrt(1.2))),
        },
        epoch_s=np.arange(1, STEPS + 1) * 0.5,
        blocks=(StateBlock("line", slice(0, 2), "m", "m", "E", ("x", "v")),),
        sensors={"y": SensorAxes("m", "E", ("x",))},
        context=xr.Dataset(),
        metrics=lambda s: {"rms_m": float(np.sqrt(np.mean(s.rms[:, 0] ** 2)))},
        claims=lambda m: [],
    )


def chunks(problem, name, runs, chunk=500, first=0):
    """Records of one filter over runs first .. first + runs - 1."""
    return (record(problem, name, *batch) for batch in worlds(problem, runs, chunk, first))


@pytest.fixture(scope="module")
def right(problem):
    return collect(chunks(problem, "right", 300, chunk=64), problem.blocks)


def test_chunks_do_not_change_a_run(problem):
    whole = np.concatenate([r["error"] for r in chunks(problem, "right", 10, chunk=10)])
    parts = np.concatenate([r["error"] for r in chunks(problem, "right", 10, chunk=4)])
    np.testing.assert_allclose(parts, whole, rtol=0, atol=1e-13)
    (later,) = chunks(problem, "right", 4, first=6, chunk=4)
    np.testing.assert_allclose(later["error"], whole[6:], rtol=0, atol=1e-13)


def test_a_run_in_a_campaign_is_the_run_alone(problem):
    record = next(chunks(problem, "right", 4, chunk=4))
    case = _simulate(jnp.asarray(2))
    c = problem.contenders["right"]
    solution = run(c.filter, c.model, case.start, case.y)
    np.testing.assert_allclose(record["error"][2], case.truth - solution.mean, atol=1e-13)
    np.testing.assert_allclose(record["sigma"][2], solution.sigma, atol=1e-13)


def test_statistics_are_those_of_a_plain_loop(problem):
    records = list(chunks(problem, "right", 10, chunk=4))
    s = collect(records, problem.blocks)
    error = np.concatenate([r["error"] for r in records])
    np.testing.assert_allclose(s.rms, np.sqrt(np.mean(error**2, axis=0)), rtol=1e-13)
    c = problem.contenders["right"]
    nees = np.zeros(STEPS)
    for i in range(10):
        case = _simulate(jnp.asarray(i))
        P = np.asarray(run(c.filter, c.model, case.start, case.y).covariance)
        nees += [e @ np.linalg.solve(p, e) / 10 for e, p in zip(error[i], P, strict=True)]
    np.testing.assert_allclose(s.anees() * 2, nees, rtol=1e-9)
    assert s.mean_nees()["nees_line"] == pytest.approx(np.mean(nees) / 2, rel=1e-9)
    assert s.runs == 10
    assert s.run_rms.shape == (10, 2)
    assert s.sensors == ["y"]


def test_runs_drawn_again_are_those_runs(problem):
    """Against statistics of records whose runs are repeated."""
    (one,) = chunks(problem, "right", 10, chunk=10)
    draws = np.vstack([np.arange(10), np.random.default_rng(0).integers(0, 10, (2, 10))])
    for at, again in zip(draws, collect([one], problem.blocks).resampled(draws), strict=True):
        want = collect([jax.tree_util.tree_map(lambda x, at=at: x[at], one)], problem.blocks)
        for figure in ("pooled_rms", "pooled_sigma", "run_rms", "lost", "runs", "diverged", "n"):
            np.testing.assert_array_equal(getattr(again, figure), getattr(want, figure))
        np.testing.assert_allclose(again.overall_ratio(), want.overall_ratio(), rtol=1e-14)
        np.testing.assert_allclose(again.ratio_bounds(), want.ratio_bounds(), rtol=1e-14)
        assert again.mean_nees() == want.mean_nees()
        assert again.nis("y") == want.nis("y")
        assert np.isnan(again.rms).all()
        assert np.isnan(again.anees_share_inside())


def test_pooled_figures_are_those_of_all_epochs(problem, right):
    np.testing.assert_allclose(right.pooled_rms, np.sqrt(np.mean(right.rms**2, axis=0)))
    np.testing.assert_allclose(right.pooled_sigma, np.sqrt(np.mean(right.sigma**2, axis=0)))
    assert right.mean_nees() == pytest.approx(
        {"nees_all_states": np.mean(right.anees()), "nees_line": np.mean(right.anees())}
    )


def test_a_claim_of_few_runs_is_undecided_and_one_of_many_is_not(problem):
    """Filters of one noise and another: their true ratio of RMS errors is some 0.9."""
    claim = Claim("x", ("right", "sure"), ratio("right", "sure", "rms_m"), (0.0, 0.97))
    judged = replace(
        problem,
        metrics=lambda s: {"rms_m": float(s.pooled_rms[0])},
        claims=claim_judge({"better": claim}),
    )
    few, many = simulate(judged, 3), simulate(judged, 100)
    assert (few.claims[0]["verdict"], many.claims[0]["verdict"]) == ("undecided", "reproduced")
    assert "The claim better is undecided" in few.notes[-1]


def test_a_matched_filter_is_consistent_and_wrong_ones_are_caught(problem, right):
    assert right.anees_share_inside() >= 0.9
    assert right.nis("y", 0.999).inside
    np.testing.assert_allclose(right.overall_ratio(), 1.0, atol=0.05)
    sure = collect(chunks(problem, "sure", 300, chunk=64), problem.blocks)
    assert not sure.nis("y", 0.999).inside
    assert sure.anees_share_inside() < 0.5
    wrong = collect(chunks(problem, "wrong R", 300, chunk=64), problem.blocks)
    assert not wrong.nis("y", 0.999).inside, "R wrong by 1.2 must be seen in the grand mean NIS"


def test_a_diverged_run_is_counted_not_dropped(problem):
    record = next(chunks(problem, "right", 4, chunk=4))
    record["error"] = record["error"].copy()
    record["error"][1, 5] = np.nan
    s = collect([record], problem.blocks)
    assert s.diverged == 1
    assert s.runs == 4
    assert np.all(np.isinf(s.rms[5]))


def test_a_filter_that_cannot_predict_has_no_error_to_show(problem):
    """An H-infinity filter that does not exist must not look like a result."""
    strict = kalman(taylor(), [h_infinity(0.5, jnp.eye(2))])
    none = replace(problem, contenders={"hinf": Contender(strict, _model(0.4), bounds=True)})
    record = next(chunks(none, "hinf", 3, chunk=4))
    first = np.argmax(np.isnan(record["error"]).any(axis=2), axis=1)
    assert np.all(first > 0)
    assert np.all(np.isnan(record["error"][:, first[0] :]))
    assert np.all(np.isfinite(record["error"][:, : first[0]]))
    assert collect([record], problem.blocks).diverged == 3
    outcome = simulate(none, 3, chunk=4)
    assert outcome.metrics["hinf"]["diverged_share"] == Probability.among(np.ones(3, bool))
    assert outcome.counts["hinf_prediction_infeasible"] == outcome.counts["hinf_y_not_predicted"]
    assert outcome.counts["hinf_prediction_infeasible"] >= np.sum(STEPS - 1 - first)
    assert outcome.warnings[0].startswith("hinf: ")
    assert f"of {3 * STEPS} predictions are INFEASIBLE" in outcome.warnings[0]


def test_all_filters_see_the_same_numbers(problem):
    outcome = simulate(problem, 5, chunk=4)
    assert list(outcome.metrics) == ["right", "sure", "wrong R"]
    assert outcome.metrics["sure"]["diverged_share"] == Probability.among(np.zeros(5, bool))
    assert not outcome.warnings  # R = 0.2^2 for 0.4^2 is not yet worth a word
    y = outcome.solution["innovation_y"].values[:, 0, 0]
    # the first innovation is y - F m0 whatever R is believed
    np.testing.assert_allclose(y, y[0], atol=1e-14)
    assert outcome.solution["rms_line"].attrs["runs"] == 5


def test_filters_may_have_states_of_their_own(problem):
    """A filter of a wider state, and one in centimetres, report what the others do."""
    wide = Model(
        Motion(
            lambda x, u: jnp.concatenate([F @ x[:2], x[2:]]),
            jnp.concatenate([Q_FACTOR, jnp.zeros((1, 2))]),
        ),
        (Sensor(lambda x, a: x[:1], jnp.array([0.4]), 1),),
    )

    def widened(case):
        start = Belief(jnp.zeros(3), jnp.eye(3))
        truth = jnp.concatenate([case.truth, jnp.zeros((STEPS, 1))], 1)
        return case._replace(start=start, truth=truth)

    def scaled(case):
        start, y = Belief(jnp.zeros(2), 100.0 * jnp.eye(2)), {"y": 100.0 * case.y["y"]}
        return case._replace(start=start, y=y, truth=100.0 * case.truth)

    right = problem.contenders["right"].filter
    mixed = replace(
        problem,
        contenders={
            "right": problem.contenders["right"],
            "wide": Contender(right, wide, widened, np.eye(2, 3), facts={"states": 3}),
            "cm": Contender(
                right, _model(40.0, 100.0 * Q_FACTOR), scaled, 0.01 * np.eye(2), bounds=True
            ),
        },
        limits=(Limit("1_m", "line", 1.0),),
    )
    told = []
    outcome = simulate(mixed, 6, chunk=4, progress=lambda share, what: told.append((what, share)))
    # Worlds and three filters, a quarter of a chunk each: of 4 runs, then of the 2 that are left.
    shares = np.interp(np.arange(8) / 4, [0, 1, 2], [0, 4, 6]) / 6
    stages = ["simulation", "right", "wide", "cm"]
    words = [f"{s}: compiling, runs 1 to 4 of 6" for s in stages]
    words += [f"{s}: runs 5 to 6 of 6" for s in stages]
    assert [what for what, _ in told] == words
    np.testing.assert_allclose([share for _, share in told], shares)
    ds = outcome.solution
    for name in ("rms_line", "mean_sigma_line", "error_line"):
        for other in (1, 2):
            np.testing.assert_allclose(ds[name][other], ds[name][0], rtol=1e-9, atol=1e-12)
    assert outcome.metrics["wide"]["states"] == 3
    np.testing.assert_array_equal(ds["bounds"], [0, 0, 1])
    np.testing.assert_array_equal(ds["anees_dof"][:2, 0], [2, 3])
    assert np.all(np.isnan(ds["anees"][2]))
    error = np.concatenate([r["error"] for r in chunks(problem, "right", 6, chunk=4)])
    inside = np.mean(np.max(np.abs(error), axis=2) <= 1.0, axis=0)
    np.testing.assert_allclose(ds["within_1_m"][0], inside)


def test_limits_say_how_many_are_inside_and_since_when(problem):
    limit = Limit("1_m", "line", 1.0)
    records = list(chunks(problem, "right", 5, chunk=4))
    s = collect(records, problem.blocks, limits=(limit,))
    worst = np.max(np.abs(np.concatenate([r["error"] for r in records])), axis=2)
    for i, since in enumerate(s.settled("1_m")):
        assert np.all(worst[i, since:] <= 1.0)
        assert since == 0 or worst[i, since - 1] > 1.0


def test_filters_that_differ_in_numbers_share_what_was_compiled(problem):
    step = problem.contenders["right"].filter
    moved = jax.tree_util.Partial(lambda x, u: F @ x)  # by no other test
    models = [_model(sigma, move=moved) for sigma in (1.0, 2.0)]
    pair = replace(problem, contenders={str(i): Contender(step, m) for i, m in enumerate(models)})
    before = monte_carlo._records._cache_size()
    simulate(pair, 3, chunk=4, machine="jax")
    assert monte_carlo._records._cache_size() == before + 1


def test_a_filter_that_is_far_too_sure_is_doubted(problem):
    far = replace(problem, contenders={"far": Contender(kalman(taylor()), _model(0.1))})
    (said,) = simulate(far, 4, chunk=4).warnings
    assert said.startswith("far: the innovations of 'y' are larger than the filter expects")


def test_worst_case_cover(problem):
    rng = np.random.default_rng(3)
    hits = 0
    for _ in range(400):
        squares = stats.chi2.rvs(20, size=30, random_state=rng) / 20
        _, low, high = rms_with_bounds(squares)
        hits += low <= 1.0 <= high
    # 95 % bounds: 400 trials, four sigma of the binomial
    assert abs(hits - 380) < 4 * np.sqrt(400 * 0.95 * 0.05)


def test_refuses_nonsense(problem):
    with pytest.raises(ValueError, match="at least 1"):
        next(chunks(problem, "right", 0))
    with pytest.raises(ValueError, match="no filter 'ghost'"):
        next(chunks(problem, "ghost", 1))
