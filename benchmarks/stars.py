"""A star sensor: images, attitude and names per frame; the attitude beside SciPy's.

The frames of a closed loop come one after the other, in a scan; a campaign has many at once.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation
from timing import best_of, show

from robins.earth.stars import synthetic
from robins.ins.star_identification import identify, index_pairs
from robins.ins.vector_attitude import METHODS
from robins.sim.random import Component, stream
from robins.sim.star_sensor import StarCamera, index_for, measure_attitude, photograph

FRAMES, PEERS, LOST = 2000, 200, 100


def in_turn(step):
    """A function of a frame for many, one after the other."""
    return jax.jit(lambda *xs: jax.lax.scan(lambda carry, x: (carry, step(*x)), 0, xs)[1])


def main():
    camera, sky = StarCamera(false_stars=3), synthetic(6.0)
    index = jax.tree.map(jnp.asarray, index_for(camera, sky))
    true = Rotation.random(FRAMES, rng=np.random.default_rng(0))
    q = jnp.asarray(true.as_quat(scalar_first=True))
    keys = jax.vmap(lambda run: stream(0, run, Component.STAR_SENSOR))(jnp.arange(FRAMES))
    image = jax.jit(jax.vmap(lambda key, q: photograph(key, index, q, camera)))(keys, q)
    weight = jnp.where(image.star >= 0, 1.0 / image.sigma_rad**2, 0.0)
    seen = image.vectors_b, index.unit_i[image.star], weight

    shoot = in_turn(lambda key, q: photograph(key, index, q, camera))
    known = in_turn(lambda key, q: measure_attitude(key, index, q, camera))
    tracked = in_turn(lambda key, q: measure_attitude(key, index, q, camera, q_ib_prior=q))
    tasks = {
        "image, in turn": lambda: shoot(keys, q),
        "image and attitude, stars known": lambda: known(keys, q),
        "image and attitude, stars tracked": lambda: tracked(keys, q),
    }
    for name, seconds in best_of(tasks).items():
        show(name, seconds, FRAMES, "frame")

    b, r, w = (np.asarray(x) for x in seen)
    sets = [(r[k, w[k] > 0], b[k, w[k] > 0], w[k, w[k] > 0]) for k in range(PEERS)]
    ways = {name: in_turn(way) for name, way in METHODS.items()}
    tasks = {name: lambda way=way: way(*seen) for name, way in ways.items()}
    best = best_of(tasks | {"scipy": lambda: [Rotation.align_vectors(*one) for one in sets]})
    peer = best.pop("scipy") / PEERS * FRAMES
    for name, seconds in best.items():
        show(f"attitude of {weight.shape[1]} rows, {name}", seconds, FRAMES, "frame", peer)
    show("attitude, scipy align_vectors (SVD)", peer, FRAMES, "frame")

    pairs, sigma = index_pairs(sky, camera.field_rad), np.asarray(image.sigma_rad)
    tasks = {
        "pairs of 4559 stars": lambda: index_pairs(sky, camera.field_rad),
        "lost in space": lambda: [identify(pairs, b[k], sigma[k]) for k in range(LOST)],
    }
    best = best_of(tasks)
    show("lost in space, 3 false stars", best["lost in space"], LOST, "frame")
    show("table of the pairs of 4559 stars", best["pairs of 4559 stars"], 1, "table")


if __name__ == "__main__":
    main()
