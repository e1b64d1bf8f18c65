"""Faults found by a bank: kept by a campaign, scored against the truth, reported and shown."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins.campaign import simulate
from robins.campaign.statistics import Statistics
from robins.filters import Belief, Model, Motion, Sensor, adaptive
from robins.report.suspects import suspects
from robins.results.roles import fault
from robins.systems.study import Case, Contender, Problem, SensorAxes, StateBlock
from robins.systems.suspects import probability_array, sentences, spans

EPOCHS, RUNS = 60, 3
TIME = 0.5 * np.arange(1, EPOCHS + 1)
PUSHED = np.zeros(EPOCHS, bool)
PUSHED[20:24] = PUSHED[50:52] = True
BLOCK = StateBlock("place", slice(0, 1), "m", "m", "line", ("x",))


def _steps(x, u):
    return x


def _reads(x, aux):
    return x


def world(index):
    """A place that stands still but for two pushes of ten, seen with a noise of 0.1."""
    truth = jnp.cumsum(jnp.where(jnp.asarray(PUSHED), 10.0, 0.0))[:, None]
    noise = 0.1 * jax.random.normal(jax.random.fold_in(jax.random.key(3), index), (EPOCHS, 1))
    start = Belief(jnp.zeros(1), 0.1 * jnp.eye(1))
    return Case(start, None, {"fix": truth + noise}, {}, truth)


def problem(faults):
    model = Model(Motion(_steps, np.array([0.1])), (Sensor(_reads, np.array([0.1]), 1, "fix"),))
    return Problem(
        simulate=world,
        contenders={"bank": Contender(adaptive((1.0, 100.0), 1.0, 0.05, 0.5), model)},
        claims=lambda *given: [],
        epoch_s=TIME,
        blocks=(BLOCK,),
        sensors={"fix": SensorAxes("m", "line", ("x",))},
        metrics=lambda statistics: {},
        faults=faults,
    )


@pytest.fixture(scope="module")
def outcome():
    return simulate(problem({"motion": PUSHED, "fix": PUSHED}), RUNS)


def test_a_push_is_found_at_once_and_there_is_hardly_a_false_alarm(outcome):
    found = outcome.metrics["bank"]
    assert found["motion_faults_detected_share"] == 1.0
    assert found["motion_detection_delay_s"] == 0.0
    assert found["motion_false_alarm_share"] < 0.1
    assert found["fix_faults_detected_share"] == 0.0  # the bank has no such hypothesis
    assert "fix_false_alarm_share" not in found
    assert "bank finds motion wrong in 3 of 3 runs, first at 10.5 s in the median." in outcome.notes


def test_what_is_believed_and_what_is_true_are_arrays_with_roles(outcome):
    s = outcome.solution
    assert s["wrong"].dims == s["mean_wrong"].dims == ("filter", "time", "suspect")
    assert list(s["suspect"].values) == ["motion"]
    np.testing.assert_array_equal(s["truly_wrong"].values[:, 0] != 0, PUSHED)
    assert all(not fault(n, s[n]) for n in ("wrong", "mean_wrong", "truly_wrong"))
    assert np.min(s["mean_wrong"].values[0, PUSHED, 0]) > 0.5
    picture = suspects(s)
    assert picture is not None
    assert "3 runs" in picture.caption


def test_where_faults_are_not_known_nothing_is_scored():
    found = simulate(problem(None), 1)
    assert not any("alarm" in name or "detect" in name for name in found.metrics["bank"])
    assert found.solution is not None
    assert "truly_wrong" not in found.solution
    assert any(note.startswith("bank finds motion wrong: 10.5 to") for note in found.notes)


def test_scores_are_those_of_loops():
    """Random probabilities of two suspects, in two chunks, against plain loops."""
    rng = np.random.default_rng(1)
    faults = {"a": rng.random(EPOCHS) < 0.2, "b": np.zeros(EPOCHS, bool)}
    wrong = {name: rng.random((RUNS, EPOCHS)) for name in faults}
    first = 7
    s = Statistics((), first, faults=faults)
    for rows in (slice(0, 2), slice(2, 3)):
        chunk = s.blank()
        chunk._suspected({name: chance[rows] for name, chance in wrong.items()})
        chunk.runs = rows.stop - rows.start
        s.merge(chunk)
    assert sorted(s.suspects) == ["a", "b"]
    for name, chance in wrong.items():
        np.testing.assert_allclose(s.fault_probability(name), chance.mean(axis=0), rtol=1e-14)
        for run, row in enumerate(chance):
            right = [k for k in range(first, EPOCHS) if not faults[name][k]]
            share = sum(row[k] > 0.5 for k in right) / len(right)
            assert s.false_alarms(name)[run] == pytest.approx(share, rel=1e-14)
            assert s.first_alarm(name)[run] == next(k for k in range(EPOCHS) if row[k] > 0.5)
            expected, k = [], 0
            while k < EPOCHS:
                if faults[name][k]:
                    end = next((j for j in range(k, EPOCHS) if not faults[name][j]), EPOCHS)
                    expected.append(next((j - k for j in range(k, end) if row[j] > 0.5), -1))
                    k = end
                k += 1
            np.testing.assert_array_equal(s.delays(name)[run], expected)


def test_sentences_name_the_longest_times_and_tables_leave_gaps():
    time = np.arange(100.0)
    chance = np.full(100, 0.1)
    chance[[3, 10, 11, 12, 30, 31, 50, 51, 70, 71]] = 0.9
    chance[20] = np.nan  # between two pieces of a log
    (said,) = sentences("bank", time, {"gnss_position": chance})
    assert said == (
        "bank finds gnss position wrong: 10.0 to 12.0 s, 30.0 to 31.0 s, 50.0 to 51.0 s, "
        "70.0 to 71.0 s and 1 shorter times; probability up to 0.90."
    )
    assert sentences("bank", time, {"imu": 0.1 * chance}) == ["bank finds nothing wrong with imu."]
    assert sentences("ekf", time, {}) == []
    falling = {"imu": np.where(time < 9, 0.8 - 0.02 * time, 0.1)}  # what the bank began with
    assert sentences("bank", time, falling) == ["bank finds nothing wrong with imu."]
    falling["imu"][5] = 0.85
    assert sentences("bank", time, falling) == [
        "bank suspects imu: 0.0 to 8.0 s; probability up to 0.85."
    ]
    assert spans(time, chance > 0.5)[:2] == [(3.0, 3.0), (10.0, 12.0)]
    table = probability_array("wrong", [{}, {"imu": chance}, {"gyro": chance}])["wrong"]
    assert table.shape == (3, 100, 2)
    assert np.all(np.isnan(table.values[0]))
    np.testing.assert_array_equal(table.values[2, :, 1], chance)
    assert np.all(np.isnan(table.values[1, :, 1]))
    assert probability_array("wrong", [{}, {}]) == {}
