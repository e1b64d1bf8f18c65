"""The page of an exported folder: how its library is called, and what single precision costs."""

from __future__ import annotations

from robins import __version__
from robins.export.library import Library
from robins.export.single_precision import PrecisionCost
from robins.filters import SENTENCES, Code


def page(
    library: Library,
    name: str,
    label: str,
    found: PrecisionCost | None,
    margin: float,
    least: float,
) -> str:
    """README of an exported folder, in Markdown.

    Args:
        library: of the filter.
        name: of the filter.
        label: of the problem by which it was tried.
        found: cost of single precision; None in double precision.
        margin: of the tolerances of the test over the differences that were found.
        least: tolerance.
    """
    n, calls = library.name, "\n".join(f"    {library.signature(e)};" for e in library.entries)
    codes = "\n".join(f"| {int(code)} | {sentence} |" for code, sentence in SENTENCES.items())
    return f"""# Filter `{name}` of `{label}` in C

By robins {__version__}. C99, no allocation, no global state, no recursion, no library but `math.h`;
one thread may use one state, several threads several states.

    make check     compiles the library and a test, replays recorded steps, compares all outputs
    make stack     lists the stack of each function

`{n}.h` names all fields; `{n}.c` needs nothing else. The numbers of the model (noise, axes,
constants) is in the code: export again to change it.

    void {n}_init({n}_state *state);
{calls}

Each step calls `{n}_predict`, then the update of each sensor that has a reading. A component that
is missing is NaN, so the header refuses `-ffast-math`. Each call returns a code:

| code | meaning |
|---|---|
{codes}

Where a reading was used, `sigma` of the result is the standard deviation of each component of the
innovation: a reading is suspicious where the innovation exceeds three of them.

`{n}_init` begins where the recorded run does. `{n}_reset` starts again from a mean and the factor
of a covariance, in any state: whatever else the filter has learned is then as after `{n}_init`. A
belief that is not finite is not taken (code {int(Code.NOT_FINITE)}). Read the state, copy it, but
change it by `{n}_init` and the calls only.
{_costs(found, margin, least)}"""


def _costs(found: PrecisionCost | None, margin: float, least: float) -> str:
    """The part of the page on single precision."""
    if found is None:
        return ""
    return f"""
## Single precision

**{found.verdict}**

{found.runs} runs of the scenario, {found.steps} steps each, by this library as compiled on the
machine that exported it, given the same readings rounded to floats; in double precision by JAX.
{found.codes_off} of {found.codes} codes differ.

{found.table()}

`make check` compares with double precision. What it allows is {margin:.0f} times what single
precision was found to cost in the recorded steps, and at least {least:.0e} of a field: see
`recorded.h`.{" It fails, since the filter is ruined." if not found.bearable else ""}
"""
