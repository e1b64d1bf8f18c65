"""Costs of the tests and the promised commands, and their ceilings, as tables."""

import sys
from pathlib import Path

from generated import setup_of

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
import budget

setup = setup_of(rooms=budget.table, commands=budget.commands)
