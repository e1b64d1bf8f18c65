"""Orientation of a nine-axis log at 286 Hz: a batch replay and one step of a live filter.

Wall time after compilation. "Replay" is all of it from arrays to an attitude at every sample:
blocks, rest, filter, attitudes. The peers are VQF (C++, without a covariance, states of scale or
smoothing) and imufusion (C, one sample a call from Python), where they are installed.
"""

import importlib.util
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from timing import best_of, show

from robins.dataset import Dataset, ImuTable, MagTable
from robins.filters import OnlineFilter, rts_smoother, run
from robins.manifold import Angle
from robins.systems.marg import MargReplay, model_of, one_prior, prepare
from robins.systems.marg.model import causal_attitudes, smoothed_attitudes
from robins.systems.replaying import kept


def installed(name: str) -> Any:
    """A package, or None without it."""
    return importlib.import_module(name) if importlib.util.find_spec(name) else None


vqf, imufusion = installed("vqf"), installed("imufusion")
RATE_HZ, SAMPLES = 285.7, 57_000
WANTED_US = 5.0


def made_log() -> Dataset:
    """A unit that is turned about, with noise; what is in the samples does not change the time."""
    rng = np.random.default_rng(0)
    time = np.arange(SAMPLES) / RATE_HZ
    hertz = rng.uniform(0.1, 0.7, 3)
    gyro = np.sin(2.0 * np.pi * hertz * time[:, None]) + 0.002 * rng.standard_normal((SAMPLES, 3))
    gyro[time < 10.0] *= 0.002
    accel = np.array([0.0, 0.0, -9.81]) + 0.05 * rng.standard_normal((SAMPLES, 3))
    field = np.array([18e-6, 0.0, 44e-6]) + 5e-7 * rng.standard_normal((SAMPLES, 3))
    time_ns = np.round(time * 1e9).astype(np.int64)
    return Dataset("made", ImuTable(time_ns, gyro, accel, "rate"), mag=MagTable(time_ns, field))


def main():
    """Print the times."""
    log, parameters = made_log(), MargReplay()
    filter_, model = one_prior(parameters), model_of(parameters)
    ready = prepare(log, parameters).world
    inputs = (filter_, model, ready.start, ready.y, ready.u, ready.aux)

    def causal():
        p = prepare(log, parameters)
        w = p.world
        mean, *_ = run(filter_, model, w.start, w.y, w.u, w.aux, keep=kept).steps
        return causal_attitudes(w.start.mean, mean, p.samples)

    def smoothed():
        p = prepare(log, parameters)
        w = p.world
        belief = rts_smoother(run(filter_, model, w.start, w.y, w.u, w.aux))
        return smoothed_attitudes(belief.mean, p.samples)

    online = OnlineFilter(filter_, model, ready.start)
    block = jax.tree_util.tree_map(lambda a: jnp.asarray(a)[300], ready.u)
    still, field_b = jnp.zeros(()), jnp.asarray(ready.aux["magnetometer"][300])
    zero = (Angle(jnp.zeros(())), jnp.zeros(2))

    def predict():
        online.state = start
        online.predict(block)
        return online.state

    def whole():
        online.state = start
        online.predict(block)
        online.update(jnp.zeros(6), "travel", still)
        online.update(zero, "magnetometer", field_b)
        return online.state

    start = online.state
    tasks = {
        "replay, causal": causal,
        "replay, smoothed": smoothed,
        "filter alone": lambda: run(*inputs, keep=kept).steps[1],
        "one predict": predict,
        "one step": whole,
    }
    assert log.mag is not None
    gyro, accel, field = (
        np.ascontiguousarray(a) for a in (log.imu.gyro, log.imu.accel, log.mag.field_t * 1e6)
    )
    if vqf is not None:
        tasks["vqf"] = lambda: vqf.VQF(1.0 / RATE_HZ).updateBatch(gyro, accel, field)["quat9D"]
        tasks["vqf, offline"] = lambda: vqf.offlineVQF(gyro, accel, field, 1.0 / RATE_HZ)["quat9D"]
    if imufusion is not None:

        def fusion():
            ahrs = imufusion.Ahrs()
            ahrs.set_sample_period(1.0 / RATE_HZ)
            for g, a, m in zip(np.degrees(gyro), accel / 9.81, field, strict=True):
                ahrs.update(g, a, m)
            return np.asarray(ahrs.get_quaternion())

        tasks["imufusion"] = fusion
    best = best_of(tasks, rounds=5)
    for name in tasks:
        single = name in ("one predict", "one step")
        show(name, best[name], 1 if single else SAMPLES, "block" if single else "sample")
    took = best["replay, causal"] / SAMPLES * 1e6
    verdict = "within" if took <= WANTED_US else "above"
    print(f"causal replay: {took:.2f} us a sample, {verdict} the {WANTED_US:g} us wanted")


if __name__ == "__main__":
    main()
