"""The series against the closed form of the level ellipsoid."""

import jax
import jax.numpy as jnp
import numpy as np

from robins.earth import curvature_radii, gravity_n
from robins.ins.zonal_gravity import gravity_nd


def test_series_is_the_closed_form_at_every_height():
    lat = np.deg2rad(np.concatenate([np.linspace(-90, 90, 181), [1e-6, 89.9999]]))
    for alt in (-10e3, -500.0, 0.0, 30e3, 500e3, 36e6):
        _, transverse = curvature_radii(lat)
        alts = jnp.full(len(lat), alt)
        series = jax.vmap(gravity_nd)(jnp.sin(lat), jnp.cos(lat), transverse, alts)
        closed = np.asarray(gravity_n(lat, alt))
        # 5e-15 of g: a dozen roundings, for both components are differences
        np.testing.assert_allclose(series[0], closed[:, 0], rtol=0, atol=5e-14)
        np.testing.assert_allclose(series[1], closed[:, 2], rtol=0, atol=5e-14)
