"""Claims: a mistyped one is refused before anything is simulated; the worst filter decides."""

import numpy as np
import pytest

from robins import scenario
from robins.systems import SYSTEMS
from robins.systems.judgement import Claim, consistency_claims, judging

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
    (found,) = judging({"c": one})({"a": {}})
    assert found["verdict"] == verdict
    assert found["band"] == (None if one.band is None else list(one.band))
    assert judging({"c": one})({"b": {}}) == judging({"c": one})({"a": {"feasible": False}}) == []


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
    found = judging(claims)(metrics)
    assert {c["id"] for c in found if c["verdict"] == "reproduced"} == held
