"""Faults on purpose: what a scenario may say, and what becomes of frames."""

import os
from collections import Counter
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robins.bench import wire
from robins.bench.broker.faults import LinkFault
from robins.bench.broker.injector import Injector, LineOutput
from robins.bench.broker.link import Link
from robins.bench.ports.port import open_pair
from robins.bench.rigs.satellite import RIG
from robins.bench.rigs.satellite.messages import WIRE
from robins.bench.wire import Frame, Header, Receiver
from robins.rotation import from_rotvec, multiply
from robins.scenario import Parameters, ScenarioError, parse
from robins.systems.satellite import nodes
from robins.systems.satellite.nodes import NoiseFreeInputs
from robins.systems.satellite.parameters import StarSensor
from robins.systems.satellite.world import _star_sensor_faults

S = 10**9
injecting = partial(Injector, RIG.table)
WORKING = np.arange(1.0, 5.0)


class Scenario(Parameters):
    faults: tuple[RIG.fault, ...] = ()


def faults(*texts: str) -> tuple[LinkFault, ...]:
    """Each as the lines of a table, on one line."""
    tables = ("[[faults]]\n" + text.replace("; ", "\n") for text in texts)
    return parse(Scenario, "\n".join(tables)).faults


def frame(name: str, values: dict, time_ns: int = 0, sequence: int = 0) -> Frame:
    payload = WIRE.encode(name, values)
    return Frame(Header(WIRE.message(name).number, 7, sequence, time_ns), payload)


def gyro(k: int) -> Frame:
    return frame("gyro", {"theta_b": [1.0, 2.0, float(k)]}, k * S // 10, k)


def star(q, time_ns: int = 0, stars: int = 5) -> Frame:
    return frame("star", {"q_ib": q, "factor": np.arange(9.0), "stars": stars}, time_ns)


def put(injector: Injector, link: str, direction: str, one: Frame, now_ns: int) -> list[LineOutput]:
    return injector.pass_on(link, direction, one, wire.encode_frame(*one), now_ns)


def said(pieces: list[LineOutput]) -> dict:
    (piece,) = pieces
    assert piece.raw is None
    return WIRE.decode(WIRE.message(piece.frame.header.type).name, piece.frame.payload)


def numbers(pieces: list[LineOutput]) -> list[int]:
    return [p.frame.header.sequence for p in pieces if p.frame is not None]


# ------------------------------------------------------------------------------------- parameters


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('kind = "loss"; angle = "3 deg"', "angle: a fault of kind 'loss' has none; it takes kind"),
        ('kind = "silent"; share = "3 %"', "share: a fault of kind 'silent' has none"),
        ('kind = "killed"', "link: a fault of kind 'killed' needs it"),
        ('kind = "power"', "link: a fault of kind 'power' needs it"),
        ('kind = "killed"; link = "adm"; end = "3 s"', "a part is killed once, at begin: leave"),
        ('kind = "delay"', "delay: a fault of kind 'delay' needs it"),
        ('kind = "wheel"', "wheel: a fault of kind 'wheel' needs it"),
        ('kind = "wheel"; wheel = 4', "wheel = 4"),
        ('kind = "loss"; end = "1 s"', r"end \(1 s\) must come after begin \(1 s\)"),
        ('kind = "loss"; link = "gyr"', "no part 'gyr', only plant, table, gyro, star, adm, acm"),
        ('kind = "loss"; link = "bench"', "there is no part 'bench'"),
        ('kind = "loss"; message = "stars"', "there is no 'stars' to meet, only motion, mounted"),
        ('kind = "loss"; message = "tick"', r"to meet \(those of the clock are spared\), only mot"),
        ('kind = "loss"; link = "gyro"; message = "star"', "'star' never goes from 'gyro', only g"),
        ('kind = "loss"; link = "adm"; message = "star"', "never goes from 'adm', only estimate"),
        ('kind = "turned"; link = "gyro"', "'star' never goes from 'gyro'"),
        ('kind = "stuck"; message = "gyro"', "message: a fault of kind 'stuck' is one of 'star'"),
        ('kind = "turned"; angle = "181 deg"', "must be at most 180 deg"),
        ('kind = "loss"; share = "0 %"', "must be above 0"),
        ('kind = "bit errors"; bits = 0', "bits = 0"),
        ('kind = "loose"', "did you mean 'lo"),
        ('kind = "loss"; direction = "up"', "direction"),
    ],
)
def test_faults_that_cannot_be(text, words):
    with pytest.raises(ScenarioError, match=words):
        faults(f'begin = "1 s"; {text}')


def test_faults_as_they_are_written():
    one, two, three, four = faults(
        'kind = "turned"; begin = "600 s"; end = "0.2 h"; angle = "20 deg"',
        'kind = "wheel"; begin = "0 s"; wheel = 3',
        'kind = "killed"; begin = "1 min"; link = "adm"',
        'kind = "lost"; begin = "1 s"; link = "adm"; direction = "to"',
    )
    assert (one.link, one.direction, one.message) == ("star", "from", "star")
    assert (one.begin_ns, one.end_ns) == (600 * S, 720 * S)
    assert one.angle == pytest.approx(np.radians(20.0), rel=1e-15)
    assert (two.link, two.message, two.wheel) == ("actuators", "actuation", 3)
    assert (three.begin_ns, three.link) == (60 * S, "adm")
    assert (four.link, four.message) == ("adm", "star")


def test_routes_are_of_the_messages_there_are():
    """Each data message comes from one part, or from the operator, and goes to one at least."""
    data = {m.name for m in WIRE.data}
    assert Counter(m for sent in (*RIG.sends.values(), RIG.console) for m in sent) == Counter(data)
    taken = {m for taken in RIG.takes.values() for m in taken}
    assert taken == data - {"innovation"}  # for who watches


def test_seeds_that_cannot_be():
    with pytest.raises(ValueError, match="seed must be from 0 to"):
        injecting(seed=-1)


# ---------------------------------------------------------------------------------------- the line


def test_bit_errors_spoil_a_frame_by_as_many_bits():
    injector = injecting(faults('kind = "bit errors"; begin = "0 s"; link = "gyro"; bits = 3'), 1)
    receiver, seen = Receiver(), set()
    for k in range(200):
        one = gyro(k)
        raw = wire.encode_frame(*one)
        (piece,) = injector.pass_on("gyro", "from", one, raw, 0)
        assert piece.frame is None
        bits = np.unpackbits(np.frombuffer(piece.raw, "u1") ^ np.frombuffer(raw, "u1"))
        assert bits.sum() == 3
        seen.update(np.flatnonzero(bits))
        assert receiver.feed(piece.raw) == []
        assert receiver.feed(raw) == [one]
    assert receiver.counts.frames == 200
    assert receiver.counts.wrong >= 199  # one may be two where a bit made a zero
    assert len(seen) > 300  # of 392 bits, 600 hit


def lossy(share: str, link: str, seed: int, count: int = 4000, **more) -> np.ndarray:
    """Which frames a fault of loss leaves."""
    text = f'kind = "loss"; begin = "0 s"; link = "{link}"; share = "{share}"'
    injector = injecting([*more.get("before", ()), *faults(text), *more.get("after", ())], seed)
    name = RIG.sends[link][0]
    fields = {f.name: np.zeros(f.length, int) for f in WIRE.message(name).fields}
    one = frame(name, fields)
    out = []
    for k in range(count):
        out.append(bool(put(injector, link, "from", one, k)))
        for other in more.get("among", ()):
            put(injector, other, "to", frame("motion", {"q_ib": WORKING, "omega_b": [0, 0, 0]}), k)
    assert injector.counts["loss", link] == count - sum(out)
    return np.array(out)


def test_losses_are_a_share_and_those_of_the_seed():
    first = lossy("30 %", "gyro", 5)
    assert abs(np.mean(~first) - 0.3) < 4.0 * np.sqrt(0.3 * 0.7 / len(first))
    np.testing.assert_array_equal(first, lossy("30 %", "gyro", 5))
    for other in (lossy("30 %", "gyro", 6), lossy("30 %", "table", 5)):
        agree = np.mean(first == other)  # 0.58 where they know nothing of each other
        assert abs(agree - 0.58) < 4.0 * np.sqrt(0.58 * 0.42 / len(first))
    pairs = np.mean(~first[1:] & ~first[:-1])
    assert abs(pairs - 0.09) < 4.0 * np.sqrt(0.09 * 0.91 / len(first))


def test_noise_of_a_fault_is_its_own():
    """Neither other faults nor other links nor how fast it runs change what a fault hits."""
    first = lossy("50 %", "gyro", 5, 200)
    more = faults('kind = "loss"; begin = "0 s"; share = "50 %"; direction = "to"')
    np.testing.assert_array_equal(
        first, lossy("50 %", "gyro", 5, 200, after=more, among=("table", "star"))
    )
    assert np.any(first != lossy("50 %", "gyro", 5, 200, before=more))  # another number


def test_duplication_and_silence():
    injector = injecting(
        faults(
            'kind = "duplication"; begin = "1 s"; end = "2 s"; link = "gyro"',
            'kind = "silent"; begin = "2 s"; end = "3 s"; link = "gyro"',
            'kind = "loss"; begin = "3 s"; message = "wheels"; direction = "to"',
        )
    )
    assert [len(put(injector, "gyro", "from", gyro(k), k * S // 10)) for k in range(9, 32)] == [
        1, *[2] * 10, *[0] * 10, 1, 1
    ]  # fmt: skip
    wheels = frame("wheels", {"momentum": WORKING})
    assert put(injector, "acm", "to", wheels, 4 * S) == []
    assert len(put(injector, "actuators", "from", wheels, 4 * S)) == 1
    assert len(put(injector, "acm", "to", gyro(1), 4 * S)) == 1
    assert injector.counts == {
        ("duplication", "gyro"): 10, ("silent", "gyro"): 10, ("loss", "acm"): 1
    }  # fmt: skip


def test_delayed_frames_are_due_later():
    injector = injecting(
        faults('kind = "delay"; begin = "0 s"; end = "0.3 s"; delay = "0.25 s"; link = "gyro"')
    )
    went = []
    for k in range(6):
        now = k * S // 10
        went.append(numbers(injector.release("gyro", "from", now)))
        went[-1] += numbers(put(injector, "gyro", "from", gyro(k), now))
    assert went == [[], [], [], [0, 3], [1, 4], [2, 5]]
    assert injector.release("gyro", "to", 10 * S) == []


def test_delayed_frames_come_as_they_are_due():
    injector = injecting(
        faults(
            'kind = "delay"; begin = "0 s"; end = "0.1 s"; delay = "0.3 s"; link = "gyro"',
            'kind = "delay"; begin = "0.1 s"; delay = "0.1 s"; link = "gyro"',
        )
    )
    for k in range(2):
        assert put(injector, "gyro", "from", gyro(k), k * S // 10) == []
    assert numbers(injector.release("gyro", "from", S)) == [1, 0]


def test_disorder_swaps_neighbours_of_the_same_message():
    injector = injecting(faults('kind = "reorder"; begin = "0 s"; end = "0.45 s"; link = "adm"'))
    sigma = {"innovation": [0, 0, 0], "sigma": [1, 1, 1], "ratio": 0.5}
    went = []
    for k in range(7):
        now = k * S // 10
        went.append(numbers(injector.release("adm", "from", now)))
        went[-1] += numbers(put(injector, "adm", "from", gyro(k), now))
        if k == 2:  # one of another message swaps with nothing, and waits
            assert put(injector, "adm", "from", frame("innovation", sigma, 0, 99), now) == []
    # frame 4 has no successor within the fault, nor has the other: they come when it ends
    assert went == [[], [1, 0], [], [3, 2], [], [99, 4, 5], [6]]


def test_a_swapped_frame_goes_with_its_successor_even_after_the_fault():
    injector = injecting(faults('kind = "reorder"; begin = "0 s"; end = "0.15 s"; link = "gyro"'))
    assert put(injector, "gyro", "from", gyro(0), 0) == []
    assert numbers(put(injector, "gyro", "from", gyro(2), S // 5)) == [2, 0]
    assert injector.release("gyro", "from", S) == []


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["delay", "reorder"]),
            st.integers(0, 20),
            st.integers(1, 20),
            st.integers(1, 100),
            st.integers(1, 9),
        ),
        max_size=4,
    ),
    st.integers(0, 3),
)
def test_what_is_held_back_comes_once(drawn, seed):
    texts = [
        f'kind = "{kind}"; begin = "{b} s"; end = "{b + n} s"; share = "{share} %"'
        + (f'; delay = "{late} s"' if kind == "delay" else "")
        for kind, b, n, share, late in drawn
    ]
    injector, went = injecting(faults(*texts), seed), []
    for k in range(40):
        went += numbers(injector.release("gyro", "from", k * S))
        went += numbers(put(injector, "gyro", "from", gyro(k), k * S))
    injector.clear()
    went += numbers(injector.release("gyro", "from", 40 * S))
    assert sorted(went) == list(range(40))
    assert injector.release("gyro", "from", 99 * S) == []


def test_the_clock_is_spared():
    every = (
        'kind = "bit errors"; begin = "0 s"',
        'kind = "loss"; begin = "0 s"',
        'kind = "silent"; begin = "0 s"; direction = "to"',
        'kind = "delay"; begin = "0 s"; delay = "1 s"',
        'kind = "reorder"; begin = "0 s"; direction = "to"',
        'kind = "killed"; begin = "0 s"; link = "gyro"',
        'kind = "power"; begin = "0 s"; link = "gyro"',
    )
    injector = injecting(faults(*every), 3)
    for m in WIRE.messages:
        one = Frame(Header(m.number, 7, 0, 0), bytes(WIRE.size_of(m.name)))
        for direction in ("to", "from"):
            kept = put(injector, "gyro", direction, one, 0) == [LineOutput(None, one)]
            assert kept is (m.number < 16)


def test_a_part_is_without_power_from_begin_to_end():
    injector = injecting(
        faults(
            'kind = "power"; begin = "2 s"; end = "4 s"; link = "adm"',
            'kind = "power"; begin = "3 s"; link = "gyro"',
        )
    )
    off = [injector.off(k * S) for k in range(1, 6)]
    assert off == [set(), {"adm"}, {"adm", "gyro"}, {"gyro"}, {"gyro"}]
    injector.clear()
    assert injector.off(5 * S) == set()


def test_killed_once_each():
    injector = injecting(
        faults(
            'kind = "killed"; begin = "2 s"; link = "adm"',
            'kind = "killed"; begin = "3 s"; link = "gyro"',
            'kind = "killed"; begin = "4 s"; link = "adm"',
        )
    )
    assert [injector.killed(k * S) for k in range(1, 7)] == [[], ["adm"], ["gyro"], ["adm"], [], []]
    assert injector.counts == {("killed", "adm"): 2, ("killed", "gyro"): 1}


def test_faults_come_and_go():
    first, second = faults(
        'kind = "loss"; begin = "1 s"; end = "2 s"; link = "gyro"',
        'kind = "loss"; begin = "0 s"; link = "gyro"',
    )
    injector = injecting([first])
    assert [injector.active(t) for t in (S - 1, S, 2 * S - 1, 2 * S)] == [[], [first], [first], []]
    assert len(put(injector, "gyro", "from", gyro(0), 5 * S)) == 1
    injector.add(second)
    assert put(injector, "gyro", "from", gyro(1), 5 * S) == []
    assert injector.active(5 * S) == [second]
    injector.clear()
    assert injector.active(5 * S) == []
    assert len(put(injector, "gyro", "from", gyro(2), 5 * S)) == 1


def test_one_fault_is_taken_away():
    first, second, third = faults(
        'kind = "loss"; begin = "0 s"; link = "gyro"',
        'kind = "loss"; begin = "0 s"; link = "adm"',
        'kind = "delay"; begin = "0 s"; delay = "2 s"; link = "table"',
    )
    injector = injecting([first, second, third])
    assert put(injector, "table", "from", gyro(4), S) == []
    for fault in (first, third):
        injector.remove(fault)
    assert injector.active(S) == [second]
    assert len(put(injector, "gyro", "from", gyro(0), S)) == 1
    assert put(injector, "adm", "from", gyro(0), S) == []
    # what it holds back comes in its time
    assert injector.release("table", "from", 2 * S) == []
    assert numbers(injector.release("table", "from", 3 * S)) == [4]


# ------------------------------------------------------------------------- sensors and actuators


def test_a_wheel_without_torque():
    injector = injecting(faults('kind = "wheel"; begin = "1 s"; wheel = 2'))
    one = frame("actuation", {"wheel_torque": WORKING, "dipole_b": [7.0, 8.0, 9.0]})
    assert put(injector, "actuators", "from", one, S - 1) == [LineOutput(None, one)]
    now = said(put(injector, "actuators", "from", one, S))
    np.testing.assert_array_equal(now["wheel_torque"], [1.0, 2.0, 0.0, 4.0])
    np.testing.assert_array_equal(now["dipole_b"], [7.0, 8.0, 9.0])


def test_a_turned_attitude():
    q = np.array([0.5, -0.5, 0.1, 0.7]) / np.linalg.norm([0.5, -0.5, 0.1, 0.7])
    injector = injecting(faults('kind = "turned"; begin = "0 s"; angle = "25 deg"'))
    now = said(put(injector, "star", "from", star(q), 0))
    turn = from_rotvec(jnp.array([0.0, 0.0, np.radians(25.0)]))
    np.testing.assert_allclose(now["q_ib"], multiply(jnp.asarray(q), turn), rtol=0, atol=2e-16)
    np.testing.assert_array_equal(now["factor"], np.arange(9.0))
    assert now["stars"] == 5


def test_a_star_sensor_that_is_lost():
    injector = injecting(faults('kind = "lost"; begin = "0 s"'))
    now = said(put(injector, "star", "from", star(WORKING), 0))
    assert np.isnan(now["q_ib"]).all()
    assert (now["stars"], np.any(now["factor"])) == (0, False)


def test_stuck_to_what_was_said_before_and_not_to_nothing():
    injector = injecting(faults('kind = "stuck"; begin = "3 s"; end = "5 s"'))
    q = np.eye(4)
    nothing = np.full(4, np.nan)
    given_q = [q[0], q[1], nothing, q[2], nothing, q[3]]  # a second apart
    went = [
        said(put(injector, "star", "from", star(one, stars=k), k * S))
        for k, one in enumerate(given_q)
    ]
    for now, then in zip(went, [0, 1, 2, 1, 1, 5], strict=True):
        np.testing.assert_array_equal(now["q_ib"], given_q[then])
        assert now["stars"] == then
    # without anything before it, to the first within
    alone = injecting(faults('kind = "stuck"; begin = "0 s"'))
    went = [said(put(alone, "star", "from", star(one), 0)) for one in (nothing, q[2], q[3])]
    np.testing.assert_array_equal([o["q_ib"] for o in went], [nothing, q[2], q[2]])


def test_damaged_and_strange_payloads_pass_as_they_are():
    """A board may send what is no `star`; who takes it refuses it."""
    injector = injecting(faults('kind = "turned"; begin = "0 s"'))
    short = Frame(Header(WIRE.message("star").number, 7, 0, 0), b"abc")
    assert put(injector, "star", "from", short, 0) == [LineOutput(None, short)]


def test_a_frame_of_an_earlier_run_goes_no_further():
    with open_pair() as pair:
        link = Link("gyro", pair.master, WIRE, injecting((), 0), lambda *_: None)
        link.restart(7)
        old = gyro(1)._replace(header=gyro(1).header._replace(run=6))
        os.write(pair.slave, wire.encode_frame(*old) + wire.encode_frame(*gyro(2)))
        found = link.read(0, S)
    assert found == [("gyro", gyro(2))]
    assert (link.health.frames, link.health.strange) == (1, 1)


def test_a_lie_on_a_noisy_line():
    """Bit errors hit what the sensor says under its fault, not what it would have said."""
    injector = injecting(
        faults(
            'kind = "bit errors"; begin = "0 s"; message = "star"', 'kind = "lost"; begin = "0 s"'
        )
    )
    one = star(WORKING)
    (piece,) = put(injector, "star", "from", one, 0)
    lie = said(put(injecting(faults('kind = "lost"; begin = "0 s"')), "star", "from", one, 0))
    raw = wire.encode_frame(one.header, WIRE.encode("star", lie))
    flipped = np.frombuffer(piece.raw, "u1") ^ np.frombuffer(raw, "u1")
    assert np.unpackbits(flipped).sum() == 1


def test_the_star_sensor_lies_as_in_one_program():
    """The same faults, in the loop of one program and on the wire, say the same."""
    spans = (
        ("turned", 3.0, 6.0), ("stuck", 5.0, 9.0), ("sign", 7.0, 20.0), ("turned", 12.0, 14.0),
        ("stuck", 17.0, 18.5),
    )  # fmt: skip
    lost = (7.0, 8.0), (13.5, 15.0), (16.5, 17.5)
    times = np.arange(1, 201) * 0.1
    due = np.arange(1, 201) % 5 == 0
    says = _star_sensor_faults(
        StarSensor.model_validate(
            {
                "faults": tuple({"kind": k, "begin": b, "end": e} for k, b, e in spans),
                "lost": tuple({"begin": b, "end": e} for b, e in lost),
            }
        ),
        due,
        times,
    )
    rng = np.random.default_rng(1)
    q = rng.normal(size=(200, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)

    @jax.jit
    def run(q, says):
        given = nodes.LoopConstants(*[jnp.zeros(())] * 5)

        def step(before, xs):
            one, say = xs
            course = NoiseFreeInputs(*[jnp.zeros(())] * 8, say, jnp.zeros(()))
            row = nodes.StepInputs(course, jnp.zeros(3), jnp.zeros(3), jnp.zeros(3))
            out = nodes.star(given, one, one, before, row)
            return out.seen_q_ib, out.q_ib

        return jax.lax.scan(step, q[0], (q, says))[1]

    inside = np.asarray(run(q, says))
    injector = injecting(
        faults(
            *(f'kind = "{k}"; begin = "{b} s"; end = "{e} s"' for k, b, e in spans),
            *(f'kind = "lost"; begin = "{b} s"; end = "{e} s"' for b, e in lost),
        )
    )
    for k in np.flatnonzero(due):
        now = (int(k) + 1) * S // 10
        outside = said(put(injector, "star", "from", star(q[k], now), now))
        np.testing.assert_allclose(outside["q_ib"], inside[k], rtol=0, atol=3e-16)
