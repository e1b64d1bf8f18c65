"""Claims: a mistyped one is refused before anything is simulated; the worst filter decides."""

import math

import numpy as np
import pytest
from scipy import stats

from robins import scenario
from robins.systems import SYSTEMS
from robins.systems.judgement import (
    RUNS,
    Claim,
    claim_judge,
    consistency_claims,
    interval_of,
    nees_claim,
    ratio,
    ratio_claims,
)

STATED = [
    (system, study)
    for system in SYSTEMS.values()
    for study in system.studies.values()
    if "claims" in study.parameters.model_fields
]


def packaged(system, study):
    """A packaged scenario of a study."""
    for path in system.scenarios.values():
        name = scenario.mapping_of(path.read_text()).get("study", next(iter(system.studies)))
        if system.studies[name] is study:
            return path.read_text()
    raise AssertionError


@pytest.mark.parametrize(("system", "study"), STATED, ids=lambda one: getattr(one, "name", ""))
def test_a_mistyped_claim_is_refused_with_the_one_that_was_meant(system, study):
    meant = next(iter(study.claims))
    text = packaged(system, study)
    given = scenario.parse(study.parameters, text, [f'claims=["{meant}s"]'])
    told = rf"no claim '{meant}s' in this study; did you mean '{meant}'\? It has .*{meant}"
    with pytest.raises(ValueError, match=told):
        study.problem(given, study.filters[:1], 0)


def claim(value, band, partly=None, verdict=None):
    return Claim("x", ("a",), lambda metrics: value, band, partly, verdict)


@pytest.mark.parametrize(
    ("one", "verdict"),
    [
        (claim(1.0, (0.0, 1.0)), "reproduced"),
        (claim(1.1, (0.0, 1.0), (0.0, 2.0)), "partly"),
        (claim(2.1, (0.0, 1.0), (0.0, 2.0)), "not"),
        (claim(-1.0, (None, 1.0)), "reproduced"),
        (claim(9.0, (1.0, None)), "reproduced"),
        (claim(np.nan, (0.0, 1.0), (0.0, None)), "not"),
        (claim(0.0, None, verdict=lambda metrics: "partly"), "partly"),
    ],
)
def test_a_verdict_is_that_of_the_band(one, verdict):
    (found,) = claim_judge({"c": one})({"a": {}})
    assert found["verdict"] == verdict
    assert found["band"] == (None if one.band is None else list(one.band))
    assert (
        claim_judge({"c": one})({"b": {}})
        == claim_judge({"c": one})({"a": {"feasible": False}})
        == []
    )


def figures(off, share, nis):
    return {
        "error_over_sigma_bounds": [[1.0 + off, 2.0], [0.5, 1.5]],
        "anees_share_inside": share,
        "nis_gnss": nis,
        "nis_gnss_band": [0.9, 1.1],
    }


@pytest.mark.parametrize(
    ("worse", "held"),
    [
        (figures(0.0, 0.95, 1.05), {"sigma", "anees", "nis"}),
        (figures(0.06, 0.95, 1.0), {"anees", "nis"}),
        (figures(np.nan, 0.95, 1.0), {"anees", "nis"}),
        (figures(0.0, np.nan, 1.0), {"sigma", "nis"}),
        (figures(0.0, 0.5, 1.2), {"sigma"}),
    ],
)
def test_of_several_filters_the_worst_is_judged(worse, held):
    claims = consistency_claims(dict.fromkeys(("sigma", "anees", "nis"), "x"))
    metrics = {"right": figures(0.0, 0.99, 1.0), "worse": worse, "again": figures(0.0, 0.99, 1.0)}
    found = claim_judge(claims)(metrics)
    assert {c["id"] for c in found if c["verdict"] == "reproduced"} == held


# -------------------------------------------------------------------------------------- intervals


def drawn(squares, draws=200, seed=0):
    """Metrics of all runs and of draws of them, the same for both filters, of (runs, 2) squares."""
    count = len(squares)
    random = np.random.default_rng(seed).integers(0, count, (draws, count))
    every = [
        {n: {"rms": float(np.sqrt(m)), RUNS: count} for n, m in zip("ab", mean, strict=True)}
        for mean in (np.mean(squares[at], axis=0) for at in [np.arange(count), *random])
    ]
    return every[0], every


def test_the_interval_of_a_mean_is_that_of_the_normal_law():
    """The closed form of a mean: its Student-t interval."""
    numbers = np.random.default_rng(1).normal(5.0, 1.0, 40)
    mean = np.mean(numbers)
    low, high = stats.t.interval(0.95, 39, mean, stats.sem(numbers))
    metrics, every = drawn(np.stack([numbers, numbers], axis=1), draws=4000)
    found = interval_of(lambda m: m["a"]["rms"] ** 2, metrics["a"]["rms"] ** 2, every)
    np.testing.assert_allclose(found, (low, high), atol=0.05 * (high - low))


@pytest.mark.parametrize("count", [8, 40])
def test_intervals_cover_the_true_ratio_as_often_as_they_say(count):
    """Errors of two filters share what is common to them; the true ratio of their RMS is 1 / 2."""
    random, hits = np.random.default_rng(2), 0
    for _ in range(300):
        common, own = random.chisquare(4, (count, 1)), random.chisquare(4, (count, 2))
        metrics, every = drawn((common + own) * (1.0, 4.0))
        of = ratio("a", "b", "rms")
        low, high = interval_of(of, of(metrics), every)
        hits += low <= 0.5 <= high
    assert stats.binom.cdf(hits, 300, 0.93) > 1e-3
    assert hits < 300


def test_draws_are_paired():
    squares = np.random.default_rng(3).chisquare(1, (20, 1)) * (1.0, 4.0)
    metrics, every = drawn(squares)
    of = ratio("a", "b", "rms")
    found = interval_of(of, of(metrics), every)
    assert found is None or np.ptp(found) < 1e-12  # the ratio is 1 / 2 in every run


def test_a_value_that_does_not_follow_from_the_runs_has_no_interval():
    metrics, every = drawn(np.ones((4, 2)) * (1.0, 2.0))
    assert (
        interval_of(lambda m: 1.0 if m is metrics else 2.0, 1.0, [dict(m) for m in every]) is None
    )
    assert interval_of(lambda m: np.nan, 1.0, every) is None
    assert interval_of(lambda m: np.inf, np.inf, every) is None
    assert interval_of(lambda m: 1.0, 1.0, ()) is None


@pytest.mark.parametrize(
    ("band", "partly", "verdict", "more"),
    [
        ((0.0, 0.9), None, "reproduced", False),
        ((0.0, 0.1), (0.0, 0.9), "partly", False),
        ((0.0, 0.1), (0.0, 0.2), "not", False),
        ((0.0, 0.52), None, "undecided", True),
        ((0.0, 0.1), (0.0, 0.52), "undecided", True),
        ((0.48, None), (0.0, None), "undecided", True),
    ],
)
def test_a_verdict_holds_for_all_of_the_interval(band, partly, verdict, more):
    squares = np.random.default_rng(4).chisquare(2, (50, 2)) * (1.0, 4.0)
    metrics, every = drawn(squares)
    of = ratio("a", "b", "rms")
    judge = claim_judge({"c": Claim("x", ("a", "b"), of, band, partly)})
    (point,), (found,) = judge(metrics), judge(metrics, every)
    assert point["interval"] is None
    assert (found["verdict"], found["more_runs"] is not None) == (verdict, more)
    assert found["interval"][0] < found["value"] < found["interval"][1]
    if more:
        edge = next(e for e in (*(partly or ()), *band) if e and 0.3 < e < 0.7)
        end = found["interval"][int(edge > found["value"])]
        share = np.sqrt(50 / (50 + found["more_runs"]))
        assert abs(end - found["value"]) * share <= abs(edge - found["value"]) * (1.0 + 1e-9)


def test_a_verdict_of_its_own_is_decided_by_most_draws():
    squares = np.random.default_rng(5).chisquare(2, (50, 2)) * (1.0, 4.0)
    metrics, every = drawn(squares)
    of = ratio("a", "b", "rms")

    def judged(limit):
        own = Claim(
            "x", ("a", "b"), of, None, verdict=lambda m: "not" if of(m) > limit else "partly"
        )
        return claim_judge({"c": own})(metrics, every)[0]["verdict"]

    assert [judged(limit) for limit in (0.1, of(metrics), 2.0)] == ["not", "undecided", "partly"]


def test_a_claim_that_states_a_confidence_has_no_interval():
    """An interval of what is proven at 99 % would ask for the same confidence twice."""
    metrics, every = drawn(np.random.default_rng(6).chisquare(2, (50, 2)) * (1.0, 4.0))
    of = ratio("a", "b", "rms")
    near = of(metrics) * 1.001
    for tested, verdict in ((False, "undecided"), (True, "reproduced")):
        one = Claim("x", ("a", "b"), of, (0.0, near), tested=tested)
        (found,) = claim_judge({"c": one})(metrics, every)
        assert (found["verdict"], found["interval"] is None) == (verdict, tested)
    claims = consistency_claims(dict.fromkeys(("sigma", "anees", "nis"), "x"))
    assert [claims[key].tested for key in ("sigma", "nis")] == [True, True]


def test_a_claim_names_what_its_nees_is_of():
    nees_claim("NEES of the position stays below 1.3", "a", "position", (0.0, 1.3))
    with pytest.raises(ValueError, match="decided by nees_all_states; say in its words"):
        nees_claim("NEES of the position stays below 1.3", "a", "all_states", (0.0, 1.3))
    row = {"c": ("a", ("b",), ("nees_velocity",), (0.0, 1.0), (0.0, 1.0))}
    with pytest.raises(ValueError, match="nees_velocity"):
        ratio_claims(row, {"c": "NEES of the attitude, one over the other"})


def test_a_ratio_to_zero_is_infinite_and_of_zeros_unknown():
    of = ratio("a", "b", "share")
    assert of({"a": {"share": 0.5}, "b": {"share": 0.0}}) == math.inf
    assert math.isnan(of({"a": {"share": 0.0}, "b": {"share": 0.0}}))
    text = "a is better than b"
    (claim,) = ratio_claims(
        {"k": ("a", ("b",), ("share", "rms"), (0, 1), (0, 1))}, {"k": text}
    ).values()
    few = {"a": {"share": 0.5, "rms": 1.0}, "b": {"share": 0.0, "rms": 2.0}}
    assert claim.value(few) == math.inf
