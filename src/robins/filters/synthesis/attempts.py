"""From a plant to a certified design: scale, solve, check the true norms, else try again, else say.

A status of the solver decides nothing. An answer it calls inaccurate is good if its true norms are,
one that it calls optimal may be wrong by orders of magnitude where numbers are badly scaled, and
what cannot be met at all it calls by half a dozen names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from robins.filters.synthesis.design import Design, NotCertified, Unreachable
from robins.filters.synthesis.inequalities import Aim
from robins.filters.synthesis.norms import Number
from robins.filters.synthesis.plant import Plant
from robins.filters.synthesis.programs import Answer, Form, solve
from robins.filters.synthesis.scaling import Scales, balanced

_REFINED = 4  # solves for the least gamma, each to a thousandth of the one before
_NOTHING = 1e-6  # of the unit of gamma: no longer told from zero
_NEAR = 1e-5  # relative distance of gamma to the least at which a design may fail


def attempt(
    plant: Plant,
    form: Form,
    aim: Aim,
    gamma: Number,
    certified: Callable[[Answer, Scales], Design],
) -> Design:
    """The first answer whose true norms are what was asked.

    Args:
        plant: in its own units.
        form: of the inequalities.
        aim: "h2" or "mixed".
        gamma: bound on the H-infinity norm; inf with "h2".
        certified: makes the design of an answer in scaled units.

    Raises:
        Unreachable: gamma is below the least one; the message and `least` tell that.
        NotCertified: no answer passed; the message tells each status and the test it failed.
    """
    told: list[str] = []
    for scales in _scalings(plant, gamma):
        answer = solve(scales.plant(plant), form, aim)
        if not answer.unknowns:
            told.append(f"the solver said {answer.status!r} and gave no answer")
            continue
        try:
            return certified(answer, scales)
        except NotCertified as error:
            told.append(str(error))
    if aim == "mixed":
        least = least_gain(plant, form)
        if gamma <= least * (1.0 + _NEAR):
            raise Unreachable(
                f"gamma {gamma:.9g} is out of reach: the least one that the {form} form of the LMI "
                f"can meet is {least:.9g}",
                least,
            )
    raise NotCertified(f"no design by the {form} form of the LMI; " + "; then ".join(told))


def least_gain(plant: Plant, form: Form) -> float:
    """Least gamma that inequalities can meet, by a program that minimises its square.

    The solver is exact to some 1e-9 of what is one in its units, so the answer becomes the unit and
    the program is solved again while it is far below.

    Returns:
        The least gamma; 0 where it is below a millionth of what the plant's n is to its z.

    Raises:
        NotCertified: the solver found none.
    """
    if not plant.Bn.any() and not plant.Dn.any():
        return 0.0
    scales = balanced(plant)
    unit = scales.hinf(1.0)
    least = np.inf
    for _ in range(_REFINED):
        answer = solve(scales.plant(plant), form, "least")
        if not answer.unknowns:
            if np.isfinite(least):
                break
            raise NotCertified(f"the least gamma was not found; the solver said {answer.status!r}")
        share = float(np.sqrt(max(answer.value, 0.0)))
        least = scales.hinf(share)
        if least < _NOTHING * unit:
            return 0.0
        if share > 0.5:
            break
        scales = balanced(plant, least)
    return least


def _scalings(plant: Plant, gamma: Number) -> Iterator[Scales]:
    """Units to try in turn."""
    yield balanced(plant, None if np.isinf(gamma) else float(gamma))
    ones = Scales(np.ones(len(plant.A)), np.ones(len(plant.C)), 1.0, 1.0, 1.0)
    yield ones if np.isinf(gamma) else ones._replace(n=1.0 / float(gamma))
