"""A cable without hardware: what is written to one end is read from the other."""

import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from stations import GONE, receive

from robins.bench.ports.cable import cable
from robins.bench.ports.port import Address, address, open_port


@pytest.fixture
def ends():
    with (
        cable() as paths,
        open_port(address(paths.bench), 5.0) as bench,
        open_port(address(paths.board), 5.0) as board,
    ):
        yield bench, board


def test_every_byte_gets_across(ends):
    every = bytes(range(256))
    for one, other in (ends, ends[::-1]):
        one.write(every)
        assert other.read(256) == every
        assert one.in_waiting == 0  # no echo


def test_a_megabyte_both_ways_at_once(ends):
    rng = np.random.default_rng(5)
    sent = [rng.bytes(1_000_000) for _ in ends]
    got = [bytearray(), bytearray()]

    def read(port, into: bytearray) -> None:
        while len(into) < 1_000_000 and (more := receive(port)):
            into.extend(more)

    threads = [threading.Thread(target=p.write, args=(d,)) for p, d in zip(ends, sent, strict=True)]
    threads += [threading.Thread(target=read, args=(p, g)) for p, g in zip(ends, got, strict=True)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20.0)
    assert got == sent[::-1]


def test_what_nobody_reads_waits_and_holds_up_nothing_else(ends):
    bench, board = ends
    heap = bytes(1000)
    filled = 0
    while filled < 1_000_000:
        try:
            filled += os.write(bench.fileno(), heap)
        except BlockingIOError:  # it is full, and stays so
            time.sleep(0.05)
            try:
                filled += os.write(bench.fileno(), heap)
            except BlockingIOError:
                break
    assert 4000 < filled < 1_000_000
    board.write(b"back")
    assert bench.read(4) == b"back"
    assert board.read(filled) == bytes(filled)


def test_ends_are_gone_with_the_cable():
    with cable() as paths:
        bench = open_port(Address(paths.bench))
    with bench, pytest.raises(GONE):
        receive(bench)
    assert not os.path.exists(paths.board)


def test_as_a_program():
    command = [sys.executable, "-m", "robins.bench.ports.cable"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, text=True, **pipes) as process:
        paths = [process.stdout.readline().split() for _ in range(2)]
        assert [name for name, _ in paths] == ["bench:", "board:"]
        with open_port(address(paths[0][1])) as one, open_port(address(paths[1][1]), 5.0) as other:
            one.write(b"hello")
            assert other.read(5) == b"hello"
        process.send_signal(signal.SIGINT)
        try:
            assert process.wait(5.0) == 0
            assert process.stderr.read() == ""
        finally:
            process.kill()  # or the end of the context waits for it
