"""A SINS and the truth as two mechanisations in continuous time, in ENU/RFU, NumPy alone.

Both are integrated by the same RK4 steps; what the SINS says at the stages of each step is kept, so
that an error model can be integrated by the same steps and compared with their difference, as it
is or with mistakes.
"""

from contextlib import nullcontext
from typing import NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from robins import rotation
from robins.systems.airship import error_model

A_M, FLATTENING, GM, OMEGA_E = 6378137.0, 1.0 / 298.257223563, 3.986004418e14, 7.292115e-5
E2 = FLATTENING * (2.0 - FLATTENING)
B_M = A_M * (1.0 - FLATTENING)

DURATION_S, DT_S = 20.0, 0.02
GYRO_ERROR = np.array([2e-4, -2.5e-4, 1.8e-4])  # rad/s, 77 deg/h long
ACCEL_ERROR = np.array([0.03, -0.04, 0.033])  # m/s^2, 0.06 long
VELOCITY_ERROR = np.array([-3.0, -2.0, 1.0])  # m/s
METRES_ERROR = np.array([1300.0, 600.0, 300.0])  # east, north, up
MISALIGNMENTS_DEG = np.array([[0.01, 0.02, 0.03], [5.0, -4.0, 20.0], [30.0, -25.0, 120.0]])

SLIPS = {
    "last-cross-term": "+ (2 w_ie + w_en) x dv with the true rates, where their errors belong: it "
    "all but cancels the term before it",
    "swapped-rows": "rows 7 and 8 are the rates of dlat, dlon; the state (38) has dlon, dlat",
    "omitted-cross-term": "the last cross product left out, being of second order",
    "gyro-sign": "the error of the gyro taken as true minus measured",
    "small-angle": "C_cn = I - [phi x], and phi' = w_nc",
}
"""What may be got wrong in eq. (40) of the airship's paper; the first two are as printed."""

AS_PRINTED = ("last-cross-term", "swapped-rows")


class State(NamedTuple):
    """One or many, along leading axes."""

    C: np.ndarray  # (..., 3, 3) body to navigation frame
    v: np.ndarray  # (..., 3) m/s
    lon: np.ndarray  # rad
    lat: np.ndarray  # rad
    alt: np.ndarray  # m


class Stages(NamedTuple):
    """Output of the SINS, (steps, 4, ...): at the stages of each RK4 step."""

    C: np.ndarray
    v: np.ndarray
    lat: np.ndarray
    alt: np.ndarray
    f_b: np.ndarray


class Flown(NamedTuple):
    """Two mechanisations from start to end."""

    start: np.ndarray  # (B, 9) error state, computed minus true
    end: np.ndarray  # (B, 9)
    stages: Stages  # of the SINS, leading axis B
    sins: State  # at the end
    truth: State


def axis_rotation(axis, angle):
    """Passive: the components of a fixed vector in a frame that was turned by the angle."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.eye(3)
    R[i, i] = R[j, j] = np.cos(angle)
    R[i, j], R[j, i] = np.sin(angle), -np.sin(angle)
    return R


def platform(phi):
    """C_cn of the three angles, as a product."""
    return axis_rotation(1, phi[1]) @ axis_rotation(0, phi[0]) @ axis_rotation(2, phi[2])


def platform_angles(C):
    """The three angles of C_cn."""
    return np.stack(
        [
            np.arcsin(C[..., 1, 2]),
            np.arctan2(-C[..., 0, 2], C[..., 2, 2]),
            np.arctan2(-C[..., 1, 0], C[..., 1, 1]),
        ],
        -1,
    )


def dcm(pitch, roll, heading):
    """Body RFU to ENU, heading clockwise from north."""
    return axis_rotation(2, heading) @ axis_rotation(0, -pitch) @ axis_rotation(1, -roll)


def euler(C):
    """Pitch, roll, heading of a matrix."""
    return np.stack(
        [
            np.arcsin(C[..., 2, 1]),
            np.arctan2(-C[..., 2, 0], C[..., 2, 2]),
            np.arctan2(C[..., 0, 1], C[..., 1, 1]),
        ],
        -1,
    )


def skew(w):
    o = np.zeros(w.shape[:-1])
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    return np.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(*w.shape, 3)


def radii(lat):
    w = np.sqrt(1.0 - E2 * np.sin(lat) ** 2)
    return A_M * (1.0 - E2) / w**3, A_M / w


def gravity(lat, alt):
    """Normal gravity in ENU by the gradient of its closed form (Heiskanen & Moritz 1967, 2-7)."""
    N = radii(lat)[1]
    p, z = (N + alt) * np.cos(lat), ((1.0 - E2) * N + alt) * np.sin(lat)
    E = np.sqrt(A_M**2 - B_M**2)
    rest = p**2 + z**2 - E**2
    u = np.sqrt(0.5 * (rest + np.sqrt(rest**2 + 4.0 * (E * z) ** 2)))
    v = np.hypot(u, E)
    sin_b, cos_b = z / u, p / v  # of the reduced latitude

    def q_of(u):
        return 0.5 * ((1.0 + 3.0 * (u / E) ** 2) * np.arctan2(E, u) - 3.0 * u / E)

    q = q_of(u) / q_of(B_M)
    q_prime = (3.0 * (1.0 + (u / E) ** 2) * (1.0 - u / E * np.arctan2(E, u)) - 1.0) / q_of(B_M)
    spin = (OMEGA_E * A_M) ** 2
    w = np.sqrt(u**2 + (E * sin_b) ** 2) / v
    along_u = -(GM / v**2 + spin * E / v**2 * q_prime * (0.5 * sin_b**2 - 1.0 / 6.0)) / w
    along_u = along_u + OMEGA_E**2 * u * cos_b**2 / w
    along_b = (spin / v * q - OMEGA_E**2 * v) * sin_b * cos_b / w
    across = u / (w * v) * cos_b * along_u - sin_b / w * along_b
    axial = sin_b / w * along_u + u / (w * v) * cos_b * along_b
    north = axial * np.cos(lat) - across * np.sin(lat)
    up = axial * np.sin(lat) + across * np.cos(lat)
    return np.stack([np.zeros_like(north), north, up], -1)


def rates(s: State):
    """Earth rate, transport rate [rad/s]."""
    M, N = radii(s.lat)
    vE, vN = s.v[..., 0], s.v[..., 1]
    ie = OMEGA_E * np.stack([np.zeros_like(s.lat), np.cos(s.lat), np.sin(s.lat)], -1)
    en = [-vN / (M + s.alt), vE / (N + s.alt), vE * np.tan(s.lat) / (N + s.alt)]
    return ie, np.stack(en, -1)


def derivative(s: State, omega_ib_b, f_b) -> State:
    """The navigation equations."""
    ie, en = rates(s)
    M, N = radii(s.lat)
    return State(
        s.C @ skew(omega_ib_b) - skew(ie + en) @ s.C,
        (s.C @ f_b[..., None])[..., 0] - np.cross(2.0 * ie + en, s.v) + gravity(s.lat, s.alt),
        s.v[..., 0] / ((N + s.alt) * np.cos(s.lat)),
        s.v[..., 1] / (M + s.alt),
        s.v[..., 2],
    )


def true_sensors(t):
    """Turn rate [rad/s] and specific force [m/s^2] in body axes of a swaying airship."""
    omega = np.array([0.02 * np.sin(0.7 * t), 0.03 * np.cos(0.5 * t), 0.05 * np.sin(0.3 * t + 1)])
    f = np.array([0.5 * np.sin(0.4 * t), 0.8 * np.cos(0.6 * t), 9.75 + 0.3 * np.sin(0.9 * t)])
    return omega, f


def moved(s: State, k: State, dt) -> State:
    return State(*(a + dt * b for a, b in zip(s, k, strict=True)))


def fly(phi0, dt=DT_S, duration=DURATION_S, gyro=GYRO_ERROR, accel=ACCEL_ERROR) -> Flown:
    """From the errors of this module and the misalignments phi0 (B, 3) [rad]."""
    C = np.stack([np.eye(3)] + [platform(phi) for phi in phi0])  # the truth first
    C = C @ dcm(np.radians(3.0), np.radians(-2.0), np.radians(80.0))
    lat0, alt0 = np.radians(34.246), 20e3
    M, N = radii(lat0)
    off = np.ones(len(C))
    off[0] = 0.0
    s = State(
        C,
        np.array([20.0, 1.0, 0.1]) + off[:, None] * VELOCITY_ERROR,
        np.radians(108.997) + off * METRES_ERROR[0] / ((N + alt0) * np.cos(lat0)),
        lat0 + off * METRES_ERROR[1] / (M + alt0),
        alt0 + off * METRES_ERROR[2],
    )
    start, kept = difference(s), []
    for step in range(round(duration / dt)):
        ks, said = [], []
        for at in (0.0, 0.5, 0.5, 1.0):
            x = moved(s, ks[-1], at * dt) if ks else s
            omega, f = true_sensors((step + at) * dt)
            f = f + off[:, None] * accel
            ks.append(derivative(x, omega + off[:, None] * gyro, f))
            said.append([a[1:] for a in (x.C, x.v, x.lat, x.alt, f)])
        kept.append([np.stack(a) for a in zip(*said, strict=True)])
        for k, weight in zip(ks, (1.0, 2.0, 2.0, 1.0), strict=True):
            s = moved(s, k, weight * dt / 6.0)
    stages = Stages(*(np.moveaxis(np.stack(a), 2, 0) for a in zip(*kept, strict=True)))
    return Flown(
        start, difference(s), stages, State(*(a[1:] for a in s)), State(*(a[0] for a in s))
    )


def difference(s: State) -> np.ndarray:
    """Error states of all but the first, which is the truth."""
    phi = platform_angles(s.C[1:] @ s.C[0].T)
    place = [(a[1:] - a[0])[:, None] for a in (s.lon, s.lat, s.alt)]
    return np.concatenate([phi, s.v[1:] - s.v[0], *place], -1)


def slipped_rate(x, sins, errors, slips):
    """The right-hand side of the error model, with mistakes of `SLIPS`."""
    if "gyro-sign" in slips:
        errors = -errors[0], errors[1]
    small = nullcontext()
    if "small-angle" in slips:
        matrices = {
            "dcm_cn": lambda phi: jnp.eye(3) - rotation.skew(phi),
            "rate_matrix_inverse": lambda phi: jnp.eye(3),
        }
        small = mock.patch.multiple(error_model, **matrices)
    with small:
        rate = error_model.error_rate(x, sins, errors)
    dv, lat, alt = x[3:6], x[error_model.LAT], x[error_model.ALT]
    here = error_model.surroundings(sins.lat, sins.alt, sins.v_n)[1]
    true = error_model.surroundings(sins.lat - lat, sins.alt - alt, sins.v_n - dv)[1]
    if "last-cross-term" in slips:
        rate = rate.at[3:6].add(jnp.cross(2.0 * true - here, dv))
    if "omitted-cross-term" in slips:
        rate = rate.at[3:6].add(jnp.cross(true - here, dv))
    return rate[jnp.array([0, 1, 2, 3, 4, 5, 7, 6, 8])] if "swapped-rows" in slips else rate


@jax.jit(static_argnames="slips")
def model_end(flown: Flown, slips=(), dt=DT_S, gyro=GYRO_ERROR, accel=ACCEL_ERROR):
    """End of the error model, (B, 9), from where the mechanisations begin, by their steps."""
    errors = gyro, accel

    def stage(carry, now):
        x, k, total = carry
        at, weight, said = now
        sins = error_model.Sins(said.C, said.v, said.lat, said.alt, said.C @ said.f_b)
        k = slipped_rate(x + at * dt * k, sins, errors, slips)
        return (x, k, total + weight * k), None

    def one_step(x, said):
        rule = jnp.array([0.0, 0.5, 0.5, 1.0]), jnp.array([1.0, 2.0, 2.0, 1.0]) / 6.0
        start = x, jnp.zeros(9), jnp.zeros(9)
        _, _, mean = jax.lax.scan(stage, start, (*rule, said))[0]
        return x + dt * mean, None

    def one(x, stages):
        return jax.lax.scan(one_step, x, stages)[0]

    return jax.vmap(one)(flown.start, jax.tree.map(jnp.asarray, flown.stages))


def apart(flown: Flown, found) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance in phi [rad], dv [m/s] and position [m], each (B,): lengths."""
    off = np.asarray(found) - flown.end
    off[:, :3] = np.remainder(off[:, :3] + np.pi, 2.0 * np.pi) - np.pi
    M, N = radii(flown.truth.lat)
    scale = np.array([(N + flown.truth.alt) * np.cos(flown.truth.lat), M + flown.truth.alt, 1.0])
    off[:, 6:] *= scale
    return tuple(np.linalg.norm(off[:, 3 * i : 3 * i + 3], axis=1) for i in range(3))
