"""One filter for a model of which nobody knows when it is wrong: a bank over the process noise.

An innovation that is too large is a bad record or a motion that was not foreseen. A robust weight
alone takes it for the first, and once the motion is wrong it refuses the truth; a fading factor
takes it for the second, and follows outliers. The bank (`robins.filters.composite.imm`) holds both:
each mode weighs its records by Huber's rule (`robins.filters.rules.huber`) and believes in another
scale of the process noise,

    Q_s = s^2 Q,     s of the scales

so a motion that is wrong for long makes a mode of more noise likely, and a bad record, which is
gone at the next step, does not. There is no gate, and where no mode has given weight to a sensor
for long, its next record is believed by all.

States that the model holds for constant (biases, misalignments) stay constant in every mode: a
bias that may wander explains what was something else, and what the quiet mode has learnt of it is
lost when the modes are mixed.

Where several instruments drive the motion, one goes wrong at a time. So a mode scales one part of
the noise, and the part that is sound still tells the error of the other: a gyro that drifts must
not make an accelerometer doubtful by which the tilt is known.

Neither more noise nor less weight answers a sensor whose records are off and stay off, or that
contradicts another because the model between the two is wrong. Where that may be, the sensors are
named, and each has two modes more (`robins.filters.composite.offsets`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike

from robins.errors import require
from robins.filters.composite.imm import Family, imm
from robins.filters.composite.offsets import (
    Supposed,
    narrowed,
    sensors_off,
    supposing,
    with_offsets,
)
from robins.filters.kalman import Filter, Form, kalman
from robins.filters.linearise import Linearisation, Transition, taylor
from robins.filters.rule import Rule, hooks
from robins.filters.rules import huber
from robins.filters.rules._robust import PATIENCE

SCALES = (1.0, 8.0, 64.0)
UP, BACK = 1e-5, 1e-2

Part = Sequence[int] | slice
"""Tangent components whose process noise goes wrong together, such as all that one instrument
drives."""

ALL = slice(None)


def excited(parts: Sequence[Part], scales: ArrayLike) -> Rule:
    """Process noise of another scale, part by part.

    Args:
        parts: of the process noise.
        scales: (parts,) of the standard deviations of the noise.
    """

    def process(memory: Any, t: Transition):
        return memory, t._replace(noise=louder(t.noise, parts, scales))

    return hooks(process=process, name="excited")


def louder(noise: Array, parts: Sequence[Part], scales: ArrayLike) -> Array:
    """A factor (n, q) of the process noise, each part of its rows times its scale."""
    for i, part in enumerate(parts):
        rows = part if isinstance(part, slice) else np.asarray(part, int)
        noise = noise.at[rows].multiply(jnp.asarray(scales)[i])
    return noise


def changes(scales: Sequence[float | int], up: float = UP, back: float = BACK) -> np.ndarray:
    """(n, n) probabilities of a change in one step between modes of these scales.

    From any to each that is not quieter up, to each that is quieter back.

    Raises:
        ValueError: they are no probabilities.
    """
    s = np.asarray(scales, float)
    change = np.where(s[None] < s[:, None], back, up)
    np.fill_diagonal(change, 0.0)
    stay = 1.0 - change.sum(axis=1)
    good = 0.0 < up < 1.0 and 0.0 < back < 1.0 and bool(np.all(stay > 0.0))
    require(good, "up and back of adaptive must leave a mode a chance to stay", (up, back))
    return change + np.diag(stay)


def lasting(change: np.ndarray) -> np.ndarray:
    """(count,) probabilities that stay as they are under a change of each step."""
    count = len(change)
    A = np.vstack([change.T - np.eye(count), np.ones(count)])
    found, *_ = np.linalg.lstsq(A, np.append(np.zeros(count), 1.0))
    found = np.maximum(found, 0.0)
    return found / found.sum()


def adaptive(
    scales: Sequence[float | int] = SCALES,
    robust: float = 0.99,
    up: float = UP,
    back: float = BACK,
    parts: Sequence[Part] = (ALL,),
    linearise: Linearisation | None = None,
    form: Form = "sqrt",
    off: Sequence[str] = (),
    patience: int | None = PATIENCE,
) -> Filter:
    """A bank of Kalman filters over the scale of the process noise, with Huber's rule in each.

    Nothing in it belongs to a scenario: the numbers are decades of what a motion may do, and the
    same for every system.

    Args:
        scales: of the standard deviations of the process noise, rising; the first is the model's.
        robust: share of right records that keep their weight (`huber`).
        up: probability of a change to one louder scale in a step.
        back: of a change to one quieter scale.
        parts: of the process noise; a mode makes one of them louder.
        linearise: of each mode; by Taylor where not given.
        form: of the update, "sqrt" or "joseph".
        off: names of sensors whose records may be off for some time, one at a time. It costs a
            state for each of their components, and two modes for each of them.
        patience: records of a sensor in a row with hardly any weight before one is believed
            (`huber`); None never does.

    Raises:
        ValueError: scales that do not rise from above zero; probabilities that are none. When a run
            begins: the model has no sensor of a name in `off`.
    """
    s = np.asarray(scales, float)
    rising = s.ndim == 1 and len(s) > 0 and s[0] > 0.0 and bool(np.all(np.diff(s) > 0.0))
    require(rising, "scales of adaptive must rise, from above zero", scales)
    # The quiet mode, then each louder scale of each part.
    more = np.tile(s[1:], len(parts))
    own = np.repeat(np.eye(len(parts)), len(s) - 1, axis=0)
    gains = s[0] * np.ones((1 + len(more), len(parts)))
    gains[1:] = np.where(own > 0.0, more[:, None], gains[1:])
    by, weight = taylor() if linearise is None else linearise, huber(robust, patience=patience)
    change = changes([s[0], *more], up, back)
    if not off:

        def one(gain: Any) -> Filter:
            return kalman(by, (excited(parts, gain), weight), form)

        return imm(Family(one, gains), change, lasting(change))

    weighed, plain = kalman(by, (weight,), form), len(gains)

    def supposes(row: tuple[Any, Supposed]) -> Filter:
        gain, of = row
        return supposing(weighed, off, of, Partial(lambda g, N: louder(N, parts, g), gain))

    change = with_offsets(change, len(off))
    gains = np.vstack([gains, np.repeat(gains[:1], len(change) - plain, axis=0)])
    rows = gains, sensors_off(plain, len(off))
    return narrowed(imm(Family(supposes, rows), change, lasting(change)), off)
