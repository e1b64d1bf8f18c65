"""From a plant to a certified design: scale, solve, check the true norms, else try again, else say.

A status of the solver decides nothing. An answer it calls inaccurate is good if its true norms are,
one that it calls optimal may be wrong by orders of magnitude where numbers are badly scaled, and
what cannot be met at all it calls by half a dozen names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from robins.filters.synthesis.design import Design, NotCertified
from robins.filters.synthesis.inequalities import Aim
from robins.filters.synthesis.least import least_gamma
from robins.filters.synthesis.norms import Number
from robins.filters.synthesis.plant import Plant
from robins.filters.synthesis.programs import Answer, Form, solve
from robins.filters.synthesis.scaling import Scales, balanced


def attempt(
    plant: Plant, form: Form, aim: Aim, gamma: Number, certified: Callable[[Answer, Scales], Design]
) -> Design:
    """The first answer whose true norms are what was asked.

    Args:
        plant: in its own units.
        form: of the inequalities.
        aim: "h2" or "mixed".
        gamma: bound on the H-infinity norm; inf with "h2".
        certified: makes the design of an answer in scaled units.

    Raises:
        Unreachable: it is proved that no filter meets gamma (`robins.filters.synthesis.least`).
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
    failed = f"no design by the {form} form of the LMI; " + "; then ".join(told)
    if aim == "mixed":
        least = least_gamma(plant)
        least.refuse(gamma)
        failed += f". No proof that gamma is out of reach: a gain has {least.reached:.6g}"
    raise NotCertified(failed)


def _scalings(plant: Plant, gamma: Number) -> Iterator[Scales]:
    """Units to try in turn."""
    yield balanced(plant, None if np.isinf(gamma) else float(gamma))
    ones = Scales(np.ones(len(plant.A)), np.ones(len(plant.C)), 1.0, 1.0, 1.0)
    yield ones if np.isinf(gamma) else ones._replace(n=1.0 / float(gamma))
