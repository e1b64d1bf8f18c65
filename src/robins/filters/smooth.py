"""Fixed-interval smoothing (Rauch, Tung & Striebel 1965) in square-root form."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from robins import linalg, manifold
from robins.filters.belief import Belief
from robins.filters.run import Solution


def rts_smoother(solution: Solution) -> Belief:
    """Beliefs given all measurements, from a run that kept its steps.

    Backwards from the last step, with the gain G = P F' (P-)^-1:

        m_s = m + G (m_s' - m-),   P_s = (S - G F S)(..)' + G (Omega + Q) G' + G P_s' G'

    written as one triangularisation of a sum of squares, so nothing is subtracted. It undoes
    process and measurement noise as the run used them; covariance a rule added in an update
    (fading, inflation) is not undone: a run with such rules is smoothed as if it were process
    noise.

    Returns:
        Beliefs with leading axis T; the last one is the filter's.

    Raises:
        ValueError: the run did not keep predictions and posteriors.
    """
    steps = solution.steps
    if not hasattr(steps, "prediction"):
        raise ValueError("smoothing needs a run that kept its steps: leave `keep` at its default")
    posterior: Belief = steps.posterior
    last = jax.tree_util.tree_map(lambda x: x[-1], posterior)

    def back(later: Belief, row):
        now, prediction = row
        t, predicted = prediction.transition, prediction.belief
        solid, _ = linalg.guard(predicted.factor)
        cross = t.spread @ now.factor.T  # (P F')'
        G = linalg.solve_spd(solid, cross).T
        mean = manifold.retract(now.mean, G @ manifold.local(predicted.mean, later.mean))
        parts = [G @ later.factor, now.factor - G @ t.spread, G @ t.excess, G @ t.noise]
        factor = linalg.tria(*parts)
        if t.deficit is not None:
            factor = linalg.downdate(factor, (G @ t.deficit[:, None])[:, 0])
        smoothed = Belief(mean, factor)
        return smoothed, smoothed

    rows = (
        jax.tree_util.tree_map(lambda x: x[:-1], posterior),
        jax.tree_util.tree_map(lambda x: x[1:], steps.prediction),
    )
    _, earlier = jax.lax.scan(back, last, rows, reverse=True)
    return jax.tree_util.tree_map(lambda a, b: jnp.concatenate([a, b[None]]), earlier, last)
