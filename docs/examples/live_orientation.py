"""Roll, pitch and heading of a nine-axis unit, printed as its samples come.

    python live_orientation.py --rate 100                      lines by UDP, port 5555
    python live_orientation.py --rate 100 --serial /dev/ttyUSB0 --baud 115200

A line is one sample: time [s], rate x y z [rad/s], specific force x y z [m/s^2] and, where the
magnetometer has read, field x y z [uT], with commas between; x forward, y right, z down:

    12.340,0.01,-0.02,0.00,0.1,0.0,-9.8,18.0,0.2,44.1

What is known is kept in `--state`, if that is given, when the program ends, and taken up again.
"""

import argparse
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from robins.rotation import to_euler
from robins.systems.marg import LiveMarg, MargReplay
from robins.systems.streaming import Flag, LiveError


def of_udp(port: int, silence_s: float) -> Iterator[str]:
    """Lines of the datagrams that come, until none comes for a while."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mouth:
        mouth.bind(("127.0.0.1", port))
        mouth.settimeout(silence_s)
        print(f"# listening at port {mouth.getsockname()[1]}", flush=True)
        try:
            while True:
                yield from mouth.recv(65536).decode("ascii", "replace").splitlines()
        except TimeoutError:
            return


def of_serial(device: str, baud: int, silence_s: float) -> Iterator[str]:
    """Lines of a serial port, until none comes for a while."""
    import serial  # pip install pyserial

    with serial.Serial(device, baud, timeout=silence_s) as port:
        while line := port.readline():
            yield line.decode("ascii", "replace").strip()


def main() -> None:
    """Print the attitude ten times a second of samples."""
    asked = argparse.ArgumentParser()
    asked.add_argument("--rate", type=float, required=True, help="of the samples [Hz]")
    asked.add_argument("--port", type=int, default=5555)
    asked.add_argument("--serial")
    asked.add_argument("--baud", type=int, default=115200)
    asked.add_argument("--silence", type=float, default=60.0, help="ends the program [s]")
    asked.add_argument("--state", type=Path)
    a = asked.parse_args()
    kept = a.state is not None and a.state.exists()
    live = LiveMarg.load(a.state) if kept else LiveMarg(MargReplay(), a.rate)
    lines = of_serial(a.serial, a.baud, a.silence) if a.serial else of_udp(a.port, a.silence)
    for number, line in enumerate(lines):
        try:
            values = [float(word) for word in line.split(",")]
            time_ns = round(1e9 * values[0])
            field_t = 1e-6 * np.array(values[7:10]) if len(values) > 7 else None
            now = live.push(time_ns, values[1:4], values[4:7], field_t)
        except (ValueError, IndexError, OverflowError) as error:
            # a line cut short, or what the filter says of a sample: the next one may be right
            who = "" if isinstance(error, LiveError) else f"line '{line[:40]}': "
            print(f"# {who}{error}", file=sys.stderr)
            continue
        if number % max(1, round(a.rate / 10.0)):
            continue
        if now.flags & Flag.STARTING:
            print(f"{values[0]:9.2f} s  starting", flush=True)
            continue
        roll, pitch, heading = np.degrees(np.array(to_euler(now.q_nb)))
        sigma = np.degrees(now.sigma_rad[2])
        state = " ".join(str(flag.name) for flag in now.flags)
        print(
            f"{values[0]:9.2f} s  roll {roll:7.2f}  pitch {pitch:7.2f}  "
            f"heading {heading % 360.0:6.2f} +- {sigma:.2f} deg  {state}",
            flush=True,
        )
    if a.state is not None:
        live.save(a.state)
    print("#", {name: count for name, count in live.counts.items() if count})


if __name__ == "__main__":
    main()
