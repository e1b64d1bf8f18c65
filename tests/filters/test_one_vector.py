"""A vector has three components and shows two directions: rules must not take rounding for a third.

An attitude known to 30 deg about a field and to half a degree across it; the field is read with
five times the error expected.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins.filters import Belief, Sensor, kalman, taylor, unscented
from robins.filters.rules import discriminator, gate, strong_tracking
from robins.rotation import Rotation, conjugate, from_euler, from_rotvec, rotate

DEG = np.pi / 180.0
FIELD = jnp.array([22e-6, -3e-6, 41e-6])  # T
ABOUT = np.asarray(FIELD) / np.linalg.norm(FIELD)
SINE = np.sin(DEG)


def read(x: Rotation, field_n):
    return rotate(conjugate(x.wxyz), field_n)


SENSOR = Sensor(read, jnp.full(3, SINE * float(jnp.linalg.norm(FIELD))), 3, "field")


ROOT = np.linalg.cholesky((0.5 * DEG) ** 2 * np.eye(3) + (30.0 * DEG) ** 2 * np.outer(ABOUT, ABOUT))


def belief(q) -> Belief:
    """Half a degree, and 30 deg about the field."""
    return Belief(Rotation(q), jnp.asarray(ROOT))


RULES = {
    "strong tracking": strong_tracking(form="projected"),
    "discriminator": discriminator(patience=1, threshold=0.0, rho=0.5),
    "gate inflates": gate(0.999, 0, "inflate"),
    "gate re-opens": gate(0.999, 1, "reinitialise"),
}


@pytest.mark.parametrize("way", [taylor(), unscented(0.5)], ids=["taylor", "unscented"])
def test_what_one_vector_does_not_show_stays_as_known_as_it_was(way):
    """Whichever way the sensor's axes lie: rounding differs with them."""
    off = jnp.asarray(np.cross(ABOUT, [0.0, 0.0, 1.0]))
    turned = rotate(from_rotvec(0.1 * off), FIELD)

    filters = {name: kalman(way, [rule]) for name, rule in RULES.items()}

    @jax.jit
    def seen(states, q):
        done, y = {}, rotate(conjugate(q), turned)
        for name, filter_ in filters.items():
            state = filter_.reset(states[name], belief(q))
            done[name] = filter_.update(state, SENSOR, y, FIELD)
        return {name: one[0] for name, one in done.items()}, done

    for euler in ((0.1, 0.7, 2.0), (0.0, 0.0, 0.0), (-2.0, 1.2, -0.4), (1.5, -0.3, 3.0)):
        q = from_euler(*euler)
        states = {name: one.init(belief(q), {"field": 3}) for name, one in filters.items()}
        for _ in range(2):  # two that agree, for the gate that asks for them
            states, done = seen(states, q)
        for name, (state, info) in done.items():
            sigma = np.sqrt(ABOUT @ np.asarray(state.belief.covariance) @ ABOUT)
            assert info.nis > 0.0, name
            # sigma points see the curve of 30 deg: what they make of it is a share, not a multiple
            assert 29.0 * DEG < sigma < 31.0 * DEG, name
