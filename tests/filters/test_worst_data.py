"""Rule R1 of the fault list, for every rule: after each step of the worst there is, the state is
finite and its covariance symmetric and positive semidefinite.

The worst: nothing known at first (P0 = 1e12) or all of it (0); measurements without noise, with
next to none, and with much; sensors that repeat themselves, or see nothing; no process noise nine
steps of ten; one component in ten missing; in a sixth run measurements of any size, whatever the
state.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from in_lanes import each
from jax.tree_util import Partial
from test_compose import RULES
from test_robustness import SENSOR, N, extremes, given, turn

from robins.filters import Belief, Code, Model, Motion, kalman, run
from robins.filters.rules import h_infinity

# An H-infinity filter with P0 = 1e12 does not exist for any gamma one would ask for.
HARD = RULES | {"h_infinity": h_infinity(10.0, jnp.eye(N), policy="raise_gamma")}
del HARD["constant_gain"]  # is designed for one sensor; here each step has another
RUNS = [(1, 1e12), (2, 0.0), (3, 1e12), (4, 1.0), (6, 1e12), (5, 1e12)]  # seed, P0
# For a few steps some in one filter, but h_infinity, whose bound the others may break; each alone
# for 120 000 in all.
OTHERS = tuple(name for name in HARD if name != "h_infinity")
SOME = [(OTHERS[i::4], 400) for i in range(4)] + [(("h_infinity",), 400)]
EACH = [((name,), 20_000) for name in HARD]


def worst(steps):
    """The runs, side by side."""
    parts = [extremes(seed, P0, steps) for seed, P0 in RUNS]
    F, G, H, W, _, y = (np.stack(part) for part in zip(*parts, strict=True))
    rng = np.random.default_rng(4)
    y[-1] += 10.0 ** rng.uniform(-3, 9, y[-1].shape) * rng.normal(size=y[-1].shape)
    roots = np.sqrt([P0 for _, P0 in RUNS])
    return F, G, H, W, y, roots[:, None, None] * np.eye(N)


def judged(step):
    belief = step.posterior
    whole = jnp.all(jnp.isfinite(belief.mean)) & jnp.all(jnp.isfinite(belief.factor))
    return whole, step.prediction.code, step.info["y"].code


@pytest.mark.parametrize(
    ("names", "steps"), SOME + EACH, ids=[f"{steps}-{names[0]}" for names, steps in SOME + EACH]
)
def test_many_steps_of_the_worst(names, steps):
    one = kalman(rules=[HARD[name] for name in names])

    @each
    def go(rows):
        F, G, H, W, y, factor = rows
        model = Model(Motion(Partial(turn, F), given), (SENSOR,))
        start = Belief(jnp.zeros(N), factor)
        solution = run(one, model, start, y, G, {"y": (H, W)}, keep=judged)
        return solution.steps, solution.final

    (whole, moved, code), final = go(worst(steps))
    # Symmetric and positive semidefinite it is by its form, S S', while S is finite.
    assert np.all(whole)
    taken = {Code.DONE, Code.MISSING, Code.PARTLY_MISSING, Code.REFUSED}
    taken |= {Code.CONTRADICTED}  # exact sensors that read anything, twice in a row
    assert np.mean(np.isin(code, list(taken))) == 1.0, np.unique(code, return_counts=True)
    assert np.mean(moved == Code.DONE) == 1.0, np.unique(moved, return_counts=True)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(final))
