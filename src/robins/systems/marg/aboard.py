"""The filter "marg" for embedded use: its step takes increments; a simulated hand tests it.

A log has no scenario, so the run that `robins export` records and judges is simulated here: a unit
that lies still for two seconds and is then turned and swung by a hand, with sensor errors as large
as the parameters of the unit state, in a field that a magnet disturbs twice. Samples are processed
up to the first belief as those of a log (`prepare`).

On the board a step takes the increments of a block, and the code integrates them by
`model.of_block`, as a replay does beforehand. The filter has a single prior: on a board the gains
of the gyros are known, or found in a log (`filters.filter_of`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, PyTree
from scipy.spatial.transform import Rotation as SciRotation

from robins.dataset import Dataset, ImuTable, MagTable
from robins.filters import Model, Motion
from robins.rotation import Rotation
from robins.systems.marg import model
from robins.systems.marg.filters import one_prior
from robins.systems.marg.log import PreparedMargLog, prepare
from robins.systems.marg.parameters import MargReplay
from robins.systems.marg.replay import CAUSAL
from robins.systems.parts import NED
from robins.systems.study import Case, Contender, Problem, StateBlock

RATE_HZ, SECONDS, RUNS = 100.0, 40.0, 3
STILL_S, BEGUN_S, COUNTED_S = 2.0, 3.0, 10.0  # end of rest; full motion from; errors count from
MAGNET_S = ((4.0, 5.0), (20.0, 24.0))  # intervals with a magnet near the unit
MAGNET_N = np.array([12e-6, -20e-6, 8e-6])  # T
FIELD_N = np.array([18e-6, 0.0, 44e-6])  # T, NED; north is its horizontal direction
SHAKE = 0.1  # noise of a reading, as a share of the assumed `magnetometer.noise`

PLACE = StateBlock("place", slice(6, 9), "m", "m", "NED", NED)  # from the centre of its motion
_LEARNED = {"ratio": "learned variances, 1 as given", "samples": "that they were learned from"}
_GATE = {"refused": "readings refused in a row", "ratio": "of the last one, 1 at the gate"}

FIELDS = {
    ("predict_input", "dt_s"): "s, length of each interval; 0 for those that are not there",
    ("predict_input", "theta_b"): "rad, body: rotation vector of each interval, as the gyros read",
    ("predict_input", "dv_b"): "m/s, body: specific force times time",
    ("predict_input", "still"): "1 where the unit lies still, else 0",
    ("predict_input", "lost_turn"): "rad, body: spread of the turn that was not sampled, else 0",
    ("predict_input", "lost_dv"): "m/s: spread of the velocity that was not sampled, else 0",
    ("update_travel_reading", "value"): "zeros: velocity and place stay near zero; NaN where "
    "nothing is claimed, as at rest",
    ("update_rest_reading", "value"): "zeros at rest, else NaN",
    ("update_rest_about", "value"): "0 to 2: rad/s, body: mean rate read at rest; 3: rad/s, sigma",
    ("update_magnetometer_reading", "at_0_rad"): "0: use the azimuth of the field given in "
    "`about`; NaN: do not",
    ("update_magnetometer_reading", "at_1"): "the same for its horizontal strength and its "
    "vertical component",
    ("update_magnetometer_about", "value"): "T, body at the end of the step: calibrated field",
    ("update_revisit_reading", "rad"): "0 where a site is read, else NaN",
    ("update_revisit_about", "value"): "0 to 2: T, body: mean field; 3: rad, sigma of its azimuth; "
    "4 to 7: 1 for the site, 0 for the others",
    **{("state", f"memory_0_0_travel_{k}"): text for k, text in _LEARNED.items()},
    **{("state", f"memory_2_rest_{k}"): text for k, text in _GATE.items()},
}
"""Comments on the fields of the exported library, in addition to those of the model."""
FIELDS_OF_GATE = {
    **{("state", f"memory_3_0_magnetometer_{k}"): text for k, text in _LEARNED.items()},
    **{("state", f"memory_4_magnetometer_{k}"): text for k, text in _GATE.items()},
    ("state", "memory_4_magnetometer_residual"): "innovations of the last ones",
    ("state", "memory_4_magnetometer_known"): "which of them are there",
}
"""The same of a filter that refuses a disturbed field."""


class BoardInput(NamedTuple):
    """Input of a step: n increments, with rest flag and uncertainty of missing samples."""

    dt_s: Any  # (n,)
    theta_b: Any  # (n, 3) rad, rotation vector of each interval
    dv_b: Any  # (n, 3) m/s
    still: Any  # () as in `model.Block`
    lost_turn: Any  # (3,) rad
    lost_dv: Any  # () m/s


def _of_increments(inner: Callable[..., PyTree], x: model.MargState, u: BoardInput) -> PyTree:
    """Function of state and block, of the block of these increments."""
    field = jnp.full(jnp.shape(u.theta_b), jnp.nan)
    integrals, _ = model.of_block(model.Samples(u.dt_s, u.theta_b, u.dv_b, field))
    return inner(x, model.Block(integrals, u.still, u.lost_turn, u.lost_dv))


def model_on_board(parameters: MargReplay) -> Model:
    """Model of `model_of`, with a motion that takes `BoardInput`."""
    known = model.model_of(parameters)
    parts = known.motion.step, known.motion.noise, known.motion.linear
    step, noise, linear = (Partial(_of_increments, part) for part in parts)
    return Model(Motion(step, noise, linear), known.sensors)


# --------------------------------------------------------------------------------------- the hand


def simulated_hand(parameters: MargReplay, seed: int, run: int) -> tuple[Dataset, model.MargState]:
    """Simulated log of a unit turned and swung by hand, and the truth at each sample.

    Each run has its own motion and errors. Samples are means over the intervals that they end.
    Errors have the sizes that the parameters state: biases uniform within plus or minus sigma,
    gains and noises normal.
    """
    p, rng, dt = parameters, np.random.default_rng((seed, run)), 1.0 / RATE_HZ
    time = np.arange(round(SECONDS * RATE_HZ) + 1) * dt
    moving = 0.5 - 0.5 * np.cos(np.pi * np.clip((time - STILL_S) / (BEGUN_S - STILL_S), 0.0, 1.0))
    hertz, phase = rng.uniform(0.05, 0.5, (3, 3)), rng.uniform(0.0, 2.0 * np.pi, (3, 3))
    angle = np.sum(np.sin(2.0 * np.pi * hertz * time[:, None, None] + phase), axis=1)
    q_nb = SciRotation.from_euler("ZYX", 0.5 * moving[:, None] * angle)
    p_n = 0.1 * moving[:, None] * np.sin(2.0 * np.pi * rng.uniform(0.3, 1.0, 3) * time[:, None])
    v_n = np.gradient(p_n, dt, axis=0)

    bias = rng.uniform(-1.0, 1.0, 3) * p.gyro.bias
    accel_bias = rng.uniform(-1.0, 1.0, 3) * p.accelerometer.bias
    gain = p.gyro.gain * rng.standard_normal((3, 3))

    def noise(size: float) -> np.ndarray:
        return size * rng.standard_normal((len(time) - 1, 3))

    true = (q_nb[:-1].inv() * q_nb[1:]).as_rotvec() / dt
    read = (true + bias) @ np.linalg.inv(np.eye(3) + gain).T
    push = np.diff(v_n, axis=0) / dt - np.array([0.0, 0.0, p.accelerometer.gravity])
    middle = q_nb[:-1] * SciRotation.from_rotvec(0.5 * true * dt)
    near = sum((time[1:] >= a) & (time[1:] < b) for a, b in MAGNET_S)
    around = FIELD_N + np.asarray(near)[:, None] * MAGNET_N
    field = q_nb[1:].inv().apply(around) + noise(SHAKE * p.magnetometer.noise)
    raw = field @ np.linalg.inv(np.array(p.magnetometer.matrix)).T + p.magnetometer.offset
    gyro = read + noise(p.gyro.noise / np.sqrt(dt))
    accel = middle.inv().apply(push) + accel_bias + noise(p.accelerometer.noise / np.sqrt(dt))
    time_ns = np.round(time * 1e9).astype(np.int64)

    def rows(values: np.ndarray) -> np.ndarray:  # the first sample is not used
        return np.concatenate([values[:1], values])

    imu = ImuTable(time_ns, rows(gyro), rows(accel), "rate")
    log = Dataset(name="hand", imu=imu, mag=MagTable(time_ns, rows(raw)))
    q = Rotation(np.roll(q_nb.as_quat(), 1, axis=-1))
    gravity = p.accelerometer.gravity
    same = bias, gain, accel_bias, 0.0, FIELD_N[[0, 2]], np.zeros(model.SITES), gravity
    each = (jnp.broadcast_to(jnp.asarray(x), (len(time), *np.shape(x))) for x in same)
    return log, model.MargState(q, jnp.asarray(v_n), jnp.asarray(p_n), *each)


def case_of(parameters: MargReplay, log: Dataset, truth: model.MargState) -> Case:
    """Inputs and measurements of the embedded filter, and the truth at the ends of its steps."""
    made: PreparedMargLog = prepare(log, parameters)
    world, samples = made.world, made.samples
    u = BoardInput(samples.dt_s, samples.theta, samples.dv, *world.u[1:])
    at_ends = jax.tree_util.tree_map(lambda a: jnp.asarray(a)[made.rows], truth)
    return Case(world.start, u, world.y, world.aux, at_ends)


def export_problem(parameters: MargReplay, seed: int) -> Problem:
    """Problem of `robins export`: the filter on several simulated logs.

    Raises:
        ValueError: the simulated logs cannot be prepared with these parameters.
    """
    cases = [case_of(parameters, *simulated_hand(parameters, seed, run)) for run in range(RUNS)]
    every = jax.tree_util.tree_map(lambda *a: jnp.stack([jnp.asarray(x) for x in a]), *cases)
    known = model_on_board(parameters)

    def simulate(run: Array) -> Case:
        return jax.tree_util.tree_map(lambda a: a[run], every)

    end_s = np.cumsum(np.sum(np.asarray(every.u.dt_s)[0], axis=1))
    return Problem(
        epoch_s=end_s,
        blocks=(*model.BLOCKS[:2], PLACE, *model.BLOCKS[2:]),
        sensors={name: model.SENSORS[name] for name in known.dims},
        simulate=simulate,
        contenders={CAUSAL: Contender(one_prior(parameters), known)},
        claims=lambda metrics: [],
        count_from=int(np.searchsorted(end_s, COUNTED_S - 1e-9)),
        fields=FIELDS | (FIELDS_OF_GATE if parameters.use_magnetometer == "undisturbed" else {}),
    )
