"""Many increments as one: what an interval of many samples did to the body.

Rotation, velocity increment and displacement in body axes at the start of an interval do not depend
on where the body is, so they are summed up once, whoever navigates with them afterwards; a filter
of sigma points moves each point over a second in one step. What the navigation frame and gravity do
meanwhile is left to that step, which takes them at the middle of the interval.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array

from robins import _float64  # noqa: F401
from robins.ins.increments import Increments, displacement
from robins.rotation import from_rotvec, multiply, normalise, rotate, to_rotvec


def joined(increments: Increments) -> Increments:
    """One increment for K in a row: dt (), theta, dv and dr (3,), by

        q <- q exp(theta_k)     dr <- dr + dv dt_k + C(q) dr_k     dv <- dv + C(q) dv_k

    Exact, but that a turn of the whole interval has to be less than one of pi; `jax.vmap` joins
    many intervals.

    Args:
        increments: K of them, leading axis, with dr or without.
    """
    inc = Increments(*(None if a is None else jnp.asarray(a, float) for a in increments))

    def add(sum_: tuple[Array, Array, Array, Array], one: Increments):
        q, dv, dr, dt = sum_
        dr = dr + dv * one.dt + rotate(q, one.dr)
        dv = dv + rotate(q, one.dv)
        return (normalise(multiply(q, from_rotvec(one.theta))), dv, dr, dt + one.dt), None

    zero = jnp.zeros(3)
    begin = (jnp.array([1.0, 0.0, 0.0, 0.0]), zero, zero, jnp.zeros(()))
    (q, dv, dr, dt), _ = jax.lax.scan(add, begin, inc._replace(dr=displacement(inc)))
    return Increments(dt, to_rotvec(q), dv, dr)
