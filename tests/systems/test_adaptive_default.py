"""The filter "adaptive" of every simulated system: that it is there, blind, one and the same."""

import numpy as np
import pytest

from robins.filters import Belief, adaptive
from robins.scenario import load
from robins.systems import transfer_alignment
from robins.systems.finding import find_system
from robins.systems.transfer_alignment.product.filters import (
    ACCELEROMETERS,
    GYROS,
    STRUCTURES,
    VARIANTS,
)
from robins.systems.transfer_alignment.product.parameters import Product, Structure
from robins.systems.transfer_alignment.product.study import product_contender

STUDIES = {
    "airship": ("navigation",),
    "ins-gnss": ("drive",),
    "rocket": ("magnetic-attitude", "field-vector"),
    "satellite": ("attitude-loop",),
    "transfer-alignment": ("product", "velocity-attitude"),
}


@pytest.mark.parametrize("system", STUDIES)
def test_every_simulated_system_has_it(system):
    studies = find_system(system).studies
    for name in STUDIES[system]:
        assert "adaptive" in studies[name].filters


def test_alignment_supposes_every_structure_at_every_scale_and_is_told_of_none():
    told = Structure(sigma=(1e-3, 1e-3, 1e-3), time=(3.0, 3.0, 3.0))
    supposed, in_spite = (VARIANTS["adaptive"].flexure(x) for x in (None, told))
    assert supposed is not None
    assert in_spite is not None
    for a, b in zip(supposed[:3], in_spite[:3], strict=True):
        np.testing.assert_array_equal(a, b)
    assert not set(STRUCTURES[1]) & {3.0, 1.5}  # times that scenarios have

    scenario = find_system(transfer_alignment.SYSTEM.name).scenarios["aircraft"]
    contender = product_contender(load(Product, scenario), "adaptive")
    n = 24
    assert contender.reported is not None
    assert contender.reported.shape[1] == n
    state = contender.filter.init(Belief.of(np.zeros(n), np.eye(n)), contender.model.dims)
    probability = np.exp(state.memory.log_probability)
    alone = adaptive(parts=(GYROS, ACCELEROMETERS))
    scales = len(alone.init(Belief.of(np.zeros(n), np.eye(n)), {"y": 1}).memory.log_probability)
    assert scales == 5
    assert probability.shape == (len(STRUCTURES[0]) * scales,)
    by_structure = probability.reshape(-1, scales)
    np.testing.assert_allclose(by_structure, by_structure[:1].repeat(len(STRUCTURES[0]), axis=0))
    np.testing.assert_allclose(probability.sum(), 1.0)
    assert np.all(by_structure[:, 0] > 0.9 / len(STRUCTURES[0]))
