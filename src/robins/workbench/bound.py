"""The command `bound`: the best accuracy that the sensors of a scenario allow.

Examples::

    robins bound ins-gnss/drive
    robins bound ins-gnss/drive --without gnss_velocity --at "60 s" --at "200 s"
    robins bound transfer-alignment/s0 --filters kf-flexure --set slave.gyro_bias="10 deg/h"
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from robins import _float64, units
from robins.campaign.bound import bound as bound_of
from robins.report import bounds
from robins.results import Outcome, Progress, ignore_progress
from robins.workbench.errors import refusing
from robins.workbench.options import Option, Scenario
from robins.workbench.scenarios import check_filters, read_scenario, request_fields


def bound(
    name: Scenario,
    *,
    runs: Annotated[int, Option("Trajectories to average over.", least=1)] = 1,
    without: Annotated[
        Sequence[str], Option("Leave it out; may be repeated.", metavar="SENSOR")
    ] = (),
    at: Annotated[
        Sequence[str], Option('Print that time, "200 s"; may be repeated.', metavar="TIME")
    ] = (),
    seed: int = 0,
    settings: Sequence[str] = (),
    filter_name: str = "",
    progress: Progress = ignore_progress,
) -> Outcome:
    """Compute the covariance bound and observability of SCENARIO; no filter can do better.

    It needs no data: the model of a filter, by default the first of the scenario, is linearised
    about the simulated truth. It shows the best sigma of each state over time, which states the
    sensors observe, what each sensor contributes, and which directions are least observable.

    Args:
        name: "system/name", the path of a TOML file, or "file.py:study" of the user's own.
        filter_name: whose model is taken; by default the scenario's first filter.
        runs: number of simulated trajectories to average over.
        seed: of the random streams.
        without: sensors to leave out altogether.
        at: times to report, such as "200 s"; by default the quarters.
        settings: "path=value" texts that change the scenario.
        progress: called with the fraction done and the current activity.

    Raises:
        InputError, robins.scenario.ScenarioError, robins.units.UnitError: the request cannot be
            computed.
    """
    _float64.require()
    one = read_scenario(name, (*settings, f"runs={runs}"))
    wanted = filter_name or one.own[0]
    chosen = check_filters(one.source, one.study.filters, [wanted])
    times = [units.parse(time, "time") for time in at]
    progress(0.0, "linearising along the truth")
    with refusing(name):
        solution = bound_of(one.problem(chosen, seed), wanted, runs, without)
        epochs = bounds.epochs(solution, times)
    return Outcome(
        solution,
        {wanted: bounds.metrics(solution)},
        files={"bound.csv": bounds.csv(solution).encode()},
        notes=bounds.sentences(solution),
        scenario=one.label,
        seed=seed,
        runs=runs,
        tables=[bounds.table(solution, epochs)],
        last_lines=[f"Next:   robins run {name}   shows how near the filters come"],
        **request_fields(one.text, settings),
    )
