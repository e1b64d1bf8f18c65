"""Serial ports: their notation, opening a real one, a pseudo-terminal in its place.

A link of the bench has two ends. Without hardware both are those of a pseudo-terminal: the bench
holds the master, the part opens the path of the slave like any serial port. With hardware the part
is a board, and the bench opens the device itself.

`list_ports` lists the ports of this machine, and whether we may use them.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
import termios
import tty
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import serial
from serial.tools import list_ports as system
from serial.tools.list_ports_common import ListPortInfo

from robins.bench.closing import Closing
from robins.bench.status import aligned
from robins.errors import RobinsError

BAUD = 460800


class PortError(RobinsError, ValueError):
    """A port that cannot be opened; names the port, the cause and the fix."""


class Address(NamedTuple):
    """Path and speed of a port."""

    path: str
    baud: int = BAUD  # pseudo-terminals take any and ignore it


def address(text: str) -> Address:
    """Parse an address: ``/dev/ttyUSB0,460800``, or ``/dev/ttyUSB0`` for 460800 baud.

    Raises:
        PortError: the speed is not a number, or the path is none, is not a port, or may not be
            opened.
    """
    path, comma, speed = text.strip().rpartition(",")
    if not comma:
        path, speed = speed, str(BAUD)
    path, speed = path.strip(), speed.strip()
    if not (speed.isascii() and speed.isdigit() and int(speed) > 0):
        raise PortError(f"'{speed}' is no speed in baud", f"port '{text}'", f"write {path},{BAUD}")
    if why := obstacle(path):
        raise PortError(why, f"port '{path}'")
    return Address(path, int(speed))


def program(text: str) -> Path | None:
    """Path of the program that a text names in place of a port; None: it names a port."""
    path = Path(text.strip())
    return path.resolve() if path.is_file() and os.access(path, os.X_OK) else None


def replacements(texts: Mapping[str, str]) -> tuple[dict[str, Address], dict[str, Path]]:
    """Boards at their ports, and programs, each by the part that it replaces.

    Raises:
        PortError: as `address`.
    """
    found = {part: program(text) for part, text in texts.items()}
    boards = {part: address(text) for part, text in texts.items() if found[part] is None}
    return boards, {part: path for part, path in found.items() if path is not None}


def obstacle(path: str) -> str:
    """Reason why a path cannot be opened as a serial port, with the fix; empty if it can."""
    try:
        kind = os.stat(path).st_mode
    except OSError:
        there = ", ".join(sorted(p.device for p in system.comports())) or "none"
        return f"there is no such path; serial ports of this machine: {there}"
    if not stat.S_ISCHR(kind):
        return "it is no character device such as /dev/ttyUSB0, and no program that may be run"
    if not os.access(path, os.R_OK | os.W_OK):
        return (
            f"no permission to read and write it; it belongs to the group '{_group(path)}': "
            f"add yourself (sudo usermod -aG {_group(path)} $USER) and log in again"
        )
    return ""


def _group(path: str) -> str:
    import grp  # Unix only, and needed for a hint only

    try:
        return grp.getgrgid(os.stat(path).st_gid).gr_name
    except (KeyError, OSError):
        return "dialout"


def open_port(at: Address, timeout_s: float | None = 0.0) -> serial.Serial:
    """Open a port: raw, 8 data bits, no parity, one stop bit, no flow control, ours alone.

    Earlier input is discarded. Writing blocks until the driver has taken all bytes; write to
    ``fileno()`` not to block.

    Args:
        at: the port.
        timeout_s: of a read; 0: do not wait, None: wait until something comes.

    Raises:
        PortError: it cannot be opened, is in use by another program, or does not support the speed.
    """
    if why := obstacle(at.path):
        raise PortError(why, f"port '{at.path}'")
    try:
        port = serial.Serial(at.path, at.baud, timeout=timeout_s, exclusive=True)
    except (OSError, ValueError, termios.error) as error:
        if isinstance(error, OSError) and error.errno in (errno.EAGAIN, errno.EBUSY):
            raise PortError(
                f"port '{at.path}' is in use by another program",
                fix=f"end it first (fuser -v {at.path} names it)",
            ) from None
        raise PortError(str(error), f"port '{at.path}' at {at.baud} baud") from None
    # USB adapters gather bytes for up to 16 ms unless set otherwise; ports that gather nothing
    # refuse the setting.
    with contextlib.suppress(AttributeError, OSError, ValueError):
        port.set_low_latency_mode(True)
    return port


@dataclass
class Pair(Closing):
    """Two ends of a pseudo-terminal, as a cable between bench and part; a context manager.

    Attributes:
        master: the bench's end, a file descriptor: raw, non-blocking.
        slave: the part's end, held open here too, so that the master stays usable while no part has
            it open, as a cable does without a board.
        path: by which a part opens its end.
    """

    master: int
    slave: int
    path: str

    def close(self) -> None:
        """Close both ends; a part that has its end open gets an error. May be repeated."""
        for end in (self.master, self.slave):
            if end >= 0:
                os.close(end)
        self.master = self.slave = -1


def open_pair() -> Pair:
    """Open a pseudo-terminal that passes any byte unchanged both ways, even with no part on it.

    Raises:
        PortError: the system has no free pseudo-terminal.
    """
    try:
        master, slave = os.openpty()
    except OSError as error:
        raise PortError(f"no pseudo-terminal to be had: {error}") from None
    tty.setraw(slave)
    os.set_blocking(master, False)
    return Pair(master, slave, os.ttyname(slave))


EXAMPLE = "gyro"  # part in the example of the next command


class PortInfo(NamedTuple):
    """A port that the system knows. Texts are empty where nothing is known."""

    path: str
    description: str
    manufacturer: str
    serial_number: str
    usable: bool  # whether we may open it; use by another program shows only on opening
    why: str  # reason why it is not usable, with the fix


def list_ports() -> list[PortInfo]:
    """All ports by path. None is opened, since that restarts some boards."""
    found = (_info(p) for p in system.comports())
    return sorted(found, key=lambda info: (_letters(info.path), _number(info.path), info.path))


def _info(port: ListPortInfo) -> PortInfo:
    why = obstacle(port.device)
    texts = (_known(t) for t in (port.description, port.manufacturer, port.serial_number))
    return PortInfo(port.device, *texts, usable=not why, why=why)


def _known(text: str | None) -> str:
    return "" if text is None or text == "n/a" else text


def _letters(path: str) -> str:
    return path.rstrip("0123456789")


def _number(path: str) -> int:
    """Number at the end of a path, so that ttyUSB10 sorts after ttyUSB9."""
    digits = path[len(_letters(path)) :]
    return int(digits) if digits else -1


def table(ports: Sequence[PortInfo]) -> str:
    """Ports as a text table, with the next command to type."""
    if not ports:
        return (
            "No serial port found.\n"
            "A USB adapter appears as /dev/ttyUSB0 or /dev/ttyACM0 as soon as it is plugged in: "
            "try another cable (some only charge), and look at what `dmesg` says of it.\n"
            "In a container or a virtual machine the device has to be passed in, for example by "
            "--device /dev/ttyUSB0.\n"
            "No hardware is needed for a run: without --node every part talks over a "
            "pseudo-terminal:\n"
            "  robins bench up satellite/s1"
        )
    head = ("port", "device", "maker", "serial number", "usable")
    rows = [
        (p.path, p.description, p.manufacturer, p.serial_number, "yes" if p.usable else "no")
        for p in ports
    ]
    lines = aligned([head, *rows])
    lines += [f"{p.path}: {p.why}" for p in ports if not p.usable]
    usable = [p for p in ports if p.usable]
    if usable:
        # a port with a description has been plugged in; a built-in one may have no socket
        likely = next((p for p in usable if p.description), usable[0])
        given = f"robins bench up satellite/s1 --node {EXAMPLE}={likely.path},{BAUD}"
        lines += ["", "To put a board in the place of a part:", f"  {given} --clock realtime"]
    return "\n".join(lines)
