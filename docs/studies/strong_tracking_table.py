"""Comparison of filters on true changes and on outliers: seven filters, four kinds of data.

    python docs/studies/strong_tracking_table.py [--runs 200] [--seed 1]

A target of one dimension: position and rate, position measured with sigma = 1 every 0.1 s. Four
kinds of data: clean; bursts of 5 sigma that last 1 s, every 30 s, of random sign; a jump of the
rate by 2 per second at half time; both. Root mean square errors of position are printed beside
reference values, and drawn.

The reference says neither how long a run is nor what drives the rate. Both follow from its row of
the plain Kalman filter, and from that row alone:

- a rate that walks by 0.01 per square root of a second gives the clean error of .159 (an error of
  .158 in the steady state; .133 for 0.005, .187 for 0.02);
- the error that a jump leaves in this filter, squared and integrated, is 245 s, so that the jump's
  .968 is a mean over 269 s: runs of 300 s whose first 30 s are not counted.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from robins.filters import Belief, Model, Motion, Sensor, kalman, run
from robins.filters.rules.discriminator import PUBLISHED, discriminator
from robins.filters.rules.huber import huber
from robins.filters.rules.strong_tracking import strong_tracking

DT, DURATION, COUNTED_FROM = 0.1, 300.0, 30.0  # s
SIGMA = 1.0  # of a measured position
RATE_WALK = 0.01  # of the rate, per square root of a second
BURST, BURST_LASTS, BURST_EVERY = 5.0 * SIGMA, 1.0, 30.0  # s
JUMP = 2.0  # of the rate, per second
COLUMNS = {"clean": (0, 0), "bursts": (1, 0), "jump": (0, 1), "both": (1, 1)}  # bursts, jump
PICTURE = Path(__file__).resolve().parents[1] / "pictures" / "strong_tracking_table.png"


class Row(NamedTuple):
    name: str
    rules: tuple
    reference: tuple  # errors by column
    noted: str | None = None  # the note that holds lambda
    mean_lambda: float | None = 1.0  # on clean data, None where the reference has none


CLASSIC = (0.692, 1.154, 0.692, 1.154)
FADED = "strong_tracking.lambda"
DECIDED = "discriminator.lambda"
ROWS = [
    Row("KF", (), (0.159, 0.416, 0.968, 1.045)),
    Row("KF + Huber", (huber(0.999),), (0.159, 0.265, 2.622, 2.796)),
    Row("classic ST, rho .95", (strong_tracking(0.95),), CLASSIC, FADED, 1.75),
    Row("classic ST, rho 1", (strong_tracking(1.0),), CLASSIC, FADED, 1.75),
    Row(
        "classic ST, .95, Q faded too",
        (strong_tracking(0.95, form="lumped"),),
        CLASSIC,
        FADED,
        1.75,
    ),
    Row(
        "ST, EWMA .98 + threshold",
        (strong_tracking(0.98, power="ewma"),),
        (0.168, 0.878, 0.214, 0.879),
        FADED,
        1.009,
    ),
    Row(
        "discriminator",
        (discriminator(patience=30, fade="multiple", threshold=PUBLISHED),),
        (0.164, 0.286, 0.228, 0.344),
        DECIDED,
        1.006,
    ),
    Row(
        "discriminator, projected",
        (discriminator(patience=30, threshold=PUBLISHED),),
        (None, None, None, None),
        DECIDED,
        None,
    ),
    Row("discriminator, default", (discriminator(),), (None,) * 4, DECIDED, None),
    Row(
        "discriminator, default, multiple",
        (discriminator(fade="multiple"),),
        (None,) * 4,
        DECIDED,
        None,
    ),
]


def model() -> tuple[Model, Belief]:
    motion = Motion(
        lambda x, u: jnp.stack([x[0] + DT * x[1], x[1]]),
        jnp.array([0.0, RATE_WALK * DT**0.5]),
    )
    sensor = Sensor(lambda x, aux: x[:1], jnp.array([SIGMA]), 1)
    return Model(motion, (sensor,)), Belief.of(jnp.zeros(2), np.eye(2))


def data(runs: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (T,) [s], true positions and measurements, both (4 columns, runs, T)."""
    rng = np.random.default_rng(seed)
    steps = round(DURATION / DT)
    k = np.arange(1, steps + 1)
    x0 = rng.normal(size=(4, runs, 2))
    rate = x0[..., 1:] + np.cumsum(RATE_WALK * DT**0.5 * rng.normal(size=(4, runs, steps)), axis=2)
    jumps = np.array([jump for _, jump in COLUMNS.values()])
    rate += JUMP * jumps[:, None, None] * (k > steps // 2)
    before = np.concatenate([x0[..., 1:], rate[..., :-1]], axis=2)
    truth = x0[..., :1] + DT * np.cumsum(before, axis=2)

    every, lasts = round(BURST_EVERY / DT), round(BURST_LASTS / DT)
    sign = rng.choice([-1.0, 1.0], size=(4, runs, steps // every + 1))
    burst = BURST * sign[:, :, k // every] * ((k % every < lasts) & (k >= every))
    bursts = np.array([bursts for bursts, _ in COLUMNS.values()])
    y = truth + SIGMA * rng.normal(size=truth.shape) + bursts[:, None, None] * burst
    return k * DT, truth, y


def filtered(row: Row, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions and lambda, (4, runs, T), of one filter: a single batch of all runs."""
    system, start = model()
    filter_ = kalman(rules=row.rules, form="joseph")

    def keep(step):
        notes = step.info["y"].notes
        return step.posterior.mean[0], notes[row.noted] if row.noted else jnp.ones(())

    batch = jax.jit(jax.vmap(lambda z: run(filter_, system, start, z, keep=keep).steps))
    position, factor = batch(y.reshape(-1, y.shape[2], 1))
    return np.asarray(position).reshape(y.shape), np.asarray(factor).reshape(y.shape)


def draw(t: np.ndarray, errors: dict[str, np.ndarray], table: dict[str, np.ndarray]) -> None:
    figure, (one, all_) = plt.subplots(2, 1, figsize=(9, 7.4), layout="constrained")
    shown = ["KF", "KF + Huber", "classic ST, rho .95", "ST, EWMA .98 + threshold", "discriminator"]
    colours = dict(zip(shown, ["C7", "C0", "C3", "C1", "C2"], strict=True))
    window = (t >= 110.0) & (t <= 200.0)
    for name in ["classic ST, rho .95", "ST, EWMA .98 + threshold", "KF", "KF + Huber"]:
        one.plot(t[window], errors[name][3, 0, window], color=colours[name], lw=1, label=name)
    one.plot(
        t[window], errors["discriminator"][3, 0, window], color="C2", lw=1.8, label="discriminator"
    )
    for start in np.arange(120.0, 200.0, BURST_EVERY):
        one.axvspan(start, start + BURST_LASTS, color="0.85", zorder=0)
    one.axvline(DURATION / 2, color="k", ls=":", lw=1)
    one.set(
        xlabel="time [s]",
        ylabel="error of position [sigma]",
        ylim=(-13, 8),
        title="One run with both: bursts (grey) and a jump of the rate at 150 s (dotted)",
    )
    one.legend(fontsize=8, ncols=3, loc="lower left")

    place = np.arange(4)
    for i, name in enumerate(shown):
        reference = next(row.reference for row in ROWS if row.name == name)
        at = place + (i - 2) * 0.16
        all_.bar(at, table[name], 0.15, color=colours[name], label=name)
        all_.plot(at, reference, "k_", ms=9, label="reference" if i == 0 else None)
    all_.set_xticks(place, list(COLUMNS))
    all_.set(
        ylabel="RMS error of position [sigma]",
        yscale="log",
        ylim=(0.1, 6.0),
        title=f"RMS from {COUNTED_FROM:.0f} s on, by what happens",
    )
    all_.set_yticks(ticks := [0.1, 0.2, 0.5, 1.0, 2.0, 5.0], [f"{tick:g}" for tick in ticks])
    all_.minorticks_off()
    all_.legend(fontsize=8, ncols=3, loc="upper left")
    figure.savefig(PICTURE, dpi=110)


def main():
    parser = argparse.ArgumentParser(
        description="Errors of strong tracking and its rivals, beside reference values."
    )
    parser.add_argument("--runs", type=int, default=200, help="runs a column")
    parser.add_argument("--seed", type=int, default=1, help="of the random numbers")
    arguments = parser.parse_args()
    t, truth, y = data(arguments.runs, arguments.seed)
    counted = t > COUNTED_FROM

    def versus(value, reference):
        if reference is None:
            return f"{value:6.3f} {'':>13}"
        return f"{value:6.3f} {reference:6.3f} {value / reference:5.2f}x"

    print("RMS error of position: here, reference, ratio")
    print(f"{'':<30}" + "".join(f"{c:^22}" for c in (*COLUMNS, "mean lambda, clean")))
    errors, table, worst = {}, {}, 0.0
    for row in ROWS:
        position, factor = filtered(row, y)
        errors[row.name] = position - truth
        rms = np.sqrt(np.mean(errors[row.name][..., counted] ** 2, axis=(1, 2)))
        table[row.name] = rms
        fade = float(np.mean(factor[0][:, counted]))
        pairs = [*zip(rms, row.reference, strict=True), (fade, row.mean_lambda)]
        print(f"{row.name:<30}" + "  ".join(versus(*pair) for pair in pairs), flush=True)
        worst = max([worst, *(abs(a / b - 1.0) for a, b in pairs if b is not None)])
    print(f"furthest from the reference: {100.0 * worst:.1f} %")
    draw(t, errors, table)
    print(f"wrote {PICTURE.relative_to(PICTURE.parents[2])}")


if __name__ == "__main__":
    plt.switch_backend("agg")
    main()
