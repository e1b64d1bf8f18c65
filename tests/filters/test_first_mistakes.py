"""First mistakes of a newcomer, each answered by a sentence that names it."""

import inspect
import re
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from interpreted import run

from robins.filters import Belief, Model, Motion, Sensor, cubature, kalman, taylor, unscented
from robins.filters.rules import gate, huber
from robins.manifold import Angle

F = jnp.array([[1.0, 0.1], [0.0, 1.0]])
START = Belief.of(jnp.zeros(2), np.eye(2))
Y = np.zeros((3, 1))
PLAIN = inspect.unwrap(kalman)  # as users have it, whose types nobody checks at a call


def model(step=lambda x, u: F @ x, read=lambda x, aux: x[:1]):
    return Model(Motion(step, jnp.ones(2)), (Sensor(read, jnp.ones(1)),))


def runs(way=taylor, start=START, **parts):
    return lambda: run(kalman(way()), model(**parts), start, Y)


MISTAKES = {
    "kalman(unscented)": (
        lambda: PLAIN(unscented),
        "linearise must be made by taylor(), unscented() or cubature(), got unscented: call it, "
        "unscented()",
    ),
    'kalman("ukf")': (lambda: PLAIN("ukf"), "got 'ukf'"),
    "rules=gate()": (
        lambda: PLAIN(rules=gate()),
        "rules must be a sequence of rules, as in rules=[gate()], got the rule gate",
    ),
    "rules=huber": (lambda: PLAIN(rules=huber), "got huber"),
    "rules=[huber]": (
        lambda: PLAIN(rules=[gate(), huber]),
        "rules[1] must be a rule, as gate() makes one, got huber: call it, huber()",
    ),
    'rules=["huber"]': (lambda: PLAIN(rules=["huber"]), "rules[0] must be a rule, as gate()"),
    "no noise": (lambda: Motion(lambda x, u: x), "the motion needs noise=, standard deviations"),
    "two noises": (
        lambda: Sensor(lambda x, aux: x, jnp.ones(1), name="gnss", noise_covariance=np.eye(1)),
        "sensor 'gnss' needs noise=, standard deviations or a factor L of the covariance L L', or "
        "noise_covariance= in its place",
    ),
    "no covariance": (
        lambda: Motion(lambda x, u: x, noise_covariance=-np.eye(2)),
        "noise covariance of the motion is not positive semidefinite",
    ),
    "no dim": (
        lambda: Sensor(lambda x, aux: x, lambda x, aux: jnp.ones(1), name="gnss"),
        "sensor 'gnss' needs dim=, how many numbers it reads",
    ),
    "noise without an axis": (
        lambda: Sensor(lambda x, aux: x, 0.1, name="gnss"),
        "sensor 'gnss' needs dim=, how many numbers it reads, or noise with an axis",
    ),
    "step of a wrong shape": (
        runs(step=lambda x, u: F[:1] @ x),
        "step of the motion returns float64(1,) of a state float64(2,)",
    ),
    "step of a wrong shape, sigma points": (
        runs(unscented, step=lambda x, u: x[:1]),
        "step of the motion returns float64(1,) of a state float64(2,)",
    ),
    "step of another structure": (
        runs(step=lambda x, u: (x[:1], x[1:])),
        "step of the motion returns ('float64(1,)', 'float64(1,)') of a state float64(2,)",
    ),
    "step that returns a list": (
        runs(step=lambda x, u: [x[0], x[1]]),
        "returns ['float64()', 'float64()'] of a state float64(2,): return jnp.array([...])",
    ),
    "mean that is a list": (
        lambda: Belief.of([0.0, 1], np.eye(2)),
        "initial mean is a list of numbers: give an array, jnp.array([0.0, 1])",
    ),
    "mean that is a tuple": (
        lambda: Belief.of((0.0,), np.eye(1)),
        "give an array, jnp.array([0.0])",
    ),
    "a sensor for sensors": (
        lambda: Model.__post_init__(
            SimpleNamespace(sensors=Sensor(F.dot, jnp.ones(2), name="ranger"))
        ),
        "sensors must be a tuple of sensors, as in (ranger,), got the Sensor 'ranger'",
    ),
    "noise of a wrong size": (
        lambda: Motion(lambda x, u: x, jnp.ones(3)).noise_factor(jnp.zeros(2), None),
        "noise of the motion has shape (3,): (2,) standard deviations or a (2, k) factor",
    ),
    "step of another element": (
        runs(start=Belief.of(Angle(jnp.zeros(())), np.eye(1)), step=lambda x, u: x.rad),
        "of a state Angle(rad='float64()')",
    ),
    "step in 32 bits": (
        runs(step=lambda x, u: x.astype(jnp.float32)),
        "step of the motion returns float32, and filters compute in float64",
    ),
    "read in 32 bits": (
        runs(cubature, read=lambda x, aux: x[:1].astype("f4")),
        "read of sensor 'y' returns float32, and filters compute in float64",
    ),
    "read of a wrong size": (runs(read=lambda x, aux: x), "sensor 'y' reads shape (2,), but was"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named(mistake):
    make, sentence = MISTAKES[mistake]
    with pytest.raises((TypeError, ValueError), match=re.escape(sentence)):
        make()


@pytest.mark.parametrize("way", [taylor, unscented])
def test_a_covariance_is_the_noise_of_its_factor(way):
    rng = np.random.default_rng(0)
    A, B = rng.normal(size=(2, 2)), rng.normal(size=(1, 2))
    Q, R = A @ A.T, B @ B.T
    y = rng.normal(size=(20, 1))

    def step(x, u):
        return F @ x

    def read(x, aux):
        return x[:1]

    of_covariances = Model(Motion(step, noise_covariance=Q), (Sensor(read, noise_covariance=R),))
    of_factors = Model(Motion(step, jnp.asarray(A)), (Sensor(read, jnp.asarray(B), 1),))
    one, other = (run(kalman(way()), m, START, y) for m in (of_covariances, of_factors))
    np.testing.assert_allclose(one.mean, other.mean, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-12, atol=1e-14)
    assert of_covariances.dims == {"y": 1}
    # It is data like any noise: models that differ in it are of one shape.
    again = Model(Motion(step, noise_covariance=2.0 * Q), (Sensor(read, noise_covariance=R),))
    assert jax.tree.structure(again) == jax.tree.structure(of_covariances)


@jax.tree_util.register_pytree_node_class
class Heading:
    """An element of a user's own, which does not say when two are equal."""

    dim = 1

    def __init__(self, rad):
        self.rad = rad

    def tree_flatten(self):
        return (self.rad,), None

    @classmethod
    def tree_unflatten(cls, _, parts):
        return cls(*parts)

    def retract(self, delta):
        return Heading(self.rad + delta[0])

    def local(self, other):
        return (other.rad - self.rad)[..., None]


def test_an_element_of_a_user_is_a_measurement():
    given = np.array([0.1, np.nan, 0.3])
    own = model(read=lambda x, aux: Heading(x[0]))
    plain = run(kalman(), model(), START, given[:, None])
    np.testing.assert_array_equal(run(kalman(), own, START, Heading(given)).mean, plain.mean)
    with pytest.raises(ValueError, match="sensor 'y' reads shape"):
        run(kalman(), own, START, Heading(np.zeros((3, 2))))
