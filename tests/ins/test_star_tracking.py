"""Stars matched with an attitude that is nearly known, against SciPy's search for neighbours."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from robins.earth.stars import index_stars, synthetic
from robins.ins.star_identification import track_stars

FIELD, TOLERANCE, POINTINGS, ROWS = np.radians(20.0), 2e-3, 100, 48
SKY = synthetic(6.0)
INDEX = jax.tree.map(jnp.asarray, index_stars(SKY, FIELD / 2.0 + 2.0 * TOLERANCE))
BORESIGHT = np.array([0.36, 0.48, 0.8])
track = jax.jit(jax.vmap(track_stars, (None, 0, 0, None, None)))


@pytest.fixture(scope="module")
def scene():
    """Directions in random order with false ones and gaps, and attitudes that are a little off."""
    rng = np.random.default_rng(4)
    true = Rotation.random(POINTINGS, rng=rng)
    b, star = np.full((POINTINGS, ROWS, 3), np.nan), np.full((POINTINGS, ROWS), -1)
    for k in range(POINTINGS):
        unit = true[k].inv().apply(SKY.unit_i)
        field = np.flatnonzero(unit @ BORESIGHT > np.cos(FIELD / 2.0))
        field = rng.permutation(field)[: len(field) * 2 // 3]  # a third is missed
        rows = rng.permutation(ROWS)[: len(field)]
        b[k, rows], star[k, rows] = unit[field], field
        free = np.setdiff1d(np.arange(ROWS), rows)[:4]
        false = BORESIGHT + rng.normal(0.0, 0.08, (4, 3))
        b[k, free] = false / np.linalg.norm(false, axis=1, keepdims=True)
    off = Rotation.from_rotvec(rng.normal(0.0, TOLERANCE / 5.0, (POINTINGS, 3)))
    return b, star, true * off


def test_a_star_is_named_where_it_is_alone_and_nowhere_else(scene):
    b, star, prior = scene
    q = jnp.asarray(prior.as_quat(scalar_first=True))
    got = np.asarray(track(INDEX, jnp.asarray(b), q, jnp.asarray(BORESIGHT), TOLERANCE))
    tree = KDTree(SKY.unit_i)
    doubts = np.zeros(2, int)
    for k in range(POINTINGS):
        seen = np.flatnonzero(~np.isnan(b[k, :, 0]))
        close = [set(x) for x in tree.query_ball_point(prior[k].apply(b[k, seen]), TOLERANCE)]
        wanted = np.full(ROWS, -1)
        for row, (i, mine) in zip(seen, enumerate(close), strict=True):
            others = set().union(*close[:i], *close[i + 1 :])
            doubts += np.array([len(mine) > 1 and not mine & others, bool(mine & others)])
            if len(mine) == 1 and not mine & others:
                wanted[row] = mine.pop()
        np.testing.assert_array_equal(got[k], wanted)
    assert min(doubts) > 3  # such cases there were
    named = got >= 0
    assert named.sum() > 0.9 * (star >= 0).sum()
    false = named & (star == -1)
    assert np.all(got[named & ~false] == star[named & ~false])
    assert false.sum() < 0.02 * 4 * POINTINGS


def test_nothing_seen_is_nothing_named(scene):
    q = jnp.asarray(scene[2].as_quat(scalar_first=True))
    none = jnp.full((POINTINGS, ROWS, 3), jnp.nan)
    assert np.all(track(INDEX, none, q, jnp.asarray(BORESIGHT), TOLERANCE) == -1)
