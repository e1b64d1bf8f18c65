"""The list of ports, as a machine without any, with some, and this one has it."""

import os

import pytest
from serial.tools.list_ports_common import ListPortInfo

from robins.bench.ports import port as listing
from robins.bench.ports import port as one_port
from robins.bench.ports.port import BAUD, PortInfo, address, list_ports, open_pair, table


def known(path: str, description: str = "n/a", maker: str | None = None, serial: str | None = None):
    port = ListPortInfo(path)
    port.description, port.manufacturer, port.serial_number = description, maker, serial
    return port


@pytest.fixture
def pair():
    with open_pair() as pair:
        yield pair


def test_ports_of_this_machine():
    for info in list_ports():
        assert os.path.exists(info.path)
        assert info.usable is (not info.why)


def test_what_the_system_says_and_what_it_does_not(monkeypatch, pair):
    there = [known(pair.path, "FT232R USB UART", "FTDI", "A50285BI"), known("/dev/ttyX0")]
    monkeypatch.setattr(listing.system, "comports", lambda: there)
    assert list_ports()[0] == PortInfo(pair.path, "FT232R USB UART", "FTDI", "A50285BI", True, "")
    gone = list_ports()[1]
    assert gone[1:5] == ("", "", "", False)
    assert "there is no such path" in gone.why


def test_a_port_that_we_may_not_open_says_what_to_do(monkeypatch, pair):
    monkeypatch.setattr(listing.system, "comports", lambda: [known(pair.path)])
    monkeypatch.setattr(one_port.os, "access", lambda *_: False)
    found = list_ports()
    assert not found[0].usable
    text = table(found)
    assert "usermod -aG" in text
    assert "--node" not in text  # there is nothing to type yet


def test_ports_are_in_the_order_of_their_numbers(monkeypatch):
    names = ["/dev/ttyUSB10", "/dev/ttyS0", "/dev/ttyUSB9", "/dev/ttyACM0", "/dev/cu.debug"]
    monkeypatch.setattr(listing.system, "comports", lambda: [known(n) for n in names])
    in_order = ["/dev/cu.debug", "/dev/ttyACM0", "/dev/ttyS0", "/dev/ttyUSB9", "/dev/ttyUSB10"]
    assert [p.path for p in list_ports()] == in_order


def test_the_table_ends_with_what_to_type(pair):
    text = table(
        [
            PortInfo("/dev/ttyS0", "", "", "", False, "no permission"),
            PortInfo("/dev/ttyS1", "", "", "", True, ""),
            PortInfo(pair.path, "FT232R USB UART", "FTDI", "A50285BI", True, ""),
        ]
    )
    lines = text.splitlines()
    assert lines[0].split() == ["port", "device", "maker", "serial", "number", "usable"]
    assert lines[3].split() == [pair.path, "FT232R", "USB", "UART", "FTDI", "A50285BI", "yes"]
    assert lines[1].index("no") == lines[3].index("yes") == lines[0].index("usable")
    assert lines[4] == "/dev/ttyS0: no permission"
    command = lines[-1].split()
    assert command[:4] == ["robins", "bench", "up", "satellite/s1"]
    part, _, where = command[command.index("--node") + 1].partition("=")
    assert part == "gyro"
    assert address(where) == (pair.path, BAUD)


def test_no_port_at_all():
    text = table([])
    assert text.startswith("No serial port found.")
    for word in ("cable", "container", "pseudo-terminal", "robins bench up satellite/s1"):
        assert word in text
