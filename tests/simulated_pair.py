"""A simulated master and slave as a log, as `robins.logs` writes and reads it."""

from dataclasses import replace

import jax
import numpy as np

from robins.dataset import Dataset, ImuTable
from robins.ins.increments import Increments, from_imu
from robins.ins.mechanise import as_trajectory
from robins.systems.transfer_alignment.product.parameters import PairParameters
from robins.systems.transfer_alignment.product.world import PairRun, lay_out, simulate_pair


def pair_dataset(parameters: PairParameters, seed: int, run: int = 0) -> Dataset:
    """One run of a simulated pair as a log; its noise is that of the same run in a campaign."""
    course = lay_out(parameters)
    simulated = jax.jit(lambda k: simulate_pair(parameters, course, seed, k))(run)
    return recorded(simulated, "simulated pair")


def recorded(run: PairRun, name: str) -> Dataset:
    """A run as tables; the truth about the slave, at the epochs, comes along.

    The slave's samples are integrals of rate and specific force, which `from_imu` turns into the
    increments of the run again.
    """
    flat = Increments(*(np.asarray(a).reshape(-1, *np.shape(a)[2:]) for a in run.increments[:3]))
    each = np.shape(run.increments.dt)[1]
    time_ns = np.concatenate([[0], np.cumsum(np.round(flat.dt * 1e9).astype(np.int64))])
    epoch_ns = time_ns[each::each]
    table = as_trajectory(epoch_ns, run.master, f"master of {name}")
    return Dataset(
        name,
        _samples(time_ns, flat, f"slave of {name}"),
        truth=as_trajectory(epoch_ns, run.truth.ins.nav, f"truth of {name}"),
        master=replace(table, omega_ib_b=np.asarray(run.master_omega_b)),
    )


def _samples(
    time_ns: np.ndarray, wanted: Increments, name: str, rounds: int = 50, tolerance: float = 1e-13
) -> ImuTable:
    """The table of which `from_imu` makes these increments; its first row repeats the second.

    What coning and sculling terms add is small beside the samples, so correcting these by what is
    missing converges.

    Raises:
        ValueError: it does not, for the body turns too far within a sample.
    """

    def table(gyro, accel) -> ImuTable:
        doubled = (np.concatenate([a[:1], a]) for a in (gyro, accel))
        return ImuTable(time_ns, *doubled, kind="increment", source=name)

    gyro, accel = np.asarray(wanted.theta), np.asarray(wanted.dv)
    for _ in range(rounds):
        made = from_imu(table(gyro, accel))[0]
        turn, push = wanted.theta - made.theta, wanted.dv - made.dv
        gyro, accel = gyro + turn, accel + push
        if max(np.abs(turn).max(), np.abs(push).max()) < tolerance:
            return table(gyro, accel)
    raise ValueError(f"{name}: the body turns too far within a sample to be written as samples")
