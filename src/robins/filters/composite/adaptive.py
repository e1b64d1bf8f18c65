"""Adaptive filter for a model that may be wrong at unknown times: a bank over the process noise.

An innovation that is too large is a bad record or a motion that was not foreseen. A robust weight
alone takes it for the first, and once the motion is wrong it refuses the truth; a fading factor
takes it for the second, and follows outliers. The bank (`robins.filters.composite.imm`) holds both:
each mode weighs its records by Huber's rule (`robins.filters.rules.huber`) and believes in another
scale of the process noise,

    Q_s = s^2 Q,     s of the scales

so a wrong motion model that lasts makes a mode of more noise likely, and a bad record, which is
gone at the next step, does not. There is no gate, and where no mode has given weight to a sensor
for long, its next record is believed by all.

States that the model holds for constant (biases, misalignments) stay constant in every mode: a
bias that may wander explains what was something else, and what the quiet mode has learnt of it is
lost when the modes are mixed.

Where several instruments drive the motion, one goes wrong at a time. So a mode scales one part of
the noise, and the part that is sound still shows the error of the other: a gyro that drifts must
not make an accelerometer doubtful by which the tilt is known.

Neither more noise nor less weight answers a sensor whose records are off and stay off, or that
contradicts another because the model between the two is wrong. Where that may be, the sensors are
named, and each has two modes more (`robins.filters.composite.offsets`).
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
"""Tangent components whose process noise goes wrong together, such as all that one instrument
drives."""

MOTION: Mapping[str, Part] = MappingProxyType({"motion": slice(None)})
"""All of the process noise, under the name of what is then wrong."""


@value
class Excited(Rule):
    """The rule of `excited`: the process noise of each part times its scale."""

    scales: Numbers  # (parts,)
    parts: tuple[tuple[Any, ...], ...] = kind()  # rows of each; `slice` and its three numbers

    name = "excited"

    def process(self, memory: Memory, transition: Transition):
        return memory, transition._replace(noise=self.scale_noise(transition.noise))

    def scale_noise(self, noise: Array) -> Array:
        """A factor (n, q) of the process noise, each part of its rows times its scale."""
        for i, part in enumerate(self.parts):
            rows = slice(*part[1:]) if part[:1] == (slice,) else np.asarray(part, int)
            noise = noise.at[rows].multiply(jnp.asarray(self.scales)[i])
        return noise


def excited(parts: Sequence[Part], scales: ArrayLike) -> Rule:
    """Process noise of another scale, part by part.

    Args:
        parts: of the process noise.
        scales: (parts,) of the standard deviations of the noise.
    """
    # before Python 3.12 a slice has no hash
    kinds = tuple(
        (slice, p.start, p.stop, p.step) if isinstance(p, slice) else tuple(map(int, p))
        for p in parts
    )
    return Excited(number("scales of excited must be real", scales), kinds)


def scale_changes(scales: Sequence[float | int], up: float = UP, back: float = BACK) -> np.ndarray:
    """(n, n) probabilities of a change in one step between modes of these scales.

    From any to each that is not quieter up, to each that is quieter back.

    Raises:
        ValueError: they are no probabilities.
    """
    change = transitions(len(scales), [(EVERY, EVERY, scale_transitions(scales, up, back))])
    good = 0.0 < up < 1.0 and 0.0 < back < 1.0 and bool(np.all(np.diag(change) > 0.0))
    require(good, "up and back of adaptive must leave a mode a chance to stay", (up, back))
    return change


@value
class Adapted:
    """Maker of a mode of `adaptive`, of the noise it believes in and of what is off if any."""

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
    """A bank of Kalman filters over the scale of the process noise, with Huber's rule in each.

    Nothing in it belongs to a scenario: the numbers are decades of what a motion may do, and the
    same for every system.

    Args:
        scales: of the standard deviations of the process noise, rising; the first is the model's.
        robust: share of right records that keep their weight (`huber`).
        up: probability of a change to one louder scale in a step.
        back: of a change to one quieter scale.
        parts: of the process noise, by the name of the instrument that drives each; a mode makes
            one of them louder, and holds that instrument for wrong.
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
