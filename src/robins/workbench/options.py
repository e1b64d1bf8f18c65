"""Words and limits of the command line about a parameter, as metadata of its annotation.

::

    def allan(log: Log, *, terms: Annotated[str, Option("Noises to fit, of Q, N, B, K, R.")])

`robins.cli.made` makes the options of a command of the signature of its function. It reads the text
of the function's file and evaluates annotations among the names of this module, so that help comes
at once; nothing here imports more than the standard library.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Annotated, NamedTuple

MOST_OF_SEED = 2**63 - 1


class Option(NamedTuple):
    """A parameter on the command line.

    Attributes:
        help: its line in the help; of an argument there is none.
        flag: "--flag"; by default the name of the parameter. Of "--no/--yes" the second sets it.
        metavar: word that stands for its value. "SCENARIO...": it may name code of a user.
        least: lower limit of a number.
        most: upper limit of a number.
        names: a sequence is written as one text with commas; others repeat the option.
        shown: the help shows the default.
    """

    help: str = ""
    flag: str = ""
    metavar: str | None = None
    least: int | None = None
    most: int | None = None
    names: bool = False
    shown: bool = False


Where = str | os.PathLike[str]
Log = Annotated[Where, Option(metavar="LOG")]
Logs = Annotated[Sequence[Where], Option(metavar="LOG...")]
Scenario = Annotated[str, Option(metavar="SCENARIO")]
Runs = Annotated[int | None, Option("Monte Carlo runs. [default: as given]", least=1)]
Filter = Annotated[str, Option("Which. [default: the first]", "--filter", "NAME")]
