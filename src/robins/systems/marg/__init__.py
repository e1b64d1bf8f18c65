"""Orientation from gyro, accelerometer and magnetometer (MARG), for logs of cheap units."""

from pathlib import Path

from robins.systems.marg.blocks import Samples, causal_attitudes, integrate, smoothed_attitudes
from robins.systems.marg.model import Block, MargState, marg_model
from robins.systems.marg.parameters import Replay
from robins.systems.marg.prepare import Prepared, prepare
from robins.systems.marg.replay import orient, replay
from robins.systems.marg.rules import marg_filter
from robins.systems.marg.setup import FILTERS, filter_of, model_of
from robins.systems.system import System

SYSTEM = System(
    name="marg",
    studies={},
    replay_filters=FILTERS,
    replay_parameters=Replay,
    replay_default=Path(__file__).parent / "scenarios" / "replay.toml",
    replay=replay,
    orientation=lambda parameters: parameters.orientation,
)

__all__ = [
    "SYSTEM",
    "Block",
    "MargState",
    "Prepared",
    "Replay",
    "Samples",
    "causal_attitudes",
    "filter_of",
    "integrate",
    "marg_filter",
    "marg_model",
    "model_of",
    "orient",
    "prepare",
    "replay",
    "smoothed_attitudes",
]
