"""Fixed-interval smoothing (Rauch, Tung & Striebel 1965) in square-root form."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from robins import linalg, manifold
from robins.filters.belief import Belief, Code
from robins.filters.kalman import Prediction
from robins.filters.run import Solution

# Rounding of a row of a factor, as a share of the row's length.
_ROUNDING = 1e-14


def rts_smoother(solution: Solution) -> Belief:
    """Beliefs given all measurements, from a run that kept its steps.

    Backwards from the last step, with the gain G = P F' (P-)^-1:

        m_s = m + G (m_s' - m-),   P_s = P - G P- G' + G P_s' G'

    The first two terms of P_s are what an update of P by the predicted state leaves, and come from
    the same triangularisation, so nothing is subtracted (Park & Kailath 1995).

    A motion that contracts without noise squeezes a direction of P- until only rounding is left of
    it, which G would blow up again. Where the measurements to come tell less of a direction than
    the rounding of P-, they are taken to tell nothing of it.

    It undoes process and measurement noise as the run used them; covariance a rule added (fading,
    inflation) is not undone: a run with such rules is smoothed as if it were process noise.

    Returns:
        Beliefs with leading axis T; the last one is the filter's.

    Raises:
        ValueError: the run did not keep predictions and posteriors.
    """
    steps = solution.steps
    if not hasattr(steps, "prediction"):
        raise ValueError("smoothing needs a run that kept its steps: leave `keep` at its default")
    if steps.prediction.transition is None:
        raise ValueError("smoothing needs one transition a step, which this kind of filter has not")
    return _backwards(steps.posterior, steps.prediction)


@jax.jit
def _backwards(posterior: Belief, predictions: Prediction) -> Belief:
    last = jax.tree_util.tree_map(lambda x: x[-1], posterior)
    rows = (
        jax.tree_util.tree_map(lambda x: x[:-1], posterior),
        jax.tree_util.tree_map(lambda x: x[1:], predictions),
    )
    _, earlier = jax.lax.scan(_back, last, rows, reverse=True)
    return jax.tree_util.tree_map(lambda a, b: jnp.concatenate([a, b[None]]), earlier, last)


def _back(later: Belief, row: tuple[Belief, Prediction]) -> tuple[Belief, Belief]:
    """One step back: an update of `now` by the state that followed."""
    now, prediction = row
    now = now if prediction.origin is None else prediction.origin
    t = prediction.transition
    assert t is not None  # looked at before
    used = linalg.independent_rows(jnp.concatenate([t.spread, t.excess, t.noise], axis=1))
    spread, excess, noise = (
        jnp.where(used[:, None], b, 0.0) for b in (t.spread, t.excess, t.noise)
    )
    unit = jnp.diag(jnp.where(used, 0.0, 1.0))
    deficit = None if t.deficit is None else jnp.where(used, t.deficit, 0.0)
    S, cross, rest = linalg.block_factor(spread, (excess, noise, unit), now.factor, deficit)
    # The state that followed in units of P-: mean and factor of e in x' = m- + S e, e ~ N(0, 1).
    ahead = linalg.solve_lower(S, manifold.local(prediction.belief.mean, later.mean)[:, None])[:, 0]
    M = linalg.solve_lower(S, later.factor)
    info = jnp.maximum(jnp.max(jnp.abs(M @ M.T - jnp.eye(len(M))), axis=1), jnp.abs(ahead))
    length = jnp.sqrt(jnp.sum(S**2, axis=1))
    known = used & (info > _ROUNDING * length / jnp.abs(jnp.diagonal(S)))
    step = cross @ jnp.where(known, ahead, 0.0)
    M = jnp.where(known[:, None], M, 0.0)
    blank = jnp.diag(jnp.where(known, 0.0, 1.0))
    smoothed = Belief(manifold.retract(now.mean, step), linalg.tria(rest, cross @ M, cross @ blank))
    # A prediction that was not taken left the state where it was: the two are one.
    taken = prediction.code == int(Code.DONE)
    smoothed = jax.tree_util.tree_map(lambda a, b: jnp.where(taken, a, b), smoothed, later)
    return smoothed, smoothed
