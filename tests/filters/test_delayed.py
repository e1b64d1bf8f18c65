"""However late and in whatever order measurements come: the belief is that of the in-order run."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_kalman import times
from interpreted import run
from jax.tree_util import Partial

from robins.filters import (
    Belief,
    Code,
    Model,
    Motion,
    OnlineFilter,
    Rule,
    Sensor,
    kalman,
    normalised,
)
from robins.filters.composite.delayed import DelayedMeasurement, delayed
from robins.filters.rules import gate
from robins.filters.values import Numbers, value
from robins.manifold import Angle

SHIFT, DEPTH, T, SEEDS = 3, 6, 24, 4


def step(x, u):
    heading = x["heading"].retract(x["rate"] + u)
    way = jnp.stack([jnp.cos(heading.rad), jnp.sin(heading.rad)])
    return {"heading": heading, "p": x["p"] + 0.5 * way, "rate": 0.9 * x["rate"]}


MOTION = Motion(step, jnp.array([0.02, 0.05, 0.05, 0.02]))
# The bearing comes first in the model and, in the schedules below, is the later of the two.
BEARING = Sensor(
    lambda x, beacon: Angle(jnp.arctan2(*(beacon - x["p"])[::-1])), jnp.array([0.05]), 1, "bearing"
)
PLACE = Sensor(lambda x, aux: x["p"], jnp.array([0.3, 0.3]), 2, "place")
MODEL = Model(MOTION, (BEARING, PLACE))
START = Belief.of(
    {"heading": Angle(jnp.array(0.3)), "p": jnp.zeros(2), "rate": jnp.zeros(1)},
    np.diag([0.1, 1.0, 1.0, 0.01]),
)


def learning() -> Rule:
    """Remembers everything there is to remember: how often it was called, and what it saw."""

    def init(belief, dims):
        return jnp.zeros((), int), {name: (jnp.zeros((), int), jnp.ones(())) for name in dims}

    def process(memory, transition):
        return (memory[0] + 1, memory[1]), transition

    def before(memory, prior, o):
        calls, power = memory[1][o.sensor]
        seen = normalised(o)
        new = 0.8 * power + 0.2 * seen.nis / jnp.maximum(seen.dof, 1).astype(float)
        power = jnp.clip(jnp.where(seen.dof > 0, new, power), 0.3, 3.0)
        memory = (memory[0], {**memory[1], o.sensor: (calls + 1, power)})
        return memory, prior, o._replace(noise=o.noise * jnp.sqrt(power))

    return Rule(init=init, process=process, before=before)


FILTER = kalman(rules=[learning(), gate(0.99)])
DELAYED = delayed(FILTER, MODEL, DEPTH, u=jnp.zeros(1), aux={"bearing": jnp.zeros(2)})


def drive(seed: int) -> dict:
    """Measurements in order, and the same as they arrive; the last steps only bring late ones."""
    rng = np.random.default_rng(seed)
    u = 0.1 * rng.normal(size=(T + SHIFT, 1))
    x, place, bearing = START.mean, [], []
    beacon = 5.0 * rng.normal(size=(T + SHIFT, 2))
    for k in range(T + SHIFT):
        x = step(x, u[k])
        place.append(x["p"] + 0.3 * rng.normal(size=2))
        bearing.append(np.arctan2(*(beacon[k] - x["p"])[::-1]) + 0.05 * rng.normal())
    place, bearing = np.array(place), np.array(bearing)
    place[rng.random(place.shape) < 0.2] = np.nan
    place[rng.integers(T)] += 9.0  # for the gate
    bearing[rng.random(T + SHIFT) < 0.2] = np.nan
    place[T:], bearing[T:] = np.nan, np.nan
    bearing = (bearing + np.pi) % (2 * np.pi) - np.pi

    def arrivals(spread, shift):
        """made[k]: the step of what arrives at step k, -1 where nothing does."""
        order = np.argsort(np.arange(T) + spread * rng.random(T))
        return np.concatenate([np.full(shift, -1), order, np.full(SHIFT - shift, -1)])

    def late(value, made):
        row = np.where(made < 0, T, made)  # row T holds nothing
        return DelayedMeasurement(
            value[row], np.where(made < 0, 0, np.arange(T + SHIFT) - made).astype(float)
        )

    made = {"bearing": arrivals(3.0, SHIFT), "place": arrivals(1.9, 2)}
    seen, known = late(bearing, made["bearing"]), late(place, made["place"])
    return {
        "u": u,
        "in order": {"bearing": Angle(bearing), "place": place},
        "beacon": {"bearing": beacon},
        "as it comes": {"bearing": DelayedMeasurement(Angle(seen.value), seen.age), "place": known},
        "beacon as it comes": {
            "bearing": beacon[np.where(made["bearing"] < 0, T, made["bearing"])]
        },
        "made": made,
    }


def each(filter_, data):
    """Runs of one filter on some measurements, inputs and beacons, side by side."""
    ran = [run(filter_, MODEL, START, *given) for given in data]
    return jax.tree.map(lambda *x: np.stack(x), *ran)


@pytest.fixture(scope="module")
def drives():
    return [drive(seed) for seed in range(SEEDS)]


@pytest.fixture(scope="module")
def runs(drives):
    return (
        each(FILTER, [(d["in order"], d["u"], d["beacon"]) for d in drives]),
        each(DELAYED, [(d["as it comes"], d["u"], d["beacon as it comes"]) for d in drives]),
    )


def close(one, other, atol):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=0.0, atol=atol)


def test_belief_and_memories_end_as_in_order(runs, drives):
    ordered, late = runs
    ages = np.concatenate([np.ravel(d["as it comes"][s].age) for d in drives for s in MODEL.dims])
    assert ages.max() >= 5
    assert np.mean(np.diff(drives[0]["made"]["bearing"][SHIFT:]) < 0) > 0.1  # out of order too
    close(late.final.belief, ordered.final.belief, 1e-12)
    close(late.final.memory.inner, ordered.final.memory, 1e-12)
    refused = ordered.steps.info["place"].code == Code.REFUSED
    assert 1 <= np.sum(refused) <= 3 * SEEDS


def test_log_likelihoods_sum_to_that_of_the_run_in_order(runs):
    ordered, late = runs
    np.testing.assert_allclose(late.log_likelihood, ordered.log_likelihood, rtol=1e-12)


def test_a_late_update_tells_of_its_own_time_until_an_earlier_one_comes(runs, drives):
    # Where nothing made before it was still on its way, what it saw is what it saw in order.
    ordered, late = runs
    compared = 0
    for i, d in enumerate(drives):
        arrived = {s: {m: k for k, m in enumerate(d["made"][s]) if m >= 0} for s in MODEL.dims}
        for k, made in enumerate(d["made"]["bearing"]):
            if made < 0 or any(
                arrived[s][m] > k or (arrived[s][m] == k and s == "place")
                for s in MODEL.dims
                for m in range(made + (s == "bearing"))
            ):
                continue
            a, b = late.steps.info["bearing"], ordered.steps.info["bearing"]
            for name in ("innovation", "factor", "gain", "nis", "dof"):
                got, want = getattr(a, name)[i, k], getattr(b, name)[i, made]
                np.testing.assert_allclose(got, want, rtol=1e-11, atol=1e-12)
            assert a.code[i, k] == b.code[i, made]
            compared += 1
    assert compared > 20


def test_at_each_step_the_belief_is_that_of_what_has_arrived(runs, drives):
    late, d = runs[1], drives[0]
    steps = [7, 12, 16, 21]
    known = []
    for k in steps:
        here = {s: np.isin(np.arange(T + SHIFT), d["made"][s][: k + 1]) for s in MODEL.dims}
        bearing, place = d["in order"]["bearing"].rad, d["in order"]["place"]
        known.append(
            {
                "bearing": Angle(np.where(here["bearing"], bearing, np.nan)),
                "place": np.where(here["place"][:, None], place, np.nan),
            }
        )
    want = each(FILTER, [(y, d["u"], d["beacon"]) for y in known]).steps.posterior
    for i, k in enumerate(steps):
        got = jax.tree.map(lambda a, k=k: a[0, k], late.steps.posterior)
        close(got, jax.tree.map(lambda a, i=i, k=k: a[i, k], want), 1e-12)


# --------------------------------------------------------------- one at a time, and what is refused

A = np.array([[1.0, 1.0], [0.0, 0.97]])


def counting(x, aux):
    return x[:1]


LINEAR = Model(
    Motion(Partial(times, jnp.array(A)), jnp.array([0.1, 0.1])),
    (
        Sensor(counting, jnp.array([0.5]), 1, "a"),
        Sensor(lambda x, aux: x, jnp.array([0.7, 0.2]), 2, "b"),
    ),
)
BEGIN = Belief.of(jnp.zeros(2), np.diag([4.0, 1.0]))
PLAIN, BACK = kalman(), delayed(kalman(), LINEAR, 3)
RNG = np.random.default_rng(5)
Y = {"a": RNG.normal(size=(8, 1)), "b": RNG.normal(size=(8, 2))}


def in_time(value):
    return value if isinstance(value, DelayedMeasurement) else DelayedMeasurement(value, 0)


def streamed(filter_, *events) -> OnlineFilter:
    """A filter fed with predictions (None) and measurements (sensor, value)."""
    live = OnlineFilter(filter_, LINEAR, BEGIN, "vm")
    for event in events:
        if event is None:
            live.predict()
        else:
            live.update(event[1] if filter_ is PLAIN else in_time(event[1]), event[0])
    return live


def test_several_late_ones_in_one_step():
    late = streamed(
        BACK,
        ("b", Y["b"][0]),  # before the first prediction
        *(None, None, ("b", Y["b"][2]), None),
        ("a", DelayedMeasurement(Y["a"][2], 1)),
        ("a", DelayedMeasurement(Y["a"][1], 2)),
        ("b", DelayedMeasurement(Y["b"][1], 2)),
        ("a", DelayedMeasurement(Y["a"][0], 3)),  # to the very start
        ("b", Y["b"][3]),
        ("a", Y["a"][3]),  # of this step, but after one whose turn is later
    )
    ordered = streamed(
        PLAIN,
        *(("a", Y["a"][0]), ("b", Y["b"][0])),
        *(None, ("a", Y["a"][1]), ("b", Y["b"][1])),
        *(None, ("a", Y["a"][2]), ("b", Y["b"][2])),
        *(None, ("a", Y["a"][3]), ("b", Y["b"][3])),
    )
    assert late.counts == ordered.counts == {"DONE": 8}
    close(late.belief, ordered.belief, 1e-14)


def test_plain_measurements_in_order_give_the_filter_itself():
    events = [None, ("a", Y["a"][0]), ("b", Y["b"][0]), None, ("b", Y["b"][1]), None]
    late, plain = streamed(BACK, *events), streamed(PLAIN, *events)
    close(late.belief, plain.belief, 0.0)


@pytest.mark.parametrize(
    ("sensor", "value", "age", "code"),
    [
        ("a", [1.0], 4, Code.TOO_OLD),
        ("a", [1.0], 1e18, Code.TOO_OLD),
        ("a", [1.0], -1, Code.REFUSED),
        ("a", [1.0], 0.5, Code.REFUSED),
        ("a", [1.0], np.nan, Code.REFUSED),
        ("a", [1.0], np.inf, Code.REFUSED),
        ("b", [1.0, 2.0], 2, Code.REFUSED),  # there was one
        ("a", [np.nan], 2, Code.MISSING),
        ("a", [np.nan], np.nan, Code.MISSING),
        ("a", [np.inf], 7, Code.MISSING),
        ("b", [np.nan, 2.0], 1, Code.PARTLY_MISSING),
        ("a", [1.0], 2.0 - 1e-9, Code.DONE),
        ("a", [1.0], 3, Code.DONE),
    ],
)
def test_what_cannot_be_placed_is_refused_and_changes_nothing(sensor, value, age, code):
    live = streamed(BACK, *[None] * 5, ("b", Y["b"][0]), None, None)
    before = live.belief
    info = live.update(DelayedMeasurement(np.array(value), age), sensor)
    assert int(info.code) == code
    used = code in (Code.DONE, Code.PARTLY_MISSING)
    assert bool(jnp.all(live.belief.mean == before.mean)) is not used
    if not used:
        close(live.belief, before, 0.0)
        assert float(info.log_likelihood) == 0.0
        assert not np.any(info.used)
    # and it leaves the buffer as it was: what comes next is put in its place all the same
    live.update(DelayedMeasurement(Y["a"][1], 1), "a")
    events = [None] * 5 + [("b", Y["b"][0]), None, ("a", Y["a"][1]), None]
    if not used:
        close(live.belief, streamed(PLAIN, *events).belief, 1e-14)


def test_older_than_the_start_is_too_old():
    live = streamed(BACK, None, None)
    assert int(live.update(DelayedMeasurement(Y["a"][0], 3), "a").code) == Code.TOO_OLD
    assert int(live.update(DelayedMeasurement(Y["a"][0], 2), "a").code) == Code.DONE


def test_an_earlier_reading_that_makes_a_later_one_impossible_is_told():
    still = Motion(LINEAR.motion.step, jnp.zeros(2))
    exact = (replace(sensor, noise=0.0 * sensor.noise) for sensor in LINEAR.sensors)
    live = OnlineFilter(BACK, Model(still, tuple(exact)), BEGIN, "vm")
    live.predict()
    assert int(live.update(in_time(np.zeros(2)), "b").code) == Code.DONE
    # From 1 the way to 0 would take a rate, and the rate was found to be 0.
    info = live.update(DelayedMeasurement(np.ones(1), 1), "a")
    assert int(info.code) == Code.CONTRADICTED
    assert float(info.log_likelihood) == -np.inf


def test_after_a_reset_there_is_no_way_back():
    state = streamed(BACK, None, None, ("a", Y["a"][0])).state
    live = OnlineFilter(BACK, LINEAR, BACK.reset(state, BEGIN))
    assert int(live.update(DelayedMeasurement(Y["b"][0], 1), "b").code) == Code.TOO_OLD
    live.predict()
    assert int(live.update(DelayedMeasurement(Y["b"][0], 1), "b").code) == Code.DONE
    close(live.belief, streamed(PLAIN, ("b", Y["b"][0]), None).belief, 1e-14)


def test_numbers_of_the_model_are_those_of_the_run():
    # The buffer was made for other noise; what is filtered again uses that of the run, and forward
    # derivatives go through it.
    y = {"a": DelayedMeasurement(Y["a"], np.array([0.0, 1, 2, 0, 1, 3, 1, 2]))}
    place = np.arange(8) - np.array([0, 1, 2, 0, 1, 3, 1, 2])
    first = np.unique(place, return_index=True)[1]
    ordered = np.full((8, 1), np.nan)
    ordered[place[first]] = Y["a"][first]

    def louder(sigma):
        return Model(Motion(LINEAR.motion.step, sigma * jnp.ones(2)), LINEAR.sensors)

    def surprise(sigma):
        return run(BACK, louder(sigma), BEGIN, y).log_likelihood

    sigma = jnp.array([0.4 - 1e-5, 0.4, 0.4 + 1e-5])
    late, slope = jax.vmap(lambda s: jax.jvp(surprise, (s,), (jnp.ones(()),)))(sigma)
    live, want = OnlineFilter(PLAIN, louder(sigma[1]), BEGIN), 0.0
    for row in ordered:
        live.predict()
        want += live.update(row, "a").log_likelihood
    np.testing.assert_allclose(late[1], want, rtol=1e-12)
    np.testing.assert_allclose(slope[1], (late[2] - late[0]) / 2e-5, rtol=1e-7)


HEARD: list[tuple] = []


@value
class Asked(Rule):
    """Counts predictions by `each`, and tells with what it is asked."""

    each: Numbers

    def init(self, belief, dims):
        return jnp.zeros(())

    def process(self, memory, transition):
        return memory + self.each, transition

    def report(self, start, final, again, time):
        other = None if again is None else float(again(replace(self, each=2.0 * self.each)))
        HEARD.append((float(start), float(final), other, time))


def test_the_filter_that_is_delayed_is_asked_with_a_run_of_its_own():
    model = Model(LINEAR.motion, LINEAR.sensors[:1])
    one = delayed(kalman(rules=[Asked(np.ones(()))]), model, 1)
    time_s = np.arange(8)
    run(one, model, BEGIN, Y["a"], time_s=time_s)
    live = OnlineFilter(one, model, BEGIN)
    live.predict()
    assert [(0.0, 8.0, 16.0, time_s), (0.0, 1.0, None, None)] == HEARD
    assert one.reports
    assert not BACK.reports


def test_other_numbers_share_what_was_compiled():
    traced = []

    def counted(x, u):
        traced.append(x)
        return jnp.array(A) @ x

    for share, sigma in ((0.99, 0.1), (0.9, 0.2)):
        model = Model(Motion(counted, np.full(2, sigma)), LINEAR.sensors)
        live = OnlineFilter(delayed(kalman(rules=[gate(share)]), model, 1), model, BEGIN)
        live.predict()
        if share == 0.99:
            once = len(traced)
    assert len(traced) == once > 0


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="depth of a delayed filter must not be negative, got -1"):
        delayed(PLAIN, LINEAR, -1)
    with pytest.raises(ValueError, match=r"aux names no sensor \['c'\]"):
        delayed(PLAIN, LINEAR, 2, aux={"c": 1.0})
    with pytest.raises(ValueError, match="an input u is of another form"):
        run(BACK, LINEAR, BEGIN, Y, u=jnp.zeros((8, 1)))
    other = Model(Motion(lambda x, u: x, jnp.array([0.1, 0.1])), LINEAR.sensors)
    with pytest.raises(ValueError, match="the motion is of another form"):
        run(BACK, other, BEGIN, Y)
    extra = Sensor(counting, jnp.array([0.5]), 1, "c")
    more = Model(LINEAR.motion, (*LINEAR.sensors, extra))
    with pytest.raises(ValueError, match="sensor 'c' is new"):
        run(BACK, more, BEGIN, {"c": Y["a"]})
