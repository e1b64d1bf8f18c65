"""Whatever filter a rule is in, it is asked after a run what it has to report."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from interpreted import run
from jax.tree_util import Partial
from two_sensors import SYSTEMS, N, Y, by_sensor, model_of

from robins import linalg
from robins.filters import (
    Belief,
    ModeFamily,
    Model,
    OnlineFilter,
    Rule,
    Sensor,
    at_master,
    channel,
    delayed,
    distributed,
    federated,
    guarded,
    imm,
    kalman,
)
from robins.filters.rules import gate, only
from robins.filters.values import Numbers, value

STEPS = 6
S = SYSTEMS[0]
MODEL = model_of(*(jnp.array(part) for part in (S.F, S.G, S.H, S.W)))
HELD = Sensor(Partial(lambda row, x, aux: row @ x, jnp.ones((1, N))), jnp.ones(1), 1, "held")
WITH_HELD = Model(MODEL.motion, (MODEL.sensors[0], HELD))
START = Belief(jnp.array(S.m0), linalg.factor(S.P0))
# One sensor is measured, so that a run compiles one update.
DATA = {"a": by_sensor(np.nan_to_num(Y[0, :STEPS]))["a"]}
HEARD: list[tuple] = []


@value
class Counting(Rule):
    """Counts predictions and updates, each as so many, and says for whom."""

    who: Numbers
    each: Numbers

    name = "counting"

    def init(self, belief, dims):
        return jnp.zeros(())

    def process(self, memory, transition):
        return memory + self.each, transition

    def after(self, memory, posterior, info, observation):
        return memory + self.each, posterior, info

    def report(self, start, final, again, time):
        """Arguments of the report; run once more with each a hundred."""
        more = None if again is None else int(again(replace(self, each=100.0 * self.each)))
        HEARD.append((int(self.who), int(start), int(final), more, time))


def counting(who):
    """A rule that reports."""
    return Counting(jnp.asarray(who, float), np.ones(()))


def asked(who):
    """A filter with such a rule."""
    return kalman(rules=[counting(who)])


LOCALS = (channel("a", asked(0)), channel("b", asked(1)))
EVEN = np.full((2, 2), 0.5)
# The filter, who in it is asked, in order, and how many predictions and updates of a step it makes.
FILTERS = {
    "two rules": (kalman(rules=[gate(), counting(0), only("a", counting(1))]), [(0, 2), (1, 2)]),
    "family": (imm(ModeFamily(asked, jnp.arange(2)), EVEN), [(0, 2), (1, 2)]),
    "guarded": (guarded(asked(0), asked(1), "a", ["b"], [(0, 1)]), [(0, 2), (1, 1)]),
    "master": (at_master(distributed(LOCALS[:1]), "held", asked(2)), [(0, 2), (2, 1)]),
    "delayed": (delayed(asked(0), MODEL, 2), [(0, 2)]),
    "deep": (
        federated([channel("a", imm([kalman(), asked(0)], EVEN)), LOCALS[1]]),
        [(0, 2), (1, 1)],
    ),
}


@pytest.mark.parametrize("name", FILTERS)
def test_every_rule_is_asked_with_a_run_of_its_own(name):
    filter_, expected = FILTERS[name]
    model = WITH_HELD if name == "master" else MODEL
    data = DATA | {"held": np.zeros((STEPS, 1))} if name == "master" else DATA
    HEARD.clear()
    run(filter_, model, START, data, time_s=np.arange(STEPS))
    steps = [(who, STEPS * of_a_step) for who, of_a_step in expected]
    assert [h[:4] for h in HEARD] == [(who, 0, n, 100 * n) for who, n in steps]
    assert all(len(h[4]) == STEPS for h in HEARD)


def test_one_by_one_there_is_no_other_run():
    online = OnlineFilter(asked(3), MODEL, START)
    HEARD.clear()
    online.predict()
    online.update(DATA["a"][0], "a")
    assert [(3, 0, n, None, None) for n in (1, 2)] == HEARD
