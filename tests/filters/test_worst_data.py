"""Rule R1 of the fault list, for every rule: after each of 100 000 steps of the worst there is, the
state is finite and its covariance symmetric and positive semidefinite.

The worst: nothing known at first (P0 = 1e12) or all of it (0); measurements without noise, with
next to none, and with much; sensors that repeat themselves, or see nothing; no process noise nine
steps of ten; one component in ten missing.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from test_compose import RULES
from test_robustness import SENSOR, N, extremes, given, turn

from robins.filters import Belief, Code, Model, Motion, kalman, run
from robins.filters.rules import h_infinity

# An H-infinity filter with P0 = 1e12 does not exist for any gamma one would ask for.
HARD = RULES | {"h_infinity": h_infinity(10.0, jnp.eye(N), policy="raise_gamma")}
del HARD["constant_gain"]  # is designed for one sensor; here each step has another


@pytest.fixture(scope="module")
def worst():
    """Five runs of 20 000 steps, side by side."""
    parts = [
        extremes(seed, P0) for seed, P0 in ((1, 1e12), (2, 0.0), (3, 1e12), (4, 1.0), (6, 1e12))
    ]
    F, G, H, W, _, y = (np.stack(part) for part in zip(*parts, strict=True))
    roots = np.sqrt([1e12, 0.0, 1e12, 1.0, 1e12])
    return F, G, H, W, y, roots[:, None, None] * np.eye(N)


def judged(step):
    belief = step.posterior
    whole = jnp.all(jnp.isfinite(belief.mean)) & jnp.all(jnp.isfinite(belief.factor))
    return whole, step.prediction.code, step.info["y"].code


@pytest.mark.parametrize("name", HARD)
def test_a_hundred_thousand_steps_of_the_worst(name, worst):
    one = kalman(rules=[HARD[name]])

    @jax.jit
    @jax.vmap
    def go(F, G, H, W, y, factor):
        model = Model(Motion(Partial(turn, F), given), (SENSOR,))
        start = Belief(jnp.zeros(N), factor)
        solution = run(one, model, start, y, G, {"y": (H, W)}, keep=judged)
        return solution.steps, solution.final

    (whole, moved, code), final = go(*worst)
    # Symmetric and positive semidefinite it is by its form, S S', while S is finite.
    assert np.all(whole)
    taken = {Code.DONE, Code.MISSING, Code.PARTLY_MISSING, Code.REFUSED}
    taken |= {Code.CONTRADICTED}  # exact sensors that read anything, twice in a row
    assert np.mean(np.isin(code, list(taken))) == 1.0, np.unique(code, return_counts=True)
    assert np.mean(moved == Code.DONE) == 1.0, np.unique(moved, return_counts=True)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(final))
