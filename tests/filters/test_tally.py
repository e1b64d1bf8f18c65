"""What a run says of steps that were not taken, and why a reader should doubt a filter."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

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
    run,
)
from robins.filters.composite.delayed import Late

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
    late = [Late(np.array([0.4]), jnp.array(age)) for age in (0.0, 1.0)]
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
    """Of one sensor whose predictions were all taken."""
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
