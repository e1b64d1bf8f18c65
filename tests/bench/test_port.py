"""Ports: addresses as people write them, and ends that carry every byte."""

import os
import select
import threading
import time

import numpy as np
import pytest
import serial
from stations import GONE, receive

from robins.bench.ports import port as ports
from robins.bench.ports.port import (
    Address,
    PortError,
    address,
    open_pair,
    open_port,
)

EVERY_BYTE = bytes(range(256))


@pytest.fixture
def pair():
    with open_pair() as pair:
        yield pair


@pytest.fixture
def part(pair):
    with open_port(address(pair.path), timeout_s=2.0) as part:
        yield part


def take(master: int, count: int, timeout_s: float = 5.0) -> bytes:
    """Bytes from the bench's end, which does not block."""
    got = bytearray()
    end = time.monotonic() + timeout_s
    while len(got) < count and time.monotonic() < end:
        if select.select([master], [], [], 0.1)[0]:
            got += os.read(master, 65536)
    return bytes(got)


def put(master: int, data: bytes) -> None:
    while data:
        select.select([], [master], [], 5.0)
        try:
            data = data[os.write(master, data) :]
        except BlockingIOError:
            continue


def fill(master: int) -> None:
    while True:
        os.write(master, bytes(4096))


# -------------------------------------------------------------------------------------- addresses


def test_addresses_as_people_write_them(pair):
    assert address(pair.path) == Address(pair.path, 460800)
    assert address(f"{pair.path},115200") == Address(pair.path, 115200)
    assert address(f" {pair.path} , 9600 ") == Address(pair.path, 9600)


@pytest.mark.parametrize("speed", ["fast", "0", "-5", "", "4.6e5", "²"])
def test_a_speed_that_is_no_number(pair, speed):
    with pytest.raises(PortError, match=f"'{speed}' is no speed in baud; write {pair.path},460800"):
        address(f"{pair.path},{speed}")


def test_a_path_that_is_not_there_lists_those_there_are(monkeypatch):
    there: list[Listed] = []
    monkeypatch.setattr(ports.system, "comports", lambda: there)
    with pytest.raises(PortError, match=r"'/dev/ttyX9': there is no such path; .*machine: none"):
        address("/dev/ttyX9")
    there += [Listed("/dev/ttyUSB7"), Listed("/dev/ttyACM0")]
    with pytest.raises(PortError, match=r"machine: /dev/ttyACM0, /dev/ttyUSB7"):
        address("/dev/ttyX9,9600")


class Listed:
    def __init__(self, device: str):
        self.device = device


def test_a_path_that_is_no_port(tmp_path):
    (tmp_path / "log.txt").write_text("")
    with pytest.raises(PortError, match=r"log.txt': it is no character device"):
        address(str(tmp_path / "log.txt"))
    with pytest.raises(PortError, match=r"'/dev/null' at 460800 baud: .*ioctl"):
        open_port(address("/dev/null"))


def test_a_port_we_may_not_open_names_the_group(pair, monkeypatch):
    monkeypatch.setattr(ports.os, "access", lambda *_: False)
    monkeypatch.setattr(ports, "_group", lambda _: "dialout")
    with pytest.raises(PortError, match=r"no permission .* usermod -aG dialout \$USER"):
        address(pair.path)
    with pytest.raises(PortError, match="no permission"):
        open_port(Address(pair.path))


def test_a_port_is_ours_alone(pair, part):
    with pytest.raises(PortError, match=f"{pair.path}' is in use by another program"):
        open_port(Address(pair.path))


def test_a_speed_that_no_port_has(pair):
    with pytest.raises(PortError, match="at -5 baud"):
        open_port(Address(pair.path, -5))


def test_a_port_is_raw_and_asked_to_gather_nothing(pair, monkeypatch):
    asked = []
    monkeypatch.setattr(serial.Serial, "set_low_latency_mode", lambda _, on: asked.append(on))
    with open_port(Address(pair.path, 9600), timeout_s=None) as port:
        assert (port.baudrate, port.bytesize, port.parity, port.stopbits) == (9600, 8, "N", 1)
        assert (port.xonxoff, port.rtscts, port.dsrdtr) == (False, False, False)
        assert port.timeout is None
    assert asked == [True]


# ------------------------------------------------------------------------------------------ bytes


def test_every_byte_passes_unchanged_both_ways(pair, part):
    part.write(EVERY_BYTE)
    assert take(pair.master, 256) == EVERY_BYTE
    put(pair.master, EVERY_BYTE)
    assert part.read(256) == EVERY_BYTE
    assert take(pair.master, 1, timeout_s=0.05) == b""  # no echo


def test_every_byte_passes_before_a_part_opens_it(pair):
    """A slave that nobody has set raw would turn 0x03 into a signal and 0x0d into 0x0a."""
    put(pair.master, EVERY_BYTE)
    assert os.read(pair.slave, 256) == EVERY_BYTE


def test_a_megabyte_both_ways_at_once(pair, part):
    to_part = np.random.default_rng(1).bytes(1_000_000)
    from_part = np.random.default_rng(2).bytes(1_000_000)
    got = bytearray()

    def read() -> None:
        while len(got) < len(to_part) and (more := receive(part)):
            got.extend(more)

    threads = [
        threading.Thread(target=read),
        threading.Thread(target=part.write, args=(from_part,)),
        threading.Thread(target=put, args=(pair.master, to_part)),
    ]
    for thread in threads:
        thread.start()
    assert take(pair.master, len(from_part), timeout_s=20.0) == from_part
    for thread in threads:
        thread.join(20.0)
    assert got == to_part


def test_the_bench_never_waits(pair):
    with pytest.raises(BlockingIOError):
        os.read(pair.master, 1)
    with pytest.raises(BlockingIOError):
        fill(pair.master)


def test_reading_waits_as_long_as_told(pair):
    with open_port(Address(pair.path)) as port:
        began = time.monotonic()
        assert receive(port) == b""
        assert time.monotonic() - began < 0.05
    with open_port(Address(pair.path), timeout_s=0.1) as port:
        began = time.monotonic()
        assert receive(port) == b""
        assert time.monotonic() - began >= 0.09


def test_what_came_before_is_thrown_away(pair):
    put(pair.master, b"of an earlier run")
    with open_port(Address(pair.path)) as port:
        assert receive(port) == b""


# ---------------------------------------------------------------------------------- ends that go


def test_a_part_may_go_and_come_back(pair):
    with open_port(Address(pair.path)) as port:
        port.write(b"one")
    assert take(pair.master, 3) == b"one"
    with pytest.raises(BlockingIOError):  # silent, not broken
        os.read(pair.master, 1)
    with open_port(Address(pair.path)) as port:
        port.write(b"two")
        assert take(pair.master, 3) == b"two"


def test_a_far_end_that_is_gone_is_told(pair, part):
    pair.close()
    pair.close()
    with pytest.raises(GONE):
        receive(part)
    with pytest.raises(GONE):
        part.write(b"x")


def test_no_more_pseudo_terminals(monkeypatch):
    def none():
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(ports.os, "openpty", none)
    with pytest.raises(PortError, match=r"no pseudo-terminal to be had: .*No space"):
        open_pair()
