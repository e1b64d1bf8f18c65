"""Increments joined inside compiled code, against NumPy and against navigating sample by sample."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from composed import composed

from robins.earth import Geodetic
from robins.ins.increments import Increments, joined
from robins.ins.mechanise import Nav, mechanise
from robins.rotation import Rotation, from_euler

RATE_HZ, SPANS = 100, 3


def sampled() -> Increments:
    """Three seconds of a body that sways, coning, and is pushed about, with unequal intervals."""
    rng = np.random.default_rng(4)
    n = RATE_HZ * SPANS
    dt = (1.0 + 0.2 * rng.random(n)) / RATE_HZ
    dt *= SPANS / dt.sum()
    t = np.cumsum(dt)[:, None]
    phase = np.array([0.0, 0.5 * np.pi, 1.0])
    omega = np.array([0.3, 0.3, 0.1]) * np.sin(2 * np.pi * np.array([1.5, 1.5, 0.4]) * t + phase)
    force = [0.4, -0.3, -9.81] + np.array([2.0, 1.0, 3.0]) * np.sin(2 * np.pi * 1.5 * t + phase)
    dr = 0.5 * dt[:, None] ** 2 * (force + 0.01 * rng.normal(size=(n, 3)))
    return Increments(dt, omega * dt[:, None], force * dt[:, None], dr)


SAMPLES = sampled()
ONE_S = Increments(*(a[:RATE_HZ] for a in SAMPLES))


join = jax.jit(joined)


@pytest.mark.parametrize("shifts", [True, False], ids=["with dr", "without dr"])
def test_joined_is_what_numpy_composes(shifts):
    given = ONE_S if shifts else ONE_S._replace(dr=None)
    want = composed(given)
    got = join(given)
    assert float(got.dt) == pytest.approx(float(want.dt), rel=1e-14)
    for name in ("theta", "dv", "dr"):
        mine, theirs = getattr(got, name), getattr(want, name)
        np.testing.assert_allclose(mine, theirs, rtol=1e-12, atol=1e-14, err_msg=name)


def test_many_intervals_are_mapped():
    blocks = Increments(*(a.reshape(SPANS, RATE_HZ, *a.shape[1:]) for a in SAMPLES))
    got = jax.vmap(join)(blocks)
    each = [composed(Increments(*(a[k] for a in blocks))) for k in range(SPANS)]
    want = Increments(*map(np.stack, zip(*each, strict=True)))
    for a, b in zip(got, want, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)
    # and joining what was joined joins all of it: the intervals lie one after the other
    for a, b in zip(join(got), composed(SAMPLES), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)


def test_one_step_over_a_second_leads_where_its_samples_lead():
    start = Nav(
        Rotation(from_euler(*jnp.asarray([0.1, -0.2, 2.0]))),
        jnp.array([30.0, -20.0, 1.0]),
        Geodetic(*(jnp.asarray(x) for x in (0.7, 1.9, 3000.0))),
    )
    single = jax.tree.map(lambda a: a[None], join(ONE_S))
    ends = [
        jax.tree.map(lambda a: a[-1], mechanise(start, jax.tree.map(jnp.asarray, inc)))
        for inc in (ONE_S, single)
    ]
    turn = np.asarray(ends[0].q_nb.local(ends[1].q_nb))
    push = np.asarray(ends[1].v_n - ends[0].v_n)
    shift = np.asarray(ends[0].position.local(ends[1].position))
    # The frame turns by 6e-5 rad in the second and gravity is taken in its middle, so what is left
    # is of third order; without joining displacement, 5 m of the swaying would be missing.
    assert np.linalg.norm(turn) < 1e-9
    assert np.linalg.norm(push) < 1e-5
    assert np.linalg.norm(shift) < 1e-4
    lost = composed(ONE_S)
    plain = mechanise(start, Increments(*(a[None] for a in lost[:3])))
    off = ends[0].position.local(jax.tree.map(lambda a: a[-1], plain.position))
    assert np.linalg.norm(off) > 100 * np.linalg.norm(shift)


def test_gradients_are_finite_where_nothing_turns():
    def moved(theta):
        still = Increments(jnp.full(5, 0.1), theta, jnp.ones((5, 3)))
        return jnp.sum(join(still).dr) + jnp.sum(join(still).theta)

    slope = jax.jit(jax.grad(moved))(jnp.zeros((5, 3)))
    assert np.all(np.isfinite(slope))
    # a small turn of the k-th sample turns the sum by as much
    difference = moved(1e-6 * jnp.eye(3)[:1].repeat(5, 0)) - moved(jnp.zeros((5, 3)))
    assert float(difference) == pytest.approx(1e-6 * float(jnp.sum(slope[:, 0])), rel=1e-4)
