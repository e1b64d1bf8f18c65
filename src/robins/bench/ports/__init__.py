"""Serial ports, and their replacements without hardware.

- `port`: what people write for one; a real one opened; a pseudo-terminal. `listing`: what there is.
- `line`: bytes that get through at the baud rate. `cable`: two paths, joined; also a program.
"""

from robins.bench.ports.line import SerialLine
from robins.bench.ports.port import (
    Address,
    Pair,
    PortError,
    PortInfo,
    address,
    list_ports,
    open_pair,
    open_port,
)
from robins.errors import moved

__all__ = [
    "Address",
    "Pair",
    "PortError",
    "PortInfo",
    "SerialLine",
    "address",
    "list_ports",
    "open_pair",
    "open_port",
]

__getattr__ = moved(__name__)
