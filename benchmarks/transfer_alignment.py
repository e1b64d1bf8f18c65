"""Attitude matching in scenario S0: 200 runs of one filter, and one run beside plain NumPy.

Processor time, after compilation. The peer of the filter is the same nine-state Kalman filter in a
textbook's NumPy (covariance form), 400 updates of one run.
"""

import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from timing import best_of, show

import robins.systems
from robins import scenario
from robins.filters import run
from robins.systems.transfer_alignment.attitude_matching import STUDY
from robins.systems.transfer_alignment.attitude_matching.model import ATTITUDE

RUNS, CHUNK = 200, 50
FILTERS = ("kf", "kf-flexure", "hinf-deg")
S0 = Path(robins.systems.__file__).parent / "transfer_alignment" / "scenarios" / "s0.toml"


def numpy_kalman(F, Q, H, R, P, z):
    """Attitude, (T, 3), by the covariance form."""
    x, out = np.zeros(len(P)), []
    for k in range(len(F)):
        x, P = F[k] @ x, F[k] @ P @ F[k].T + Q
        S = H[k] @ P @ H[k].T + R
        K = np.linalg.solve(S, H[k] @ P).T
        x = x + K @ (z[k] - H[k] @ x)
        P = P - K @ H[k] @ P
        out.append(x[:3])
    return np.array(out)


def attitude(step):
    return step.posterior.mean[:3]


def main():
    parameters = scenario.load(STUDY.parameters, S0)
    problem = STUDY.problem(parameters, FILTERS, 0)

    def errors(contender, index):
        case = contender.case(problem.simulate(index))
        found = run(
            contender.filter, contender.model, case.start, case.y, case.u, case.aux, attitude
        )
        return case.truth[:, :3] - found.steps

    def campaign(batch):
        parts = [batch(jnp.arange(k, k + CHUNK)) for k in range(0, RUNS, CHUNK)]
        return np.concatenate([np.asarray(p) for p in parts])

    contenders = {
        name: partial(campaign, jax.jit(jax.vmap(partial(errors, c))))
        for name, c in problem.contenders.items()
    }
    print(f"S0, {RUNS} runs of 400 updates and 2000 steps of the truth, simulated and filtered")
    for name, seconds in best_of(contenders, rounds=3, clock=time.process_time).items():
        verdict = "within" if seconds <= 3.0 else "above"
        print(f"{name:<20}{seconds:8.2f} s, {verdict} the 3 s wanted", flush=True)

    kf = problem.contenders["kf"]
    case = kf.case(jax.jit(problem.simulate)(jnp.asarray(0)))
    F, H, z = (np.asarray(a) for a in (case.u, case.aux[ATTITUDE], case.y[ATTITUDE]))
    G, P0 = np.asarray(kf.model.motion.noise), np.asarray(case.start.covariance)
    R = np.diag(np.asarray(kf.model.sensors[0].noise) ** 2)

    def ours():
        return run(kf.filter, kf.model, case.start, z, case.u, case.aux, attitude).steps

    def peer():
        return numpy_kalman(F, G @ G.T, H, R, P0, z)

    apart = np.max(np.abs(np.asarray(ours()) - peer()))
    if apart > 1e-9:
        raise SystemExit(f"the two filters differ by {apart:.1e} rad")
    best = best_of({"ours": ours, "peer": peer}, clock=time.process_time)
    show("one run, nine states", best["ours"], len(F), "update", best["peer"])
    show("  NumPy, covariance form", best["peer"], len(F), "update")


if __name__ == "__main__":
    main()
