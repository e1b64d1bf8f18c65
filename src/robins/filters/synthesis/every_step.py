"""A new LMI design at every sample, for the plant as it is at that sample.

This is what some published filters do whose transition depends on a measured rate. It is slow, and
it proves nothing: each inequality certifies the filter for a plant that stays as it is for ever,
and a product of error transitions each of which decays need not decay. Prefer one design for the
worst plant, or a Kalman filter told of the modelling error (`channel_inflation`), which follows a
plant that varies. The design is the observer's, for the full-order one does not exist where A has
spectral radius one, as every rotation has.
"""

from __future__ import annotations

import warnings

import numpy as np

from robins.filters.synthesis.lmi import ObserverForm, check_form, gain_of, observer
from robins.filters.synthesis.norms import Levels, Number, h2_norm, spectral_radius
from robins.filters.synthesis.plant import Plant, error_system
from robins.filters.synthesis.programs import solve
from robins.filters.synthesis.riccati import check_gamma
from robins.filters.synthesis.scaling import Scales, balanced

_BOUND, _GAMMA = 1e-3, 1e-6  # relative tolerances of `certify`


class FrozenTimeWarning(UserWarning):
    """A filter designed anew at every sample carries no guarantee from one sample to the next."""


class EveryStep:
    """Gains of `lmi.observer`, one a call, for frozen matrices of one shape.

    The program is built at the first call and only filled in later; its units are those of the
    first plant, until an answer in them fails.

    Args:
        gamma: bound on the H-infinity norm of the plant frozen.
        form: "common" or "slack".

    Raises:
        ValueError: gamma is not positive, or the form is not known.

    Warns:
        FrozenTimeWarning: once, when it is made.
    """

    def __init__(self, gamma: Number, form: ObserverForm = "common"):
        check_gamma(gamma)
        check_form(form)
        self.gamma = float(gamma)
        self.form: ObserverForm = form
        self._scales: Scales | None = None
        warnings.warn(
            "LMIs for the plant frozen at each sample guarantee nothing for a plant that varies: "
            "neither that errors decay nor gamma",
            FrozenTimeWarning,
            stacklevel=2,
        )

    def __call__(self, plant: Plant) -> np.ndarray:
        """The gain K (n, m) for this plant, by its true norms good for it if it stayed so.

        Raises:
            Unreachable: gamma is below the least one of this plant.
            NotCertified: no answer of the solver passed the test of its true norms.
            MissingExtra: cvxpy or Clarabel is not installed.
        """
        sizes = (len(plant.A), len(plant.C))
        if self._scales is None or sizes != (len(self._scales.x), len(self._scales.y)):
            self._scales = balanced(plant, None if np.isinf(self.gamma) else self.gamma)
        answer = solve(
            self._scales.plant(plant), self.form, "h2" if np.isinf(self.gamma) else "mixed"
        )
        if answer.unknowns:
            K = gain_of(answer, self._scales)
            if self._holds(plant, K, self._scales.h2(np.sqrt(max(answer.value, 0.0)))):
                return K
        self._scales = None
        return observer(plant, self.gamma, self.form).gain

    def _holds(self, plant: Plant, K: np.ndarray, bound: float) -> bool:
        """What `certify` asks, but whether gamma is kept, not what the norm is."""
        e = error_system(plant, K)
        if spectral_radius(e.A) >= 1.0 or h2_norm(e.A, e.Bw, e.L) > bound * (1.0 + _BOUND):
            return False
        if np.isinf(self.gamma):
            return True
        levels = Levels.of(e.A, e.Bn, e.L, np.zeros((len(e.L), e.Bn.shape[1])))
        return not levels.reached(self.gamma * (1.0 + _GAMMA))
