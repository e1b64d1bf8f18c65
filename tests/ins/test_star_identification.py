"""Lost in space: stars named rightly or not at all, the table of pairs, and doubt of every kind."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest

from robins.earth.stars import Stars, synthetic
from robins.ins.star_identification import identify, index_pairs, pairs_between

ARCSEC = np.pi / 648e3
SIGMA, FIELD = 20.0 * ARCSEC, np.radians(20.0)
SKY = synthetic(6.0)
INDEX = index_pairs(SKY, FIELD)
RNG = np.random.default_rng(21)


def in_field(count):
    """Directions uniform over the field of a camera along z."""
    z = RNG.uniform(np.cos(FIELD / 2.0), 1.0, count)
    azimuth, across = RNG.uniform(0.0, 2.0 * np.pi, count), np.sqrt(1.0 - z**2)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], 1)


def picture(false=3, limit=6.0, most=None):
    """An image in any order: attitude, directions, true stars (-1: false), magnitudes."""
    true = Rotation.random(rng=RNG)
    unit = true.inv().apply(SKY.unit_i[SKY.magnitude < limit])
    star = np.flatnonzero(unit[:, 2] > np.cos(FIELD / 2.0))[:most]
    b = unit[star] + SIGMA * RNG.normal(size=(len(star), 3))
    b = np.concatenate([b / np.linalg.norm(b, axis=1, keepdims=True), in_field(false)])
    star = np.concatenate([star, np.full(false, -1)])
    magnitude = np.where(star >= 0, SKY.magnitude[star], 5.0)
    order = RNG.permutation(len(b))
    return true, b[order], star[order], magnitude[order]


def assert_right(found, true, star):
    """All names right, and the attitude within what three stars may be off by."""
    assert found.refusal == ""
    np.testing.assert_array_equal(found.star[found.star >= 0], star[found.star >= 0])
    assert found.named == np.sum(found.star >= 0)
    numbers = np.where(found.star >= 0, SKY.identifier[found.star], -1)
    np.testing.assert_array_equal(found.identifier, numbers)
    off = Rotation.from_quat(found.q_ib, scalar_first=True).inv() * true
    assert off.magnitude() < 400.0 * ARCSEC


@pytest.mark.parametrize("limit", [6.0, 5.5])
def test_random_pointings_with_false_stars_are_identified_and_none_wrongly(limit):
    index = index_pairs(synthetic(limit), FIELD)
    real = named = 0
    for _ in range(60):
        true, b, star, _ = picture(limit=limit)
        found = identify(index, b, SIGMA)
        assert_right(found, true, star)
        assert found.chance < 1e-6
        real, named = real + np.sum(star >= 0), named + found.named
    # Those beyond four sigmas, one in 3000, and neighbours that could be each other have no name.
    assert binomtest(int(real - named), int(real), 2e-3, alternative="greater").pvalue > 1e-3


def test_more_false_stars_than_real_ones_only_take_longer():
    for _ in range(5):
        true, b, star, _ = picture(false=25, most=15)
        assert_right(identify(INDEX, b, SIGMA), true, star)


def test_an_image_of_no_sky_has_no_names():
    for _ in range(4):
        found = identify(INDEX, in_field(12), SIGMA)
        assert np.all(found.star == -1)
        assert np.all(found.identifier == -1)
        assert found.named == 0
        assert np.all(np.isnan(found.q_ib))
        assert found.triangles > 100
        assert "triangle" in found.refusal or "too few stars agree" in found.refusal


def test_an_image_in_a_mirror_has_no_names():
    _, b, _, _ = picture(false=0, most=12)
    assert identify(INDEX, b, SIGMA).named == 12
    assert identify(INDEX, b * [1.0, -1.0, 1.0], SIGMA).named == 0


def test_few_stars_are_named_only_as_far_as_chance_allows():
    true, b, star, _ = picture(false=0)
    assert "3 stars are seen; a pyramid has four" in identify(INDEX, b[:3], SIGMA).refusal
    doubtful = identify(INDEX, b[:4], SIGMA)
    assert doubtful.named == 0
    assert "too few stars agree" in doubtful.refusal
    assert 1e-6 < doubtful.chance < 0.05
    assert_right(identify(INDEX, b[:4], SIGMA, most_chance=0.05), true, star[:4])
    assert_right(identify(INDEX, b[:7], SIGMA), true, star[:7])


def test_missing_directions_have_no_name_and_do_no_harm():
    true, b, star, _ = picture()
    gaps = np.where((np.arange(len(b)) % 4 == 0)[:, None], np.nan, b)
    found = identify(INDEX, gaps, np.full(len(b), SIGMA))
    assert_right(found, true, star)
    assert np.all(found.star[::4] == -1)


def test_magnitudes_tell_a_star_from_one_too_bright():
    true, b, star, magnitude = picture()
    found = identify(INDEX, b, SIGMA, magnitude + 0.3)
    assert_right(found, true, star)
    bright = found.star == found.star.max()
    found = identify(INDEX, b, SIGMA, np.where(bright, -1.0, magnitude))
    assert_right(found, true, star)
    assert found.star[bright] == -1
    assert identify(INDEX, b, SIGMA, magnitude + 3.0).named == 0


def test_two_directions_for_one_star_leave_it_without_a_name():
    true, b, star, _ = picture()
    k = np.flatnonzero(star >= 0)[2]
    beside = b[k] + 30.0 * ARCSEC * np.array([1.0, 0.0, 0.0])
    twice = np.concatenate([b, [beside / np.linalg.norm(beside)]])
    found = identify(INDEX, twice, SIGMA)
    assert_right(found, true, np.append(star, star[k]))
    assert found.star[k] == found.star[-1] == -1


def test_two_stars_for_one_direction_leave_it_without_a_name():
    true, b, star, _ = picture()
    k = np.flatnonzero(star >= 0)[2]
    unit = SKY.unit_i.copy()
    other = np.setdiff1d(np.arange(1000), star)[0]  # moved there from elsewhere in the sky
    beside = unit[star[k]] + 30.0 * ARCSEC * np.linalg.svd(unit[star[k]][None])[2][1]
    unit[other] = beside / np.linalg.norm(beside)
    found = identify(index_pairs(SKY._replace(unit_i=unit), FIELD), b, SIGMA)
    assert_right(found, true, star)
    assert found.star[k] == -1


def test_the_table_of_pairs_holds_each_pair_in_the_field_and_finds_every_range():
    few = synthetic(4.0)
    index = index_pairs(few, FIELD)
    i, j = np.triu_indices(len(few.unit_i), 1)
    a, b = few.unit_i[i], few.unit_i[j]
    angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, 1))
    within = angle < FIELD
    every = sorted(zip(i[within], j[within], strict=True))
    assert sorted(zip(index.first, index.second, strict=True)) == every
    edges = RNG.choice(index.angle_rad, (50, 2))  # exactly at an angle, both ends belong to it
    low, high = np.sort(np.concatenate([edges, RNG.uniform(-0.1, 0.5, (50, 2))]), axis=1).T
    for a, b in zip([*low, 0.0, -1.0, 0.4, 0.2], [*high, 1.0, -0.5, 0.5, 0.1], strict=True):
        first, second = pairs_between(index, a, b)
        inside = (index.angle_rad >= a) & (index.angle_rad <= b)
        np.testing.assert_array_equal(first, index.first[inside])
        np.testing.assert_array_equal(second, index.second[inside])


B = in_field(5)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"vectors_b": B[0]}, r"vectors_b must have shape \(n, 3\)"),
        ({"vectors_b": 2.0 * B}, r"vectors_b\[0\] .* unit vectors"),
        ({"sigma_rad": -SIGMA}, "sigma_rad must be positive"),
        ({"sigma_rad": [SIGMA]}, r"sigma_rad must be a number or of shape \(5,\)"),
        ({"magnitude": [5.0]}, r"magnitude must have shape \(5,\)"),
        ({"magnitude_tolerance": 0.0}, "magnitude_tolerance must be positive"),
        ({"most_chance": 0.0}, "most_chance must be between 0 and 1"),
    ],
)
def test_what_is_no_image_is_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        identify(INDEX, **({"vectors_b": B, "sigma_rad": SIGMA} | wrong))


@pytest.mark.parametrize(
    ("stars", "field", "message"),
    [
        (SKY, 0.0, "field_rad must be above 0"),
        (SKY, 2.0, "field_rad must be above 0"),
        (Stars(*(x[:3] for x in SKY)), FIELD, "N four at least"),
        (SKY._replace(unit_i=2.0 * SKY.unit_i), FIELD, "unit vectors"),
        (Stars(*(x[:4] for x in SKY)), 1e-3, "no two stars are within the field"),
    ],
)
def test_what_makes_no_table_is_refused(stars, field, message):
    with pytest.raises(ValueError, match=message):
        index_pairs(stars, field)
