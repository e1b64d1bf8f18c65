"""The command `export`: a filter as C."""

from __future__ import annotations

import importlib
import shlex
from pathlib import Path
from typing import Any

from robins.cli import cache
from robins.cli.printing import print_data


def write(name: str, to: Path, *, as_json: bool, **options: Any) -> None:
    """Write the folder and list its contents."""
    cache.enable()
    workbench = importlib.import_module("robins.workbench")
    made = workbench.export_filter(name, to, **options)
    scalars = ", ".join(f"{entry} {count}" for entry, count in made.scalars.items())
    costs = (
        f"{made.cost.table()}\n\n{made.cost.codes_off} of {made.cost.codes} codes differ. "
        f"{made.cost.verdict}\n\n"
        if made.cost
        else ""
    )
    text = (
        f"Filter {made.filter} of {name} as C: {made.bytes / 1000.0:.0f} kB of text; "
        f"scalars of each call: {scalars}.\n\n"
        f"{costs}"
        f"Wrote:  {to}/  {', '.join(made.files)}\n"
        f"Next:   make -C {to} check   compiles it here and replays recorded steps\n"
        f"        {to}/README.md says how to call it"
    )
    if made.program:
        # filter parameters are compiled in, so a run must use those of the export
        options_text = "".join(f" --set {shlex.quote(one)}" for one in options["settings"])
        options_text += f" --seed {options['seed']}" if options["seed"] else ""
        node = f"{made.program.name.removesuffix('_board')}={made.program}"
        flown = f"robins bench up {name} --filter {made.filter} --node {node}{options_text}"
        text += f"\n        {flown}   flies with it"
    cost = made.cost and made.cost.as_data()
    data = {**made._asdict(), "folder": str(to), "scenario": name, "cost": cost}
    data["program"] = made.program and str(made.program)
    print_data(data, text, as_json)
