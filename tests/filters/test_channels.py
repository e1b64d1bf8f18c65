"""Promises of joined filters step by step: who reads what, what stands, what is refused."""

import inspect
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import posterior, times
from interpreted import run
from jax.tree_util import Partial
from two_sensors import CHANNELS, SYSTEMS, N, Y, by_sensor, model_of

from robins import linalg
from robins.filters import (
    Belief,
    Code,
    Model,
    Motion,
    OnlineFilter,
    Rule,
    Sensor,
    kalman,
    rts_smoother,
    unscented,
)
from robins.filters.composite.channels import channel
from robins.filters.composite.distributed import distributed, intersecting
from robins.filters.composite.federated import federated
from robins.filters.composite.fusion import fuse
from robins.filters.rules import gate
from robins.manifold import Angle

VECTOR = np.array([[0.8, 0.3, 0.5, 0.1], [0.2, 0.7, 0.5, 0.9]])
S = SYSTEMS[0]
MODEL = model_of(*(jnp.array(a) for a in (S.F, S.G, S.H, S.W)))
START = Belief(jnp.array(S.m0), linalg.factor(S.P0))


# ----------------------------------------------------------------- robust locals, angles, streams


def turning():
    """A heading that turns through +-pi, a compass and a rate gyro; the compass is off once."""
    dt, sigma = 1.0, np.array([0.02, 0.01])
    rng = np.random.default_rng(0)
    heading, rate, compass, gyro = 2.7, 0.1, [], []
    for _ in range(20):
        heading, rate = heading + dt * rate, rate + 0.002 * rng.normal()
        compass.append((heading + sigma[0] * rng.normal() + np.pi) % (2 * np.pi) - np.pi)
        gyro.append(rate + sigma[1] * rng.normal())
    assert np.ptp(np.sign(compass)) == 2
    compass[12] += 1.0

    def step(x, u):
        return {"heading": x["heading"].retract(dt * x["rate"]), "rate": x["rate"]}

    model = Model(
        Motion(step, jnp.array([0.001, 0.002])),
        (
            Sensor(lambda x, aux: x["heading"], jnp.array(sigma[:1]), 1, "compass"),
            Sensor(lambda x, aux: x["rate"], jnp.array(sigma[1:]), 1, "gyro"),
        ),
    )
    start = Belief.of({"heading": Angle(2.6), "rate": np.zeros(1)}, np.diag([0.04, 0.04]))
    return model, start, {"compass": Angle(jnp.array(compass)), "gyro": jnp.array(gyro)[:, None]}


def test_robust_unscented_locals_through_a_turn():
    # A gate that refuses one sample: then all is as if that had not been measured.
    model, start, y = turning()
    one = federated(
        [channel("compass", kalman(unscented(), [gate()])), channel("gyro", kalman(unscented()))],
        shares=[[0.3, 0.8], [0.7, 0.2]],
        linearise=unscented(),
    )
    got = run(one, model, start, y)
    without = {**y, "compass": Angle(y["compass"].rad.at[12].set(jnp.nan))}
    want = run(kalman(unscented()), model, start, without)
    assert int(got.steps.info["compass"].code[12]) == Code.REFUSED
    off = jax.vmap(lambda a, b: a.local(b))(want.mean["heading"], got.mean["heading"])
    np.testing.assert_allclose(off, 0.0, atol=1e-10)
    np.testing.assert_allclose(got.mean["rate"], want.mean["rate"], atol=1e-10)
    np.testing.assert_allclose(got.covariance, want.covariance, rtol=1e-8, atol=1e-14)
    notes = got.steps.info["gyro"].notes
    np.testing.assert_allclose(notes["federated.share"], 0.45)
    assert not np.any(notes["federated.silent"])
    silent = np.asarray(got.steps.info["compass"].notes["federated.silent"])
    np.testing.assert_array_equal(silent, np.arange(20) == 12)

    live = OnlineFilter(one, model, start, "vm")
    for k in range(20):
        live.predict()
        live.update(Angle(y["compass"].rad[k]), "compass")
        live.update(y["gyro"][k], "gyro")
    np.testing.assert_allclose(live.belief.factor, got.final.belief.factor, rtol=1e-12, atol=1e-16)
    assert live.counts == {"DONE": 39, "REFUSED": 1}


def test_a_common_prediction_can_be_smoothed():
    T = 12
    got = rts_smoother(run(federated(CHANNELS, shares=VECTOR), MODEL, START, by_sensor(Y[0, :T])))
    F, Q, H, R = ([part] * T for part in (S.F, S.Q, S.H, S.R))
    means, covariances = posterior(F, Q, H, R, S.m0, S.P0, Y[0, :T])
    np.testing.assert_allclose(got.mean, means, atol=1e-8)
    np.testing.assert_allclose(got.covariance, covariances, atol=1e-8)


def test_gradients_of_a_federated_step():
    def left(scale):
        model = model_of(jnp.array(S.F), scale * S.G, jnp.array(S.H), jnp.array(S.W))
        one = federated(CHANNELS, shares=VECTOR, after_prediction=False)
        state = one.init(Belief(jnp.array(S.m0), jnp.eye(N)), model.dims)
        state, _ = one.predict(state, model.motion, None)
        state, info = one.update(state, model.sensors[0], jnp.array([1.0, jnp.nan]), None)
        return jnp.sum(state.belief.mean**2) + info.log_likelihood

    one = jax.jit(jax.value_and_grad(left))
    slope = (one(1.0 + 1e-5)[0] - one(1.0 - 1e-5)[0]) / 2e-5
    assert float(one(1.0)[1]) == pytest.approx(float(slope), rel=1e-6)


# ---------------------------------------------------------------------------------- single steps


@partial(jax.jit, static_argnums=0)
def stepped(one, y_a, y_b):
    """State after a prediction and each update, and what the updates said."""
    state, _ = one.predict(one.init(START, MODEL.dims), MODEL.motion, None)
    after_a, seen_a = one.update(state, MODEL.sensors[0], y_a, None)
    after_b, seen_b = one.update(after_a, MODEL.sensors[1], y_b, None)
    return state, after_a, after_b, seen_a, seen_b


def test_what_is_not_measured_changes_nothing_and_the_fused_belief_is_of_all_locals():
    one = federated(CHANNELS, shares=VECTOR)
    gone = jnp.full(2, jnp.nan)
    state, after_a, after_b, seen_a, seen_b = stepped(one, gone, jnp.ones(1))
    assert int(seen_a.code) == Code.MISSING
    np.testing.assert_array_equal(after_a.belief.mean, state.belief.mean)
    np.testing.assert_array_equal(after_a.belief.factor, state.belief.factor)
    want = fuse([m.belief for m in after_b.memory.members])
    np.testing.assert_allclose(after_b.belief.mean, want.mean, rtol=1e-13)
    assert int(seen_b.code) == Code.DONE
    local = after_a.memory.members[1].belief  # what an update says is what the local filter says
    reading = np.asarray(S.H[2] @ np.asarray(local.mean))
    assert float(seen_b.innovation[0]) == pytest.approx(1.0 - float(reading), rel=1e-12)
    np.testing.assert_array_equal(after_b.memory.silent, [1, 0])


COUNTED = Rule(init=lambda belief, dims: jnp.zeros((), int))


def having_learnt(state, i, count):
    """The state in which local filter i remembers a count."""
    members = list(state.memory.members)
    members[i] = members[i]._replace(memory=(jnp.array(count),))
    return state._replace(memory=state.memory._replace(members=tuple(members)))


def test_going_on_from_another_belief_shares_it_out_and_keeps_what_was_learnt():
    robust = [channel("a", kalman(rules=[COUNTED])), channel("b")]
    other = Belief(jnp.arange(4.0), jnp.diag(jnp.array([1.0, 2.0, 3.0, 4.0])))
    for one in (federated(robust, master=0.2), distributed(robust)):
        again = one.reset(having_learnt(one.init(START, MODEL.dims), 0, 7), other)
        assert again.belief is other
        beliefs = [m.belief for m in again.memory.members]
        for belief in beliefs:
            np.testing.assert_array_equal(belief.mean, other.mean)
        total = fuse(beliefs).covariance * (1 if len(beliefs) == 3 else 2)
        np.testing.assert_allclose(total, other.covariance, rtol=1e-12, atol=1e-12)
        assert int(again.memory.members[0].memory[0]) == 7


@pytest.mark.parametrize("sharing", ["scalar", "root"])
def test_a_step_that_one_local_cannot_take_is_taken_by_none(sharing):
    def settle(memory, belief):
        return memory + 1, belief, jnp.where(memory == 1, int(Code.INFEASIBLE), int(Code.DONE))

    picky = Rule(init=lambda belief, dims: jnp.zeros((), int), settle=settle)
    one = federated([channel("a"), channel("b", kalman(rules=[picky]))], sharing=sharing)
    predict = jax.jit(one.predict)
    state, first = predict(one.init(START, MODEL.dims), MODEL.motion, None)
    stood, second = predict(state, MODEL.motion, None)
    assert [int(first.code), int(second.code)] == [Code.DONE, Code.INFEASIBLE]
    np.testing.assert_array_equal(stood.belief.factor, state.belief.factor)
    for before, after in zip(state.memory.members, stood.memory.members, strict=True):
        np.testing.assert_array_equal(after.belief.factor, before.belief.factor)
    assert int(stood.memory.members[1].memory[0]) == 2  # what it learnt of that is kept
    assert int(predict(stood, MODEL.motion, None)[1].code) == Code.DONE


def test_infinite_information_is_refused_with_what_to_do():
    exact = Sensor(Partial(times, jnp.array(S.H[2:])), jnp.zeros(1), 1, "b")
    model = Model(MODEL.motion, (MODEL.sensors[0], exact))
    one = distributed(CHANNELS)
    live = OnlineFilter(one, model, START, "vm")
    before = live.predict().belief
    with pytest.raises(ValueError, match=r"channel 'b' was singular in 1 steps.*some noise"):
        live.update([1.0], "b")
    np.testing.assert_array_equal(live.belief.factor, before.factor)
    assert live.counts == {"NOT_FINITE": 1}
    known = Belief(START.mean, jnp.zeros((N, N)))
    still = Model(Motion(MODEL.motion.step, jnp.zeros(N)), MODEL.sensors)
    state, prediction = jax.jit(one.predict)(one.init(known, still.dims), still.motion, None)
    assert int(prediction.code) == Code.NOT_FINITE
    assert prediction.transition is None  # there is one a local
    assert state.memory.singular.tolist() == [1, 1]
    assert np.all(np.isfinite(state.belief.mean))


# --------------------------------------------------------------------------------- what is refused


def test_every_sensor_belongs_to_one_channel():
    for joined in (federated, distributed, intersecting):
        with pytest.raises(ValueError, match="no channels"):
            joined([])
        with pytest.raises(ValueError, match="'b' belongs to two channels"):
            joined([channel("b"), channel(("a", "b"))])
        with pytest.raises(ValueError, match="no channel uses sensor 'b'"):
            joined([channel("a")]).init(START, MODEL.dims)
        with pytest.raises(ValueError, match=r"channel 'b\+c' uses sensor 'c'; this model has"):
            joined([channel("a"), channel(["b", "c"])]).init(START, MODEL.dims)
    with pytest.raises(ValueError, match="each named once"):
        channel(["a", "a"])
    with pytest.raises(ValueError, match="a channel needs sensors"):
        channel([])
    one = federated(CHANNELS)
    other = Sensor(lambda x, aux: x[:1], jnp.ones(1), 1, "c")
    with pytest.raises(ValueError, match="no channel uses sensor 'c'"):
        one.update(one.init(START, MODEL.dims), other, jnp.ones(1), None)


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"sharing": "naive"}, "asymmetric"),
    ({"sharing": "some"}, "sharing must be"),
    ({"mode": "some"}, "mode must be"),
    ({"shares": [0.5, 0.6]}, "must sum to one"),
    ({"shares": [0.5, 0.4]}, "must sum to one"),
    ({"shares": [0.5, 0.5], "master": 0.1}, "with the master's 0.1"),
    ({"shares": [1.5, -0.5]}, "not negative"),
    ({"shares": [0.5, np.nan]}, "must be finite"),
    ({"shares": [1.0]}, r"\(2,\) or \(2, n\)"),
    ({"shares": "some"}, "'equal', 'trace', 'diagonal' or numbers"),
    ({"shares": "observability"}, r"observability_shares\(model"),
    ({"shares": VECTOR, "sharing": "scalar"}, "use 'root'"),
    ({"shares": "diagonal", "sharing": "scalar"}, "use 'root'"),
    ({"master": 1.0}, "the master's share"),
    ({"master": -0.1}, "the master's share"),
    ({"mode": "rescale"}, "needs a master"),
    ({"mode": "rescale", "master": 0.5, "keep": 1.0}, "keep must lie"),
    ({"mode": "zero-reset", "master": 0.5}, "everything to the master"),
    ({"mode": "zero-reset", "shares": [0.5, 0.5]}, "everything to the master"),
    ({"mode": "no-reset", "after_prediction": True}, "is of mode 'fusion-reset'"),
]


@pytest.mark.parametrize(
    ("asked", "why"), REFUSED, ids=lambda x: str(x) if isinstance(x, dict) else ""
)
def test_what_cannot_be_is_refused(asked, why):
    # A wrong literal is caught by the type check in tests, by the functions themselves elsewhere.
    with pytest.raises(ValueError, match=why):
        inspect.unwrap(federated)(CHANNELS, **asked)


def test_shares_for_other_states_are_refused_and_small_ones_raised():
    with pytest.raises(ValueError, match="shares are for 3 states, the belief has 4"):
        federated(CHANNELS, shares=np.full((2, 3), 0.5)).init(START, MODEL.dims)
    raised = federated(CHANNELS, shares=[1.0, 0.0]).init(START, MODEL.dims).memory.shares
    np.testing.assert_allclose(raised, np.array([[1.0], [0.05]]) / 1.05)


def test_what_is_unsound_warns():
    with pytest.warns(UserWarning, match="no upper bound.*adds information at every reset"):
        federated(CHANNELS, sharing="half")
    with pytest.warns(UserWarning, match="counted again at the next fusion"):
        distributed(CHANNELS, "full")
    with pytest.raises(ValueError, match="feedback must be"):
        inspect.unwrap(distributed)(CHANNELS, "some")
    with pytest.raises(ValueError, match="feedback must be"):
        inspect.unwrap(intersecting)(CHANNELS, feedback="some")
    with pytest.raises(ValueError, match="one for each of 2"):
        intersecting(CHANNELS, [1.0])
