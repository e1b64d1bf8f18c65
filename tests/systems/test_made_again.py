"""A contender that is made again, or with other numbers, shares what was compiled for the first."""

import jax
import numpy as np
import pytest

from robins.filters.values import as_data
from robins.workbench.scenarios import read_scenario

# Scenario, filter, another number of it, another choice that is compiled.
STUDIES = {
    "airship/matched": ("centralised", "sar.position=12 m", "centralised-errors"),
    "rocket/b1": ("usque", "magnetometer.noise=2 deg", "usque-scale-factor"),
    "satellite/s1": ("mekf", "star.noise=9 arcsec", "ekf-quaternion"),
}


def made(name, filter_, settings=()):
    """Model and case, which any filter takes."""
    read = read_scenario(name, settings)
    c = read.study.contender(read.parameters, read.study.lay_out(read.parameters), filter_)
    return c.model, as_data(c.case)


@pytest.mark.parametrize("name", STUDIES)
def test_what_is_made_again_is_of_the_same_structure(name):
    filter_, number, kind = STUDIES[name]
    first, again, other = made(name, filter_), made(name, filter_), made(name, filter_, [number])
    shape = jax.tree_util.tree_structure(first)
    assert jax.tree_util.tree_structure(again) == shape
    assert jax.tree_util.tree_structure(other) == shape
    pairs = zip(*(jax.tree_util.tree_leaves(x) for x in (first, other)), strict=True)
    assert not all(np.array_equal(a, b) for a, b in pairs)
    assert jax.tree_util.tree_structure(made(name, kind)) != shape
