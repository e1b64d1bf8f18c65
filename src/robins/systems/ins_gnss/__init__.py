"""Loosely coupled INS/GNSS, closed loop, two rates; a simulated drive and recorded logs."""

from pathlib import Path

from robins.errors import moved
from robins.systems.ins_gnss.live import LiveInsGnss
from robins.systems.ins_gnss.log import NAMES, recorded, replay
from robins.systems.ins_gnss.model import ins_gnss_model
from robins.systems.ins_gnss.parameters import Drive, InsGnssReplay
from robins.systems.ins_gnss.study import DRIVE
from robins.systems.ins_gnss.world import drive_dataset
from robins.systems.study import System

SYSTEM = System(
    name="ins-gnss",
    studies={"drive": DRIVE},
    default="adaptive",
    replay_filters=NAMES,
    replay_parameters=InsGnssReplay,
    replay_default=Path(__file__).parent / "scenarios" / "replay.toml",
    replay=replay,
    recorded=recorded,
    orientation=lambda parameters: parameters.imu.orientation,
)

__all__ = [
    "SYSTEM",
    "Drive",
    "InsGnssReplay",
    "LiveInsGnss",
    "drive_dataset",
    "ins_gnss_model",
    "replay",
]

__getattr__ = moved(__name__)
