"""Rules that learn the noise, at work: what they find, what they gain, and where they must lose."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from interpreted import run

from robins.filters import Belief, Model, Motion, Sensor, kalman
from robins.filters.rules.innovation_fading import innovation_fading
from robins.filters.rules.sage_husa import sage_husa
from robins.filters.rules.variational_bayes import variational_bayes

RUNS, STEPS = 200, 300


def walks(seed, r_times, q_times):
    """Positions and speeds, and positions measured; the noise is a multiple of the nominal one."""
    rng = np.random.default_rng(seed)
    x, states, y = rng.normal(size=(RUNS, 2)) * [2.0, 1.0], [], []
    for _ in range(STEPS):
        push = np.sqrt(q_times) * rng.normal(size=(RUNS, 1))
        x = x @ np.array([[1.0, 0.0], [1.0, 1.0]]) + push * [0.05, 0.1]
        states.append(x)
        y.append(x[:, :1] + np.sqrt(r_times) * rng.normal(size=(RUNS, 1)))
    return np.array(states).swapaxes(0, 1), np.array(y).swapaxes(0, 1)


def track(one, states, y, nominal=1.0, q_nominal=1.0):
    """Position RMS over steps 100 on, and the mean of each note there."""
    mean, notes = tracked(one, y, jnp.array([np.sqrt(nominal)]), jnp.array(np.sqrt(q_nominal)))
    error = np.asarray(mean)[:, 100:, 0] - states[:, 100:, 0]
    return np.sqrt(np.mean(error**2)), {k: np.mean(v[:, 100:]) for k, v in notes.items()}


@partial(jax.jit, static_argnames="one")
def tracked(one, y, sigma, q_sigma):
    F = jnp.array([[1.0, 1.0], [0.0, 1.0]])
    motion = Motion(lambda x, u: F @ x, q_sigma * jnp.array([[0.05], [0.1]]))
    model = Model(motion, (Sensor(lambda x, aux: x[:1], sigma, 1),))
    start = Belief(jnp.zeros(2), jnp.diag(jnp.array([2.0, 1.0])))
    keep = lambda step: (step.posterior.mean, step.info["y"].notes)  # noqa: E731
    return jax.vmap(lambda row: run(one, model, start, row, keep=keep).steps)(y)


KF = kalman(form="joseph")
R_LEARNERS = {
    "sage_husa": (kalman(rules=[sage_husa()], form="joseph"), "sage_husa.r_scale.0"),
    "variational_bayes": (
        kalman(rules=[variational_bayes()], form="joseph"),
        "variational_bayes.r_scale.0",
    ),
}


@pytest.mark.parametrize(("one", "note"), R_LEARNERS.values(), ids=R_LEARNERS)
def test_noise_four_times_as_large_is_found(one, note):
    states, y = walks(1, 4.0, 1.0)
    rms, notes = track(one, states, y)
    plain, _ = track(KF, states, y)
    told, _ = track(KF, states, y, nominal=4.0)
    assert notes[note] == pytest.approx(4.0, rel=0.03)
    assert told < rms < 1.02 * told
    assert plain > 1.05 * rms


@pytest.mark.parametrize(("one", "note"), R_LEARNERS.values(), ids=R_LEARNERS)
def test_where_the_noise_is_as_said_little_is_lost(one, note):
    states, y = walks(2, 1.0, 1.0)
    rms, notes = track(one, states, y)
    plain, _ = track(KF, states, y)
    assert notes[note] == pytest.approx(1.0, rel=0.03)
    assert rms < 1.01 * plain


@pytest.mark.parametrize(("one", "note"), R_LEARNERS.values(), ids=R_LEARNERS)
def test_a_wrong_motion_is_taken_for_noise_and_must_lose(one, note):
    states, y = walks(3, 1.0, 9.0)
    rms, notes = track(one, states, y)
    plain, _ = track(KF, states, y)
    assert notes[note] > 3.0  # the sensor is as good as ever
    assert rms > 1.4 * plain


def test_the_noise_of_the_motion_is_found_where_the_sensor_is_known():
    one = kalman(rules=[sage_husa(adapt="Q")], form="joseph")
    for q_times, low, high in ((9.0, 5.0, 9.0), (1.0, 1.0, 2.0)):
        states, y = walks(4, 1.0, q_times)
        rms, notes = track(one, states, y)
        told, _ = track(KF, states, y, q_nominal=q_times)
        plain, _ = track(KF, states, y)
        assert low < notes["sage_husa.q_scale.1"] < high
        assert rms < 1.05 * told
        assert q_times == 1.0 or plain > 1.2 * rms


def test_fading_by_innovations_is_for_motions_and_not_for_sensors():
    one = kalman(rules=[innovation_fading()], form="joseph")
    ratios = {}
    for name, r_times, q_times in (("right", 1.0, 1.0), ("motion", 1.0, 9.0), ("sensor", 4.0, 1.0)):
        states, y = walks(5, r_times, q_times)
        ratios[name] = track(one, states, y)[0] / track(KF, states, y)[0]
    assert ratios["motion"] < 0.9
    assert 1.0 < ratios["right"] < 1.15
    assert ratios["sensor"] > 1.5
