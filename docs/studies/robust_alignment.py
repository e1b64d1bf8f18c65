"""One filter against flexure, outliers, gyro noise and drift, without knowledge of them.

    python docs/studies/robust_alignment.py [--runs 100] [--seed 0]

The scenarios A to E of the study "velocity-attitude": A nominal, B flexure and outliers, C gyro
noise and a step of drift, D both, E a mounting error of 0.3 deg. All-axis RMS errors of attitude
are printed, pooled over the runs from 30 s on, of

- Kalman filters of the patent's twelve states, open loop, plain and told of the trouble: "told R"
  of that in B, "told Q" of that in C, "told both";
- filters of the product model, closed loop, without knowledge of any, with unknown mounting;
- an informed product filter, which is given what happens, how strong it is and when: flexure states
  only where there is flexure, the gyro noise in its window, the drift at its step, Huber's rule
  where there are outliers.

"adaptive" is the one configuration: the same numbers in every scenario.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jax.tree_util import Partial

from robins.campaign.monte_carlo import record, worlds
from robins.filters import Model, Motion, kalman
from robins.filters.rules import huber
from robins.scenario import load
from robins.systems import transfer_alignment
from robins.systems.study import Contender, Problem
from robins.systems.transfer_alignment.product.parameters import PairAssumptions
from robins.systems.transfer_alignment.product.study import product_contender, reported
from robins.systems.transfer_alignment.velocity_attitude.study import STUDY, VelocityAttitude

SCENARIOS = Path(transfer_alignment.__file__).parent / "scenarios"
PICTURE = Path(__file__).resolve().parents[1] / "pictures" / "robust_alignment.png"
MINUTE = np.deg2rad(1.0) / 60.0
NAMES = "abcde"
PATENT = ("kf", "kf-told-r", "kf-told-q", "kf-told-both", "adaptive-hinf")
UNTOLD = ("product", "product-flexure", "adaptive")
INFORMED = "informed product"
# rows of the study "velocity-attitude": attitude, horizontal velocity, gyro and accelerometer bias
BLOCKS = ("attitude", "velocity", "gyro_bias", "accel_bias")
ROWS = [0, 1, 2, 3, 4, 6, 7, 8, 9, 10]
PLAIN, WEIGHED = kalman(), kalman(rules=(huber(0.99),))


# ------------------------------------------------------------------------ the informed filter


class Told(NamedTuple):
    """Input of a step whose noise is known to be other than the stated one."""

    u: Any
    gyro: Any  # () factor of the gyro noise
    jump: Any  # (3,) rad/s, sigma of a step of the drift


def told_step(motion: Motion, x, told: Told):
    return motion.step(x, told.u)


def told_linear(motion: Motion, x, told: Told):
    assert motion.linear is not None
    new, F, noise = motion.linear(x, told.u)
    louder = jnp.concatenate([told.gyro * noise[:, :3], noise[:, 3:]], 1)
    jump = jnp.zeros((len(noise), 3)).at[9:12].set(jnp.diag(told.jump))
    return new, F, jnp.concatenate([louder, jump], 1)


def told_noise(motion: Motion, x, told: Told):
    return told_linear(motion, x, told)[2]


def of_pair(case, world):
    return case(world.pair)


def told_case(case, gyro, jump, world):
    given = case(world.pair)
    return given._replace(u=Told(given.u, gyro, jump))


def informed(given: VelocityAttitude, epoch_s: np.ndarray) -> Contender:
    """The product filter that knows it all, but for what is random."""
    d, structure = given.disturbance, given.flexure
    flexes = any(structure.sigma)
    believed = PairAssumptions(flexure=structure if flexes else None)
    base = product_contender(given, "product", believed)
    begin = epoch_s - epoch_s[0] + 1e-9
    gyro, jump = np.ones(len(epoch_s)), np.zeros((len(epoch_s), 3))
    if d.gyro_noise_window is not None:
        window = (begin >= d.gyro_noise_window.begin) & (begin < d.gyro_noise_window.end)
        gyro[window] = d.gyro_noise_factor
    if d.drift_step_time is not None:
        jump[np.searchsorted(begin, d.drift_step_time)] = np.abs(d.drift_step)
    motion = base.model.motion
    told = Motion(
        *(Partial(told_part, motion) for told_part in (told_step, told_noise, told_linear))
    )
    return replace(
        own(base),
        filter=WEIGHED if d.outlier_share else PLAIN,
        model=Model(told, base.model.sensors),
        case=Partial(told_case, base.case, jnp.asarray(gyro), jnp.asarray(jump)),
    )


def own(contender: Contender) -> Contender:
    """A contender of the product model in this study's worlds, reporting what the others do."""
    assert contender.reported is not None
    rows = reported(contender.reported.shape[1], BLOCKS, "ENU")[ROWS]
    return replace(contender, case=Partial(of_pair, contender.case), reported=rows)


# ------------------------------------------------------------------------------- the table


def problem_of(name: str, seed: int) -> tuple[VelocityAttitude, Problem]:
    """A scenario with all filters of the table."""
    given = load(VelocityAttitude, SCENARIOS / f"{name}.toml")
    problem = STUDY.problem(given, PATENT, seed)
    more = {name: own(product_contender(given, name)) for name in UNTOLD}
    more[INFORMED] = informed(given, problem.epoch_s)
    return given, replace(problem, contenders={**problem.contenders, **more})


def errors(problem: Problem, names, runs: int, chunk: int) -> dict[str, np.ndarray]:
    """(runs, E, 3) rad, attitude errors east, north, up of each filter on the same worlds."""
    found: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for batch, count in worlds(problem, runs, chunk):
        for name in names:
            found[name].append(record(problem, name, batch, count)["error"][..., :3])
    return {name: np.concatenate(parts) for name, parts in found.items()}


def rms(error: np.ndarray, axis=None) -> np.ndarray:
    return np.sqrt(np.mean(error**2, axis=axis)) / MINUTE


def draw(epoch_s, table, in_d) -> None:
    figure, (bars, time) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    shown = {
        "kf": ("patent's states, plain KF", "C7"),
        "best told": ("patent's states, best told KF", "C0"),
        "adaptive": ("adaptive, told nothing", "C2"),
        INFORMED: ("product, informed", "C1"),
    }
    place = np.arange(len(NAMES))
    for i, (name, (label, colour)) in enumerate(shown.items()):
        bars.bar(place + (i - 1.5) * 0.2, table[name], 0.19, color=colour, label=label)
    bars.set_xticks(place, [n.upper() for n in NAMES])
    bars.set(yscale="log", ylabel="attitude RMS [arcmin]", title="from 30 s on, by scenario")
    bars.set_yticks(ticks := [0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0], [f"{t:g}" for t in ticks])
    bars.minorticks_off()
    bars.legend(fontsize=8, loc="upper left")
    bars.set_ylim(0.1, 150.0)
    time.axvspan(40.0, 80.0, color="0.9", label="gyro noise 20 times")
    time.axvline(50.0, color="k", ls=":", lw=1, label="step of drift")
    for name in ("kf-told-both", "adaptive", INFORMED):
        colour = shown.get(name, shown["best told"])[1]
        time.plot(epoch_s, rms(in_d[name], axis=(0, 2)), color=colour, lw=1.2, label=name)
    time.set(xlabel="time [s]", ylabel="attitude RMS [arcmin]", title="scenario D, over time")
    time.set(yscale="log", ylim=(0.5, 60.0))
    time.legend(fontsize=8)
    figure.savefig(PICTURE, dpi=110)
    print(f"wrote {PICTURE.relative_to(PICTURE.parents[2])}")


def main() -> None:
    parser = argparse.ArgumentParser(description="One alignment filter for every kind of trouble.")
    parser.add_argument("--runs", type=int, default=100, help="runs a scenario")
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers")
    parser.add_argument("--chunk", type=int, default=25, help="runs at a time")
    arguments = parser.parse_args()
    names = (*PATENT, *UNTOLD, INFORMED)
    table: dict[str, list[float]] = {name: [] for name in names}
    in_d: dict[str, np.ndarray] = {}
    epoch_s = np.zeros(0)
    for scenario in NAMES:
        _, problem = problem_of(scenario, arguments.seed)
        epoch_s = problem.epoch_s
        found = errors(problem, names, arguments.runs, arguments.chunk)
        for name, error in found.items():
            table.setdefault(name, []).append(float(rms(error[:, problem.count_from :])))
            print(f"{scenario.upper()} {name:<28} {table[name][-1]:7.2f}", flush=True)
        if scenario == "d":
            in_d = found
    best = np.min([table[name] for name in PATENT if name.startswith("kf")], axis=0)
    table["best told"] = best.tolist()
    print(f"\nRMS of attitude, all axes [arcmin], {arguments.runs} runs")
    print(f"{'':<28}" + "".join(f"{n.upper():>8}" for n in NAMES))
    for name, row in table.items():
        print(f"{name:<28}" + "".join(f"{value:8.2f}" for value in row))
    for name in ("best told", INFORMED):
        ratio = np.divide(table["adaptive"], table[name])
        print(f"{'adaptive / ' + name:<28}" + "".join(f"{value:8.2f}" for value in ratio))
    draw(epoch_s, table, in_d)


if __name__ == "__main__":
    plt.switch_backend("agg")
    main()
