"""Tables of transfer alignment: attitude RMS of all filters in the published scenarios.

python docs/studies/alignment_tables.py [scenario ...]

Prints what `robins run transfer-alignment/NAME` finds, as the tables of
docs/systems/transfer_alignment.md: seed 0, as many runs as the scenario says, errors in arcminutes,
and the verdict of each claim.
"""

import sys

import jax

from robins.results.summary import plain
from robins.workbench import run

BANK_TURN = ("s0", "s0r", "s1", "s2", "s3")  # east, north, up
S_TURN = ("a", "b", "c", "d", "e")  # all axes


def summary_of(name: str) -> dict:
    """Results of a scenario."""
    return plain(run(f"transfer-alignment/{name}").summary)


def cell(metrics: dict | None, by_axis: bool) -> str:
    """One filter in one scenario."""
    if metrics is None:
        return "-"
    if metrics.get("feasible") is False:
        return f"refused at update {metrics['infeasible_at_update']}"
    if by_axis:
        return " ".join(f"{x:.1f}" for x in metrics["attitude_rms_arcmin"])
    return f"{metrics['attitude_rms_all_arcmin']:.2f}"


def table(found: dict[str, dict], by_axis: bool) -> None:
    """Filters by scenario."""
    filters = list(dict.fromkeys(name for s in found.values() for name in s["filters"]))
    print(f"\n| filter | {' | '.join(found)} |")
    print(f"|---|{'---|' * len(found)}")
    for name in filters:
        row = (cell(s["filters"].get(name), by_axis) for s in found.values())
        print(f"| `{name}` | {' | '.join(row)} |")


def main(wanted: list[str]) -> None:
    """Both tables, then the verdicts."""
    for names, by_axis in ((BANK_TURN, True), (S_TURN, False)):
        found = {n: summary_of(n) for n in names if not wanted or n in wanted}
        if not found:
            continue
        table(found, by_axis)
        print("\n| scenario | claim | verdict | value |\n|---|---|---|---|")
        for name, summary in found.items():
            for claim in summary["claims"]:
                print(f"| {name} | {claim['id']} | {claim['verdict']} | {claim['value']:.3g} |")


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")
    main(sys.argv[1:])
