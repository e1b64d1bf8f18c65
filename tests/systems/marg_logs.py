"""Nine-axis logs of a simulated hand, with their true attitude: what the MARG tests share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from robins.dataset import AttitudeTable, Dataset, ImuTable, MagTable

GRAVITY = 9.81
FIELD_NED = np.array([18e-6, 0.0, 44e-6])
RATE_HZ = 100.0


def scalar_first(rotation: Rotation) -> np.ndarray:
    """(..., 4) quaternions as robins keeps them."""
    return np.roll(rotation.as_quat(), 1, axis=-1)


def log_of(
    q_nb: Rotation,
    p_n: np.ndarray,
    *,
    gyro_bias=(0.0, 0.0, 0.0),
    gyro_gain=None,
    gyro_noise=0.0,
    accel_noise=0.0,
    field_noise=0.0,
    seed=0,
) -> Dataset:
    """A log of samples that are means over the interval they end, as MEMS units give them.

    Args:
        q_nb: N + 1 true attitudes.
        p_n: (N + 1, 3) m, places, NED.
        gyro_bias: (3,) rad/s and
        gyro_gain: (3, 3), so that true rate = (I + gain) read - bias.
        gyro_noise: rad/s, of a sample.
        accel_noise: m/s^2, of a sample.
        field_noise: T, of a sample.
        seed: of the noise.
    """
    rng = np.random.default_rng(seed)
    dt = 1.0 / RATE_HZ
    true = (q_nb[:-1].inv() * q_nb[1:]).as_rotvec() / dt
    gain = np.eye(3) if gyro_gain is None else np.eye(3) + gyro_gain
    gyro = (true + np.asarray(gyro_bias)) @ np.linalg.inv(gain).T
    gyro = gyro + gyro_noise * rng.standard_normal(gyro.shape)
    v_n = np.gradient(p_n, dt, axis=0)
    push = np.diff(v_n, axis=0) / dt - np.array([0.0, 0.0, GRAVITY])
    middle = q_nb[:-1] * Rotation.from_rotvec(0.5 * true * dt)
    accel = middle.inv().apply(push) + accel_noise * rng.standard_normal(gyro.shape)
    field = q_nb[1:].inv().apply(FIELD_NED) + field_noise * rng.standard_normal(gyro.shape)
    # the first row belongs to an interval before the log; nothing is made of it
    first = lambda rows: np.concatenate([rows[:1], rows])  # noqa: E731
    time_ns = np.round(np.arange(len(true) + 1) * dt * 1e9).astype(np.int64)
    return Dataset(
        name="hand",
        imu=ImuTable(time_ns, first(gyro), first(accel), "rate"),
        mag=MagTable(time_ns, first(field)),
        attitude=AttitudeTable(time_ns, scalar_first(q_nb)),
    )


def hand(seconds: float = 60.0, seed: int = 0) -> tuple[Rotation, np.ndarray]:
    """Attitudes and places: rest for 8 s, then a hand that turns and swings without a stop."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(seconds * RATE_HZ) + 1) / RATE_HZ
    moving = 0.5 - 0.5 * np.cos(np.pi * np.clip((time - 8.0) / 2.0, 0.0, 1.0))
    hertz, phase = rng.uniform(0.05, 0.6, (4, 3)), rng.uniform(0.0, 2.0 * np.pi, (4, 3))
    angle = np.sum(np.sin(2.0 * np.pi * hertz * time[:, None, None] + phase), axis=1)
    q = Rotation.from_euler("ZYX", 0.6 * moving[:, None] * angle[:, [0, 1, 2]])
    swing = np.sin(2.0 * np.pi * rng.uniform(0.3, 1.2, 3) * time[:, None])
    return q, 0.1 * moving[:, None] * swing


def with_imu(dataset: Dataset, **columns) -> Dataset:
    """The log with other columns of inertial samples."""
    return replace(dataset, imu=replace(dataset.imu, **columns))


def with_field(dataset: Dataset, field_t: np.ndarray) -> Dataset:
    """The log with other readings of the field."""
    assert dataset.mag is not None
    return replace(dataset, mag=replace(dataset.mag, field_t=field_t))
