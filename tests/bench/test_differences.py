"""Differences of two runs, against differences that were put there by hand."""

import math
import struct

import numpy as np
import pytest

from robins.bench.recording import differences as module
from robins.bench.recording.differences import FieldDifference, differences, name_of, table
from robins.bench.rigs.satellite.messages import WIRE
from robins.bench.wire import Frame, Header

STEP_NS = 100_000_000
STEPS = 20


def frames(seed: int = 0) -> list[Frame]:
    """A run: in each step an estimate and a done; every second one a frame of the star sensor."""
    rng = np.random.default_rng(seed)
    made = []
    for k in range(STEPS):
        made.append(frame("estimate", k, **estimate(rng)))
        if k % 2:
            said = {"q_ib": rng.normal(size=4), "factor": rng.normal(size=9), "stars": 7}
            made.append(frame("star", k, **said))
        made.append(frame("done", k, step=k, compute=int(rng.integers(1000))))
    return made


def estimate(rng: np.random.Generator) -> dict:
    return {
        "q_ib": rng.normal(size=4),
        "gyro_bias": rng.normal(size=3) * 1e-6,
        "sigma": rng.normal(size=6) ** 2,
        "flags": 1,
    }


def frame(name: str, k: int, **values) -> Frame:
    payload = WIRE.encode(name, values)
    return Frame(Header(WIRE.message(name).number, 7, k, (k + 1) * STEP_NS), payload)


def changed(run: list[Frame], name: str, field: str, component: int, by: dict[int, float]):
    """The run with a number of a message set, by step."""
    number = WIRE.message(name).number
    out = []
    for one in run:
        step = one.header.time_ns // STEP_NS - 1
        if one.header.type == number and step in by:
            values = WIRE.decode(name, one.payload)
            if np.ndim(values[field]):
                values[field][component] = by[step]
            else:
                values[field] = int(by[step])
            one = Frame(one.header, WIRE.encode(name, values))
        out.append(one)
    return out


def value(run: list[Frame], name: str, field: str, component: int, step: int) -> float:
    number = WIRE.message(name).number
    for one in run:
        if one.header.type == number and one.header.time_ns == (step + 1) * STEP_NS:
            return float(np.ravel(WIRE.decode(name, one.payload)[field])[component])
    raise LookupError(step)


def test_the_same_is_the_same():
    """Whatever the header says of run and number, and how long computing took."""
    again = []
    for f in frames():
        head = f.header._replace(run=9, sequence=f.header.sequence + 5)
        done = frame("done", f.header.sequence, step=0, compute=1)
        again.append(done if head.type == 3 else Frame(head, f.payload))
    assert differences(WIRE, frames(), again) == []
    assert differences(WIRE, frames(), list(reversed(again))) == []
    assert differences(WIRE, [], []) == []
    assert table([]) == "No difference: every number has the same bits."


def test_numbers_that_differ():
    a = frames()
    old = {k: value(a, "estimate", "gyro_bias", 1, k) for k in (5, 9, 12)}
    new = {5: old[5] + 1e-9, 9: old[9] * 3.0, 12: np.nextafter(old[12], 1.0)}
    (d,) = differences(WIRE, a, changed(a, "estimate", "gyro_bias", 1, new), STEP_NS)
    assert (d.message, d.field, d.component, d.unit) == ("estimate", "gyro_bias", 1, "rad/s")
    assert (d.first_step, d.count) == (5, 3)
    assert d.first_time_s == pytest.approx(0.6, rel=1e-15)
    assert (d.a, d.b) == (old[5], new[5])
    assert d.max_abs == max(abs(new[k] - old[k]) for k in old)
    assert d.max_rel == max(abs(new[k] - old[k]) / max(abs(new[k]), abs(old[k])) for k in old)
    assert name_of(d) == "estimate.gyro_bias[1]"


def test_of_pieces_it_is_what_it_is_of_the_whole(monkeypatch):
    """The greatest difference comes in any piece, and a piece may have none."""
    a, rng = frames(), np.random.default_rng(5)
    b = [
        frame("estimate", f.header.time_ns // STEP_NS - 1, **estimate(rng))
        if f.header.type == WIRE.message("estimate").number
        else f
        for f in a
    ]
    whole = differences(WIRE, a, b, STEP_NS)
    assert {d.count for d in whole} == {STEPS}
    monkeypatch.setattr(module, "_BATCH", 4)
    assert differences(WIRE, a, b, STEP_NS) == whole
    assert differences(WIRE, a, list(reversed(b)), STEP_NS) == whole


def test_whole_numbers_differ_without_going_below_zero():
    a = frames()
    (d,) = differences(WIRE, a, changed(a, "star", "stars", 0, {3: 9, 5: 2}), STEP_NS)
    assert (d.component, name_of(d)) == (-1, "star.stars")
    assert (d.a, d.b, d.max_abs, d.max_rel, d.count) == (7.0, 9.0, 5.0, 5 / 7, 2)


def test_the_earliest_difference_comes_first():
    a = frames()
    b = changed(a, "star", "factor", 8, {1: 0.5})
    b = changed(b, "estimate", "q_ib", 0, {11: 0.5})
    b = changed(b, "estimate", "flags", 0, {4: 3})
    found = [(d.message, d.first_step) for d in differences(WIRE, a, b, STEP_NS)]
    assert found == [("star", 1), ("estimate", 4), ("estimate", 11)]


def test_nan_is_nan_and_zeros_have_signs():
    a = changed(frames(), "estimate", "q_ib", 2, {0: np.nan, 1: 0.0, 2: np.nan, 3: np.inf})
    other_nan = struct.unpack("<d", struct.pack("<Q", 0xFFF8_0000_0000_0123))[0]
    b = changed(a, "estimate", "q_ib", 2, {0: other_nan})
    assert a[0].payload != b[0].payload
    assert differences(WIRE, a, b) == []

    (zero,) = differences(WIRE, a, changed(a, "estimate", "q_ib", 2, {1: -0.0}))
    assert (zero.max_abs, zero.max_rel, zero.count) == (0.0, 0.0, 1)
    assert math.copysign(1.0, zero.b) == -1.0
    assert "-0.0 and 0.0 are equal, their bits are not" in table([zero])

    for step, to in ((2, 1.0), (3, 1.0), (3, -np.inf)):
        (d,) = differences(WIRE, a, changed(a, "estimate", "q_ib", 2, {step: to}))
        assert (d.max_abs, d.max_rel) == (np.inf, np.inf)


def test_frames_that_only_one_has():
    a, star = frames(), WIRE.message("star").number
    b = [f for f in a if f.header.type != star or f.header.time_ns // STEP_NS - 1 not in (5, 7)]
    (first,) = differences(WIRE, a, b, STEP_NS)
    at_s = 6 * STEP_NS * 1e-9
    assert first == FieldDifference("star", "", -1, "", 0.0, 0.0, 5, at_s, 2.0, 0.0, 2)
    (second,) = differences(WIRE, b, a, STEP_NS)
    assert (second.a, second.b) == (0.0, 2.0)
    assert table([first]) == "star: 2 frames only recorded, from 0.6 s on."
    assert table([second], ("old", "new")) == "star: 2 frames only new, from 0.6 s on."


def test_a_repeated_answer_is_matched_to_a_repeated_answer():
    a = frames()
    twice = [f for f in a for _ in range(2)]
    assert differences(WIRE, twice, twice) == []
    found = {(d.message, d.field, d.a, d.b) for d in differences(WIRE, twice, a)}
    assert found == {("estimate", "", STEPS, 0.0), ("star", "", STEPS // 2, 0.0)}


def test_what_this_version_does_not_know_is_compared_as_bytes():
    strange = [Frame(Header(200, 7, k, (k + 1) * STEP_NS), bytes([k])) for k in range(5)]
    assert differences(WIRE, strange, strange) == []
    other = [strange[0], strange[1]._replace(payload=b"x"), *strange[2:]]
    (d,) = differences(WIRE, strange, other, STEP_NS)
    assert (d.message, d.field, d.first_step, d.a, d.b, d.count) == ("message 200", "", 1, 1, 1, 1)
    short = [f._replace(payload=f.payload[:-1]) if f.header.type == 19 else f for f in frames()]
    (d,) = differences(WIRE, frames(), short)
    assert (d.message, d.field, d.count, d.first_step) == ("star", "", STEPS // 2, -1)
    assert "10 frames of a length that is not that of the message" in table([d])


def test_the_table_has_a_line_for_each_number():
    a = frames()
    old = value(a, "estimate", "q_ib", 0, 3)
    b = changed(a, "estimate", "q_ib", 0, {3: np.nextafter(old, 9.0)})
    b = changed(b, "estimate", "flags", 0, {4: 3})
    lines = table(differences(WIRE, a, b, STEP_NS), ("MEKF", "SO3 filter")).splitlines()
    assert len(lines) == 3
    assert "MEKF" in lines[0]
    assert "SO3 filter" in lines[0]
    cells = lines[1].split()
    assert cells[:5] == ["estimate.q_ib[0]", "1", "1", "3", "0.4"]
    # two numbers that differ never look the same
    assert float(cells[5]) == old
    assert float(cells[6]) == value(b, "estimate", "q_ib", 0, 3)
    assert lines[2].split()[:7] == ["estimate.flags", "1", "1", "4", "0.5", "1", "3"]
