"""Two pictures of the satellite: a drift faster than believed, and what steadiness means.

python docs/studies/satellite_pictures.py [--runs 24]
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from robins import scenario
from robins.campaign import record, worlds
from robins.systems.satellite import SYSTEM

PICTURES = Path(__file__).resolve().parents[1] / "pictures"
ARCSEC = math.pi / 648000.0
COLOURS = {
    "mekf": "#d55e00",
    "mixed-riccati-quarter": "#0072b2",
    "mixed-bias": "#009e73",
    "mekf-informed": "#777777",
}
WORDS = {
    "mekf": "MEKF, nominal noise",
    "mixed-riccati-quarter": "mixed, n on the rate",
    "mixed-bias": "mixed, n on the bias",
    "mekf-informed": "MEKF told the truth",
}


def lengths(name: str, runs: int) -> tuple[np.ndarray, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Times, and by filter the lengths (runs, E) of attitude and pointing error in arcsec."""
    study = SYSTEM.studies["attitude-loop"]
    given = scenario.parse(study.parameters, SYSTEM.scenarios[name].read_text(), source=name)
    problem = study.problem(given, tuple(COLOURS), 0)
    ((batch, count),) = worlds(problem, runs)
    out = {}
    for filter_ in COLOURS:
        found = record(problem, filter_, batch, count)
        sizes = found["error"][..., :3], found["outputs"]["pointing"]
        out[filter_] = tuple(np.linalg.norm(x, axis=2) / ARCSEC for x in sizes)
    return problem.epoch_s, out


def smooth(values: np.ndarray, width: int) -> np.ndarray:
    """Root mean square over runs and over so many epochs."""
    mean = np.mean(values**2, axis=0)
    return np.sqrt(np.convolve(mean, np.full(width, 1.0 / width), mode="same"))


def main() -> None:
    """Draw both."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=24)
    runs = parser.parse_args().runs
    time, found = lengths("s4", runs)
    counted = (time > 500.0) & (time < 1490.0)
    figure, stack = plt.subplots(2, figsize=(7.0, 4.4), sharex=True, layout="constrained")
    kinds = ("attitude error", "pointing error")
    for axes, k, kind in zip(stack, range(2), kinds, strict=True):
        for name, colour in COLOURS.items():
            line = smooth(found[name][k], 100)
            axes.plot(time[counted], line[counted], color=colour, label=WORDS[name], lw=1.3)
        axes.set(ylabel=f"{kind} [arcsec]", ylim=(0.0, None))
        axes.grid(alpha=0.25)
    stack[0].legend(ncols=2, fontsize=8.5, loc="lower center")
    stack[1].set(xlabel="time [s]", xlim=(500.0, 1490.0))
    save(figure, "satellite_drift")

    both = {"s1": lengths("s1", runs)[1], "s4": found}
    figure, row = plt.subplots(1, 2, figsize=(7.0, 3.0), sharey=True, layout="constrained")
    worst = 0.0
    titles = {"s1": "noise as believed", "s4": "drift faster than believed"}
    for axes, (name, of) in zip(row, both.items(), strict=True):
        for i, (filter_, colour) in enumerate(COLOURS.items()):
            each = np.sqrt(np.mean(of[filter_][0][:, time > 500.0] ** 2, axis=1))
            worst = max(worst, float(np.max(each)))
            spread = np.linspace(-0.25, 0.25, runs)
            axes.plot(i + spread, np.sort(each), ".", color=colour, ms=4.0)
            axes.plot([i - 0.35, i + 0.35], [np.sqrt(np.mean(each**2))] * 2, color=colour, lw=2.0)
        ticks = [WORDS[f].replace(", ", ",\n").replace("told ", "told\n") for f in COLOURS]
        axes.set_xticks(range(len(COLOURS)), ticks, fontsize=7.5)
        axes.set(title=titles[name])
        axes.grid(alpha=0.25, axis="y")
    row[0].set(ylabel="RMS error of a run [arcsec]", ylim=(0.0, 1.05 * worst))
    save(figure, "satellite_spread")


def save(figure: Any, name: str) -> None:
    target = PICTURES / f"{name}.png"
    figure.savefig(target, dpi=110)
    print(f"wrote {target.name}")


if __name__ == "__main__":
    plt.switch_backend("agg")
    main()
