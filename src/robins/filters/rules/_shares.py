"""What part of an innovation's covariance the prior has in it, and what part the noise."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from robins import linalg
from robins.filters.observation import Normalised, Observation, left_out, whiten


class Shares(NamedTuple):
    """Parts of S = H P H' + Omega + R in units of S = L L', where they add up to the identity.

    With R and P rescaled, L^-1 S L^-T is a weighted sum of these parts: no subtraction, however
    large the weights, and no factor larger than the measurement.
    """

    seen: Normalised  # the innovation, with L and w = L^-1 r
    noise: Array  # (m, q) factor N of R, zero where not used
    white_noise: Array  # (m, q) L^-1 N
    prior: Array  # (m, m) L^-1 (H P H' + Omega) L^-T
    idle: Array  # (m, m) ones on the diagonal where not used


def shares(o: Observation) -> Shares:
    """The parts of an innovation's covariance."""
    # What `normalised` does, and its blocks again: looking for what is used twice costs time.
    spread, excess, padded, deficit, used = left_out(o)
    L = linalg.tria(spread, excess, padded)
    if deficit is not None:
        L = linalg.downdate(L, deficit)
    seen, noise = whiten(L, used, o.residual), padded[:, : o.noise.shape[1]]
    columns = [spread, excess, noise] + ([] if deficit is None else [deficit[:, None]])
    white = linalg.solve_lower(L, jnp.concatenate(columns, axis=1))
    known = spread.shape[1] + excess.shape[1]
    W, rest = white[:, :known], white[:, known : known + noise.shape[1]]
    prior = W @ W.T
    if deficit is not None:
        prior = prior - white[:, -1:] @ white[:, -1:].T
    return Shares(seen, noise, rest, prior, jnp.diag(jnp.where(used, 0.0, 1.0)))
