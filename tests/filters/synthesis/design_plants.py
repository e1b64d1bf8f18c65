"""Plants whose designs are tabulated in the specification, and random ones."""

import numpy as np
import scipy.linalg

from robins.filters.synthesis import Plant, current_form, plant


def two_states() -> Plant:
    """Sections 2.4 and 3.2: n drives the state that is not measured."""
    return plant(
        A=[[0.9, 0.2], [-0.1, 0.8]],
        Bw=[[0.3, 0.0, 0.0], [0.0, 0.3, 0.0]],
        Bn=[[0.0], [0.4]],
        C=[[1.0, 0.0]],
        Dw=[[0.0, 0.0, 0.5]],
    )


def attitude_axis(unit: float = 1.0, axes: int = 1, rate_rad_s=(0.0, 0.0, 0.0)) -> Plant:
    """Section 3: attitude and gyro bias, `unit` for one arcsecond, n an error of the rate."""
    dt_s, arw, rrw, star = 0.5, 1.2, 5e-3, 10.0
    Q = [
        [arw**2 * dt_s + rrw**2 * dt_s**3 / 3.0, -(rrw**2) * dt_s**2 / 2.0],
        [-(rrw**2) * dt_s**2 / 2.0, rrw**2 * dt_s],
    ]
    eye = np.eye(axes)
    x, y, z = rate_rad_s
    turn = scipy.linalg.expm(-dt_s * np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]))
    return current_form(
        A=np.block([[turn if axes == 3 else eye, -dt_s * eye], [0.0 * eye, eye]]),
        Bw=np.kron(np.linalg.cholesky(Q) * unit, eye),
        Bn=np.kron([[dt_s], [0.0]], eye),
        C=np.kron([[1.0, 0.0]], eye),
        Dv=star * unit * eye,
        L=np.kron([[1.0, 0.0]], eye),
    )


def quaternion(rate_rad_s: float = 0.1225, b: float = 0.5, Bn=None, euler: bool = False) -> Plant:
    """Section 2.7, sound placement: sw 1, ss 3; n isotropic unless Bn is given."""
    x, y, z = rate_rad_s * np.array([2.0, -1.0, 2.0]) / 3.0
    Omega = np.array([[0.0, -x, -y, -z], [x, 0.0, z, -y], [y, -z, 0.0, x], [z, y, -x, 0.0]])
    eye, zero = np.eye(4), np.zeros((4, 4))
    return plant(
        A=eye + Omega / 2.0 if euler else scipy.linalg.expm(Omega / 2.0),
        Bw=np.hstack([eye, zero]),
        Bn=b * eye if Bn is None else Bn,
        C=eye,
        Dw=np.hstack([zero, 3.0 * eye]),
    )


def kinematics(q) -> np.ndarray:
    """(4, 3) Xi(q): qdot = Xi(q) w / 2."""
    q0, q1, q2, q3 = q
    return np.array([[-q1, -q2, -q3], [q0, -q3, q2], [q3, q0, -q1], [-q2, q1, q0]])


def stable_system(rng: np.random.Generator, n: int, q: int, r: int, radius: float):
    """A (n, n) of this spectral radius, B (n, q), C (r, n)."""
    A = rng.normal(size=(n, n))
    A *= radius / np.max(np.abs(np.linalg.eigvals(A)))
    return A, rng.normal(size=(n, q)), rng.normal(size=(r, n))
