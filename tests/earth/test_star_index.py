"""The stars near a direction against all the stars there are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins.earth.stars import Stars, _cube_points, index_stars, near, synthetic

REACH = np.radians(10.0)
SKY = synthetic(5.0)
INDEX = index_stars(SKY, REACH)
found_near = jax.jit(jax.vmap(near, (None, 0)))


def directions():
    """Anywhere, and where cells and faces of the cube meet."""
    rng = np.random.default_rng(2)
    anywhere = rng.normal(size=(300, 3))
    corners = np.array(np.meshgrid(*3 * [[-1.0, 0.0, 1.0]])).reshape(3, -1).T
    n = round((len(INDEX.members) / 6) ** 0.5)
    line = np.tan((np.arange(n + 1) / n - 0.5) * np.pi / 2.0)
    borders = np.stack([line, np.ones(n + 1), np.full(n + 1, 0.3)], 1)
    every = np.concatenate([anywhere, np.delete(corners, 13, 0), borders, -borders])
    return every / np.linalg.norm(every, axis=1, keepdims=True)


def test_no_star_within_reach_is_missed():
    unit = directions()
    lists = np.asarray(found_near(INDEX, jnp.asarray(unit)))
    within = SKY.unit_i @ unit.T > np.cos(REACH)
    assert within.any(0).all()
    for row, wanted in zip(lists, within.T, strict=True):
        some = row[row >= 0]
        assert np.all(np.diff(some) > 0)  # brightest first, none twice
        assert np.all(row[len(some) :] == -1)
        assert set(np.flatnonzero(wanted)) <= set(some)
    # And a list is short beside the catalogue, else it were no help.
    assert lists.shape[1] < 0.05 * len(SKY.magnitude)


def test_a_star_is_found_from_the_far_corner_of_a_cell():
    """Each star just within reach of a corner, away from the middle of the cell."""
    n = round((len(INDEX.members) / 6) ** 0.5)
    corners, steps = _cube_points(np.arange(n + 1.0), n), np.arange(n) + 0.5
    corner, middle = corners[:, :-1, :-1].reshape(-1, 3), _cube_points(steps, n).reshape(-1, 3)
    away = corner * np.sum(corner * middle, 1)[:, None] - middle
    away = away / np.linalg.norm(away, axis=1, keepdims=True)
    reach = 0.9999 * REACH
    star = np.cos(reach) * corner + np.sin(reach) * away
    number = np.arange(len(star))
    index = index_stars(Stars(star, 5.0 + 0.0 * number, number), REACH)
    assert len(index.members) == len(star)  # one star for each cell
    inside = corner + 1e-7 * (middle - corner)
    lists = np.asarray(found_near(index, jnp.asarray(inside)))
    assert np.all(np.any(lists == number[:, None], axis=1))


def test_a_catalogue_out_of_order_is_sorted_by_brightness():
    shuffled = np.random.default_rng(1).permutation(len(SKY.magnitude))
    again = index_stars(Stars(*(x[shuffled] for x in SKY)), REACH)
    for got, wanted in zip(again, INDEX, strict=True):
        np.testing.assert_array_equal(got, wanted)


@pytest.mark.parametrize(
    ("stars", "reach", "message"),
    [
        (SKY, 0.0, "reach_rad must be above 0"),
        (SKY, np.nan, "reach_rad must be above 0"),
        (SKY, 1.0, "at most pi/4"),
        (SKY._replace(unit_i=SKY.unit_i[:0]), REACH, "N at least one"),
        (SKY._replace(unit_i=SKY.unit_i[:, :2]), REACH, r"shape \(N, 3\)"),
        (SKY._replace(unit_i=1.1 * SKY.unit_i), REACH, r"unit_i\[0\] is .* unit vectors"),
    ],
)
def test_what_cannot_be_sorted_is_refused(stars, reach, message):
    with pytest.raises(ValueError, match=message):
        index_stars(stars, reach)
