"""The serial ports of this machine, and whether we may use them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from serial.tools import list_ports as system
from serial.tools.list_ports_common import ListPortInfo

from robins.bench.ports.port import BAUD, obstacle

EXAMPLE = "gyro"  # the part that the next command is shown with


class PortInfo(NamedTuple):
    """A port that the system knows. Texts are empty where nothing is known."""

    path: str
    description: str
    manufacturer: str
    serial_number: str
    usable: bool  # whether we may open it; who else has it open shows only when it is opened
    why: str  # it is not usable, with what to do


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
    """So that ttyUSB10 comes after ttyUSB9."""
    digits = path[len(_letters(path)) :]
    return int(digits) if digits else -1


def table(ports: Sequence[PortInfo]) -> str:
    """The ports for people, with what to type next."""
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
    widths = [max(len(row[k]) for row in (head, *rows)) for k in range(len(head))]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in (head, *rows)
    ]
    lines += [f"{p.path}: {p.why}" for p in ports if not p.usable]
    usable = [p for p in ports if p.usable]
    if usable:
        # a port that tells what it is has been plugged in; a built-in one may have no socket
        likely = next((p for p in usable if p.description), usable[0])
        given = f"robins bench up satellite/s1 --node {EXAMPLE}={likely.path},{BAUD}"
        lines += ["", "To put a board in the place of a part:", f"  {given} --clock realtime"]
    return "\n".join(lines)
