"""A satellite in closed loop over one orbit at 10 Hz: craft, control, gyro, star sensor, filter.

The peer is the same craft and control by SciPy and NumPy (see `spacecraft.py`) with a
multiplicative EKF of six states in NumPy beside it, over some hundred steps.
"""

import jax
import numpy as np
import spacecraft
from timing import best_of, show

from robins import scenario
from robins.campaign import worlds
from robins.filters import run_closed
from robins.sim.attitude_reference import nadir
from robins.sim.orbit import circular_orbit, field_along_orbit
from robins.systems.satellite import SYSTEM

ORBIT_S, DT, PEER_STEPS, BATCH, BATCH_S = 5600.0, 0.1, 300, 24, 300.0
ARCSEC = np.pi / 648000.0


def problem(names, duration_s, runs):
    study = SYSTEM.studies["attitude-loop"]
    text = SYSTEM.scenarios["s1"].read_text()
    settings = (f'duration="{duration_s} s"', 'counted_from="100 s"')
    given = scenario.parse(study.parameters, text, settings, source="s1")
    found = study.problem(given, names, 0)
    ((batch, _),) = worlds(found, runs)
    return found, batch


def skew(v):
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def mekf(steps):
    """Predictions at 10 Hz, updates at 2 Hz, of one attitude that does not matter."""
    P, Q = np.diag([60.0] * 3 + [3.0] * 3) ** 2 * ARCSEC**2, 1e-14 * np.eye(6)
    R, H = np.diag([10.0, 10.0, 40.0]) ** 2 * ARCSEC**2, np.eye(3, 6)
    x, q = np.zeros(6), np.array([1.0, 0.0, 0.0, 0.0])
    for k in range(steps):
        turn = np.array([0.0, -1.1e-4, 0.0]) - DT * x[3:]
        half = 0.5 * turn
        q = q + np.concatenate([[-half @ q[1:]], q[0] * half + np.cross(q[1:], half)])
        q = q / np.linalg.norm(q)
        F = np.eye(6)
        F[:3, :3] -= skew(turn)
        F[:3, 3:] = -DT * np.eye(3)
        P = F @ P @ F.T + Q
        if k % 5 == 4:
            S = H @ P @ H.T + R
            K = np.linalg.solve(S, H @ P).T
            x = x + K @ (1e-5 * np.ones(3))
            I_KH = np.eye(6) - K @ H
            P = I_KH @ P @ I_KH.T + K @ R @ K.T
    return P


def peer():
    orbit = circular_orbit(500e3, np.radians(97.4), 0.3, 0.1, DT * np.arange(PEER_STEPS))
    given = (nadir(orbit), orbit.r_i_m, field_along_orbit(orbit))
    return spacecraft.peer(given, PEER_STEPS), mekf(PEER_STEPS)


def main():
    whole, worlds_of_one = problem(("mekf", "mixed-bias"), ORBIT_S, 1)
    short, many = problem(("mekf",), BATCH_S, BATCH)
    world = jax.tree_util.tree_map(lambda x: x[0], worlds_of_one)

    def keep(step):
        return step.posterior

    def loop(p, name, of):
        c = p.contenders[name]
        it = c.case(of)
        return run_closed(c.filter, c.model, it.start, it.loop, keep).steps

    batch = jax.jit(jax.vmap(lambda of: loop(short, "mekf", of)))
    seconds = best_of(
        {
            "mekf": lambda: loop(whole, "mekf", world),
            "mixed": lambda: loop(whole, "mixed-bias", world),
            "batch": lambda: batch(many),
            "peer": peer,
        }
    )
    beside = seconds["peer"] / PEER_STEPS
    steps = ORBIT_S / DT
    show("SciPy and NumPy, craft, control, MEKF", beside, 1.0, "step")
    show("robins, closed loop, MEKF, one orbit", seconds["mekf"] / steps, 1.0, "step", beside)
    show("robins, closed loop, mixed, one orbit", seconds["mixed"] / steps, 1.0, "step", beside)
    each = seconds["batch"] / BATCH / (BATCH_S / DT)
    show(f"robins, closed loop, MEKF, a batch of {BATCH}", each, 1.0, "step and run", beside)
    print(f"one orbit of {steps:.0f} steps with MEKF: {seconds['mekf']:.2f} s", flush=True)


if __name__ == "__main__":
    main()
