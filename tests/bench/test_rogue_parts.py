"""Parts that say what they must not, among honest ones: all on threads, over pseudo-terminals."""

import math
import time
from functools import partial, partialmethod

import numpy as np
import pytest
from clockwork import CLOCKWORK, adder
from stations import Threads, config, on_threads

from robins.bench.broker import Broker
from robins.bench.parts.station import Part, Station
from robins.bench.recording import Event
from robins.bench.rigs.satellite import RIG
from robins.bench.rigs.satellite.messages import WIRE
from robins.bench.run import outcome
from robins.bench.run.processes import ProcessExit
from robins.bench.run.session import Session
from robins.bench.run.setup import changed, read
from robins.bench.wire import Wire

SHORT = "duration=60 s", "counted_from=10 s"
FLIGHT = changed(read("satellite/s1", SHORT), {"seconds": 4.0, "filter": "mekf-gate"})
WRONG = 24  # the first step in which the rogue goes wrong; it ends with a star frame
AGAIN = 5  # steps between two star frames


class Rogue(Station):
    """Says more, or something else, in some steps."""

    def __init__(self, of: Part, wire: Wire, modes: tuple[str, ...]):
        super().__init__(of, wire)
        self._modes = {WRONG + k * AGAIN: mode for k, mode in enumerate(modes)}

    def _frame(self, name: str, payload: bytes, time_ns: int) -> bytes:
        mode, more = self._modes.get(self._done[0]), b""
        if mode is None or name == "done":
            pass
        elif mode == "long":  # beside the right one
            more = super()._frame(name, payload + b"\1", time_ns)
        elif mode == "jump":
            self._sent = (self._sent + 2**31) % 2**32
        else:
            said = {k: np.ravel(v).copy() for k, v in WIRE.decode(name, payload).items()}
            said[next(iter(said))][-1] = float(mode)
            payload = WIRE.encode(name, said)
        return more + super()._frame(name, payload, time_ns)


@pytest.fixture
def fly(monkeypatch):
    # A slow machine's ticks would be sent again after a second, and answered again.
    monkeypatch.setattr(Broker, "step", partialmethod(Broker.step, again_ns=100_000_000_000))

    def now(name: str = "", *modes: str):
        on_threads(monkeypatch, **{name: partial(Rogue, modes=modes)})
        return session(FLIGHT).run()

    return now


def session(of):
    return Session(of, config=config("satellite/s1", "mekf-gate", *SHORT))


def figures(result):
    return outcome.figures(FLIGHT, result, outcome.run_figures(FLIGHT, result), None)


ALL = ("long", "1e308", "inf", "nan")


@pytest.mark.parametrize(
    ("name", "refused"),  # of 'adm' two messages in four steps, of which one may have NaN
    {"gyro": 3, "star": 3, "adm": 7, "acm": 4, "actuators": 8, "table": 4}.items(),
)
def test_what_cannot_be_goes_no_further(fly, name, refused):
    result = fly(name, *ALL)
    told = figures(result)
    assert result.failure == ""
    assert np.isfinite(result.series["motion.q_ib"]).all()
    assert np.isfinite(told["attitude_rms_arcsec"])
    assert {k: h.refused for k, h in result.health.items() if h.refused} == {name: refused}
    assert told["counts"]["refused_frames"] == refused
    assert told["warnings"][0].startswith(f"'{name}': {refused} frames were refused")
    # each message is told of once
    messages = {"adm": 2, "actuators": 2}.get(name, 1)
    assert [e.text.split(":")[0] for e in result.events] == [f"'{name}'"] * messages
    assert max(h.lost + h.repeated for h in result.health.values()) == 0


@pytest.mark.parametrize(("mode", "words"), [("nan", "q_ib[3] is nan"), ("1e308", "q_ib[3] is 1e")])
def test_a_run_whose_truth_cannot_be_has_failed(fly, mode, words):
    result = fly("plant", mode)
    assert (
        f"at {(WRONG + 1) * 0.1:.1f} s 'plant' says a true motion that cannot be" in result.failure
    )
    assert words in result.failure
    assert result.steps == WRONG
    assert np.isfinite(result.series["motion.q_ib"]).all()


def test_a_true_motion_of_a_wrong_length_is_refused_and_the_right_one_taken(fly):
    result = fly("plant", "long")
    assert (result.failure, result.health["plant"].refused) == ("", 1)
    assert np.isfinite(result.series["motion.q_ib"]).all()


def test_a_part_that_counts_anew_is_heard(fly):
    honest, jumped = fly(), fly("gyro", "jump")
    np.testing.assert_array_equal(jumped.series["estimate.q_ib"], honest.series["estimate.q_ib"])
    assert (jumped.health["gyro"].repeated, jumped.health["gyro"].lost) == (0, 0)
    # and what happens once is told, whatever happens often
    often = [Event(k, "missed", f"step {k}", {"time_s": 0.0}) for k in range(500)]
    once = Event(0, "died", "'adm' was killed", {"time_s": 0.0})
    told = figures(honest._replace(events=[once, *often]))["events"]
    assert (len(told), told[0]["kind"]) == (200, "died")


CLOCK = changed(read(CLOCKWORK), {"seconds": 0.9})
STEP_NS, STEPS, ODD = 100_000_000, 9, 5


class Untimely(Station):
    """Says a number more in a step, after one of its messages: as sound, as new, of another time.

    In the step before it leaves its own out, if it is to.
    """

    def __init__(self, of: Part, wire: Wire, after: str, later_ns: int, leaves_out: bool = False):
        super().__init__(of, wire)
        self._after, self._later_ns, self._leaves_out = after, later_ns, leaves_out

    def _frame(self, name: str, payload: bytes, time_ns: int) -> bytes:
        step = self._done[0]
        if name == "count" and self._leaves_out and step == ODD - 1:
            return b""
        frame = super()._frame(name, payload, time_ns)
        if step == ODD and name == self._after:
            lie = self._wire.encode("count", {"n": 777.0})
            frame += super()._frame("count", lie, time_ns + self._later_ns)
        return frame


def clockwork(monkeypatch, lag: int = 0, counter=Station, **more):
    """A run of the clockwork whose counter is odd, its health, and what is counted in its lines."""
    build = {"adder": lambda of: adder(of)._replace(takes={"count": lag})}
    of = CLOCK._replace(rig=CLOCK.rig.varied(name=f"clockwork {lag}", build=build))
    on_threads(monkeypatch, counter=partial(counter, **more) if more else counter)
    result = Session(of).run()
    assert (result.failure, result.steps) == ("", STEPS)
    told = outcome.figures(of, result, outcome.run_figures(of, result), None)["counts"]
    told = {name.removesuffix("_frames"): n for name, n in told.items() if n and name != "frames"}
    return result, told


@pytest.mark.parametrize(
    ("lag", "after", "steps", "counted"),
    [
        (0, "count", 0, "repeated"),
        (1, "done", 0, "repeated"),
        (0, "count", -1, "repeated"),
        (1, "count", -1, "repeated"),
        (0, "count", -ODD, "repeated"),
        (1, "count", -ODD - 1, "late"),  # before the first step
        (1, "count", -0.5, "late"),  # between two
        (1, "count", 1, "early"),
        (0, "count", 1e10, "early"),
    ],
)
def test_neither_past_nor_future_can_be_written(monkeypatch, lag, after, steps, counted):
    later_ns = round(steps * STEP_NS)
    result, told = clockwork(monkeypatch, lag, Untimely, after=after, later_ns=later_ns)
    assert told == {counted: 1}
    wanted = CLOCK.rig.inside(None, STEPS)
    np.testing.assert_array_equal(result.series["count.n"], wanted["count.n"])
    wanted = np.r_[np.zeros(lag), wanted["sum.total"][: STEPS - lag]]
    np.testing.assert_array_equal(result.series["sum.total"], wanted)


@pytest.mark.parametrize("lag", [0, 1])
def test_a_step_is_filled_in_later_only_where_a_part_takes_its_message_so(monkeypatch, lag):
    late = {"after": "count", "later_ns": -STEP_NS, "leaves_out": True}
    result, told = clockwork(monkeypatch, lag, Untimely, **late)
    assert told == {"late": 1}
    n = np.arange(float(STEPS))
    n[ODD - 1] = 777.0 if lag else np.nan
    np.testing.assert_array_equal(result.series["count.n"], n)
    n[ODD - 1] = 0.0  # the adder was ticked before it came
    sums = np.cumsum(n)[: STEPS - lag]
    np.testing.assert_array_equal(result.series["sum.total"], np.r_[np.zeros(lag), sums])


@pytest.mark.parametrize(("ahead", "lost", "jumps"), [(7, 7, 0), (10**9, 0, 1), (2**31 + 5, 0, 1)])
def test_a_jump_of_a_number_is_no_loss_of_frames(monkeypatch, ahead, lost, jumps):
    class Jumps(Station):
        def _frame(self, name, payload, time_ns):
            if name == "count" and self._done[0] == ODD:
                self._sent += ahead
            return super()._frame(name, payload, time_ns)

    result, told = clockwork(monkeypatch, 0, Jumps)
    assert (told.pop("lost", 0), told.pop("sequence_jumps", 0), told) == (lost, jumps, {})
    np.testing.assert_array_equal(result.series["count.n"], np.arange(float(STEPS)))


def test_a_frame_that_no_part_may_send_is_strange_and_not_lost(monkeypatch):
    class Strange(Station):
        def _frame(self, name, payload, time_ns):
            frame = super()._frame(name, payload, time_ns)
            if name == "count" and self._done[0] == ODD:
                tick = self._wire.encode("tick", {"step": ODD})
                frame += super()._frame("sum", payload, time_ns)
                frame += super()._frame("tick", tick, time_ns)
            return frame

    result, told = clockwork(monkeypatch, 0, Strange)
    assert (result.health["counter"].strange, told) == (2, {})


@pytest.mark.parametrize("works", [True, False])
def test_a_part_that_computes_is_waited_for_and_named(monkeypatch, works):
    """Before the first step, and in one; a part that does nothing is not."""

    class Slow(Station):
        def hello(self):
            time.sleep(0.5)
            return super().hello()

        def _compute(self, step, time_ns):
            time.sleep(0.5 * (step == ODD))
            super()._compute(step, time_ns)

    told, step = [], Broker.step
    short = {"again_ns": 50_000_000, "most_ns": 200_000_000}
    monkeypatch.setattr(Broker, "step", lambda *args: step(*args, **short))
    monkeypatch.setattr(Threads, "idle_s", lambda part_processes, part: 0.0 if works else math.inf)
    for name in ("session.FIRST_HELLO_S", "session._LONG_S"):
        monkeypatch.setattr(f"robins.bench.run.{name}", 0.2 if works else 1.0)
    monkeypatch.setattr("robins.bench.broker.broker._REPORT_S", 0.1)
    on_threads(monkeypatch, counter=Slow)
    result = Session(CLOCK, progress=lambda share, what: told.append(what)).run()
    assert "counter: starting, compiling" in told
    said = [event.text for event in result.events if event.kind == "waiting"]
    assert bool(said) == works
    if works:
        assert (result.failure, result.steps) == ("", STEPS)
        assert all(": counter: starting, compiling" in text for text in said)
    else:
        words = f"'counter' does not answer the tick of step {ODD} (for 0.2 s)"
        assert (result.failure, result.steps) == (words, ODD)


@pytest.mark.parametrize(
    ("restarts", "why"), [(2, "one more than restarts = 2"), (10, "its third death in a minute")]
)
def test_a_part_that_dies_again_and_again_fails_the_run(monkeypatch, restarts, why):
    class Mortal(Threads):
        def deaths(self, among=None):
            return [ProcessExit("adm", -9, "")]

        def start(self, name, port, since=-1):
            if len(self._running) < len(RIG.parts):  # nobody comes in the place of the dead
                super().start(name, port, since)

    on_threads(monkeypatch, Mortal)
    mortal = session(changed(FLIGHT, {"on_death": "restart", "restarts": restarts}))
    monkeypatch.setattr(mortal, "_poll", lambda: mortal.done > 2 and mortal._reap())
    result = mortal.run()
    assert result.failure.startswith("'adm' was killed by SIGKILL, at 0.4 s of the run; that is ")
    assert result.failure.endswith(why)
    assert result.deaths == 3
    assert [e.kind for e in result.events] == ["died"] * 3 + ["failed"]
