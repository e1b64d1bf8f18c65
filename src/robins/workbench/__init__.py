"""Functions behind the commands: one a command, from its arguments to an `Outcome`.

::

    outcome = run("ins-gnss/drive", runs=20)
    result = publish(outcome, "results/drive")

The first line writes nothing; `publish` makes a result folder of any outcome, with its report.
Where computing takes long, `publishing` refuses a folder that cannot be written before it begins.

A function is imported when it is used: the doctor of logs does not wait for the systems, nor a
list of scenarios for JAX. A new command is a function in a module here, and its row below.
"""

from __future__ import annotations

import importlib
from typing import Any

_WHERE = {
    "InputError": "errors",
    "align": "recorded",
    "allan": "still",
    "bench_node": "benches",
    "bench_replay": "benches",
    "bench_up": "benches",
    "bound": "simulated",
    "calibrate": "magnetometer",
    "campaign_run": "workers",
    "campaign_show": "campaigns",
    "campaign_status": "campaigns",
    "campaign_verify": "campaigns",
    "campaign_work": "campaigns",
    "compare": "comparison",
    "demo": "simulated",
    "design": "gains",
    "examine": "examination",
    "export": "exporting",
    "export_filter": "boards",
    "guess": "guessing",
    "inventory": "contents",
    "overview": "contents",
    "plan_campaign": "campaigns",
    "publish": "publication",
    "publishing": "publication",
    "replay": "recorded",
    "report": "sweeps",
    "run": "simulated",
    "sensitivity": "sensitivities",
    "status": "sweeps",
    "sweep": "sweeps",
    "tune": "tuning",
    "verify": "comparison",
    "work_here": "workers",
}

__all__ = list(_WHERE)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(importlib.import_module(f"{__name__}.{_WHERE[name]}"), name)
    globals()[name] = found
    return found
