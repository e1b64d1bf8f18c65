"""Processes of the parts: spawned (never forked), watched, and all ended at exit."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from robins.bench.parts.config_files import private_folder, put
from robins.bench.parts.idle import idleness
from robins.bench.parts.node import REALTIME
from robins.bench.parts.station import path_of
from robins.bench.rig import Rig
from robins.errors import RobinsError

_ERROR = re.compile(r"[\w.]*(Error|Exception|Interrupt)\b")
_GRACE_S = 2.0  # between the signal to stop and the kill


class ProcessExit(RobinsError):
    """A process that has ended; raised where it has to be there.

    Attributes:
        part: whose process it was.
        code: status; negative: the signal that ended it.
        error_output: its last output on standard error.
    """

    bad_input = False

    def __init__(self, part: str, code: int, error_output: str):
        self.part, self.code, self.error_output = part, code, error_output
        how = f"ended with status {code}"
        if code < 0:
            with contextlib.suppress(ValueError):
                how = f"was killed by {signal.Signals(-code).name}"
        super().__init__(f"'{part}' {how}" + (f": {error_output}" if error_output else ""))


class PartProcesses:
    """Processes of the parts; a context manager that ends them all on any exit."""

    def __init__(
        self,
        rig: Rig,
        config: Any,
        realtime: bool = False,
        restarts: bool = False,
        programs: Mapping[str, Path] = MappingProxyType({}),
    ):
        """Prepare their input.

        Args:
            rig: whose parts they are.
            config: for all of them.
            realtime: whether they request a real-time scheduler.
            restarts: whether they save their memory, to be restarted from it.
            programs: replacements of parts, by part; each is given the path of a port.
        """
        self._rig, self._config, self._programs = rig, config, programs
        self._realtime, self._restarts = realtime, restarts
        self._folder: Path | None = None
        self._held = contextlib.ExitStack()
        self._running: dict[str, subprocess.Popen] = {}
        self._idle_s = idleness()

    def __enter__(self) -> PartProcesses:
        with contextlib.ExitStack() as stack:
            self._folder = stack.enter_context(private_folder())
            put(self._config, self._folder / "kit")
            self._held = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self.end_all()
        self._held.close()

    def start(self, part: str, port: str, since: int = -1) -> None:
        """Start a part on its port; it sends its hello when it is ready.

        Args:
            part: its name.
            port: by its path.
            since: the step whose memory it goes on from; -1: it starts without one.
        """
        assert self._folder is not None
        words = (self._folder / f"{part}.txt").open("wb")
        # Steps are short: dispatch to a thread of JAX and back takes longer than some of them.
        environment = {**os.environ, "JAX_CPU_ENABLE_ASYNC_DISPATCH": "false"}
        if self._realtime:
            environment[REALTIME] = "1"
        command = [sys.executable, "-P", "-m", "robins.bench.parts.node"]
        command += [self._rig.address or self._rig.name, part, port]
        command.append(str(self._folder / "kit"))
        if self._restarts:
            command += [str(self._folder), str(since)]
        if part in self._programs:
            command = [str(self._programs[part]), port.partition(",")[0]]
        with words:
            self._running[part] = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=words,
                stderr=words,
                env=environment,
                start_new_session=True,  # Ctrl-C of the terminal is for the bench
            )

    def process(self, part: str) -> int | None:
        """The process number of a part; None where a board takes its place."""
        running = self._running.get(part)
        return None if running is None else running.pid

    def idle_s(self, part: str) -> float:
        """Idle time of the process of a part [s]; see `idleness`."""
        return self._idle_s(self.process(part))

    def has_saved_memory(self, part: str, step: int) -> bool:
        """True if a part has saved its memory after a step."""
        assert self._folder is not None
        return path_of(self._folder, part, step).exists()

    def deaths(self, among: str | None = None) -> list[ProcessExit]:
        """Processes that have ended since the last call; of one part, or of all."""
        asked = {k: p for k, p in self._running.items() if among in (None, k)}
        dead = [(part, code) for part, p in asked.items() if (code := p.poll()) is not None]
        for part, _ in dead:
            del self._running[part]
        return [ProcessExit(part, code, self._error_output(part)) for part, code in dead]

    def kill(self, part: str) -> None:
        """Kill a part at once, as a fault."""
        if part in self._running:
            self._running[part].kill()

    def end_all(self) -> None:
        """End all: processes that received a stop end by themselves, the others are killed."""
        until = time.monotonic() + _GRACE_S
        while any(p.poll() is None for p in self._running.values()):
            if time.monotonic() > until:
                break
            time.sleep(0.01)
        for p in self._running.values():
            if p.poll() is None:
                p.kill()
            p.wait()
        self._running.clear()

    def _error_output(self, part: str) -> str:
        assert self._folder is not None
        lines = (self._folder / f"{part}.txt").read_text("utf-8", "replace").strip().splitlines()
        errors = [line for line in lines if _ERROR.match(line)]  # notes may follow them
        return (errors or lines or [""])[-1]
