"""The command `robins`. ``docs/contract.md`` states the interface for scripts.

Modules here import only fast modules at their top; a command imports the others when it runs, so
that help and usage errors come at once.
"""

from robins.cli.commands import app
from robins.cli.frame import ExitStatus
from robins.cli.running import main
from robins.errors import moved

__all__ = ["ExitStatus", "app", "main"]

__getattr__ = moved(__name__)
