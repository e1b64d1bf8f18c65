"""A bar for people who wait, and for nobody else."""

import io
import re
import time

import pytest

from robins.cli.progress import Progress


class Screen(io.StringIO):
    """A terminal, or not."""

    def __init__(self, terminal):
        super().__init__()
        self.terminal = terminal

    def isatty(self):
        return self.terminal


def until(condition):
    for _ in range(200):
        if condition():
            return True
        time.sleep(0.02)
    return False


@pytest.fixture(autouse=True)
def known_terminal(monkeypatch):
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.delenv("NO_COLOR", raising=False)


def test_a_bar_appears_after_a_while_and_goes_away():
    screen = Screen(terminal=True)
    with Progress(stream=screen, wait_s=0.05) as progress:
        progress(0.25, "[first] part")
        assert until(lambda: "[first] part" in screen.getvalue())
        assert "25%" in screen.getvalue()
        progress(2.0, "second part")
        assert until(lambda: "second part" in screen.getvalue())
        assert until(lambda: "100%" in screen.getvalue())
    ended = screen.getvalue()
    assert ended.endswith("\x1b[2K")  # the line is erased
    time.sleep(0.3)
    assert screen.getvalue() == ended


def test_it_moves_while_nothing_is_told():
    screen = Screen(terminal=True)
    with Progress(stream=screen, wait_s=0.0) as progress:
        progress(0.0, "compiling")

        def seen():
            return set(re.findall(r"([-\\|/])(?:\x1b\[[\d;]*m)? compiling", screen.getvalue()))

        assert until(lambda: len(seen()) > 2)


def test_short_work_shows_a_line_at_once_and_leaves_nothing():
    screen = Screen(terminal=True)
    with Progress(stream=screen, wait_s=0.5) as progress:
        assert screen.getvalue() == "starting ..."
        progress(0.5, "x")
    time.sleep(0.7)
    assert screen.getvalue() == "starting ...\r\x1b[2K"


def test_a_terminal_that_cannot_erase_gets_no_line(monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    screen = Screen(terminal=True)
    with Progress(stream=screen, wait_s=10.0):
        assert screen.getvalue() == ""


def test_what_is_not_a_terminal_sees_nothing():
    screen = Screen(terminal=False)
    with Progress(stream=screen, wait_s=0.0) as progress:
        progress(0.5, "x")
        time.sleep(0.2)
    assert screen.getvalue() == ""


def test_a_failure_takes_the_bar_away():
    screen = Screen(terminal=True)

    def work():
        with Progress(stream=screen, wait_s=0.01):
            assert until(lambda: "starting" in screen.getvalue())  # though nothing is told
            raise RuntimeError

    with pytest.raises(RuntimeError):
        work()
    assert screen.getvalue().endswith("\x1b[2K")
