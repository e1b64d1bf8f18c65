"""The commands of campaigns and their options.

Examples of `robins campaign`::

    robins campaign run airship/s1 --runs 1000 --out airship   begin, or go on
    robins campaign status airship                             how far is it?
    robins campaign work airship                               one more worker
    robins campaign report airship                             figures of all runs
    robins campaign show airship --run 137                     that run alone
    robins campaign verify airship                             is all as it was?

Examples of `robins campaign run`::

    robins campaign run transfer-alignment/s0 --runs 200 --out s0 --machine c
    robins campaign run airship/s1 --runs 10000 --filters ekf --out airship --workers 8

Examples of `robins campaign work`::

    robins campaign work airship

Examples of `robins campaign status`::

    robins campaign status airship --json

Examples of `robins campaign verify`::

    robins campaign verify airship
    robins campaign verify airship --share 0.1

Examples of `robins campaign show`::

    robins campaign show airship --run 137

Examples of `robins campaign report`::

    robins campaign report airship --out airship-report

Examples of `robins sweep`::

    robins sweep ins-gnss/drive --vary "imu.gyro_bias=1 deg/h,10 deg/h" --out biases
    robins sweep transfer-alignment/s0 --vary h_infinity.gamma=20,50,100 --vary "flexure.sigma=1 arcmin,3 arcmin,9 arcmin" --runs 20 --out gammas
"""  # noqa: E501

from __future__ import annotations

import importlib
import os
import threading
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import click
from click import option

from robins.cli import cache
from robins.cli.frame import ExitStatus, command_line, only_json
from robins.cli.options import OUT, TRUST, add_examples, answers, choices, of_value
from robins.cli.printing import carry_out, print_and_write, print_data
from robins.cli.progress import Progress

if TYPE_CHECKING:
    from robins.results import Outcome, Result
    from robins.workbench.campaign import CampaignStatus


@click.group(short_help="Run a scenario many times, on all cores or machines; nothing is lost.")
def campaign() -> None:
    """Campaigns: thousands of runs, kept in a folder that any number of workers fill.

    The folder is the truth. Each chunk of runs is one sealed file, put in place whole; what is
    interrupted or killed goes on with the same command.
    """


def _workbench() -> ModuleType:
    cache.enable()
    return importlib.import_module("robins.workbench")


_PATIENCE_S = 600.0  # wait for a report that another coordinator writes
_WHERE = click.argument("where", metavar="DIR")


def _end_with_parent(held: bool) -> None:
    """End this process when its parent closes its standard input, or has ended."""
    if not held:
        return

    def wait() -> None:
        while os.read(0, 1024):
            pass
        os._exit(ExitStatus.INTERRUPTED)

    threading.Thread(target=wait, daemon=True).start()


@campaign.command(short_help="Begin a campaign, or go on with it.")
@click.argument("scenario")
@option("--out", required=True, metavar="DIR", help="Folder, or an address such as s3://name/dir.")
@option("--runs", type=click.IntRange(min=1), help="How many. [default: as given]")
@option("--workers", type=click.IntRange(min=0), help="Processes. [default: one a core]")
@choices
def run(scenario: str, out: str, workers: int | None, as_json: bool, **options: Any) -> None:
    """Run SCENARIO many times, with as many processes as there are cores.

    The same command on the same DIR goes on: what is there is not computed again, more runs or
    filters are added. It ends with the figures of all runs, in the folder DIR/report.

    With --workers 0 it computes nothing: workers are started elsewhere.
    """
    bench = _workbench()
    if workers == 0:
        with only_json(as_json):
            bench.plan_campaign(out, scenario, **options)
            found = bench.campaign_status(out)
        print_data(found._asdict(), _progress_text(out, found), as_json)
        return
    with only_json(as_json), Progress() as progress:
        outcome = bench.campaign_run(out, scenario, workers=workers, progress=progress, **options)
    _deliver(bench, out, outcome, as_json)


def _deliver(
    bench: ModuleType, where: str, outcome: Outcome, as_json: bool, to: Path | None = None
) -> None:
    # several coordinators of a campaign end at the same time, each with all runs to report
    timeout_s = 0.0 if to else _PATIENCE_S
    to = to or (_result(where, "report") if "://" in where else Path(where) / "report")
    command, writing = command_line(), Progress("drawing figures")

    def write() -> Result:
        return bench.publish(outcome, to, command=command, progress=writing, patience_s=timeout_s)

    print_and_write(outcome, write, writing, as_json)


@campaign.command(short_help="Compute what is missing, as one more worker.")
@_WHERE
@option(
    "--held", is_flag=True, hidden=True, expose_value=False, callback=of_value(_end_with_parent)
)
@TRUST
@answers
def work(where: str, as_json: bool) -> None:
    """Take the next missing chunk of the campaign in DIR, compute it, put it; until all are there.

    Any number of workers may do this at once, here and on other machines that see the folder.
    """
    bench = _workbench()
    done = total = 0
    with only_json(as_json), Progress() as progress:
        for done, total in bench.campaign_work(where):
            progress(done / total, f"{done} of {total} shards")
    text = f"{done} of {total} shards are there.\nNext:   robins campaign report {where}"
    print_data({"done": done, "shards": total}, text, as_json)


@campaign.command(short_help="How far a campaign is.")
@_WHERE
@answers
def status(where: str, as_json: bool) -> None:
    """Read and check every shard of the campaign in DIR, and report what is done, missing, damaged.

    Of a sweep it reports the campaign of each point.
    """
    with only_json(as_json):
        found = _workbench().status(where)
    if isinstance(found, dict):
        points = {name: one._asdict() for name, one in found.items()}
        print_data({"points": points}, _points_text(where, found), as_json)
    else:
        print_data(found._asdict(), _progress_text(where, found), as_json)


def _points_text(where: str, found: Mapping[str, CampaignStatus]) -> str:
    width, lines = max(map(len, found)), []
    for name, one in found.items():
        done = ", ".join(f"{filter_} {n}" for filter_, n in one.done.items())
        damaged = f", {len(one.damaged)} shards damaged" if one.damaged else ""
        lines.append(f"{name:<{width}}  {one.wanted} runs wanted; done: {done}{damaged}")
    short = any(one.digest is None for one in found.values())
    then = ("work", "   computes what is missing") if short else ("report", "")
    return "\n".join([*lines, f"Next:   robins campaign {then[0]} {where}{then[1]}"])


def _progress_text(where: str, found: CampaignStatus) -> str:
    lines = [f"{found.scenario}, seed {found.seed}, by {found.machine}: {found.wanted} runs wanted"]
    for name in found.filters:
        shards_text = "".join(
            f"   {what}: {', '.join(map(str, runs[:10]))}{' ...' if len(runs) > 10 else ''}"
            for what, runs in (("diverged", found.diverged[name]), ("kept", found.kept[name]))
            if runs
        )
        lines.append(f"  {name:<20} {found.done[name]:>8} done{shards_text}")
    lines.append(
        f"shards: {found.shards}, {found.missing} missing, {len(found.damaged)} damaged"
        + "".join(f"\n  damaged: {name}" for name in found.damaged)
    )
    if found.digest:
        lines += [f"digest {found.digest}", f"Next:   robins campaign report {where}"]
    else:
        lines.append(f"Next:   robins campaign work {where}   computes what is missing")
    return "\n".join(lines)


@campaign.command(short_help="Compute a share of a campaign again, and compare the bits.")
@_WHERE
@option("--share", type=click.FloatRange(0.0, 1.0, min_open=True), default=0.01, show_default=True)
@TRUST
@answers
def verify(where: str, share: float, as_json: bool) -> int:
    """Check all shards of DIR, compute some again, drawn by chance, and compare them bit by bit.

    Kept histories are checked too. The exit status is 1 if something is damaged or differs.
    """
    with only_json(as_json), Progress() as progress:
        found = _workbench().campaign_verify(where, share, progress=progress)
    text = (
        f"{found.shards} shards, {len(found.damaged)} damaged; "
        f"{len(found.recomputed)} computed again, {len(found.different)} different"
        + "".join(f"\n  damaged: {name}" for name in found.damaged)
        + "".join(f"\n  different: {name}" for name in found.different)
    )
    print_data(found._asdict(), text, as_json)
    return ExitStatus.FAILED if found.damaged or found.different else ExitStatus.DONE


@campaign.command(short_help="One run of a campaign alone, with all its histories.")
@_WHERE
@option("--run", "number", type=click.IntRange(min=0), required=True, help="Its number.")
@OUT
@TRUST
@answers
def show(where: str, number: int, out: Path | None, as_json: bool) -> None:
    """Compute one run of DIR again and write its histories and figures; it has the same bits."""
    out = out or _result(where, f"run-{number}")
    carry_out("campaign_show", where, number, out=out, as_json=as_json)


def _result(where: str, what: str) -> Path:
    """Path of a result that is not in the folder of its campaign."""
    return Path("results") / f"{where.rstrip('/').rpartition('/')[2]}-{what}"


@campaign.command(short_help="Figures of all runs that are there.")
@_WHERE
@OUT
@TRUST
@answers
def report(where: str, out: Path | None, as_json: bool) -> None:
    """Join the shards of DIR and write a result with figures and a page; by default DIR/report.

    DIR may be the folder of a sweep.
    """
    bench = _workbench()
    with only_json(as_json), Progress() as progress:
        progress(0.0, "joining shards")
        outcome = bench.report(where)
    _deliver(bench, where, outcome, as_json, out)


@click.command(short_help="Run a scenario over the values of one parameter, or of two.")
@click.argument("scenario")
@option("--vary", multiple=True, required=True, metavar="key=a,b,c", help="Once, or twice.")
@option("--out", required=True, metavar="DIR", help="Folder, or an address such as s3://name/dir.")
@option("--runs", type=click.IntRange(min=1), help="At each point. [default: as given]")
@option("--workers", type=click.IntRange(min=1), help="Processes. [default: one a core]")
@choices
def sweep(scenario: str, out: str, as_json: bool, **options: Any) -> None:
    """Run SCENARIO for each value of one parameter or of two, with the same random numbers.

    One parameter gives curves with their bounds, two give a map for each filter; the result is in
    DIR/report, all numbers in its sweep.csv. Each point is a campaign in DIR/points: the same
    command goes on, and `robins campaign work DIR` is one more worker.
    """
    bench = _workbench()
    with only_json(as_json), Progress() as progress:
        outcome = bench.sweep(scenario, out, progress=progress, **options)
    _deliver(bench, out, outcome, as_json)


add_examples(__doc__, campaign, sweep)
