"""Fixed-interval smoothing (Rauch, Tung & Striebel 1965) in square-root form."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from robins import linalg, manifold
from robins.filters.belief import Belief, Code
from robins.filters.kalman import Prediction
from robins.filters.run import Solution


def rts_smoother(solution: Solution) -> Belief:
    """Beliefs given all measurements, from a run that kept its steps.

    Backwards from the last step, with the gain G = P F' (P-)^-1:

        m_s = m + G (m_s' - m-),   P_s = P - G P- G' + G P_s' G'

    The first two terms of P_s are what an update of P by the predicted state leaves, and come from
    the same triangularisation, so nothing is subtracted (Park & Kailath 1995).

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
    ahead = jnp.where(used, manifold.local(prediction.belief.mean, later.mean), 0.0)
    step = cross @ linalg.solve_lower(S, ahead[:, None])[:, 0]
    G = jnp.where(used[None, :], linalg.solve_lower_transposed(S, cross.T).T, 0.0)
    smoothed = Belief(manifold.retract(now.mean, step), linalg.tria(rest, G @ later.factor))
    # A prediction that was not taken left the state where it was: the two are one.
    taken = prediction.code == int(Code.DONE)
    smoothed = jax.tree_util.tree_map(lambda a, b: jnp.where(taken, a, b), smoothed, later)
    return smoothed, smoothed
