"""robins: robust inertial navigation and simulation.

Conventions, everywhere unless a name says otherwise:

- SI units and radians inside; names at an interface carry their unit (``lat_rad``, ``alt_m``).
- ``q_nb``, ``C_nb`` map body coordinates to navigation coordinates. Quaternions are unit, scalar
  first, Hamilton. Heading is clockwise from north.
- Navigation frames: NED with body forward-right-down (FRD) for logs and INS/GNSS, ENU with body
  right-forward-up (RFU) inside the systems of the papers; ``robins.ins.frames`` converts between
  them without rounding.
- The estimation error is ``true = retract(estimate, error)``; for an attitude this is
  ``C_true = exp(phi x) C_estimate``, phi seen in the navigation frame.
- Time is integer nanoseconds in files and tables, seconds since the start inside a run.
- NaN in a measurement means missing, per component.

`import robins as rb` gives the names of `FRONT_DOOR`, each imported when it is first used.
"""

import importlib
import os
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("robins")
except PackageNotFoundError:  # run from source, not installed
    __version__ = "0+unknown"

# Two concurrent batched QR factorisations, each waiting for threads of the other, deadlock
# jaxlib 0.10; with one worker they do not. Read when JAX makes its first array.
os.environ.setdefault("PJRT_NPROC", "1")

# Name of the front door -> "module:attribute" of its home. `python tests/front_door.py` writes the
# same names with their types into `__init__.pyi`, for editors.
FRONT_DOOR = {
    # filters
    "Belief": "robins.filters:Belief",
    "Model": "robins.filters:Model",
    "Motion": "robins.filters:Motion",
    "Sensor": "robins.filters:Sensor",
    "kalman": "robins.filters:kalman",
    "unscented": "robins.filters:unscented",
    "imm": "robins.filters:imm",
    "gate": "robins.filters.rules:gate",
    "h_infinity": "robins.filters.rules:h_infinity",
    "huber": "robins.filters.rules:huber",
    "student_t": "robins.filters.rules:student_t",
    "run_filter": "robins.filters:run",
    "rts_smoother": "robins.filters:rts_smoother",
    "OnlineFilter": "robins.filters:OnlineFilter",
    # logs, scenarios and results
    "load": "robins.logs:load_dataset",
    "doctor": "robins.workbench:examine",
    "replay": "robins.workbench:replay",
    "run": "robins.workbench:run",
    "publish": "robins.workbench:publish",
    "load_result": "robins.results:read",
    # one sample at a time, and on a board
    "LiveAlignment": "robins.systems.transfer_alignment:LiveAlignment",
    "LiveGnss": "robins.systems.gnss:LiveGnss",
    "LiveInsGnss": "robins.systems.ins_gnss:LiveInsGnss",
    "LiveMarg": "robins.systems.marg:LiveMarg",
    "export_filter": "robins.workbench:export_filter",
    # systems and vehicles of your own
    "study_from_model": "robins.systems.from_model:study_from_model",
    "Scenario": "robins.systems:Scenario",
    "Study": "robins.systems:Study",
    "Rig": "robins.bench:Rig",
    "RobinsError": "robins.errors:RobinsError",
}

__all__ = [*FRONT_DOOR]  # pyright: ignore[reportUnsupportedDunderAll]


def _at(place: str) -> Callable:
    """The object at "module:attribute"."""
    module, _, attribute = place.partition(":")
    return getattr(importlib.import_module(module), attribute)


def __getattr__(name: str) -> Callable:
    if name not in FRONT_DOOR:
        return _at("robins.errors:moved")(__name__)(name)
    found = globals()[name] = _at(FRONT_DOOR[name])
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *FRONT_DOOR})
