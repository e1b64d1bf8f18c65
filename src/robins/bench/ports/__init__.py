"""Serial ports, and their replacements without hardware.

- `port`: addresses of ports; opens real ports and pseudo-terminals, and lists those of the machine.
- `line`: a virtual line with a baud rate. `cable`: two joined paths, also as a program.
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
