"""Positions as states: metres north, east, down there and back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins.earth import Geodetic, dcm_en

retract, local = jax.jit(Geodetic.retract), jax.jit(Geodetic.local)
GRAIN_M = 4e-9  # one unit in the last place of a longitude near pi is 2.8e-9 m


@pytest.fixture(scope="module")
def places():
    rng = np.random.default_rng(0)
    ranges = ((-1.5, 1.5), (-np.pi, np.pi), (-500, 5e5))
    return Geodetic(*(jnp.asarray(rng.uniform(*ends, 500)) for ends in ranges))


@pytest.mark.parametrize("size", [0.0, 1e-3, 1.0, 1e3, 1e5])
def test_local_gives_back_the_step(places, size):
    step = size * np.random.default_rng(1).uniform(-1, 1, (500, 3))
    np.testing.assert_allclose(local(places, retract(places, step)), step, atol=GRAIN_M, rtol=0)


def test_retract_reaches_the_other_place(places):
    other = Geodetic(*(jnp.flip(a) for a in (places.lat, places.lon, places.alt)))
    reached = retract(places, local(places, other))
    np.testing.assert_allclose(reached.lat, other.lat, atol=4e-16)
    np.testing.assert_allclose(reached.lon, other.lon, atol=2e-15)
    np.testing.assert_allclose(reached.alt, other.alt, atol=1e-9)


def test_short_steps_are_metres_of_the_local_frame(places):
    # What is left is the curvature of the Earth: s^2/R, grown by tan(lat) near the poles.
    step = np.random.default_rng(2).uniform(-1, 1, (500, 3))
    moved = np.asarray(retract(places, step).as_ecef() - places.as_ecef())
    C_en = np.asarray(dcm_en(places.lat, places.lon))
    seen = np.einsum("nij,ni->nj", C_en, moved)
    bound = 1.5 * (1 + np.abs(np.tan(places.lat))) / 6.3e6 + 2 * GRAIN_M
    assert np.all(np.max(np.abs(seen - step), -1) <= bound)


@pytest.mark.parametrize("east", [300.0, -300.0])
def test_date_line_is_no_seam(east):
    side = 1 if east > 0 else -1
    start = Geodetic.from_degrees(-18.0, side * 179.999, 0.0)
    end = retract(start, np.array([0.0, east, 0.0]))
    assert np.sign(end.lon) == -side
    np.testing.assert_allclose(local(start, end), [0, east, 0], atol=GRAIN_M)
    np.testing.assert_allclose(local(end, start), [0, -east, 0], atol=GRAIN_M)
    chord = np.linalg.norm(end.as_ecef() - start.as_ecef())
    np.testing.assert_allclose(chord, 300.0, atol=1e-6)


def test_longitude_stays_in_its_half_open_turn(places):
    around = retract(places, np.full((500, 3), [0.0, 3e7, 0.0]))
    assert np.all(around.lon >= -np.pi)
    assert np.all(around.lon < np.pi)
    assert float(Geodetic.from_degrees(0.0, 180.0, 0.0).lon) == -np.pi
    assert float(Geodetic.from_ecef([-6.4e6, 0.0, 0.0]).lon) == -np.pi


def test_degrees_and_earth_fixed_coordinates():
    munich = Geodetic.from_degrees(48.1374, 11.5755, 519.0)
    np.testing.assert_allclose([munich.lat, munich.lon], np.deg2rad([48.1374, 11.5755]), rtol=1e-15)
    back = Geodetic.from_ecef(munich.as_ecef())
    np.testing.assert_allclose(back.local(munich), np.zeros(3), atol=GRAIN_M)
    many = Geodetic.from_degrees([10, 20, 30], 5, 0)  # whole numbers, one longitude for all
    assert many.as_ecef().shape == (3, 3)


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ((116.4, 39.9, 0.0), "exchanged"),
        ((np.nan, 0.0, 0.0), "lat_deg"),
        ((0.0, np.inf, 0.0), "lon_deg"),
        ((0.0, 0.0, [1.0, np.nan]), "alt_m"),
    ],
)
def test_places_that_are_none_are_refused(place, words):
    with pytest.raises(ValueError, match=words):
        Geodetic.from_degrees(*place)


def test_gradient_of_the_way_there_and_back_is_the_identity():
    start = Geodetic.from_degrees(60.0, 180.0, 1000.0)
    slope = jax.jit(jax.jacrev(lambda d: start.local(start.retract(d))))(jnp.zeros(3))
    np.testing.assert_allclose(slope, np.eye(3), atol=1e-15)
