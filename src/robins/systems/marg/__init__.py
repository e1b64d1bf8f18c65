"""Orientation from gyro, accelerometer and magnetometer (MARG), for logs of low-cost units."""

from pathlib import Path

from robins.errors import moved
from robins.systems.marg.aboard import export_problem
from robins.systems.marg.filters import filter_of, one_prior
from robins.systems.marg.live import LiveMarg
from robins.systems.marg.log import prepare
from robins.systems.marg.model import Block, Samples, integrate, model_of
from robins.systems.marg.parameters import MargReplay
from robins.systems.marg.replay import FILTERS, recorded, replay
from robins.systems.marg.start import first_belief, initial_alignment
from robins.systems.study import System

SYSTEM = System(
    name="marg",
    studies={},
    default="marg",
    replay_filters=FILTERS,
    replay_parameters=MargReplay,
    replay_default=Path(__file__).parent / "scenarios" / "replay.toml",
    replay=replay,
    recorded=recorded,
    use="attitude",
    replay_finds=("attitude",),
    orientation=lambda parameters: parameters.orientation,
    aboard=export_problem,
)

__getattr__ = moved(__name__)

__all__ = [
    "SYSTEM",
    "Block",
    "LiveMarg",
    "MargReplay",
    "Samples",
    "filter_of",
    "first_belief",
    "initial_alignment",
    "integrate",
    "model_of",
    "one_prior",
    "prepare",
    "replay",
]
