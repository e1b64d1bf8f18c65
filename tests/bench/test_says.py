"""Operator messages through the bench: which can be sent, at which time, and by whom."""

import numpy as np
import pytest

from robins.bench.broker.console import Console, OperatorMessageError, operator_messages_of
from robins.bench.broker.injector import Injector
from robins.bench.rig import RigError
from robins.bench.rigs import rig_of
from robins.bench.rigs.satellite import RIG
from robins.bench.rigs.satellite.messages import WIRE
from robins.bench.run.orders import Orders, in_words
from robins.bench.run.setup import read
from robins.bench.wire.fields import Field, f64, message
from robins.bench.wire.schema import Wire
from robins.scenario import ScenarioError

Q = [0.5, -0.5, 0.5, 0.5]
STEP_NS = 100_000_000


def flight(tmp_path, *entries: str, seconds="20 s"):
    path = tmp_path / "said.toml"
    says = "".join(f"[[says]]\n{entry}\n" for entry in entries)
    path.write_text(f'bench = "satellite"\nseconds = "{seconds}"\n{says}')
    return read(str(path))


def test_what_is_left_out_is_missing_or_nothing():
    said = WIRE.decode("reference", RIG.operator_console.payload("reference", {"rate": 0.02}))
    assert said["rate"] == 0.02
    assert np.all(np.isnan(said["q_ib"]))
    said = WIRE.decode("reference", RIG.operator_console.payload("reference", {"q_ib": Q}))
    np.testing.assert_array_equal(said["q_ib"], Q)
    assert said["rate"] == 0.0


WRONG = [
    ("referense", {}, "the bench does not say 'referense'; did you mean 'reference'"),
    ("command", {}, "the bench does not say 'command'"),  # one of a part
    ("tick", {"step": 3}, "the bench does not say 'tick'"),
    ("reference", {"q": Q}, "'reference' has the fields"),
    ("reference", {"q_ib": Q[:3]}, "reference.q_ib has 4 numbers, got 3"),
    ("reference", {"q_ib": [3.0, 0, 0, 0]}, r"q_ib\[0\] is 3, not -2 to 2 or NaN"),
    ("reference", {"q_ib": [np.inf, 0, 0, 0]}, r"q_ib\[0\] is inf"),
    ("reference", {"rate": -0.1}, "rate is -0.1 rad/s, not 0 to 1000"),
    ("reference", {"rate": np.nan}, "rate is nan rad/s, not 0 to 1000"),
    ("reference", {"q_ib": [1.0, 0.1, 0, 0]}, "q_ib has the length 1.00499: give a quaternion"),
    ("reference", {"q_ib": [1.0, np.nan, 0, 0]}, "q_ib misses a number"),
]


@pytest.mark.parametrize(("name", "values", "words"), WRONG)
def test_what_cannot_be_said_is_told_with_field_and_limit(name, values, words):
    with pytest.raises(OperatorMessageError, match=words):
        RIG.operator_console.payload(name, values)


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ('message = "reference"', "says.0.at"),
        ('at = "-1 s"\nmessage = "reference"', "says.0.at"),
        ('at = "1 s"\nmessage = "wheels"', "the bench does not say 'wheels'"),
        ('at = "1 s"\nmessage = "reference"\nrate = 0.5', "says.0.rate"),  # of what unit?
        ('at = "1 s"\nmessage = "reference"\nrate = "0.5 deg"', "says.0.rate"),
        ('at = "1 s"\nmessage = "reference"\nrate = "-1 deg/s"', "not 0 to 1000"),
        ('at = "1 s"\nmessage = "reference"\nq_ib = [1, 0, 0]', "says.0.q_ib"),
        ('at = "1 s"\nmessage = "reference"\nq_ib = [1, 1, 0, 0]', "length 1.41421"),
        ('at = "1 s"\nmessage = "reference"\nq = [1, 0, 0, 0]', "says.0.q"),
    ],
)
def test_a_scenario_that_says_what_cannot_be_is_refused(tmp_path, entry, words):
    with pytest.raises(ScenarioError, match=words):
        flight(tmp_path, entry)


def test_a_scenario_says_with_units_and_at_boundaries_of_steps(tmp_path):
    of = flight(
        tmp_path,
        'at = "0 s"\nmessage = "reference"\nrate = "3 deg/s"',
        f'at = "1.23 s"\nmessage = "reference"\nq_ib = {Q}',
        'at = "1.3 s"\nmessage = "reference"',
    )
    assert of.setup.says[0].rate == np.radians(3.0)
    # never before the end of the first step, and not before its time
    assert [one.step(STEP_NS) for one in of.setup.says] == [1, 13, 13]
    orders = Orders(of, Injector(of.rig.table), STEP_NS)
    orders.say("reference", {"rate": 0.5})
    out = {k: orders.due(k) for k in range(20)}
    assert [len(found) for found in out.values()] == [0, 2, *[0] * 11, 2, *[0] * 6]
    assert [planned for *_, planned in out[1]] == [True, False]
    assert [one.step for one in orders.operator_events] == [1, 1, 13, 13]
    last = [WIRE.decode("reference", out[k][-1][1]) for k in (1, 13)]
    assert last[0]["rate"] == 0.5
    assert np.all(np.isnan(last[1]["q_ib"]))
    words = "'reference': q_ib nan nan nan nan; rate 0.5"
    assert in_words("reference", last[0]) == words


def test_a_rig_without_a_console_says_nothing():
    with pytest.raises(OperatorMessageError, match=r"does not say 'state'.* It says nothing"):
        rig_of("airship").operator_console.payload("state", {})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"console": ()}, "each message is sent by one part: .*'reference'"),
        ({"console": ("reference", "wheels")}, "sent by one part or said by the bench"),
        ({"takes": {**RIG.takes, "acm": ()}}, "the bench says 'reference', but no part takes it"),
    ],
)
def test_a_rig_that_contradicts_itself_is_refused(change, words):
    with pytest.raises(RigError, match=words):
        RIG.varied(**change)


def test_fields_are_typed_by_the_wire():
    say = message(
        16, "say", "", f64("turn", 3, "rad", "", 9.0), Field("way", "u8", 1, "1", "", (0, 3))
    )
    other = message(17, "other", "", f64("turn", 2, "rad", "", 9.0))
    wire = Wire(("part",), (say, other))
    made = operator_messages_of(Console(wire, ("say",)))
    one = made.model_validate({"at": 1.0, "message": "say", "turn": (0.1, 0.2, 0.3), "way": 2})
    np.testing.assert_array_equal(wire.decode("say", one.payload)["turn"], [0.1, 0.2, 0.3])
    assert wire.decode("say", one.payload)["way"] == 2
    with pytest.raises(ValueError, match="less than or equal to 3"):
        made.model_validate({"at": 1.0, "message": "say", "way": 4})
    with pytest.raises(OperatorMessageError, match="field 'turn' of the console is there twice"):
        operator_messages_of(Console(wire, ("say", "other")))
