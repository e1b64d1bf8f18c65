"""Two pictures of the rocket: a disturbance of a second, and what one vector does not show.

python docs/studies/rocket_pictures.py [--runs 20]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr

from robins import scenario
from robins.campaign import simulate
from robins.systems.rocket import SYSTEM

PICTURES = Path(__file__).resolve().parents[1] / "pictures"
COLOURS = {
    "federated-vector-stukf": "#d55e00",
    "ukf": "#777777",
    "huber": "#0072b2",
    "gate": "#009e73",
    "usque": "#777777",
    "strong-tracking": "#d55e00",
    "gyro": "#0072b2",
}
WORDS = {
    "federated-vector-stukf": "the paper's federated STUKF",
    "ukf": "UKF",
    "huber": "UKF, Huber",
    "gate": "gated",
    "usque": "USQUE",
    "strong-tracking": "strong tracking",
    "gyro": "gyro alone",
}


def found(name: str, filters: tuple[str, ...], runs: int, *settings: str) -> xr.Dataset:
    """Solution of a scenario."""
    text = SYSTEM.scenarios[name].read_text()
    study = SYSTEM.studies[scenario.mapping_of(text)["study"]]
    given = scenario.parse(study.parameters, text, settings, source=name)
    return simulate(study.problem(given, filters, 0), runs).solution


def draw(axes: Any, time: np.ndarray, name: str, values: np.ndarray) -> None:
    axes.plot(time, values, color=COLOURS[name], label=WORDS[name], linewidth=1.4)


def burst(runs: int) -> None:
    """RMS error of the attitude about a disturbance of 5 deg."""
    filters = ("federated-vector-stukf", "ukf", "huber", "gate")
    data = found("a1", filters, runs, 'duration="75 s"')
    time = data["time"].values
    shown = (time > 27.0) & (time < 37.0)
    figure, axes = plt.subplots(figsize=(7.0, 3.2), layout="constrained")
    rms = np.degrees(np.sqrt(np.mean(data["rms_attitude"].values ** 2, axis=2)))
    stated = 3.0 * np.degrees(data["mean_sigma_attitude"].values[3].mean(axis=1))
    axes.fill_between(time[shown], 0.0, stated[shown], color=COLOURS["gate"], alpha=0.15, lw=0)
    for name, row in zip(filters, rms, strict=True):
        draw(axes, time[shown], name, row[shown])
    axes.axvspan(30.0, 31.0, color="#000000", alpha=0.07, lw=0)
    axes.annotate("magnetometer wrong by 5 deg", (31.1, 5.0), fontsize=9)
    axes.set(xlabel="time since launch [s]", ylabel="RMS attitude error [deg]", ylim=(0.0, None))
    axes.legend(frameon=False, title=f"{runs} runs; shaded: 3 sigma of the gated filter")
    figure.savefig(PICTURES / "rocket_burst.png", dpi=150)


def about_and_across(runs: int) -> None:
    """RMS errors about the field and across it, with what the gated filter states."""
    filters = ("gyro", "strong-tracking", "usque", "gate")
    data = found("b2", filters, runs)
    time = data["time"].values
    rms = np.degrees(data["rms_field_attitude"].values)
    sigma = np.degrees(data["mean_sigma_field_attitude"].values[3])
    figure, pair = plt.subplots(2, 1, figsize=(7.0, 5.0), sharex=True, layout="constrained")
    sides = (rms[..., 0], np.hypot(rms[..., 1], rms[..., 2]))
    stated = (sigma[:, 0], np.hypot(sigma[:, 1], sigma[:, 2]))
    titles = ("about the field", "across the field")
    for axes, side, bound, title in zip(pair, sides, stated, titles, strict=True):
        for name, row in zip(filters, side, strict=True):
            draw(axes, time, name, row)
        axes.plot(
            time, 3.0 * bound, "k:", linewidth=1.0, label="3 sigma stated by the gated filter"
        )
        axes.set(yscale="log", ylabel=f"RMS error\n{title} [deg]")
    pair[1].set(xlabel="time since launch [s]")
    pair[0].legend(
        frameon=False, ncols=3, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, 1.3)
    )
    figure.savefig(PICTURES / "rocket_one_vector.png", dpi=150)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=20)
    count = parser.parse_args().runs
    burst(count)
    about_and_across(count)
