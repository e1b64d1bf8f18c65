"""Fixed-interval smoothing (Rauch, Tung & Striebel 1965) in square-root form."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from robins import linalg, manifold
from robins.errors import require
from robins.filters.belief import Belief, Code
from robins.filters.checks import one_of
from robins.filters.kalman import Prediction
from robins.filters.model import Data
from robins.filters.run import RunMachine, Solution

# Rounding of a row of a factor, as a share of the row's length.
_ROUNDING = 1e-14


def rts_smoother(solution: Solution, machine: RunMachine = "jax") -> Belief:
    """Smoothed beliefs of a run that kept its steps.

    Backwards from the last step, with the gain G = P F' (P-)^-1:

        m_s = m + G (m_s' - m-),   P_s = P - G P- G' + G P_s' G'

    The first two terms of P_s are an update of P by the predicted state and come from its
    triangularisation, so nothing is subtracted (Park & Kailath 1995).

    A motion that contracts a direction without noise leaves only rounding in P- there, which G
    would amplify. Later measurements with less information on that direction than the rounding are
    ignored there. Covariance added by a rule (fading, inflation) is treated as process noise.

    Args:
        solution: the run.
        machine: "jax", or "vm" for the interpreter where possible, which compiles nothing and does
            not work in code that JAX transforms.

    Returns:
        Beliefs with leading axis T; the last one is the filter's.

    Raises:
        ValueError: the run did not keep predictions and posteriors.
    """
    one_of("machine", machine, RunMachine)
    steps = solution.steps
    kept = hasattr(steps, "prediction")
    require(kept, "smoothing needs a run that kept its steps: leave `keep` at its default")
    single = steps.prediction.transition is not None
    require(single, "smoothing needs one transition a step, which this kind of filter has not")
    if machine == "vm":
        return _interpreted(steps.posterior, steps.prediction)
    return _backwards(steps.posterior, steps.prediction)


@jax.jit
def _backwards(posterior: Belief, predictions: Prediction) -> Belief:
    last, rows = _end_and_rows(posterior, predictions)
    _, earlier = jax.lax.scan(_back, last, rows, reverse=True)
    return jax.tree_util.tree_map(lambda a, b: jnp.concatenate([a, b[None]]), earlier, last)


def _interpreted(posterior: Belief, predictions: Prediction) -> Belief:
    # Imported here: a filter needs no programs.
    from robins.program.scanned import named_scan

    arrays = jax.tree_util.tree_map(np.asarray, (posterior, predictions))
    last, rows = _end_and_rows(*arrays)
    backwards = jax.tree_util.tree_map(lambda x: x[::-1], rows)
    _, later = named_scan(_back, last, backwards)
    return jax.tree_util.tree_map(lambda a, b: np.concatenate([a[::-1], b[None]]), later, last)


def _end_and_rows(posterior: Belief, predictions: Prediction) -> tuple[Belief, Data]:
    """Last belief, and for each step before it its belief with the prediction that follows."""
    last = jax.tree_util.tree_map(lambda x: x[-1], posterior)
    rows = (
        jax.tree_util.tree_map(lambda x: x[:-1], posterior),
        jax.tree_util.tree_map(lambda x: x[1:], predictions),
    )
    return last, rows


def _back(later: Belief, row: tuple[Belief, Prediction]) -> tuple[Belief, Belief]:
    """Smooth the belief of a row by the smoothed belief of the following step."""
    now, prediction = row
    now = now if prediction.origin is None else prediction.origin
    t = prediction.transition
    assert t is not None
    used = linalg.independent_rows(jnp.concatenate([t.spread, t.excess, t.noise], axis=1))
    spread, excess, noise = (
        jnp.where(used[:, None], b, 0.0) for b in (t.spread, t.excess, t.noise)
    )
    unit = jnp.diag(jnp.where(used, 0.0, 1.0))
    deficit = None if t.deficit is None else jnp.where(used, t.deficit, 0.0)
    S, cross, rest = linalg.block_factor(spread, (excess, noise, unit), now.factor, deficit)
    # The following state in units of P-: mean and factor of e in x' = m- + S e, e ~ N(0, 1).
    ahead = linalg.solve_lower(S, manifold.local(prediction.belief.mean, later.mean)[:, None])[:, 0]
    M = linalg.solve_lower(S, later.factor)
    info = jnp.maximum(jnp.max(jnp.abs(M @ M.T - jnp.eye(len(M))), axis=1), jnp.abs(ahead))
    length = jnp.sqrt(jnp.sum(S**2, axis=1))
    known = used & (info > _ROUNDING * length / jnp.abs(jnp.diagonal(S)))
    step = cross @ jnp.where(known, ahead, 0.0)
    M = jnp.where(known[:, None], M, 0.0)
    blank = jnp.diag(jnp.where(known, 0.0, 1.0))
    smoothed = Belief(manifold.retract(now.mean, step), linalg.tria(rest, cross @ M, cross @ blank))
    # A prediction that was not taken left the state unchanged.
    taken = prediction.code == int(Code.DONE)
    smoothed = jax.tree_util.tree_map(lambda a, b: jnp.where(taken, a, b), smoothed, later)
    return smoothed, smoothed
