"""The filter "adaptive" of every simulated system: that it is there, blind, one and the same."""

import jax
import numpy as np
import pytest

from robins.filters.composite.bank import stacked
from robins.scenario import load
from robins.sim.flexure import Flexure
from robins.systems.finding import find_system
from robins.systems.transfer_alignment.attitude_matching.model import ATTITUDE, linear_system
from robins.systems.transfer_alignment.attitude_matching.parameters import AttitudeMatching
from robins.systems.transfer_alignment.attitude_matching.structures import (
    START,
    StructureHypothesis,
    hypotheses,
    structure_bank,
    structure_filter,
)
from robins.systems.transfer_alignment.product.filters import NOISY, UNKNOWN, VARIANTS
from robins.systems.transfer_alignment.product.parameters import Product, Structure
from robins.systems.transfer_alignment.velocity_attitude.study import VelocityAttitude

SCENARIOS = find_system("transfer-alignment").scenarios

STUDIES = {
    "airship": ("navigation",),
    "ins-gnss": ("drive",),
    "rocket": ("magnetic-attitude", "field-vector"),
    "satellite": ("attitude-loop",),
    "transfer-alignment": ("product", "velocity-attitude", "attitude-matching"),
}


@pytest.mark.parametrize("system", STUDIES)
def test_every_simulated_system_has_it(system):
    studies = find_system(system).studies
    for name in STUDIES[system]:
        assert "adaptive" in studies[name].filters


def test_alignment_is_told_of_no_structure_and_has_no_number_of_a_scenario():
    told = Structure(sigma=(1e-3, 1e-3, 1e-3), time=(3.0, 3.0, 3.0))
    for name, believed in (("adaptive", UNKNOWN), ("product-flexure", told)):
        found = VARIANTS[name].flexure(told)
        assert found is not None
        np.testing.assert_array_equal(found.sigma_rad, believed.sigma)
        np.testing.assert_array_equal(found.tau_s, believed.time)
    given = [load(VelocityAttitude, SCENARIOS[name]) for name in "abcde"]
    given += [load(Product, SCENARIOS[name]) for name in ("aircraft", "ship", "vehicle")]
    assert not {t for g in given for t in g.flexure.time} & set(UNKNOWN.time)
    assert NOISY.gyro not in {g.disturbance.gyro_noise_factor for g in given}


def test_attitude_matching_supposes_structures_and_no_louder_gyros():
    rows = stacked(hypotheses())
    count = len(rows.sigma)
    swings = {(float(s), float(t)) for s, t in zip(rows.sigma, rows.time, strict=True)}
    assert count == 2 * len(swings) == 18  # with flutter and without
    given = load(AttitudeMatching, SCENARIOS["s1"])
    system = linear_system(given, 3, START)
    bank = structure_bank(system, given.master.attitude_noise, given.period)
    state = bank.init(system.start(), {ATTITUDE: 3})
    probability = np.exp(state.memory.log_probability)
    np.testing.assert_allclose(probability[np.asarray(rows.sigma) == 0.0].sum(), 0.5)
    np.testing.assert_allclose(probability.sum(), 1.0)
    assert bank.suspects == (ATTITUDE, "flexure")
    assert dict(bank.wrong)["flexure"] == tuple(np.flatnonzero(rows.sigma))
    assert dict(bank.wrong)[ATTITUDE] == tuple(np.flatnonzero(rows.flutter))


def test_a_bank_made_again_is_the_same_and_its_numbers_are_leaves():
    system = linear_system(load(AttitudeMatching, SCENARIOS["s1"]), 3, START)
    one, other = (jax.tree_util.tree_flatten(structure_bank(system, s, 0.1)) for s in (3e-4, 5e-4))
    assert one[1] == other[1]
    assert {leaf.dtype for leaf in one[0]} == {np.dtype(float)}
    differ = [a for a, b in zip(one[0], other[0], strict=True) if np.any(a != b)]
    assert differ == [3e-4]


def test_each_hypothesis_is_the_kalman_filter_of_its_structure():
    """Against matrices of the linear system that is told that structure."""
    given = load(AttitudeMatching, SCENARIOS["s0"])
    noise, T = given.master.attitude_noise, given.period
    told, flutter = Flexure(np.full(3, 2e-3), np.full(3, 4.0)), 3.0
    system, own = linear_system(given, 3, START), linear_system(given, 3, told)
    y = 1e-3 * np.random.default_rng(1).normal(size=(3, 3))
    mode = structure_filter(system, noise, T)(StructureHypothesis(2e-3, 4.0, flutter))
    model = own.model(noise)
    u, aux = system.inputs()
    state = mode.filter_.init(system.start(), model.dims)
    x, P = np.zeros(15), np.diag(system.sigma) ** 2
    for k in range(3):
        at = jax.tree.map(lambda a, k=k: a[k], (u, aux))
        state, *_ = mode.predict(state, model.motion, at[0])
        state, *_ = mode.update(state, model.sensor(ATTITUDE), y[k], at[1][ATTITUDE])
        x, P = own.F[k] @ x, own.F[k] @ P @ own.F[k].T + own.G @ own.G.T
        H, R = own.H[k], noise**2 * (1.0 + flutter**2) * np.eye(3)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x, P = x + K @ (y[k] - H @ x), P - K @ H @ P
    np.testing.assert_allclose(state.belief.mean, x, rtol=1e-9, atol=1e-15)
    sigma = np.sqrt(np.diag(P))
    scale = np.outer(sigma, sigma)
    np.testing.assert_allclose(state.belief.covariance / scale, P / scale, atol=1e-9)


def test_a_stiff_structure_is_forgotten():
    given = load(AttitudeMatching, SCENARIOS["s1"])
    system = linear_system(given, 3, START)
    mode = structure_filter(system, 3e-4, given.period)(StructureHypothesis(0.0, 1.0, 0.0))
    state = mode.filter_.init(system.start(), {ATTITUDE: 3})
    state, *_ = mode.predict(state, system.model(3e-4).motion, system.inputs()[0][0])
    assert np.all(state.belief.sigma[9:] == 0.0)
    assert np.all(state.belief.sigma[:9] > 0.0)
