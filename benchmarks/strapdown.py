"""Strapdown mechanisation against pyins in the same process: one run, a batch, one sample."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from pyins import strapdown
from timing import best_of, show

from robins.dataset import ImuTable
from robins.earth import Geodetic
from robins.ins.increments import Increments, from_imu
from robins.ins.mechanise import Nav, mechanise, mechanise_chunked, step
from robins.ins.state import InsNoise, InsState, propagate, propagate_linear
from robins.rotation import Rotation

N, DT, BATCH, BATCH_STEPS, STREAM, BLOCKS, K = 1_000_000, 0.005, 256, 1000, 200, 200, 200


def samples():
    """White samples about a level body at rest: the arithmetic does not care."""
    rng = np.random.default_rng(0)
    gyro = rng.normal(0.0, 1e-3 * DT, (N, 3))
    accel = rng.normal([0.0, 0.0, -9.8 * DT], 1e-2 * DT, (N, 3))
    return np.arange(N, dtype=np.int64) * round(DT * 1e9), gyro, accel


def start() -> Nav:
    return Nav(
        Rotation.from_euler(0.01, 0.02, 0.5),
        jnp.array([1.0, 2.0, 0.0]),
        Geodetic.from_degrees(55.0, 37.0, 150.0),
    )


def main():
    time_ns, gyro, accel = samples()
    imu = ImuTable(time_ns, gyro, accel, "increment")
    inc, _ = from_imu(imu)
    columns = ["gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"]
    frame = pd.DataFrame(np.hstack([gyro, accel]), index=time_ns * 1e-9, columns=columns)
    rows = strapdown.compute_increments_from_imu(frame, "increment")
    pva = pd.Series(
        [55.0, 37.0, 150.0, 1.0, 2.0, 0.0, 0.5, 1.0, 30.0],
        index=["lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading"],
    )
    nav, one = start(), jax.jit(step)
    # runs that differ, or the compiler would compute one of them
    scale = 1.0 + 1e-6 * np.arange(BATCH)
    many = jax.tree.map(
        lambda a: jnp.asarray(np.multiply.outer(scale, a[:BATCH_STEPS])), inc._replace(dr=None)
    )._replace(dt=jnp.full((BATCH, BATCH_STEPS), DT))
    batch = jax.jit(jax.vmap(mechanise, (None, 0)))
    ends = jax.jit(jax.vmap(propagate, (None, 0)))
    singles = [Increments(*(a[k] for a in inc)) for k in range(STREAM)]
    blocks = jax.tree.map(
        lambda a: jnp.asarray(a[: BLOCKS * K]).reshape(BLOCKS, K, *a.shape[1:]), inc
    )
    noise = InsNoise(1e-5, 1e-4, 1e-8, 1e-6)

    @jax.jit
    def linear(x, blocks):
        def body(x, block):
            x, Phi, L = propagate_linear(x, block, noise)
            return x, (Phi[0, 0], L[0, 0])

        return jax.lax.scan(body, x, blocks)

    def streaming():
        state = nav
        for inc in singles:
            state = one(state, inc)
        return state

    def peer_streaming():
        integrator = strapdown.Integrator(pva)
        for k in range(STREAM):
            integrator.integrate(rows.iloc[k : k + 1])

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        seconds = best_of(
            {
                "pyins": lambda: strapdown.Integrator(pva).integrate(rows),
                "robins": lambda: mechanise_chunked(nav, inc).v_n,
                "pyins increments": lambda: strapdown.compute_increments_from_imu(
                    frame, "increment"
                ),
                "robins increments": lambda: from_imu(imu)[0].dv,
                "batch": lambda: batch(nav, many),
                "ends": lambda: ends(InsState.start(nav), many),
                "pyins stream": peer_streaming,
                "stream": streaming,
                "linear": lambda: linear(InsState.start(nav), blocks),
            }
        )
    peer = seconds["pyins"] / N
    show("pyins, one run of 1e6 samples", peer, 1.0, "sample")
    show("robins, one run of 1e6 samples", seconds["robins"] / N, 1.0, "sample", peer)
    for name, title in (("batch", "all states kept"), ("ends", "the last one kept")):
        each = seconds[name] / BATCH / BATCH_STEPS
        show(f"robins, batch of {BATCH}, {title}", each, 1.0, "sample and run", peer)
    peer = seconds["pyins increments"] / N
    show("pyins, samples to increments", peer, 1.0, "sample")
    show("robins, samples to increments", seconds["robins increments"] / N, 1.0, "sample", peer)
    peer = seconds["pyins stream"] / STREAM
    show("pyins, one sample at a time", peer, 1.0, "sample")
    show("robins, one sample at a time", seconds["stream"] / STREAM, 1.0, "sample", peer)
    show(f"robins, blocks of {K} with Phi and Q", seconds["linear"] / BLOCKS / K, 1.0, "sample")


if __name__ == "__main__":
    main()
