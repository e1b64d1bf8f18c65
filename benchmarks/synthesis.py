"""Filter design by LMI: a program kept against one built anew, and against a Riccati equation.

Three plants of attitude determination: one axis with its gyro bias, the quaternion, and three axes
with three biases. The peers are the same design with everything built anew, which is how a script
with cvxpy works, and SciPy's solver of the Kalman filter's Riccati equation. Processor time, with
one thread of LAPACK: more only wait for each other at matrices as small as these.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
import warnings
from itertools import count

import numpy as np
import scipy.linalg
from timing import best_of, show

from robins.filters.synthesis import Plant, current_form, plant, programs
from robins.filters.synthesis.lmi import EveryStep, FrozenTimeWarning, observer
from robins.filters.synthesis.riccati import riccati
from robins.filters.synthesis.scaling import balanced

STAR_S, ARW, RRW, STAR = 0.5, 1.2, 5e-3, 10.0  # s; arcsec/sqrt(s); arcsec/s/sqrt(s); arcsec
RATE = np.array([0.02, -0.01, 0.02])  # rad/s


def attitude(axes: int) -> Plant:
    """Attitude [arcsec] and gyro bias [arcsec/s], star sensor at 2 Hz, n an error of the rate."""
    Q = [
        [ARW**2 * STAR_S + RRW**2 * STAR_S**3 / 3, -(RRW**2) * STAR_S**2 / 2],
        [-(RRW**2) * STAR_S**2 / 2, RRW**2 * STAR_S],
    ]
    x, y, z = RATE
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    eye = np.eye(axes)
    turn = scipy.linalg.expm(-STAR_S * cross) if axes == 3 else eye
    return current_form(
        A=np.block([[turn, -STAR_S * eye], [0 * eye, eye]]),
        Bw=np.kron(np.linalg.cholesky(Q), eye),
        Bn=np.kron([[STAR_S], [0.0]], eye),
        C=np.kron([[1.0, 0.0]], eye),
        Dv=STAR * eye,
        L=np.kron([[1.0, 0.0]], eye),
    )


def quaternion() -> Plant:
    """The transition of the quaternion over 1 s, in units of the rotation's noise."""
    x, y, z = RATE
    Omega = np.array([[0.0, -x, -y, -z], [x, 0.0, z, -y], [y, -z, 0.0, x], [z, y, -x, 0.0]])
    eye, zero = np.eye(4), np.zeros((4, 4))
    return plant(
        A=scipy.linalg.expm(Omega / 2),
        Bw=np.hstack([eye, zero]),
        Bn=0.5 * eye,
        C=eye,
        Dw=np.hstack([zero, 3.0 * eye]),
    )


PLANTS = {
    "2 states, axis": (attitude(1), 2.7542),
    "4 states, quaternion": (quaternion(), 1.0),
    "6 states, three axes": (attitude(3), 2.7542),
}


def contenders(given: Plant, gamma: float) -> dict:
    moved = (given._replace(A=given.A * (1.0 - 1e-6 * k)) for k in count())  # no two alike
    scales = balanced(given, gamma)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FrozenTimeWarning)
        each = EveryStep(gamma)

    def kept(form="common"):
        return programs.solve(scales.plant(next(moved)), form, "mixed")

    def anew(form="common"):
        programs.build.cache_clear()
        return kept(form)

    def dare():
        p = next(moved)
        return scipy.linalg.solve_discrete_are(
            p.A.T, p.C.T, p.Bw @ p.Bw.T, p.Dw @ p.Dw.T, s=p.Bw @ p.Dw.T
        )

    return {
        "built anew": anew,
        "kept": kept,
        "slack form, built anew": lambda: anew("slack"),
        "slack form, kept": lambda: kept("slack"),
        "design with its true norms": lambda: observer(next(moved), gamma),
        "every step": lambda: each(next(moved)),
        "Riccati with lambda": lambda: riccati(next(moved), gamma),
        "DARE of SciPy": dare,
    }


def main():
    rates = {}
    for title, (given, gamma) in PLANTS.items():
        tasks = contenders(given, gamma)
        # What is built anew empties the shelf, so it does not take turns with what is kept.
        rebuilt = {k: v for k, v in tasks.items() if "anew" in k}
        others = {k: v for k, v in tasks.items() if "anew" not in k}
        best = best_of(rebuilt, 5, time.process_time) | best_of(others, 15, time.process_time)
        print(title)
        for name, seconds in best.items():
            peer = best.get(name.replace("kept", "built anew")) if "kept" in name else None
            show(f"  {name}", seconds, 1, "design", peer)
        print(f"  a kept design takes {best['kept'] / best['DARE of SciPy']:.1f} DAREs")
        rates[title] = 1.0 / best["every step"]
    print("LMI at every step: " + ", ".join(f"{k} {v:.0f} Hz" for k, v in rates.items()))


if __name__ == "__main__":
    main()
