"""Reports of a run on steps that were not taken, and reasons to doubt a filter."""

import json
import re

import jax.numpy as jnp
import numpy as np
import pytest
from interpreted import run

from robins import linalg
from robins.filters import (
    Belief,
    Code,
    Model,
    Motion,
    OnlineFilter,
    Sensor,
    StepWarning,
    Tally,
    at_master,
    channel,
    delayed,
    doubts,
    federated,
    guarded,
    imm,
    kalman,
    particle,
    whiteness,
)
from robins.filters.composite.delayed import DelayedMeasurement

LOST, STEPS = 2, 6  # the step that cannot be predicted, and all

MODEL = Model(
    Motion(lambda x, u: 0.9 * x + u, jnp.array([0.5])),
    (
        Sensor(lambda x, aux: x, jnp.array([0.7]), 1, "a"),
        Sensor(lambda x, aux: 2.0 * x, jnp.array([0.4]), 1, "b"),
    ),
)
START = Belief.of(jnp.array([0.3]), np.array([[2.0]]))
RNG = np.random.default_rng(3)
U = RNG.normal(size=STEPS)
Y = {name: RNG.normal(size=(STEPS, 1)) for name in "ab"}

# Where sensors are alike to a filter one is enough.
ONE = {"kalman", "imm", "federated", "delayed"}
FILTERS = {
    "kalman": kalman(),
    "imm": imm([kalman(), kalman(form="joseph")], [[0.9, 0.1], [0.2, 0.8]]),
    "federated": federated([channel("a"), channel("b")]),
    "at_master": at_master(federated([channel("a")]), "b"),
    "guarded": guarded(kalman(), kalman(), assumption="b", judges="a"),
    "delayed": delayed(kalman(), MODEL, 2, u=jnp.zeros(())),
}


@pytest.mark.parametrize("name", FILTERS)
def test_a_step_that_cannot_be_predicted_is_as_if_it_had_not_been(name):
    lost, data = np.insert(U[:-1], LOST, np.nan), {"a": Y["a"]} if name in ONE else Y
    with pytest.warns(StepWarning, match=r"1 of 6 predictions are NOT_FINITE.*'a' are NOT_PRED"):
        found = run(FILTERS[name], MODEL, START, data, lost)
    kept = np.delete(np.arange(STEPS), LOST)
    # A run without that step, made as long by one at its end.
    fewer = {k: np.append(y[kept], y[-1:], axis=0) for k, y in data.items()}
    without = run(FILTERS[name], MODEL, START, fewer, U)
    np.testing.assert_allclose(found.mean[kept], without.mean[:-1], rtol=1e-12)
    np.testing.assert_allclose(found.covariance[kept], without.covariance[:-1], rtol=1e-12)
    np.testing.assert_array_equal(found.mean[LOST], found.mean[LOST - 1])
    for sensor in data:
        info = found.steps.info[sensor]
        assert int(info.code[LOST]) == Code.NOT_PREDICTED
        assert (float(info.nis[LOST]), int(info.dof[LOST])) == (0.0, 0)
        assert Code.NOT_PREDICTED not in info.code[kept].tolist()
        assert found.tally.counts(sensor)[Code.NOT_PREDICTED] == 1
        assert float(found.tally.nis[sensor]) == pytest.approx(float(jnp.sum(info.nis)))
        assert int(found.tally.dof[sensor]) == int(jnp.sum(info.dof))
    assert found.tally.counts() == {Code.DONE: STEPS - 1, Code.NOT_FINITE: 1}
    assert float(found.log_likelihood) == -np.inf


def test_a_missing_measurement_stays_missing_and_a_new_belief_is_of_its_time():
    one = particle(8, 0)
    live = OnlineFilter(one, MODEL, START)
    live.predict(jnp.nan)
    assert int(live.update(np.array([np.nan]), "a").code) == Code.MISSING
    assert int(live.update(np.array([1.0]), "a").code) == Code.NOT_PREDICTED
    live.state = one.reset(live.state, START)
    assert int(live.update(np.array([1.0]), "a").code) == Code.DONE


def test_what_is_late_is_used_though_the_last_prediction_was_lost():
    live, plain = (OnlineFilter(FILTERS[f], MODEL, START) for f in ("delayed", "kalman"))
    late = [DelayedMeasurement(np.array([0.4]), jnp.array(age)) for age in (0.0, 1.0)]
    live.predict(U[0])
    live.predict(jnp.nan)
    assert int(live.update(late[0], "a").code) == Code.NOT_PREDICTED
    assert int(live.update(late[1], "a").code) == Code.DONE
    plain.predict(U[0])
    plain.update(np.array([0.4]), "a")
    np.testing.assert_allclose(live.belief.mean, plain.belief.mean, rtol=1e-13)


def test_joseph_form_beyond_its_condition_is_not_taken_for_a_run(cases_dir):
    case = json.loads((cases_dir / "kf_ill_conditioned.json").read_text("utf-8"))
    F, Q, H, R, m0, P0, y = (
        np.array(case["given"][k], dtype=float) for k in ("F", "Q", "H", "R", "m0", "P0", "y")
    )
    A, C = jnp.array(F), jnp.array(H)
    model = Model(
        Motion(lambda x, u: A @ x, linalg.factor(Q)),
        (Sensor(lambda x, aux: C @ x, linalg.factor(R), len(H)),),
    )
    with pytest.warns(StepWarning, match="predictions are INDEFINITE.*use form='sqrt'"):
        found = run(kalman(form="joseph"), model, Belief.of(jnp.array(m0), P0), y)
    lost = found.steps.prediction.code != Code.DONE
    assert np.any(lost)
    code = found.steps.info["y"].code
    np.testing.assert_array_equal(code == Code.NOT_PREDICTED, lost)
    assert found.tally.counts()[Code.INDEFINITE] == np.sum(lost)
    assert any("predictions are INDEFINITE" in sentence for sentence in doubts(found.tally))


# ------------------------------------------------------------------------- sentences from numbers


def tally(nis=100.0, dof=100, **codes) -> Tally:
    """Tally of one sensor whose predictions were all taken."""
    total = np.zeros(len(Code), int)
    predictions = total.copy()
    for code, number in codes.items():
        total[Code[code]] = number
    predictions[Code.DONE] = total.sum()
    return Tally(predictions, {"gnss": total}, {"gnss": np.array(nis)}, {"gnss": np.array(dof)})


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (tally(DONE=100), ""),
        (tally(DONE=70, REFUSED=30, MISSING=900), ""),
        (tally(DONE=60, REFUSED=40, MISSING=900), "40 of 100 measurements of 'gnss' were refused"),
        (tally(nis=5, dof=5, DONE=5, REFUSED=10), ""),  # too few to say
        (tally(nis=390, DONE=100), ""),
        (tally(nis=410, DONE=100), "larger than the filter expects"),
        (tally(nis=7, DONE=100), ""),
        (tally(nis=6, DONE=100), "smaller than the filter expects"),
        (tally(nis=120, dof=20, DONE=20), ""),  # two that count: chi-square may reach 6.9 of each
        (tally(nis=160, dof=20, DONE=20), "mean NIS per degree of freedom 8"),
        (tally(DONE=90, APART=10), ""),
        (tally(DONE=80, APART=20), "differed by more than 5 standard deviations at 20 of 100"),
        (tally(DONE=99, NOT_FINITE=1), "1 of 100 updates with 'gnss' are NOT_FINITE"),
        (tally(nis=np.inf, DONE=99, CONTRADICTED=1), "contradict what is known exactly"),
    ],
)
def test_doubts(given, said):
    sentences = doubts(given)
    assert (said in sentences[0]) if said else not sentences
    # Runs on a leading axis are summed.
    batch = Tally(
        np.stack([given.predictions, 0 * given.predictions]),
        {k: np.stack([v, 0 * v]) for k, v in given.updates.items()},
        {k: np.stack([v, np.zeros(())]) for k, v in given.nis.items()},
        {k: np.stack([v, 0 * v]) for k, v in given.dof.items()},
    )
    assert doubts(batch) == sentences


def test_a_bound_is_not_tested_as_a_covariance():
    assert not doubts(tally(nis=1000, DONE=100), bounds=True)
    assert doubts(tally(nis=1000, DONE=100))


# ------------------------------------------------------------------------- sentences from sequences

DT_S, LONG = 0.1, 400
F = np.array([[1.0, DT_S], [0.0, 1.0]])
L = np.linalg.cholesky(0.2 * np.array([[DT_S**3 / 3, DT_S**2 / 2], [DT_S**2 / 2, DT_S]]))


def tracked(runs, seed, too_small=1.0, change=lambda k, y: y):
    """Kalman filters of a position with its rate by NumPy: what `looked` takes, and error/sigma."""
    rng = np.random.default_rng(seed)
    x, m, P = np.zeros((runs, 2)), np.zeros((runs, 2)), np.eye(2)
    e, sigma, given, far = [], [], [], []
    for k in range(LONG):
        x = x @ F.T + rng.standard_normal((runs, 2)) @ L.T
        y = change(k, x[:, 0] + rng.standard_normal(runs))
        m, P = m @ F.T, F @ P @ F.T + L @ L.T / too_small**2
        S = P[0, 0] + 1.0
        e.append(y - m[:, 0])
        sigma.append(np.full(runs, np.sqrt(S)))
        m, P = m + np.outer(e[-1], P[:, 0] / S), P - np.outer(P[:, 0], P[0]) / S
        given.append(y)
        far.append(np.max(np.abs(m - x) / np.sqrt(np.diag(P)), axis=1))
    e, sigma, given = (np.array(a).T[..., None] for a in (e, sigma, given))
    nis = (e / sigma)[..., 0] ** 2
    return (e, sigma, nis, np.ones_like(nis, int), given), np.max(far[LONG // 4 :], axis=0)


def doubted(numbers):
    """The sentences on each run alone."""
    table = whiteness.innovation_sums(*numbers)
    return [whiteness.suspicions({"y": row}) for row in table], table


def test_no_sound_run_of_a_thousand_is_doubted_but_nearly_all_that_trust_their_motion_too_much():
    numbers, _ = tracked(1000, 1)
    sound, table = doubted(numbers)
    assert not any(sound)
    assert not whiteness.suspicions({"y": table})
    numbers, far = tracked(20, 2, too_small=10.0)
    assert np.sum(far > 5.0) >= 19
    sure, table = doubted(numbers)
    assert sum(map(bool, sure)) >= 19
    (said,) = [one for one in whiteness.suspicions({"y": table}) if "follow" in one]
    assert re.match(r"in (19|20) of 20 runs 'y' has innovations that follow the 10 before", said)


def test_the_order_of_innovations_is_not_hidden_by_gaps_weights_or_outliers():
    (e, sigma, nis, dof, _), _ = tracked(20, 4, too_small=10.0)
    gone = np.arange(LONG) % 3 > 0
    e, sigma = np.where(gone[:, None], np.nan, e), np.where(gone[:, None], np.nan, sigma)
    alone = whiteness.innovation_sums(e[:, ~gone], sigma[:, ~gone], nis[:, ~gone], dof[:, ~gone])
    np.testing.assert_allclose(whiteness.innovation_sums(e, sigma, nis, dof), alone, rtol=1e-12)
    (e, sigma, nis, dof, _), _ = tracked(20, 5, too_small=10.0)
    e[:, 7] = 1e30
    sigma[:, 150:] = np.nan  # refused
    found, _ = doubted((e, sigma, nis, dof))
    assert sum(any("follow" in one for one in row) for row in found) >= 19
    (e, sigma, nis, dof, _), _ = tracked(1, 6, change=lambda k, y: y + (k > 300) * 30.0 * (-1) ** k)
    found, _ = doubted((e, sigma, np.minimum(nis, 1.0), dof))  # as a rule that weighs leaves it
    assert any("of the last 100 innovations beyond 3 sigma" in one for one in found[0])


def test_one_lasting_error_counts_as_one_innovation():
    e = 1.7 * np.ones((LONG, 1))
    e[1::2] *= -1.0
    table = whiteness.innovation_sums(e, np.ones_like(e), e[:, 0] ** 2, np.ones(LONG, int))
    assert any("mean NIS" in one for one in whiteness.suspicions({"y": table}))
    assert not whiteness.suspicions({"y": table}, ("y",))
    table = whiteness.innovation_sums(
        10.0 * e, np.ones_like(e), 100.0 * e[:, 0] ** 2, np.ones(LONG, int)
    )
    assert any("mean NIS" in one for one in whiteness.suspicions({"y": table}, ("y",)))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda k, y: y if k < 300 else y + 300.0 + 0.5 * (k - 300) ** 2, "on one side"),
        (lambda k, y: y + (k > 300) * 30.0 * (-1) ** k, "last quarter of mean NIS"),
        (lambda k, y: y if k % 40 > 12 else 0.125 + 0.0 * y, "same reading 13 times in a row"),
        (lambda k, y: 4.0 * np.round(y / 4.0), ""),  # coarse
        (lambda k, y: 0.0 * y, "-"),  # a pseudo-measurement repeats itself
    ],
)
def test_what_a_sequence_shows(change, said):
    found, _ = doubted(tracked(1, 6, change=change)[0])
    repeated = [one for one in found[0] if "same reading" in one]
    assert any(said in one for one in found[0]) if len(said) > 1 else not repeated
    if not said:
        assert not found[0]


def test_pieces_of_a_log_are_judged_as_one():
    numbers, _ = tracked(2, 7, change=lambda k, y: y if k % 40 > 12 else 0.125 + 0.0 * y)
    table = whiteness.innovation_sums(*numbers)
    whole = whiteness.joined(list(table))
    assert whole[0, 0] == table[:, 0, 0].sum()
    (said,) = [one for one in whiteness.suspicions({"y": whole}, ("y",)) if "same" in one]
    assert "'y' gave the same reading 13 times in a row" in said


def test_a_run_and_a_stream_are_doubted_alike():
    y = np.where(np.arange(60)[:, None] < 30, RNG.normal(size=(60, 1)), 0.25)
    data = {"a": y, "b": y + 100.0}
    found = run(FILTERS["kalman"], MODEL, START, data, np.zeros(60))
    live = OnlineFilter(FILTERS["kalman"], MODEL, START)
    for k in range(60):
        live.predict(0.0)
        for name, rows in data.items():
            live.update(rows[k], name)
    said = doubts(found.tally)
    assert any("'a' gave the same reading 30 times in a row" in one for one in said)
    assert any("'b' has 60 of 60 innovations on one side" in one for one in said)
    assert live.doubts() == said
    assert not any("one side" in one for one in live.doubts(assumed=["a", "b"]))
