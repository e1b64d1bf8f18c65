"""Laws of every rule, over the table of rules: see rule_table.py."""

import inspect
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from in_lanes import each
from interpreted import run
from rule_table import (
    ABSURD,
    ACTING,
    AROUND,
    BASE,
    CIRCLE,
    FACING,
    FAILING,
    GONE,
    HOLDING,
    LEARNING,
    MISTYPED,
    MISUSED,
    NEARLY_OFF,
    NO_SLOPE,
    OFF,
    QUIET,
    QUIET_WHEN_OFF,
    RAD,
    RETURNING,
    RULES,
    SEAM,
    START,
    M,
    T,
    Y,
    line,
)

from robins.filters import (
    Belief,
    Code,
    Model,
    Motion,
    OnlineFilter,
    Sensor,
    kalman,
    taylor,
    unscented,
)
from robins.filters.rules import gate
from robins.manifold import Angle

MODEL = line()
FILTERS = ACTING | HOLDING
# What acts beside others too needs no programs of its own.
FILTERS["learning"] = [*FILTERS.pop("discriminating"), *ACTING["learning"]]
EACH = pytest.mark.parametrize("name", FILTERS)
WAYS = {"derivatives": taylor(), "sigma points": unscented()}
# The noise as told, a little less and more of it, and twice of it for other data.
SMALL = 1e-6
SCALES = jnp.array([1.0, 1.0 - SMALL, 1.0 + SMALL, 2.0])
# The gate of "given" is closed in the end; the slope of its whole run is always looked at.
NO_SLOPE_OF_A_STEP = NO_SLOPE | {"given"}
DATA = jnp.stack([Y, Y, Y, np.where(np.arange(T)[:, None] == 3, np.nan, Y)])


@cache
def batch(name):
    """Runs of a filter of the table, one for each of `SCALES` and `DATA`."""
    one = kalman(rules=FILTERS[name])
    found = [run(one, line(scale), START, y) for scale, y in zip(SCALES, DATA, strict=True)]
    return jax.tree.map(lambda *rows: np.stack(rows), *found)


def ran(name):
    """The first of them."""
    return jax.tree.map(lambda x: x[0], batch(name))


@cache
def stepped(name):
    """One compiled step of such a filter: a number, what it is of, and its slope in the noise."""
    one = kalman(rules=FILTERS[name])

    def step(scale, state, row):
        model = line(scale)
        moved, _ = one.predict(state, model.motion, None)
        after, info = one.update(moved, model.sensors[0], row, None)
        total = info.log_likelihood + jnp.sum(after.belief.mean**2)
        return total + jnp.sum(after.belief.factor**2), (moved, after, info)

    if name in NO_SLOPE_OF_A_STEP:
        return jax.jit(lambda *given: (step(*given), None))
    return jax.jit(jax.value_and_grad(step, has_aux=True))


def equal(a, b, **close):
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        if close:
            np.testing.assert_allclose(one, other, **close)
        else:
            np.testing.assert_array_equal(one, other)


def test_each_rule_is_in_a_filter_where_it_acts():
    there = {rule.name for rules in FILTERS.values() for rule in rules}
    assert there >= {name.split()[0] for name in RULES} - {"projection"}
    quiet = dict(QUIET)
    for name in FILTERS:
        for note, value in ran(name).steps.info["y"].notes.items():
            if note in quiet and np.any(np.asarray(value) != quiet[note]):
                del quiet[note]
    assert not quiet, "nothing happens to these"


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("form", ["sqrt", "joseph"])
def test_rules_turned_off_are_the_kalman_filter_bit_for_bit(form, way):
    # All in one filter, which is one program; if they are not, one after the other, to name it.
    plain = run(kalman(WAYS[way], form=form), MODEL, START, Y)

    def is_plain(rules):
        got = run(kalman(WAYS[way], rules, form), MODEL, START, Y)
        notes = got.steps.info["y"].notes
        said = {note: quiet for note, quiet in QUIET_WHEN_OFF.items() if note in notes}
        return (
            np.array_equal(got.mean, plain.mean)
            and np.array_equal(got.steps.posterior.factor, plain.steps.posterior.factor)
            and float(got.log_likelihood) == float(plain.log_likelihood)
            and all(np.all(np.asarray(notes[note]) == quiet) for note, quiet in said.items())
        )

    if not is_plain(list(OFF.values())):
        pytest.fail(f"not off: {[name for name, rule in OFF.items() if not is_plain([rule])]}")


def test_rules_whose_limit_is_approached_come_near_the_kalman_filter():
    plain = run(kalman(), MODEL, START, Y)
    got = run(kalman(rules=list(NEARLY_OFF.values())), MODEL, START, Y)
    np.testing.assert_allclose(got.mean, plain.mean, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(got.covariance, plain.covariance, rtol=1e-11, atol=1e-12)


@EACH
def test_a_stream_is_a_run_of_a_batch_and_what_is_not_measured_moves_nothing(name):
    whole, step = ran(name), stepped(name)
    assert np.any(batch(name).mean[3] != whole.mean)
    state = without = OnlineFilter(kalman(rules=FILTERS[name]), MODEL, START).state
    for k, row in enumerate(Y):
        (_, (moved, state, info)), _ = step(SCALES[0], state, row)
        (_, (skipped, updated, _)), _ = step(SCALES[0], without, row)
        without = skipped if k in GONE else updated
        equal(state.belief.mean, whole.mean[k], rtol=1e-9, atol=1e-11)
        if k not in GONE:
            continue
        assert int(info.code) == Code.MISSING
        assert not np.any(info.gain)
        for note in QUIET.keys() & info.notes.keys():
            assert float(info.notes[note]) == QUIET[note], note
        if name not in HOLDING:
            equal(state.belief, moved.belief)
    equal(state, whole.final, rtol=1e-9, atol=1e-10)
    if name not in HOLDING:
        equal(without, state)


@EACH
def test_a_batch_is_its_runs_one_by_one(name):
    one = kalman(rules=FILTERS[name])
    got = jax.jit(jax.vmap(lambda scale, y: run(one, line(scale), START, y)))(SCALES, DATA)
    equal((got.steps, got.final), (batch(name).steps, batch(name).final), rtol=1e-8, atol=1e-9)


@EACH
def test_sigma_points_in_josephs_form_on_a_circle_say_what_derivatives_on_a_line_do(name):
    want = ran(name)
    got = run(kalman(unscented(), FILTERS[name], "joseph"), CIRCLE, FACING, AROUND)
    assert np.nanmax(AROUND[0].rad) > 3.1 > -3.1 > np.nanmin(AROUND[0].rad)
    np.testing.assert_allclose(got.mean["rest"], want.mean[:, 1:], rtol=1e-6, atol=1e-7)
    turned = Angle(want.mean[:, 0] + SEAM).local(got.mean["heading"])
    np.testing.assert_allclose(turned, np.zeros((T, 1)), atol=1e-7)
    np.testing.assert_allclose(got.covariance, want.covariance, rtol=1e-6, atol=1e-7)
    one, other = got.steps.info["y"], want.steps.info["y"]
    np.testing.assert_array_equal(one.code, other.code)
    for note, value in other.notes.items():
        np.testing.assert_allclose(one.notes[note], value, rtol=1e-5, atol=1e-6, err_msg=note)


SMOOTH = pytest.mark.parametrize("name", [name for name in FILTERS if name not in NO_SLOPE])


@pytest.mark.parametrize("name", [n for n in FILTERS if n not in NO_SLOPE_OF_A_STEP])
def test_slopes_of_a_step_are_right(name):
    step, learnt = stepped(name), jax.tree.map(np.asarray, ran(name).final)
    row = Y[-1] + np.array([RAD, 1.0, 1.0])  # too little for a gate to refuse
    (low, _), (_, slope), (high, _) = (
        (total, slope) for (total, _), slope in (step(SCALES[i], learnt, row) for i in (1, 0, 2))
    )
    assert slope != 0.0
    assert float(slope) == pytest.approx(float(high - low) / (2 * SMALL), rel=1e-5)


@SMOOTH
def test_slopes_are_right(name):
    one = kalman(rules=FILTERS[name])

    @jax.jit
    @jax.value_and_grad
    def total(scale):
        return run(one, line(scale), START, Y).log_likelihood

    value, slope = total(1.0)
    values = batch(name).log_likelihood
    assert float(value) == pytest.approx(float(values[0]), rel=1e-10)
    assert float(slope) == pytest.approx(float(values[2] - values[1]) / (2 * SMALL), rel=1e-5)


def test_what_is_refused_or_missing_teaches_nothing_component_by_component():
    one = kalman(rules=[gate(0.99), *LEARNING])
    update = jax.jit(one.update)
    state, _ = update(OnlineFilter(one, MODEL, START).state, MODEL.sensors[0], Y[1])
    for y, code in ((np.nan, Code.MISSING), (1e4, Code.REFUSED)):
        after, info = update(state, MODEL.sensors[0], np.full(M, y))
        assert int(info.code) == code
        equal(after.memory[1:], state.memory[1:])
        equal(after.belief, state.belief)
    after, info = update(state, MODEL.sensors[0], np.array([np.nan, 1.0, np.nan]))
    assert int(info.code) == Code.PARTLY_MISSING
    for rule, new, old in zip(LEARNING, after.memory[1:], state.memory[1:], strict=True):
        moved = [
            np.any(np.asarray(a != b).reshape(M, -1), axis=1)
            for a, b in zip(jax.tree.leaves(new), jax.tree.leaves(old), strict=True)
            if jnp.shape(a)[:1] == (M,)
        ]
        assert np.any(moved, axis=0).tolist() == [False, True, False], rule.name


# --------------------------------------------------------------------- failures, and the way back


def test_what_a_rule_cannot_do_and_what_has_no_weight_reach_the_tally():
    told = {"refused", "infeasible", "weight"}
    notes = {note for name in FILTERS for note in ran(name).steps.info["y"].notes}
    there = {rule.name for rule, *_ in FAILING.values()}
    assert there >= {note.split(".")[0] for note in notes if note.split(".")[-1] in told}
    model = Model(
        Motion(lambda x, u: x, jnp.zeros(2)), (Sensor(lambda x, aux: x[1:], jnp.ones(1), 1, "y"),)
    )

    def one(rule, sigma, y):
        start = Belief(jnp.zeros(2), jnp.diag(sigma))
        return run(kalman(rules=[rule]), model, start, y[None, None])

    @each
    def found(given):
        return {name: one(FAILING[name][0], *row) for name, row in given.items()}

    given = {
        name: (np.array([sigma], float), np.array([y], float))
        for name, (_, sigma, y, _) in FAILING.items()
    }
    for name, got in jax.tree.map(lambda x: x[0], found(given)).items():
        *_, y, code = FAILING[name]
        assert got.tally.counts("y") == {code: 1}, name
        lost = code == Code.CONTRADICTED
        assert bool(np.isinf(got.tally.nis["y"])) == bool(np.isinf(got.log_likelihood)) == lost
        if y == ABSURD:  # as if it had not been
            np.testing.assert_array_equal(got.mean[0], np.zeros(2), err_msg=name)
            np.testing.assert_array_equal(got.covariance[0], np.eye(2), err_msg=name)


AT, BACK, LONG = 40, 60, 130  # the step of a jump, steps until all must be back, and all


def test_a_jump_of_the_state_is_followed_and_a_burst_is_not():
    """A jump of 1e3 and of 1e6 sigma; and readings off by 1e6 for as long as a rule is patient."""
    F, G = np.array([[1.0, 1.0], [0.0, 1.0]]), 0.03 * np.array([0.5, 1.0])
    rng, x, truth = np.random.default_rng(0), np.zeros(2), []
    for _ in range(LONG):
        x = F @ x + G * rng.normal()
        truth.append(x[0])
    truth, step = np.array(truth), np.arange(LONG)
    y = truth + rng.normal(size=LONG)
    jumped = np.array([1e3, 1e6])[:, None] * (step >= AT)
    model = Model(
        Motion(lambda x, u: jnp.asarray(F) @ x, jnp.asarray(G)[:, None]),
        (Sensor(lambda x, aux: x[:1], jnp.ones(1), 1, "y"),),
    )
    start = Belief.of(np.zeros(2), np.eye(2))

    def keep(step):
        return step.posterior.mean[0], step.posterior.sigma[0], step.info["y"].expected[0]

    for name, (filter_, patience) in RETURNING.items():
        burst = 1e6 * ((step >= AT) & (step < AT + patience))
        data = (y + np.vstack([jumped, burst]))[..., None]
        through = each(lambda one, f=filter_: run(f, model, start, one, keep=keep).steps)
        mean, sigma, expected = through(data)
        # what the innovation is compared with is not what a rule makes of it
        first = np.asarray(expected[:2, AT])
        np.testing.assert_allclose(first, expected[:2, AT - 1], rtol=0.05, err_msg=name)
        error = np.abs(np.asarray(mean) - truth - np.vstack([jumped, 0.0 * step]))
        off = error > 5.0 * np.asarray(sigma)
        assert not np.any(off[:, :AT]), name
        assert np.all(off[:2, AT]), f"{name} follows the first reading of a jump"
        assert not np.any(off[:2, AT + BACK :]), f"{name} is not back"
        assert np.max(error[:2, AT + BACK :]) < 5.0, f"{name} is not back"
        assert not np.any(off[2]), f"{name} is led away by a burst"


REFUSED = [(*row, ValueError) for row in MISUSED] + [(*row, TypeError) for row in MISTYPED]


@pytest.mark.parametrize(
    ("rule", "wrong", "words", "error"),
    REFUSED,
    ids=[f"{rule.__name__}-{'-'.join(wrong)}" for rule, wrong, *_ in REFUSED],
)
def test_arguments_that_make_no_sense_are_refused(rule, wrong, words, error):
    # A wrong literal is caught by the type check in tests, by the rule itself elsewhere.
    with pytest.raises(error, match=words):
        inspect.unwrap(rule)(**(BASE.get(rule, {}) | wrong)).init(START, MODEL.dims)
