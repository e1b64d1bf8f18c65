"""Functions behind the commands: one per command, from its arguments to an `Outcome`.

::

    outcome = run("ins-gnss/drive", runs=20)
    result = publish(outcome, "results/drive")

The first line writes nothing; `publish` makes a result folder of any outcome, with its report.
Where computing takes long, `publishing` refuses a folder that cannot be written before it begins.

A module is named after its command in `robins --help`; `demo` is in `run`, `verify` in `compare`.
Modules that several of them use are nouns: `scenarios`, `publication`, `formats`, `workers`.

A function is imported when it is used, so that the doctor of logs imports no system, and a list of
scenarios no JAX. A new command is a function in a module here, and its row below.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from robins.errors import lazy, places

if TYPE_CHECKING:  # the functions that are named as their file, for editors
    from robins.workbench.allan import allan as allan
    from robins.workbench.bound import bound as bound
    from robins.workbench.calibrate import calibrate as calibrate
    from robins.workbench.compare import compare as compare
    from robins.workbench.design import design as design
    from robins.workbench.formats import export as export
    from robins.workbench.guess import guess as guess
    from robins.workbench.replay import replay as replay
    from robins.workbench.run import run as run
    from robins.workbench.sensitivity import sensitivity as sensitivity
    from robins.workbench.sweep import sweep as sweep
    from robins.workbench.tune import tune as tune

_FILES = {
    "allan": "allan",
    "bench": "bench_node bench_replay bench_up",
    "bound": "bound",
    "calibrate": "calibrate",
    "campaign": "campaign_show campaign_status campaign_verify campaign_work plan_campaign",
    "compare": "compare verify",
    "design": "design",
    "doctor": "examine",
    "errors": "InputError",
    "export": "export_filter",
    "formats": "export",
    "guess": "guess",
    "list": "inventory overview",
    "publication": "publish publishing",
    "replay": "align replay",
    "run": "demo run",
    "sensitivity": "sensitivity",
    "sweep": "report status sweep",
    "tune": "tune",
    "workers": "campaign_run work_here",
}
_WHERE = places(__name__, _FILES)

__all__ = sorted(_WHERE)  # pyright: ignore[reportUnsupportedDunderAll]


__getattr__ = lazy(__name__, _WHERE)


class _Functions(ModuleType):
    """A package whose functions keep their names when a file of the same name is imported."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in _WHERE or not isinstance(value, ModuleType):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Functions
