"""A study of a model that is true: its worlds are those of the model, its filters consistent."""

import runpy
from functools import partial
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import robins as rb
from robins.campaign import simulate
from robins.manifold import Angle
from robins.scenario import Quantity, default
from robins.sim.random import stream
from robins.systems.from_model import draw_run

EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "first.py"
F = np.array([[1.0, 1.0], [0.0, 1.0]])


def model(noise: float = 0.0, sigma: float = 0.0) -> rb.Model:
    motion = rb.Motion(lambda x, u: F @ x, jnp.full(2, noise))
    return rb.Model(motion, (rb.Sensor(lambda x, aux: x[:1], jnp.full(1, sigma), name="a"),))


def start(factor: float = 1.0) -> rb.Belief:
    return rb.Belief(jnp.array([1.0, 2.0]), factor * jnp.eye(2))


def test_without_noise_the_world_is_the_motion():
    truth, y = draw_run(model(), start(0.0), 4, partial(stream, 1, 0))
    np.testing.assert_array_equal(truth, [[3, 2], [5, 2], [7, 2], [9, 2]])
    np.testing.assert_array_equal(y["a"], truth[:, :1])


def test_its_covariances_are_those_of_the_model():
    """Scatter of a variance over 4000 runs: a share of 1/sqrt(2000)."""
    runs = jax.vmap(lambda k: draw_run(model(0.5, 3.0), start(2.0), 2, partial(stream, 7, k)))
    truth, y = runs(jnp.arange(4000))
    P, Q = 4.0 * np.eye(2), 0.25 * np.eye(2)
    for k in range(2):
        P = F @ P @ F.T + Q
        np.testing.assert_allclose(np.cov(truth[:, k].T), P, atol=0.07 * P.max())
    assert np.std(y["a"] - truth[..., :1]) == pytest.approx(3.0, rel=0.04)


def test_readings_may_be_elements_of_a_manifold():
    turned = rb.Sensor(lambda x, aux: Angle(x[0]), jnp.array([0.1]), name="turned")
    held = rb.Model(rb.Motion(lambda x, u: x, jnp.zeros(1)), (turned,))
    nearly = rb.Belief(jnp.array([np.pi]), jnp.zeros((1, 1)))
    _, y = draw_run(held, nearly, 50, partial(stream, 0, 0))
    assert np.all(np.abs(y["turned"].rad) <= np.pi)
    assert np.abs(y["turned"].rad).min() > 2.5


READS_BOTH = rb.Model(model().motion, (rb.Sensor(lambda x, aux: x, jnp.ones(1), name="a"),))


class Wind(rb.Scenario):
    gust: Annotated[float, Quantity("length", least="0 m")] = default("2 m")


def test_model_and_faults_may_be_functions():
    study = rb.study_from_model(
        lambda given: model(sigma=given.gust),
        start(),
        {"kf": rb.kalman()},
        3,
        faults=lambda key, y: {"a": y["a"].at[1].set(jnp.nan)},
        parameters=Wind,
    )
    given = Wind()
    believed, begin = study.lay_out(given)
    assert believed.sensors[0].noise.tolist() == [2.0]
    case = study.simulate(given, (believed, begin), 0, jnp.asarray(0))
    assert np.isnan(case.y["a"]).ravel().tolist() == [False, True, False]
    assert study.view(given, (believed, begin)).blocks[1].name == "x1"


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"states": {"height": "m"}}, "states names height; the error has 2 components"),
        ({"readings": {"b": "m"}}, "readings names b; the model has a"),
        (
            {"states": {"place": "metre", "speed": "m/s"}},
            r"states\['place'\]: unknown unit 'metre'",
        ),
        ({"readings": {"a": "metres"}}, r"readings\['a'\]: unknown unit .*; write one of the SI"),
        ({"model": READS_BOTH}, r"sensor 'a' reads 2 numbers, and its noise .* is of 1"),
        ({"filters": {}}, "needs a filter"),
        ({"steps": 0}, "needs a step at least, got 0"),
    ],
)
def test_what_does_not_fit_is_refused(wrong, words):
    given = {"model": model(), "start": start(), "filters": {"kf": rb.kalman()}, "steps": 3} | wrong
    with pytest.raises(ValueError, match=words):
        rb.study_from_model(**given).problem(rb.Scenario(), ["kf"], 0)


def test_the_first_system_of_the_documents_is_consistent():
    study = runpy.run_path(str(EXAMPLE))["study"]
    metrics = simulate(study.problem(study.parameters(), ["kf"], 0), 30).metrics["kf"]
    assert metrics["nees_all_states"] == pytest.approx(1.0, abs=0.1)
    low, high = metrics["nis_barometer_band"]
    assert low < metrics["nis_barometer"] < high
