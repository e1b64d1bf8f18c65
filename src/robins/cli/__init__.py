"""The command `robins`. What it promises to scripts is written in ``docs/contract.md``.

Modules here import at their top only what starts in a blink; a command imports what it works with
when it runs, so that help and usage errors come at once.
"""

from robins.cli.commands import app
from robins.cli.frame import ExitStatus
from robins.cli.running import main
from robins.errors import moved

__all__ = ["ExitStatus", "app", "main"]

__getattr__ = moved(__name__)
