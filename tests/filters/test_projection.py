"""Constraints that come with data, against dense projections; rules that see some sensors alone."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import random_system, simulate, times
from interpreted import run
from jax.tree_util import Partial

from robins.filters import (
    Code,
    Model,
    Motion,
    Rule,
    Sensor,
    channel,
    distributed,
    kalman,
    taylor,
    unscented,
)
from robins.filters.rules import gate, huber, igg3, only, projection, sage_husa
from robins.filters.values import value

S = random_system(4, n=4, m=3)
D, T = np.array([[1.0, -1.0, 0.0, 2.0], [0.0, 1.0, 0.5, 0.0]]), 10
L = np.array([[0.3, 0.0], [0.1, 0.2]])
W = np.diag([2.0, 1.0, 3.0, 0.5]) + 0.3
Y = simulate(S, 5, T)[1]
HELD = np.random.default_rng(6).normal(size=(T, 2))
HELD[3], HELD[5, 0], HELD[7, 1] = np.nan, np.nan, np.nan
SEEN = Sensor(Partial(times, jnp.array(S.H)), jnp.array(S.W), 3, "seen")
MOTION = Motion(Partial(times, jnp.array(S.F)), jnp.array(S.G))


def model(noise):
    held = Sensor(Partial(times, jnp.array(D)), noise, 2, "held")
    return Model(MOTION, (SEEN, held))


def by_the_book(root, weight, project=True):
    m, P, out = S.m0, S.P0, []
    for y, d in zip(Y, HELD, strict=True):
        m, P = S.F @ m, S.F @ P @ S.F.T + S.Q
        K = P @ S.H.T @ np.linalg.inv(S.H @ P @ S.H.T + S.R)
        m, P = m + K @ (y - S.H @ m), P - K @ S.H @ P
        here = np.isfinite(d)
        C, R = D[here], (root @ root.T)[np.ix_(here, here)]
        V = {"covariance": P, "identity": np.eye(4), "matrix": np.linalg.inv(W)}[weight]
        G = V @ C.T @ np.linalg.inv(C @ V @ C.T)
        J = np.eye(4) - G @ C
        m = m - G @ (C @ m - d[here])
        P = J @ P @ J.T + G @ R @ G.T if project else P
        out.append((m, P))
    return [np.array(series) for series in zip(*out, strict=True)]


CASES = [
    ("covariance", L, True, taylor()),
    ("covariance", 0 * L, True, taylor()),
    ("identity", L, True, taylor()),
    ("matrix", L, True, taylor()),
    ("identity", 0 * L, True, taylor()),
    ("identity", L, False, unscented()),
]


@pytest.mark.parametrize(("weight", "root", "project", "way"), CASES)
def test_a_constraint_in_the_data_is_met(weight, root, project, way):
    rule = projection("held", W if weight == "matrix" else weight, project)
    got = run(kalman(way, [rule]), model(jnp.asarray(root)), S.start(), {"seen": Y, "held": HELD})
    means, covariances = by_the_book(root, weight, project)
    np.testing.assert_allclose(got.mean, means, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(got.covariance, covariances, rtol=1e-7, atol=1e-9)
    there = np.isfinite(HELD)
    on = np.asarray(got.mean) @ D.T
    np.testing.assert_allclose(on[there], HELD[there], atol=1e-10)
    info = got.steps.info["held"]
    assert info.code[3] == Code.MISSING
    assert not np.any(info.gain[3])
    residual = np.max(np.abs(np.where(there, np.nan_to_num(info.innovation), 0.0)), axis=1)
    np.testing.assert_allclose(info.notes["projection.residual"], residual, rtol=1e-12)
    assert "projection.residual" not in got.steps.info["seen"].notes


def test_what_was_refused_is_not_met():
    far = HELD + 1e4
    one = kalman(rules=[only("held", gate(patience=T)), projection("held")])
    got = run(one, model(jnp.asarray(L)), S.start(), {"seen": Y, "held": far})
    plain = run(kalman(), model(jnp.asarray(L)), S.start(), {"seen": Y, "held": np.nan * HELD})
    np.testing.assert_array_equal(got.mean, plain.mean)


def test_exact_ones_twice_in_joseph_form_and_in_a_local_filter():
    exact = model(jnp.zeros((2, 2)))
    held = Sensor(exact.sensors[1].read, jnp.zeros((2, 2)), 2, "again")
    rule = projection(["held", "again"])
    one = kalman(rules=[rule])
    update = jax.jit(one.update)
    state, _ = update(one.init(S.start(), {"held": 2}), exact.sensors[1], HELD[0], None)
    assert np.linalg.matrix_rank(np.asarray(state.belief.factor)) == 2
    twice, _ = update(state, held, HELD[0], None)
    np.testing.assert_array_equal(twice.belief.mean, state.belief.mean)
    np.testing.assert_array_equal(twice.belief.factor, state.belief.factor)

    joseph = kalman(form="joseph")
    start = joseph.init(state.belief, {"seen": 3})
    assert int(jax.jit(joseph.update)(start, SEEN, Y[0], None)[1].code) == Code.INDEFINITE

    locals_ = distributed([channel("held", one), channel("seen")])
    with pytest.raises(ValueError, match="'held' was singular"):
        run(locals_, exact, S.start(), {"held": HELD})


def test_a_projection_that_does_not_fit():
    with pytest.raises(ValueError, match="5 components, the state only 4"):
        projection("held").init(S.start(), {"held": 5})


# ------------------------------------------------------------------------------------------ only


def deaf():
    """A rule that refuses all it sees, counts it and says so."""

    def before(count, prior, o):
        return count + 1, prior, o._replace(accepted=jnp.zeros_like(o.accepted))

    def after(count, posterior, info, o):
        return count, posterior, info._replace(notes={**info.notes, "deaf.count": count})

    return Rule(lambda belief, dims: jnp.zeros((), int), before=before, after=after, name="deaf")


def test_a_rule_for_one_sensor_leaves_the_others_alone():
    noise, data = jnp.asarray(L), {"seen": Y, "held": HELD}
    got = run(kalman(rules=[only("seen", deaf())]), model(noise), S.start(), data)
    want = run(kalman(), model(noise), S.start(), {"seen": np.nan * Y, "held": HELD})
    np.testing.assert_array_equal(got.mean, want.mean)
    assert set(got.steps.info["seen"].code.tolist()) == {Code.REFUSED}
    np.testing.assert_array_equal(got.steps.info["held"].code, want.steps.info["held"].code)
    np.testing.assert_array_equal(got.steps.info["seen"].notes["deaf.count"], np.arange(1, T + 1))
    assert not got.steps.info["held"].notes


@value
class Reporting(Rule):
    """Says in a report with what it was asked."""

    number: Any

    def settle(self, memory, belief):
        return memory + self.number, belief, int(Code.DONE)

    def report(self, start, final, again, time):
        more = None if again is None else again(Reporting(self.number + 1.0))
        raise LookupError(start, final, more, time)


def test_a_rule_inside_settles_and_reports():
    rule = only("seen", Reporting(np.asarray(2.0)))
    assert rule.settles
    assert not only("seen", gate()).settles
    assert rule.settle(3.0, S.start())[0] == 5.0
    with pytest.raises(LookupError) as told:
        rule.report(0, 1, lambda other: (other.names, float(other.inner.number)), 9)
    assert told.value.args == (0, 1, (("seen",), 3.0), 9)
    with pytest.raises(LookupError) as told:
        rule.report(0, 1, None, None)
    assert told.value.args == (0, 1, None, None)


def test_hooks_of_a_step_stay_and_one_rule_serves_several_filters():
    rule = only(["seen", "other"], sage_husa())
    assert rule.name == "sage_husa"
    data, noise = {"seen": Y}, jnp.asarray(L)
    joined = distributed([channel("seen", kalman(rules=[rule])), channel("held")])
    alone = distributed([channel("seen", kalman(rules=[sage_husa()])), channel("held")])
    got, want = (run(f, model(noise), S.start(), data).mean for f in (joined, alone))
    np.testing.assert_array_equal(got, want)
    several = kalman(rules=[only("seen", huber()), only("held", igg3())])
    given = model(noise), S.start()
    both = jax.eval_shape(lambda y: run(several, *given, y), data | {"held": HELD})
    notes = {k: set(v.notes) for k, v in both.steps.info.items()}
    assert all(name.startswith("huber") for name in notes["seen"])
    assert all(name.startswith("igg3") for name in notes["held"])
