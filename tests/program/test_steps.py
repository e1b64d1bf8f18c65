"""Steps from state to state: zeros that last are structural, all others are not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from machines import apart, quickly, stepping
from rule_table import START, Y, line

from robins.filters import kalman, unscented
from robins.program import Native, ProgramError, trace, trace_step


def rotate(state, y):
    """Zeros in a lower triangle last, those of the vector only until something is measured."""
    L, x, count = state
    return (jnp.tril(L @ L), x + y, count + 1), jnp.sum(L)


STATE = (np.tril(np.arange(1.0, 10.0).reshape(3, 3)), np.zeros(3), np.zeros((), int))


def test_only_zeros_that_last_are_structural():
    program = trace_step(rotate, STATE, np.ones(3))
    assert program.zeros[0].tolist() == (np.triu(np.ones((3, 3)), 1) > 0).tolist()
    assert not program.zeros[1].any()
    assert len(program.live) < len(trace(rotate, STATE, np.ones(3)).live)


def test_zeros_that_depend_on_zeros_that_do_not_last_do_not_last_either():
    def chain(x, y):
        return (jnp.concatenate([y[None], x[:-1]]),)

    program = trace_step(lambda x, y: chain(x, y), np.zeros(5), 1.0)
    assert not program.zeros[0].any()
    one = Native(program, quickly)
    x = np.zeros(5)
    for k in range(5):
        (x,) = one(x, float(k + 1))
    assert x.tolist() == [5.0, 4.0, 3.0, 2.0, 1.0]


def test_a_state_that_has_not_these_zeros_is_refused():
    one = Native(trace_step(rotate, STATE, np.ones(3)), quickly)
    other = (STATE[0] + np.eye(3, k=1), *STATE[1:])
    with pytest.raises(ProgramError, match=r"arguments\[0\]\[0\]: a number is not zero"):
        one(other, np.ones(3))
    one((np.tril(np.ones((3, 3))), np.ones(3), np.ones((), int)), np.ones(3))


def test_a_step_must_give_a_state():
    with pytest.raises(ProgramError, match="structure"):
        trace_step(lambda state, y: y, STATE, np.ones(3))


def test_a_filter_needs_less_and_says_the_same():
    model = line()
    one = kalman(unscented())
    state = jax.tree.map(jnp.asarray, one.init(START, model.dims))
    state = jax.tree.map(lambda x: jnp.asarray(x, x.dtype), state)
    step, row = stepping(one, model), {"y": Y[0]}
    whole, less = trace(step, state, None, row, {}), trace_step(step, state, None, row, {})
    # Nothing stands above the diagonal of a factor.
    factor = next(k for k, leaf in enumerate(less.inputs) if leaf.path.endswith(".factor"))
    assert less.zeros[factor].tolist() == (np.triu(np.ones((4, 4)), 1) > 0).tolist()
    assert len(less.live) < len(whole.live)
    a, b = Native(whole, quickly), Native(less, quickly)
    s = t = state
    for y in Y:
        s, _ = a(s, None, {"y": y}, {})
        t, _ = b(t, None, {"y": y}, {})
        assert apart(s.belief.factor, t.belief.factor) < 1e-13
        assert apart(s.belief.mean, t.belief.mean) < 1e-13
