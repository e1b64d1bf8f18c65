"""Tight GNSS: pseudoranges, wheels and a yaw gyro; a simulated city and recorded logs."""

from pathlib import Path

from robins.errors import moved
from robins.systems.gnss.filters import NAMES
from robins.systems.gnss.live import LiveGnss, RoadNavigation
from robins.systems.gnss.log import recorded, replay
from robins.systems.gnss.model import gnss_model
from robins.systems.gnss.parameters import City, GnssReplay
from robins.systems.gnss.study import CITY
from robins.systems.study import System

SYSTEM = System(
    name="gnss",
    studies={"city": CITY},
    default="delays",
    replay_filters=NAMES,
    replay_parameters=GnssReplay,
    replay_default=Path(__file__).parent / "scenarios" / "replay.toml",
    replay=replay,
    recorded=recorded,
    reads="ranges",
    replay_finds=("track",),
)

__all__ = [
    "SYSTEM",
    "City",
    "GnssReplay",
    "LiveGnss",
    "RoadNavigation",
    "gnss_model",
    "replay",
]

__getattr__ = moved(__name__)
