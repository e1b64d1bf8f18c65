"""INS/GNSS: loosely coupled, closed loop, two rates; a simulated drive and recorded logs."""

from pathlib import Path

from robins.systems.ins_gnss.drive import drive_dataset, drive_problem
from robins.systems.ins_gnss.drive_claims import CLAIMS
from robins.systems.ins_gnss.model import ins_gnss_model
from robins.systems.ins_gnss.parameters import Drive, Replay
from robins.systems.ins_gnss.replay import replay
from robins.systems.ins_gnss.setup import FILTERS, SMOOTHED
from robins.systems.study import Study
from robins.systems.system import System

_HERE = Path(__file__).parent / "scenarios"
_FILTERS = (*FILTERS, *(name + SMOOTHED for name in FILTERS))

SYSTEM = System(
    name="ins-gnss",
    studies={"drive": Study(Drive, drive_problem, _FILTERS, CLAIMS)},
    replay_filters=_FILTERS,
    replay_parameters=Replay,
    replay_default=_HERE / "replay.toml",
    replay=replay,
    orientation=lambda parameters: parameters.imu.orientation,
)

__all__ = [
    "SYSTEM",
    "Drive",
    "Replay",
    "drive_dataset",
    "drive_problem",
    "ins_gnss_model",
    "replay",
]
