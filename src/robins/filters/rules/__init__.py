"""Rules: one published adaptation per file; each composes with every linearisation."""

from robins.filters.rules.adaptive_h_infinity import adaptive_h_infinity
from robins.filters.rules.channel_inflation import channel_inflation
from robins.filters.rules.consider import consider
from robins.filters.rules.constant_gain import constant_gain, with_gains
from robins.filters.rules.correntropy import correntropy
from robins.filters.rules.discriminator import discriminator
from robins.filters.rules.equality import equality
from robins.filters.rules.fading_memory import fading_memory, per_step
from robins.filters.rules.gate import gate
from robins.filters.rules.h_infinity import Infeasible, h_infinity, with_gamma
from robins.filters.rules.huber import huber
from robins.filters.rules.igg3 import igg3
from robins.filters.rules.inequality import inequality
from robins.filters.rules.innovation_fading import innovation_fading
from robins.filters.rules.only import only
from robins.filters.rules.projection import projection
from robins.filters.rules.sage_husa import sage_husa
from robins.filters.rules.strong_tracking import strong_tracking
from robins.filters.rules.student_t import student_t
from robins.filters.rules.variational_bayes import variational_bayes

__all__ = [
    "Infeasible",
    "adaptive_h_infinity",
    "channel_inflation",
    "consider",
    "constant_gain",
    "correntropy",
    "discriminator",
    "equality",
    "fading_memory",
    "gate",
    "h_infinity",
    "huber",
    "igg3",
    "inequality",
    "innovation_fading",
    "only",
    "per_step",
    "projection",
    "sage_husa",
    "strong_tracking",
    "student_t",
    "variational_bayes",
    "with_gains",
    "with_gamma",
]
