"""Cost of a bound on the worst case: true H2 norm against gamma, by every method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from robins.errors import require
from robins.filters.synthesis import lmi
from robins.filters.synthesis.closed_form import closed_form, isotropic
from robins.filters.synthesis.design import Design, NotCertified, Unreachable
from robins.filters.synthesis.least import LeastGamma, least_gamma
from robins.filters.synthesis.norms import Number
from robins.filters.synthesis.plant import Plant
from robins.filters.synthesis.programs import MissingExtra, packages
from robins.filters.synthesis.riccati import check_gamma, kalman_design, riccati

_DESIGNERS: dict[str, Callable[[Plant, float], Design]] = {
    "riccati": riccati,
    "closed-form": closed_form,
    "lmi-common": lambda plant, gamma: lmi.observer(plant, gamma, "common"),
    "lmi-slack": lambda plant, gamma: lmi.observer(plant, gamma, "slack"),
    "retuned-common": lambda plant, gamma: lmi.retuned(plant, gamma, "common"),
    "retuned-slack": lambda plant, gamma: lmi.retuned(plant, gamma, "slack"),
    "full-order": lmi.full,
}
METHODS = tuple(_DESIGNERS)
_POINTS = 6  # number of gammas of the default range
_DEEPEST = 0.1  # least gamma of the default range over the Kalman filter's norm

Progress = Callable[[int, int, str], None]


class Attempt(NamedTuple):
    """Design by one method for one gamma."""

    method: str
    gamma: float
    design: Design | None
    why: str  # reason why there is no design; "" with a design
    least: float  # least gamma of the method, if gamma is below it; else nan


class TradeOff(NamedTuple):
    """Results of all methods for all gammas."""

    kalman: Design  # without bound
    least: LeastGamma  # `reached` includes the designs of `attempts`
    gammas: tuple[float, ...]  # in descending order
    attempts: list[Attempt]  # every method for the first gamma, then for the next
    left_out: dict[str, str]  # inapplicable methods, with reasons

    def best(self, gamma: Number) -> Attempt | None:
        """Attempt of least H2 norm for a gamma; among equals (to 1e-4) that of the first method."""
        made = [(o, o.design.h2) for o in self.attempts if o.gamma == gamma and o.design]
        least = min((h2 for _, h2 in made), default=np.nan)
        return next((o for o, h2 in made if h2 <= least * (1.0 + 1e-4)), None)


def trade_off(
    plant: Plant,
    gammas: Sequence[Number] | None = None,
    methods: Sequence[str] = METHODS,
    progress: Progress | None = None,
) -> TradeOff:
    """Design by every method for every gamma; the result includes failures.

    By default there are six gammas, from nine tenths of the Kalman filter's H-infinity norm down to
    just above the least gamma, or to a tenth of that norm. `progress` gets the number of designs
    done, the total and the name of the next.

    Raises:
        Unreachable: all gammas are below the proved lower bound.
        ValueError: a gamma is not positive or finite, a method is not known, or the plant has no
            steady Kalman filter.
    """
    for gamma in () if gammas is None else gammas:
        check_gamma(gamma)
        finite = np.isfinite(gamma)
        require(finite, "gamma must be finite here; without a bound it is the Kalman filter")
    for name in methods:
        require(name in METHODS, f"no method {name!r}; there are {', '.join(METHODS)}")
    notify = progress or (lambda done, total, what: None)
    notify(0, 1, "least gamma")
    kalman = kalman_design(plant)
    left_out = {name: why for name in methods if (why := _why_not(plant, name))}
    least = least_gamma(plant)
    if gammas is None:
        chosen = _range(least.reached, kalman.hinf)
    else:
        chosen = tuple(sorted({float(gamma) for gamma in gammas}, reverse=True))
        least.refuse(max(chosen, default=np.inf))
    used = [name for name in METHODS if name in methods and name not in left_out]
    attempts: list[Attempt] = []
    total = len(chosen) * len(used)
    for gamma in chosen:
        for name in used:
            notify(len(attempts), total, f"{name}, gamma {gamma:.4g}")
            attempts.append(_attempt(plant, gamma, name))
            if made := attempts[-1].design:
                least = least.improved_by(made)
    return TradeOff(kalman, least, chosen, attempts, left_out)


def _attempt(plant: Plant, gamma: float, name: str) -> Attempt:
    try:
        return Attempt(name, gamma, _DESIGNERS[name](plant, gamma), "", np.nan)
    except (Unreachable, NotCertified) as error:
        return Attempt(name, gamma, None, str(error), getattr(error, "least", np.nan))


def _why_not(plant: Plant, name: str) -> str:
    """Reason why a method does not apply to a plant; "" if it does."""
    try:
        if name == "closed-form":
            isotropic(plant)
        elif name != "riccati":
            packages()
        if name == "full-order":
            lmi.refuse_unstable(plant)
    except (ValueError, MissingExtra) as error:
        return str(error)
    return ""


def _range(least: float, own: float) -> tuple[float, ...]:
    """Gammas from just below the Kalman filter's norm ``own`` to just above the least."""
    if own <= 0.0:
        return ()
    low = max(1.02 * least, _DEEPEST * own)
    if low >= 0.9 * own:  # hardly anything to gain
        return (0.5 * (least + own),) if least < own else ()
    # Rounded, to be easy to read and type.
    return tuple(float(f"{gamma:.4g}") for gamma in np.geomspace(0.9 * own, low, _POINTS))
