"""Attitude from stars: three ways to one answer, how good it is, and when there is none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from robins.earth.stars import synthetic
from robins.ins.vector_attitude import METHODS, attitude_from_vectors

ARCSEC = np.pi / 648e3
SIGMA = 20.0 * ARCSEC
POINTINGS, MOST = 300, 40
OPTIMAL = ("quest", "davenport", "svd")
RNG = np.random.default_rng(11)
compiled = jax.jit(lambda *given: {name: way(*given) for name, way in METHODS.items()})


def every(b, r, weight):
    """Results of each method for k sets of up to MOST directions, with one compilation for all."""
    k, n = weight.shape
    pads = (0, -k % POINTINGS), (0, MOST - n)
    b, r = (np.pad(x, (*pads, (0, 0))) for x in (b, r))
    weight = np.pad(weight, pads)
    parts = [
        compiled(*(jnp.asarray(x[i : i + POINTINGS]) for x in (b, r, weight)))
        for i in range(0, len(weight), POINTINGS)
    ]
    return jax.tree.map(lambda *x: np.concatenate(x)[:k], *parts)


def noisy(rng, unit, sigma):
    """Directions with an error of sigma in each of two angles."""
    seen = unit + sigma * rng.normal(size=unit.shape)
    return seen / np.linalg.norm(seen, axis=-1, keepdims=True)


def angles(true, q):
    """dtheta of q_true = q exp(dtheta), body axes."""
    return (Rotation.from_quat(q, scalar_first=True).inv() * true).as_rotvec()


@pytest.fixture(scope="module")
def scene():
    """Random pointings of a camera along z with a round field of 20 deg, stars to magnitude 5.5."""
    stars = synthetic(5.5).unit_i
    true = Rotation.random(POINTINGS, rng=RNG)
    b, r = np.full((2, POINTINGS, MOST, 3), np.nan)
    weight = np.zeros((POINTINGS, MOST))
    for k, attitude in enumerate(true):
        in_body = attitude.inv().apply(stars)
        field = np.flatnonzero(in_body[:, 2] > np.cos(np.radians(10.0)))
        b[k, : len(field)], r[k, : len(field)] = noisy(RNG, in_body[field], SIGMA), stars[field]
        weight[k, : len(field)] = 1.0 / SIGMA**2
    return true, b, r, weight, every(b, r, weight)


def test_three_ways_lead_to_one_attitude(scene):
    found = scene[-1]
    for name in OPTIMAL:
        assert found[name].solved.all()
        apart = angles(Rotation.from_quat(found["svd"].q_ib, scalar_first=True), found[name].q_ib)
        assert np.abs(apart).max() < 3e-6 * ARCSEC
        np.testing.assert_allclose(np.linalg.norm(found[name].q_ib, axis=1), 1.0, rtol=1e-14)
        assert np.all(found[name].q_ib[:, 0] >= 0.0)
        np.testing.assert_array_equal(found[name].covariance, found["svd"].covariance)
        np.testing.assert_allclose(found[name].loss, found["svd"].loss, rtol=1e-9)


def test_errors_are_as_small_as_the_cramer_rao_bound_allows(scene):
    true, _, _, weight, found = scene
    np.testing.assert_array_equal(found["quest"].stars, (weight > 0).sum(1))
    assert 18.0 < found["quest"].stars.mean() < 21.0
    bound = np.sqrt(np.einsum("kii->ki", found["quest"].covariance).mean(0)) / ARCSEC
    np.testing.assert_allclose(bound, [4.73, 4.72, 39.3], rtol=0.04)  # of another synthetic sky
    rms = np.sqrt(np.mean(angles(true, found["quest"].q_ib) ** 2, axis=0)) / ARCSEC
    across = np.hypot(*rms[:2]) / np.hypot(*bound[:2])
    assert abs(across - 1.0) < 0.1
    assert abs(rms[2] / bound[2] - 1.0) < 0.1
    two_stars = np.sqrt(np.mean(angles(true, found["triad"].q_ib) ** 2, axis=0)) / ARCSEC
    assert np.all(two_stars > 1.5 * rms)


def test_the_loss_is_chi_square(scene):
    found, freedom = scene[-1], 2 * (scene[3] > 0).sum() - 3 * POINTINGS
    total = 2.0 * found["quest"].loss.sum()
    assert chi2.ppf(1e-4, freedom) < total < chi2.ppf(1.0 - 1e-4, freedom)
    assert np.all(found["triad"].loss > found["quest"].loss)


def test_scipy_finds_the_same(scene):
    _, b, r, weight, found = scene
    for k in np.flatnonzero(found["quest"].stars <= 32)[::30]:
        seen = weight[k] > 0
        # What SciPy returns turns its second argument into its first: body to inertial this way
        # round, its inverse the other.
        rotation, _ = Rotation.align_vectors(r[k, seen], b[k, seen], weight[k, seen])
        assert np.abs(angles(rotation, found["quest"].q_ib[k])).max() < 3e-6 * ARCSEC
        one = attitude_from_vectors(b[k, :32], r[k, :32], SIGMA)  # the rows of NaN are no stars
        np.testing.assert_allclose(one.q_ib, found["quest"].q_ib[k], atol=1e-14)
        np.testing.assert_allclose(one.covariance, found["quest"].covariance[k], rtol=1e-9)


SPREAD = np.array([[0.1, 0.0, 1.0], [-0.1, 0.12, 1.0], [0.02, -0.17, 1.0], [0.05, 0.15, 1.0]])
SPREAD = SPREAD / np.linalg.norm(SPREAD, axis=1, keepdims=True)


def test_the_covariance_is_that_of_many_draws():
    runs, sigma = 4000, np.array([30.0, 20.0, 10.0, 40.0]) * ARCSEC
    true = Rotation.random(rng=RNG)
    b = noisy(RNG, np.broadcast_to(SPREAD, (runs, 4, 3)), sigma[:, None])
    r = np.broadcast_to(true.apply(SPREAD), b.shape)
    weight = np.broadcast_to(1.0 / sigma**2, b.shape[:2])
    found = every(b, r, weight)
    for name in ("quest", "triad"):
        error = angles(true, found[name].q_ib)
        # Whitened by what each run says of itself, all is of variance one and unrelated.
        roots = np.linalg.cholesky(np.linalg.inv(found[name].covariance))
        white = np.einsum("kji,kj->ki", roots, error)
        near = 5.0 * (2.0 / runs) ** 0.5
        np.testing.assert_allclose(white.T @ white / runs, np.eye(3), atol=near)
    # TRIAD took stars 2 and, farthest from it, 3: better told than with the worst two.
    more = found["triad"].covariance - found["quest"].covariance
    assert np.all(np.linalg.eigvalsh(more) > -1e-16)


@pytest.mark.parametrize("noise", [0.0, SIGMA])
def test_half_turns_are_no_trouble(noise):
    axes = np.concatenate([np.eye(3), RNG.normal(size=(5, 3)), [[0.0, 1.0, 1.0], [1.0, 1.0, 0.0]]])
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    turns = [np.pi, np.pi * (1 - 1e-9), -np.pi * (1 - 1e-5), 0.0, 1e-9]
    true = Rotation.from_rotvec(np.concatenate([turn * axes for turn in turns]))
    b = noisy(RNG, np.broadcast_to(SPREAD, (len(true), 4, 3)), noise)
    r = np.stack([attitude.apply(SPREAD) for attitude in true])
    found = every(b, r, np.full(b.shape[:2], 1.0 / SIGMA**2))
    sigma = np.sqrt(np.einsum("kii->ki", found["quest"].covariance))
    for name in OPTIMAL:
        assert np.all(np.abs(angles(true, found[name].q_ib)) < 5.0 * sigma * (noise > 0) + 1e-12)
        apart = angles(Rotation.from_quat(found["svd"].q_ib, scalar_first=True), found[name].q_ib)
        assert np.abs(apart).max() < 3e-6 * ARCSEC


def test_directions_that_contradict_each_other_still_have_a_best_attitude():
    b, r = noisy(RNG, np.zeros((200, 5, 3)), 1.0), noisy(RNG, np.zeros((200, 5, 3)), 1.0)
    found = every(b, r, RNG.uniform(0.5, 2.0, (200, 5)))
    np.testing.assert_allclose(found["quest"].loss, found["davenport"].loss, rtol=1e-9)
    np.testing.assert_allclose(found["svd"].loss, found["davenport"].loss, rtol=1e-9)


def tilted(degrees):
    """Two directions, so many degrees apart."""
    angle = np.radians(degrees)
    return np.array([[0.0, 0.0, 1.0], [np.sin(angle), 0.0, np.cos(angle)]])


FEW = {  # what is seen, and whether there is an attitude in it
    "none": (SPREAD[:0], False),
    "one": (SPREAD[:1], False),
    "one, twice": (SPREAD[[0, 0]], False),
    "two as close as one": (tilted(0.4), False),
    "one and its opposite": (tilted(179.7), False),
    "two": (tilted(0.6), True),
    "two far apart": (tilted(170.0), True),
}


@pytest.mark.parametrize("name", METHODS)
def test_below_two_separated_stars_there_is_no_answer(name):
    b, weight = np.full((len(FEW), 4, 3), np.nan), np.zeros((len(FEW), 4))
    for k, (seen, _) in enumerate(FEW.values()):
        b[k, : len(seen)], weight[k, : len(seen)] = seen, 1.0 / SIGMA**2
    found = every(b, b, weight)[name]
    for k, (seen, there) in enumerate(FEW.values()):
        assert found.solved[k] == there
        assert found.stars[k] == len(seen)
        for x in found[:3]:
            assert np.all(np.isfinite(x[k])) if there else np.all(np.isnan(x[k]))
        if there:
            assert np.abs(angles(Rotation.identity(), found.q_ib[k])).max() < 1e-11
            attitude_from_vectors(seen, seen, SIGMA, name)
        else:
            with pytest.raises(ValueError, match=rf"0.5 deg apart: got {len(seen)}"):
                attitude_from_vectors(seen, seen, SIGMA, name)


def test_gradients_are_finite_where_there_is_an_answer_and_where_not():
    b = np.stack([SPREAD, SPREAD[[0, 0, 0, 0]]])
    r = jnp.asarray(b @ Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix().T)

    def cost(b, weight):
        answers = [METHODS[name](b, r, weight) for name in ("quest", "triad")]
        return sum(jnp.sum(jnp.where(a.solved[:, None], a.q_ib, 0.0)) for a in answers)

    slopes = jax.jit(jax.grad(cost, (0, 1)))(jnp.asarray(b), jnp.ones((2, 4)))
    assert all(np.all(np.isfinite(x)) for x in slopes)
    assert np.any(np.asarray(slopes[0])[0])


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"vectors_i": SPREAD[:3]}, r"one shape \(n, 3\), got \(4, 3\) and \(3, 3\)"),
        ({"vectors_b": 1.1 * SPREAD}, r"vectors_b\[0\] .* unit vectors"),
        ({"vectors_i": SPREAD * np.nan}, r"vectors_i\[0\] .* unit vectors"),
        ({"sigma_rad": 0.0}, "sigma_rad must be positive"),
        ({"sigma_rad": [SIGMA] * 3}, r"sigma_rad must be a number or of shape \(4,\)"),
        ({"method": "esoq"}, "method must be one of quest, davenport, svd, triad, got 'esoq'"),
    ],
)
def test_what_is_no_set_of_directions_is_refused(wrong, message):
    given = {"vectors_b": SPREAD, "vectors_i": SPREAD, "sigma_rad": SIGMA} | wrong
    with pytest.raises(ValueError, match=message):
        attitude_from_vectors(**given)
