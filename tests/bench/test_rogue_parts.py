"""Parts that say what they must not, among honest ones: all on threads, over pseudo-terminals."""

import threading
from contextlib import suppress
from functools import cache

import numpy as np
import pytest

from robins.bench import wire
from robins.bench.parts.satellite import BUILD
from robins.bench.parts.satellite.preparing import kit_for
from robins.bench.parts.station import Part, Station, ready, serve
from robins.bench.ports.port import address, open_port
from robins.bench.recording import Event
from robins.bench.run import outcome
from robins.bench.run.crew import Death
from robins.bench.run.session import Session
from robins.bench.run.setup import changed, read

FLIGHT = changed(
    read("satellite/s1", ("duration=60 s", "counted_from=10 s")),
    {"seconds": 4.0, "filter": "mekf-gate"},
)
WRONG = 24  # the first step in which the rogue goes wrong; it ends with a star frame
AGAIN = 5  # steps between two star frames


@cache
def kit():
    return kit_for(FLIGHT.loop, "mekf-gate", 0)


@cache
def part(name: str) -> Part:
    return ready(BUILD[name](kit()), kit().frames)


class Rogue(Station):
    """Says more, or something else, in some steps."""

    def __init__(self, of: Part, modes: tuple[str, ...]):
        super().__init__(of)
        self._modes = {WRONG + k * AGAIN: mode for k, mode in enumerate(modes)}

    def _frame(self, name: str, payload: bytes, time_ns: int) -> bytes:
        assert self._done is not None
        mode, more = self._modes.get(self._done[0]), b""
        if mode is None or name == "done":
            pass
        elif mode == "long":  # beside the right one
            more = super()._frame(name, payload + b"\1", time_ns)
        elif mode == "jump":
            self._sent = (self._sent + 2**31) % 2**32
        else:
            said = {k: np.ravel(v).copy() for k, v in wire.decode(name, payload).items()}
            said[next(iter(said))][-1] = float(mode)
            payload = wire.encode(name, said)
        return more + super()._frame(name, payload, time_ns)


class Threads:
    """In the place of `Crew`: starts no process."""

    rogue: tuple[str, tuple[str, ...]] = ("", ())

    def __init__(self, kit, realtime=False, restarts=False):
        self.threads: list[threading.Thread] = []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for thread in self.threads:
            thread.join(5.0)

    def start(self, name, port, since=-1):
        def be():
            with suppress(OSError), open_port(address(port), timeout_s=None) as line:
                rogue = name == self.rogue[0]
                serve(line, Rogue(part(name), self.rogue[1]) if rogue else Station(part(name)))

        self.threads.append(threading.Thread(target=be, daemon=True))
        self.threads[-1].start()

    def process(self, name):
        return 1

    def deaths(self, among=None):
        return []

    def remembers(self, name, step):
        return False


@pytest.fixture
def fly(monkeypatch):
    def now(name: str = "", *modes: str):
        monkeypatch.setattr(Threads, "rogue", (name, modes))
        monkeypatch.setattr("robins.bench.run.session.Crew", Threads)
        return Session(FLIGHT, kit=kit()).run()

    return now


ALL = ("long", "1e308", "inf", "nan")


@pytest.mark.parametrize(
    ("name", "refused"),  # of 'adm' two messages in four steps, of which one may have NaN
    {"gyro": 3, "star": 3, "adm": 7, "acm": 4, "actuators": 8, "table": 4}.items(),
)
def test_what_cannot_be_goes_no_further(fly, name, refused):
    ran = fly(name, *ALL)
    told = outcome.figures(FLIGHT, ran, None)
    assert ran.failure == ""
    assert np.isfinite(ran.flown.q_ib).all()
    assert np.isfinite(told["attitude_rms_arcsec"])
    assert {k: h.refused for k, h in ran.health.items() if h.refused} == {name: refused}
    assert told["counts"]["refused_frames"] == refused
    assert told["warnings"][0].startswith(f"'{name}': {refused} frames were refused")
    # each message is told of once
    messages = {"adm": 2, "actuators": 2}.get(name, 1)
    assert [e.text.split(":")[0] for e in ran.events] == [f"'{name}'"] * messages
    assert max(h.lost + h.repeated for h in ran.health.values()) == 0


@pytest.mark.parametrize(("mode", "words"), [("nan", "q_ib[3] is nan"), ("1e308", "q_ib[3] is 1e")])
def test_a_run_whose_truth_cannot_be_has_failed(fly, mode, words):
    ran = fly("plant", mode)
    assert f"at {(WRONG + 1) * 0.1:.1f} s 'plant' says a true motion that cannot be" in ran.failure
    assert words in ran.failure
    assert ran.steps == WRONG
    assert np.isfinite(ran.flown.q_ib).all()


def test_a_true_motion_of_a_wrong_length_is_refused_and_the_right_one_taken(fly):
    ran = fly("plant", "long")
    assert (ran.failure, ran.health["plant"].refused) == ("", 1)
    assert np.isfinite(ran.flown.q_ib).all()


def test_a_part_that_counts_anew_is_heard(fly):
    honest, jumped = fly(), fly("gyro", "jump")
    np.testing.assert_array_equal(jumped.flown.q_est_ib, honest.flown.q_est_ib)
    assert (jumped.health["gyro"].repeated, jumped.health["gyro"].lost) == (0, 0)
    # and what happens once is told, whatever happens often
    often = [Event(k, "missed", f"step {k}", {"time_s": 0.0}) for k in range(500)]
    once = Event(0, "died", "'adm' was killed", {"time_s": 0.0})
    told = outcome.figures(FLIGHT, honest._replace(events=[once, *often]), None)["events"]
    assert (len(told), told[0]["kind"]) == (200, "died")


def test_a_part_that_dies_again_and_again_fails_the_run(monkeypatch):
    class Mortal(Threads):
        def deaths(self, among=None):
            return [Death("adm", -9, "")]

        def start(self, name, port, since=-1):
            if len(self.threads) < len(BUILD):  # nobody comes in the place of the dead
                super().start(name, port, since)

    monkeypatch.setattr("robins.bench.run.session.Crew", Mortal)
    of = changed(FLIGHT, {"on_death": "restart", "restarts": 3})
    session = Session(of, kit=kit())
    monkeypatch.setattr(session, "_glance", lambda: session.done > 2 and session._bury())
    ran = session.run()
    assert ran.failure.startswith("'adm' was killed by SIGKILL, at 0.4 s of the run; that is one")
    assert ran.failure.endswith("one more than restarts = 3")
    assert ran.deaths == 4
    assert [e.kind for e in ran.events] == ["died"] * 4 + ["failed"]
