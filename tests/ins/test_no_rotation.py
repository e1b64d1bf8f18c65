"""Direction cosine matrices that are none: refused, or no number where nothing can be raised."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins import rotation as rot


def test_a_matrix_that_is_no_rotation_is_refused():
    mirror = jnp.diag(jnp.array([1.0, 1.0, -1.0]))
    for wrong, words in (
        (mirror, "is a reflection"),
        (-jnp.eye(3), "is a reflection"),
        (jnp.stack([jnp.eye(3), mirror]), "is a reflection"),
        (jnp.zeros((3, 3)), "differs from the identity by 1"),
        (2.0 * jnp.eye(3), "differs from the identity by 3"),
    ):
        with pytest.raises(ValueError, match=words):
            rot.from_dcm(wrong)
    # what cannot raise gives no number, and what is missing stays missing
    assert np.all(np.isnan(jax.jit(rot.from_dcm)(mirror)))
    assert np.all(np.isnan(rot.from_dcm(jnp.full((3, 3), jnp.nan))))
