"""One H-infinity filter in three units of angle: with R = I and L = I it is three filters.

python docs/studies/unit_study.py [--runs 200] [picture]

Attitude matching of Gu & Qin (2005), scenario transfer-alignment/s0, gamma = 50. The state, R and L
are written down literally in radians, degrees and arcminutes, with the physical P0 and with P0 = I.
Then the same filter with weights that carry units (R the master's noise, L the attitude, gamma an
angle) in the same three units. RMS over the runs for t >= 15 s; reference figures are those of an
independent prototype.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import robins.systems
from robins import scenario, units
from robins.filters import Filter, kalman, run
from robins.filters.rules.h_infinity import h_infinity, with_gamma
from robins.systems.transfer_alignment.attitude_matching.model import (
    ATTITUDE,
    PHI,
    LinearSystem,
    linear_system,
)
from robins.systems.transfer_alignment.attitude_matching.parameters import AttitudeMatching
from robins.systems.transfer_alignment.attitude_matching.study import (
    ARCMIN,
    central_filter,
    existence,
)
from robins.systems.transfer_alignment.attitude_matching.world import (
    MatchingWorld,
    lay_out,
    simulate,
)

PICTURE = Path(__file__).resolve().parents[1] / "pictures" / "unit_study.png"
PACKAGED = Path(robins.systems.__file__).parent / "transfer_alignment" / "scenarios" / "s0.toml"
S0 = scenario.load(AttitudeMatching, PACKAGED)
COURSE = lay_out(S0)
FROM = int(np.searchsorted(COURSE.epoch_s, S0.settle - 1e-9))
GAMMA = S0.h_infinity.gamma
UNITS = ("rad", "deg", "arcmin")
ATTITUDE_ONLY = kalman(rules=[h_infinity(np.inf, np.eye(9)[:3])])
WEIGHTED_ARCMIN = 75.0  # gamma of the weighted form, 1.05 times its least

# gamma_min; RMS east, north, up [arcmin], None where there is no filter
REFERENCE = {
    ("rad", "physical"): ("0.172", "29.5 29.1 29.3"),
    ("deg", "physical"): ("4.656", "12.5 10.3 10.5"),
    ("arcmin", "physical"): ("100.69", "infeasible"),
    ("rad", "identity"): ("15.71", "39.0 15.3 18.8"),
    ("deg", "identity"): ("15.71", "-"),
    ("arcmin", "identity"): ("15.84", "-"),
}


class Row(NamedTuple):
    """A filter in a unit: state, R = sigma^2 and gamma in it."""

    filter: Filter
    system: LinearSystem
    sigma: float
    gamma: float
    per_rad: float


def physical() -> LinearSystem:
    """The system in radians."""
    return linear_system(S0, len(COURSE.at))


def of(unit: str, P0: str) -> Row:
    """R = I, L = I and gamma = 50 in a unit."""
    system = physical().in_unit(unit)
    if P0 == "identity":
        system = system._replace(sigma=np.ones(9))
    return Row(central_filter(), system, 1.0, GAMMA, float(units.from_si(1.0, unit)))


def weighted(unit: str) -> Row:
    """R = (1 arcmin)^2, L the attitude, gamma an angle: given in a unit."""
    per_rad = float(units.from_si(1.0, unit))
    noise, gamma = S0.master.attitude_noise * per_rad, WEIGHTED_ARCMIN * ARCMIN * per_rad
    return Row(ATTITUDE_ONLY, physical().in_unit(unit), noise, gamma, per_rad)


@jax.jit
def worlds(runs):
    return jax.vmap(lambda index: simulate(S0, COURSE, 0, index))(runs)


def rms_over_time(row: Row, world: MatchingWorld) -> np.ndarray:
    """(E, 3) arcmin, over the runs."""
    model, (u, aux) = row.system.model(row.sigma), row.system.inputs()
    filter_, start = with_gamma(row.filter, row.gamma), row.system.start()

    def one(z):
        return run(filter_, model, start, z, u, aux, keep=attitude).steps

    estimate = jax.vmap(one)(world.measured * row.per_rad) / row.per_rad
    return np.sqrt(np.mean((np.asarray(world.state[..., PHI] - estimate) / ARCMIN) ** 2, axis=0))


def attitude(step):
    return step.posterior.mean[:3]


def pooled(rms: np.ndarray) -> str:
    """Figures for t >= 15 s."""
    return " ".join(f"{x:.1f}" for x in np.sqrt(np.mean(rms[FROM:] ** 2, axis=0)))


def table(world: MatchingWorld) -> dict[str, np.ndarray]:
    """Print it; RMS over time of what exists, by label."""
    print(
        f"{'R = I, L = I, gamma = 50':<28}{'gamma_min':>10}{'ref.':>9}{'RMS E N U':>18}{'ref.':>18}"
    )
    found: dict[str, np.ndarray] = {}
    for (unit, P0), (least, figures) in REFERENCE.items():
        row = of(unit, P0)
        told = existence(row.filter, row.system, 1.0, COURSE, GAMMA)
        if told["feasible"]:
            found[f"{unit}, P0 {P0}"] = rms_over_time(row, world)
            shown = pooled(found[f"{unit}, P0 {P0}"])
        else:
            shown = f"none: update {told['infeasible_at_update']}"
        ours = told["gamma_min"]
        print(f"{unit + ', P0 ' + P0:<28}{ours:10.4g}{least:>9}{shown:>18}{figures:>18}")
    print(f"\nR = (1')^2, L = attitude, gamma = {WEIGHTED_ARCMIN:g}'")
    same = {unit: rms_over_time(weighted(unit), world) for unit in UNITS}
    for unit, rms in same.items():
        apart = np.max(np.abs(rms - same["rad"]))
        print(f"{unit:<28}{pooled(rms):>37}   apart from radians: {apart:.0e}'")
        if apart > 1e-9:
            raise SystemExit("weights with units must not depend on the unit")
    found["weights with units"] = same["rad"]
    return found


def local_bounds(unit: str) -> np.ndarray:
    """(E,) what gamma must exceed at each update, in the unit; NaN after the filter has ended."""
    row = of(unit, "physical")
    model, (u, aux) = row.system.model(1.0), row.system.inputs()
    start, nothing = row.system.start(), jnp.zeros((len(u), 3))

    @jax.jit  # so that nothing is raised where the filter does not exist
    def one(filter_):
        return run(filter_, model, start, nothing, u, aux, keep=bound).steps

    found = np.asarray(one(with_gamma(row.filter, GAMMA)))
    ended = np.concatenate([[False], np.maximum.accumulate(found >= GAMMA)[:-1]])
    return np.where(ended, np.nan, found)


def bound(step):
    return step.info[ATTITUDE].notes["h_infinity.bound"]


def draw(found: dict[str, np.ndarray], target: Path) -> None:
    """RMS over time, and what gamma must exceed."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 4.0), layout="constrained")
    colours = {"rad": "tab:blue", "deg": "tab:orange", "arcmin": "tab:green"}
    for label, rms in found.items():
        size = np.sqrt(np.mean(rms**2, axis=1))
        style = "--" if "identity" in label else "-"
        left.plot(
            COURSE.epoch_s, size, style, color=colours.get(label.split(",")[0], "k"), label=label
        )
    left.set(xlabel="time [s]", ylabel="attitude RMS, mean of the axes [arcmin]", ylim=(0.0, 60.0))
    left.set_title("gamma = 50 in three units, and weights with units")
    left.legend(fontsize="small")
    for unit in UNITS:
        bounds = local_bounds(unit)
        right.loglog(COURSE.epoch_s, bounds, color=colours[unit], label=unit)
        last = int(np.max(np.flatnonzero(np.isfinite(bounds))))
        if last + 1 < len(bounds):
            right.plot(COURSE.epoch_s[last], bounds[last], "X", ms=9, color=colours[unit])
            right.annotate(
                f"update {last + 1}: no filter",
                (COURSE.epoch_s[last], bounds[last]),
                xytext=(10, 0),
                textcoords="offset points",
            )
    right.axhline(GAMMA, color="k", lw=0.8)
    right.text(0.98, 0.7 * GAMMA, "gamma = 50", ha="right", transform=right.get_yaxis_transform())
    right.set(xlabel="time [s]", ylabel="local bound [unit]", ylim=(5e-3, 4.0 * GAMMA))
    right.set_title("what gamma = 50 must exceed, physical P0")
    right.legend(loc=(0.72, 0.56))
    figure.savefig(target, dpi=110)
    print(f"wrote {target.name}")


def main() -> None:
    """Print the table, save the picture."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("picture", nargs="?", type=Path, default=PICTURE)
    parser.add_argument("--runs", type=int, default=200)
    asked = parser.parse_args()
    draw(table(worlds(jnp.arange(asked.runs))), asked.picture)


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")
    plt.switch_backend("agg")
    main()
