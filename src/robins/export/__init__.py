"""C of a filter for a board: a library, its header, recorded steps that test it, a page.

- `folder`: the files of an export, from the problem of a scenario and the name of a filter;
- `runs`: simulated runs of a filter by its entry points, as a board calls them;
- `library`: programs on one state as C, with named fields; `field_notes`: their units and axes;
- `harness`: the test that a user's own compiler runs; `page`: how the library is called;
- `single_precision`: the cost of 32-bit reals for a filter, against the simulated truth.

The C of one program is `robins.program.c`, the header of the wire `robins.bench.wire.c_header`.
"""

from robins.export.folder import Request, files_of, with_adjustable, write_folder
from robins.export.library import EntryPoint, Library
from robins.export.runs import board_runs, by_jax, entry_functions, reset_function
from robins.export.single_precision import PrecisionCost

__all__ = [
    "EntryPoint",
    "Library",
    "PrecisionCost",
    "Request",
    "board_runs",
    "by_jax",
    "entry_functions",
    "files_of",
    "reset_function",
    "with_adjustable",
    "write_folder",
]
