"""Adaptive filter for a model that may be wrong at unknown times: a bank over the process noise.

An innovation that is too large comes from an outlier or from an unmodelled motion. A robust weight
alone assumes the first, and rejects correct measurements once the motion is wrong; a fading factor
assumes the second, and follows outliers. The bank (`robins.filters.composite.imm`) covers both:
each mode weighs measurements by Huber's rule (`robins.filters.rules.huber`) and assumes another
scale of the process noise,

    Q_s = s^2 Q,     s of the scales

so a motion error that lasts makes a mode of more noise likely, and an outlier of a single step does
not. There is no gate, and where no mode has given weight to a sensor for long, all use its next
measurement with full weight.

States that the model keeps constant (biases, misalignments) stay constant in every mode: a bias
that may wander would absorb other errors, and the knowledge of it in the mode of least noise would
be lost when modes are mixed.

Where several instruments drive the motion, one is assumed to fail at a time. So a mode scales one
part of the noise, and the sound part still shows the error of the other: a drifting gyro must not
inflate the noise of the accelerometer, which determines the tilt.

Neither more noise nor less weight suits a sensor whose readings have a lasting offset, or that
contradicts another because the model between the two is wrong. Such sensors are named in ``off``,
and each gets two more modes (`robins.filters.composite.offsets`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, ArrayLike

from robins.errors import require
from robins.filters.composite.bank import EVERY, HypothesisRow, bank, scale_transitions, transitions
from robins.filters.composite.offsets import (
    OffsetHypothesis,
    marginal,
    offset_hypotheses,
    offset_transitions,
    under_hypothesis,
)
from robins.filters.kalman import Filter, Form, kalman
from robins.filters.linearise import Linearisation, Transition, taylor
from robins.filters.rule import Memory, Rule
from robins.filters.rules import huber
from robins.filters.rules._robust import PATIENCE
from robins.filters.values import Numbers, kind, number, value

SCALES = (1.0, 8.0, 64.0)
UP, BACK = 1e-5, 1e-2

Part = Sequence[int] | slice
"""Tangent components whose process noise changes together, such as those driven by one
instrument."""

MOTION: Mapping[str, Part] = MappingProxyType({"motion": slice(None)})
"""All of the process noise, under the name of the fault that its scale represents."""


@value
class Excited(Rule):
    """Rule of `excited`: the process noise of each part times its scale."""

    scales: Numbers  # (parts,)
    parts: tuple[tuple[Any, ...], ...] = kind()  # rows of each, or `slice` and its three numbers

    name = "excited"

    def process(self, memory: Memory, transition: Transition):
        return memory, transition._replace(noise=self.scale_noise(transition.noise))

    def scale_noise(self, noise: Array) -> Array:
        """(n, q) factor of the process noise, with the rows of each part times its scale."""
        for i, part in enumerate(self.parts):
            rows = slice(*part[1:]) if part[:1] == (slice,) else np.asarray(part, int)
            noise = noise.at[rows].multiply(jnp.asarray(self.scales)[i])
        return noise


def excited(parts: Sequence[Part], scales: ArrayLike) -> Rule:
    """Scale the process noise part by part.

    Args:
        parts: tangent components of each part.
        scales: (parts,) factors of the standard deviations of the noise.
    """
    # before Python 3.12 a slice has no hash
    kinds = tuple(
        (slice, p.start, p.stop, p.step) if isinstance(p, slice) else tuple(map(int, p))
        for p in parts
    )
    return Excited(number("scales of excited must be real", scales), kinds)


def scale_changes(scales: Sequence[float | int], up: float = UP, back: float = BACK) -> np.ndarray:
    """(n, n) probabilities of a change in one step between modes of these scales.

    ``back`` from a mode to each of a smaller scale, ``up`` to each other one.

    Raises:
        ValueError: up or back is not between 0 and 1, or leaves no probability of staying.
    """
    change = transitions(len(scales), [(EVERY, EVERY, scale_transitions(scales, up, back))])
    good = 0.0 < up < 1.0 and 0.0 < back < 1.0 and bool(np.all(np.diag(change) > 0.0))
    require(good, "up and back of adaptive must leave a mode a chance to stay", (up, back))
    return change


@value
class Adapted:
    """Factory of a mode of `adaptive`, from its noise rule and its offset hypothesis, if any."""

    way: Linearisation
    weight: Rule
    form: Form = kind()
    off: tuple[str, ...] = kind()

    def __call__(self, row: tuple[Excited, OffsetHypothesis | None]) -> Filter:
        noise, of = row
        if of is None:
            return kalman(self.way, (noise, self.weight), self.form)
        weighed = kalman(self.way, (self.weight,), self.form)
        return under_hypothesis(weighed, self.off, of, Partial(Excited.scale_noise, noise))


def adaptive(
    scales: Sequence[float | int] = SCALES,
    robust: float = 0.99,
    up: float = UP,
    back: float = BACK,
    parts: Mapping[str, Part] = MOTION,
    linearise: Linearisation | None = None,
    form: Form = "sqrt",
    off: Sequence[str] = (),
    patience: int | None = PATIENCE,
) -> Filter:
    """Bank of Kalman filters over the scale of the process noise, with Huber's rule in each.

    The defaults are not tuned to a scenario: they span decades of motion errors, and are the same
    for every system.

    Args:
        scales: factors of the standard deviations of the process noise, rising from above zero; all
            parts have the first, and one part at a time another.
        robust: share of correct measurements that keep their weight (`huber`).
        up: probability per step of a change to each mode of a larger or equal scale.
        back: probability per step of a change to each mode of a smaller scale.
        parts: parts of the process noise, by the name of the instrument that drives each; a mode
            raises one of them, and takes that instrument as faulty.
        linearise: linearisation of each mode; `taylor()` by default.
        form: form of the update, "sqrt" or "joseph".
        off: names of sensors whose readings may have an offset for some time, one at a time. Each
            of their components costs a state, and each sensor two modes.
        patience: measurements of a sensor in a row with a weight below 1e-2 before one is used
            (`huber`); None never recovers.

    Raises:
        ValueError: scales do not rise from above zero; up or back is not a probability. When a run
            starts: the model has no sensor of a name in `off`.
    """
    s = np.asarray(scales, float)
    rising = s.ndim == 1 and len(s) > 0 and s[0] > 0.0 and bool(np.all(np.diff(s) > 0.0))
    require(rising, "scales of adaptive must rise, from above zero", scales)
    # a user may give a list
    named = isinstance(parts, Mapping) and len(parts) > 0  # pyright: ignore[reportUnnecessaryIsInstance]
    require(named, 'parts of adaptive must be named, as in {"gyros": [0, 1, 2]}', parts)
    quiet, names = np.full(len(parts), s[0]), tuple(off)
    own = zip(np.eye(len(parts)) > 0.0, parts, strict=True)
    plain = [
        HypothesisRow(quiet),
        *(HypothesisRow(np.where(i, x, quiet), (name,)) for i, name in own for x in s[1:]),
    ]
    change = scale_changes([float(np.max(row.numbers)) for row in plain], up, back)
    way, weight = taylor() if linearise is None else linearise, huber(robust, patience=patience)
    make = Adapted(way, weight, form, names)

    def loud(row: HypothesisRow) -> Rule:
        return excited(list(parts.values()), row.numbers)

    if not names:
        return bank(make, [HypothesisRow((loud(row), None), row.wrong) for row in plain], change)
    each = [*plain, *(HypothesisRow(quiet, (name,)) for name in names for _ in ("begins", "lasts"))]
    off_of = map(OffsetHypothesis, *offset_hypotheses(len(plain), len(names)))
    rows = [HypothesisRow((loud(row), of), row.wrong) for row, of in zip(each, off_of, strict=True)]
    return marginal(bank(make, rows, offset_transitions(change, len(names))), names)
