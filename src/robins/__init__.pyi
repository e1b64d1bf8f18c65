"""Types of `robins.FRONT_DOOR`; written by `python tests/front_door.py`, not by hand."""

from robins.bench.rig import Rig as Rig
from robins.errors import RobinsError as RobinsError
from robins.filters.belief import Belief as Belief
from robins.filters.composite.imm import imm as imm
from robins.filters.kalman import kalman as kalman
from robins.filters.linearise import unscented as unscented
from robins.filters.model import Model as Model
from robins.filters.model import Motion as Motion
from robins.filters.model import Sensor as Sensor
from robins.filters.online import OnlineFilter as OnlineFilter
from robins.filters.rules.gate import gate as gate
from robins.filters.rules.h_infinity import h_infinity as h_infinity
from robins.filters.rules.huber import huber as huber
from robins.filters.rules.student_t import student_t as student_t
from robins.filters.run import run as run_filter
from robins.filters.smooth import rts_smoother as rts_smoother
from robins.logs.loading import load_dataset as load
from robins.results.reader import read as load_result
from robins.systems.from_model import study_from_model as study_from_model
from robins.systems.gnss.live import LiveGnss as LiveGnss
from robins.systems.ins_gnss.live import LiveInsGnss as LiveInsGnss
from robins.systems.marg.live import LiveMarg as LiveMarg
from robins.systems.study import Scenario as Scenario
from robins.systems.study import Study as Study
from robins.systems.transfer_alignment.product.live import LiveAlignment as LiveAlignment
from robins.workbench.doctor import examine as doctor
from robins.workbench.export import export_filter as export_filter
from robins.workbench.publication import publish as publish
from robins.workbench.replay import replay as replay
from robins.workbench.run import run as run

__all__ = [
    "Belief",
    "LiveAlignment",
    "LiveGnss",
    "LiveInsGnss",
    "LiveMarg",
    "Model",
    "Motion",
    "OnlineFilter",
    "Rig",
    "RobinsError",
    "Scenario",
    "Sensor",
    "Study",
    "doctor",
    "export_filter",
    "gate",
    "h_infinity",
    "huber",
    "imm",
    "kalman",
    "load",
    "load_result",
    "publish",
    "replay",
    "rts_smoother",
    "run",
    "run_filter",
    "student_t",
    "study_from_model",
    "unscented",
]
__version__: str
FRONT_DOOR: dict[str, str]
