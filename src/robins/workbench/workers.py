"""Workers of a campaign as processes of this machine, watched until nothing is missing."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from time import monotonic, sleep
from typing import IO, Any

from robins.campaign.machine import available_cores
from robins.campaign.plan import CampaignPlan
from robins.campaign.store import GOES_ON, open_store
from robins.campaign.work import missing
from robins.errors import RobinsError
from robins.results import Outcome, Progress, ignore_progress
from robins.systems import trust
from robins.workbench.campaign import campaign_report, plan_campaign, remove_damaged

POLL_S = 0.2
DEATHS = 3  # of workers without a new shard in between, after which a campaign fails
_ROBINS = "from robins.cli import main; raise SystemExit(main())"


def command(
    where: str | os.PathLike[str], trusted: Sequence[str | os.PathLike[str]] = ()
) -> list[str]:
    """The command line of a worker of a campaign, with this Python and files of user code."""
    options = [word for file in trusted for word in ("--trust", os.fspath(file))]
    return [
        *(sys.executable, "-P", "-c", _ROBINS),
        *("campaign", "work", os.fspath(where), *options, "--json"),
    ]


def work_here(where: str | os.PathLike[str], trusted: Sequence[str | os.PathLike[str]] = ()) -> int:
    """Run a worker as a process of its own until nothing is missing; for engines that call Python.

    Args:
        where: folder or address of the campaign.
        trusted: files of user code that the campaign names and that may run here.

    Returns:
        Number of shards in the store afterwards.

    Raises:
        RobinsError: the worker failed.
    """
    done = subprocess.run(command(where, trusted), capture_output=True, text=True)
    if done.returncode:
        raise _failed(done.stderr.removeprefix("robins: ").strip(), str(where))
    return json.loads(done.stdout)["done"]


class _Process:
    """A worker: `robins campaign work`, which ends when its standard input is closed."""

    def __init__(self, where: str):
        self._errors: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 (closed by `close`)
        self._process = subprocess.Popen(
            [*command(where, trust.confirmed()), "--held"],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            start_new_session=True,  # Ctrl-C is for the campaign, which ends its workers
        )

    @property
    def status(self) -> int | None:
        """Exit status, negative if it was killed; None as long as it runs."""
        return self._process.poll()

    @property
    def error_output(self) -> str:
        """Text of its error output."""
        self._errors.seek(0)
        return self._errors.read().decode("utf-8", "replace").strip()

    def close(self) -> None:
        """Kill it at once: objects of a store are always whole."""
        self._process.kill()
        self._process.wait()
        if self._process.stdin:
            self._process.stdin.close()
        self._errors.close()


def campaign_run(
    where: str | os.PathLike[str],
    name: str,
    *,
    workers: int | None = None,
    progress: Progress = ignore_progress,
    **options: Any,
) -> Outcome:
    """Begin or continue a campaign until all its runs are done; see `plan_campaign`.

    Args:
        where: a folder, or an address of object storage.
        name: of the scenario.
        workers: processes; by default one per core.
        progress: called with the fraction done and the current activity.
        **options: of `plan_campaign`.
    """
    progress(0.0, "looking what is there")
    plan = plan_campaign(where, name, **options)
    fill(where, [(str(where), plan)], workers or available_cores(), progress)
    return campaign_report(where)


def fill(
    where: str | os.PathLike[str],
    campaigns: Sequence[tuple[str, CampaignPlan]],
    workers: int,
    progress: Progress = ignore_progress,
) -> None:
    """Compute by workers what is missing or damaged of a campaign, or of those of a sweep.

    A worker that is killed is replaced. All are ended if this is interrupted.

    Raises:
        RobinsError: a worker failed, or one after the other was killed.
    """
    for one, _ in campaigns:
        remove_damaged(one)
    all_shards = [(open_store(one), plan.shards) for one, plan in campaigns]
    total = sum(len(some) for _, shards in all_shards for some in shards.values())
    runs = sum(plan.runs for _, plan in campaigns)
    lacking, deaths, began = total, 0, monotonic()
    with ExitStack() as stack:

        def started() -> _Process:
            process = _Process(str(where))
            stack.callback(process.close)
            return process

        running: list[_Process] = []
        while lack := [one for store, shards in all_shards for one in missing(store, shards)]:
            now = sum(len(one.shards) for one in lack)
            if now < lacking:
                lacking, deaths = now, 0
            for process in [p for p in running if p.status is not None]:
                running.remove(process)
                deaths += _judged(process, str(where))
            if deaths >= DEATHS:
                raise _failed("its workers are killed, one after the other", str(where))
            # a worker for each chunk at most
            running += [started() for _ in range(min(workers, len(lack)) - len(running))]
            verb = "starting, " if monotonic() - began < 5.0 else ""
            share = 1.0 - lacking / total
            progress(share, f"{verb}{round(runs * share)} of {runs} runs, {workers} workers")
            sleep(POLL_S)


def _judged(process: _Process, where: str) -> int:
    """Number of deaths: 1 for a worker that was killed, 0 for one with nothing left to do.

    Raises:
        RobinsError: it failed by itself.
    """
    status = process.status or 0
    if status > 0:
        error_output: Sequence[str] = process.error_output.splitlines()
        why = (
            error_output[-1].removeprefix("robins: ") if error_output else f"it ended with {status}"
        )
        raise _failed(why, where)
    return int(status < 0)


def _failed(why: str, where: str) -> RobinsError:
    """Error of a worker; folder and advice are not repeated if its message contains them."""
    why = why.removeprefix(f"{where}: ")
    fix = "" if why.endswith(GOES_ON) else GOES_ON
    return RobinsError(f"a worker failed: {why}", where, fix, bad_input=False)
