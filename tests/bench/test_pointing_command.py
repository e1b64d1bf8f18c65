"""The craft points where the operator says: the way there, the bits, the record, the page."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stations import Loop, config, on_threads

from robins.bench.evaluation import OperatorEvent
from robins.bench.recording import read_record
from robins.bench.rigs.satellite import RIG
from robins.bench.rigs.satellite.judging import SAYS, inside, judge, sample
from robins.bench.rigs.satellite.messages import SAFE, USED, WIRE
from robins.bench.rigs.satellite.reference import (
    attitude_target,
    limits,
    plan_after_command,
    reference_q_ib,
    target_after,
    target_attitudes,
)
from robins.bench.run.session import Session
from robins.bench.run.setup import changed, read
from robins.bench.run.telemetry import Telemetry, difference
from robins.bench.wire import Receiver
from robins.workbench import bench_replay

LOOP = "duration=130 s", "counted_from=10 s"
DEG = np.pi / 180.0
NONE = np.full(4, np.nan)
pytestmark = pytest.mark.usefixtures("unchecked")  # 1300 steps of seven parts


def rotation(q_ib: Any) -> Rotation:
    return Rotation.from_quat(q_ib, scalar_first=True)


def away(q_ib: Any, of: Any) -> np.ndarray:
    """Angles between attitudes [deg]."""
    return np.degrees((rotation(of).inv() * rotation(q_ib)).magnitude())


@pytest.fixture(scope="module")
def of():
    return config("satellite/s1", "mekf", *LOOP)


@pytest.fixture(scope="module")
def asked(of):
    """A third of a right angle from where it points at 5 s; of the other sign, too."""
    turn = Rotation.from_rotvec(30.0 * DEG * np.array([2.0, -1.0, 2.0]) / 3.0)
    there = rotation(of.rows.course.ref_q_ib[50]) * turn
    return -there.as_quat(scalar_first=True)


class Watch:
    """Does things at steps of a run, and gives commands."""

    def __init__(self, at: dict[int, Any], commands: dict[int, dict[str, Any]] | None = None):
        self.at, self.given, self.events = at, commands or {}, []

    def event(self, kind: str, time_s: float, text: str) -> None:
        self.events.append((kind, text))

    def step(self, session: Session, step: int) -> None:
        if (do := self.at.pop(step, None)) is not None:
            do(session)

    def over(self, session: Session, failed: bool) -> None:
        pass

    def commands(self, session: Session) -> list[dict[str, Any]]:
        command = self.given.pop(session.done, None)
        return [command] if command else []


@pytest.fixture(scope="module")
def series(of, asked, tmp_path_factory):
    """An attitude at 5 s, the course again at 70 s; control is killed on its way to the first."""

    says = (
        {"at": 5.0, "message": "reference", "q_ib": tuple(asked), "rate": 1.0 * DEG},
        {"at": 70.0, "message": "reference", "rate": 2.0 * DEG},  # more than it can
    )
    flight = changed(read("satellite/s1", LOOP), {"says": says, "on_death": "restart"})
    record = tmp_path_factory.mktemp("pointing") / "record.mcap"
    watch = Watch({150: lambda session: session.part_processes.kill("acm")})
    with pytest.MonkeyPatch.context() as patch:
        on_threads(patch)
        result = Session(flight, record, watch, config=of).run()
    assert (result.failure, result.steps, result.deaths) == ("", 1300, 1)
    return flight, result, record


def test_the_craft_comes_to_the_attitude_that_was_asked_and_back_to_its_course(of, asked, series):
    _, result, _ = series
    true = result.series["motion.q_ib"]
    assert abs(away(true[49], asked) - 30.0) < 0.1
    assert np.max(away(true[620:700], asked)) < 0.1
    # the course has gone on meanwhile, by a part of its orbit
    course = np.asarray(of.rows.course.ref_end_q_ib)
    assert away(true[699], course[699]) > 20.0
    assert np.max(away(true[1250:], course[1250:1300])) < 0.1
    speed = np.linalg.norm(result.series["motion.omega_b"], axis=1)
    orbit = np.linalg.norm(of.rows.course.ref_omega_b[0])
    assert 0.5 * DEG < np.max(speed[:700]) < 1.0 * DEG + 1.1 * orbit


def test_it_has_the_bits_of_one_program_with_the_same_words(of, series):
    _, result, _ = series
    assert [(one.step, one.message) for one in result.operator_events] == [
        (50, "reference"),
        (700, "reference"),
    ]
    assert difference(result.series, inside(of, said=result.operator_events)) == 0.0
    assert difference(result.series, inside(of)) > 0.1  # it was another run


def test_an_estimate_that_is_not_to_be_steered_by_is_not_in_the_figures(series):
    flight, result, _ = series
    plain, unfit = judge(flight, result), np.arange(1300) % 100 >= 60
    counts = np.arange(1300) >= 100
    arrays = {name: x.copy() for name, x in result.series.items()}
    arrays["estimate.flags"][unfit] |= SAFE
    arrays["estimate.q_ib"][unfit] = [0.5, 0.5, 0.5, 0.5]  # far from any
    marked = judge(flight, result._replace(series=replace(result.series, arrays=arrays)))
    error_arcsec = away(result.series["estimate.q_ib"], result.series["motion.q_ib"]) * 3600.0
    of = error_arcsec[counts & ~unfit]
    found = marked.metrics
    np.testing.assert_allclose(found["attitude_peak_arcsec"], np.max(of), rtol=1e-6)
    np.testing.assert_allclose(found["attitude_rms_arcsec"], np.sqrt(np.mean(of**2)), rtol=1e-6)
    assert np.isnan(found["attitude_end_arcsec"])  # it ends with one
    assert found["pointing_rms_arcsec"] == plain.metrics["pointing_rms_arcsec"]  # it is true
    assert (plain.warnings, marked.counts["steps_in_safe_mode"]) == ([], 520)
    assert marked.warnings == [
        "The estimate was marked as not to be steered by in 480 of the 1200 steps that count, and "
        "the figures are those of the others"
    ]


def test_its_pointing_is_judged_by_what_was_asked(of, asked, series):
    flight, result, _ = series
    pointing = judge(flight, result).metrics["pointing_peak_arcsec"]
    assert pointing < 360.0  # while it turns, too
    reference = reference_q_ib(of, result.series, 1300)
    course = np.asarray(of.rows.course.ref_end_q_ib)
    np.testing.assert_array_equal(
        reference[:49], course[:49]
    )  # the end of the 50th is where it is left
    np.testing.assert_allclose(away(reference[620:700], asked), 0.0, atol=1e-5)
    np.testing.assert_array_equal(reference[1250:], course[1250:1300])
    for step in (10, 49, 50, 300, 699, 700, 1000, 1299):
        at = target_after(of, result.series, step + 1).q_ib
        np.testing.assert_array_equal(at, reference[step])
        shown = np.array(sample(result.series, of, step, step))[14:17]
        size = np.linalg.norm(shown) / 3600.0
        np.testing.assert_allclose(size, away(result.series["motion.q_ib"][step], at), atol=1e-6)


def test_the_record_has_it_and_control_hears_it_again(series, monkeypatch):
    _, _, path = series
    on_threads(monkeypatch)
    record = read_record(path)
    heard, receiver = [], Receiver()
    for entry in record.entries:
        if (entry.link, entry.direction) == ("acm", "to"):
            heard += receiver.feed(entry.data)
    said = [f for f in heard if f.header.type == WIRE.numbers["reference"]]
    # a frame is recorded when it goes out; what is told again to a part started anew is not
    assert [f.header.time_ns for f in said] == [5_000_000_000, 70_000_000_000]
    told_of = [event.text for event in record.events if event.kind == "said"]
    assert told_of[0].startswith("'reference': q_ib")
    assert told_of[1] == "'reference': q_ib nan nan nan nan; rate 0.0349066"
    again = bench_replay(path, node="acm")
    assert again.same


# ------------------------------------------------------------------------------------- the plan


def test_a_slew_keeps_its_greatest_rate_and_what_the_wheels_can(of):
    most, acceleration = limits(of)
    # Along the weakest axis, as a linear program would have it: least over all directions of the
    # greatest torque whose wheels are within their limits, by allocation.
    axes, pinv = np.asarray(of.given.craft.wheel_axes_b), np.asarray(of.given.pinv)
    rng = np.random.default_rng(1)
    way = rng.normal(size=(4000, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    torque = np.min(0.005 / np.maximum(np.abs(way @ pinv.T), 1e-12), axis=1)
    np.testing.assert_allclose(axes @ pinv, np.eye(3), atol=1e-12)
    moments = np.linalg.eigvalsh(np.asarray(of.given.craft.inertia_b))
    assert 0.45 < acceleration * moments[-1] / np.min(torque) <= 0.5
    for rate in (0.0, 0.2 * DEG, 100.0):
        plan = plan_after_command(of, None, 100, np.array([0.5, 0.5, 0.5, -0.5]), rate)
        angle = np.linalg.norm(plan.turn)
        ways = [attitude_target(of, plan, edge) for edge in range(100, len(of.due))]
        turning = [np.linalg.norm(at.omega_b) for at in ways]
        orbit = np.linalg.norm(of.rows.course.ref_omega_b[0])
        allowed = {0.0: 0.5 * most, 100.0: most}.get(rate, rate)
        assert max(turning) < allowed + 1.1 * orbit
        assert plan.length_s > angle / allowed
        assert max(np.linalg.norm(at.alpha_b) for at in ways) < 1.2 * acceleration


def test_another_attitude_on_the_way_goes_on_without_a_jump(of, asked):
    """Check by differences of the target attitudes."""
    said = [(50, asked, 0.0), (200, np.array([1.0, 0, 0, 0]), 0.0), (350, NONE, 0.0)]
    ways = target_attitudes(of, said)
    q, omega = np.stack([at.q_ib for at in ways]), np.stack([at.omega_b for at in ways])
    turn = (rotation(q[:-1]).inv() * rotation(q[1:])).as_rotvec() / 0.1
    np.testing.assert_allclose(turn, 0.5 * (omega[:-1] + omega[1:]), atol=2e-5)
    assert np.max(np.linalg.norm(np.diff(omega, axis=0), axis=1)) < 2.5e-4  # 0.1 s of acceleration


def test_a_quaternion_of_another_length_is_not_followed(of, asked):
    plan = plan_after_command(of, None, 50, asked, 0.0)
    assert plan_after_command(of, plan, 60, 1.01 * asked, 0.0) is plan
    near = plan_after_command(of, plan, 60, 1.0005 * asked, 0.0)
    np.testing.assert_allclose(np.linalg.norm(near.q_ib), 1.0, atol=1e-15)


def test_control_follows_what_it_hears_alone(of, asked):
    """A frame that is lost on its line is not followed; it stays on its course."""
    loop = Loop(of).run(50)
    loop.to(
        "acm",
        "reference",
        RIG.operator_console.payload("reference", {"q_ib": asked}),
        49 * of.step_ns,
    )
    loop.run(100)  # it came too late: its step was over
    course = np.asarray(of.rows.course.ref_end_q_ib)
    assert np.max(away(loop.all("motion", "q_ib"), course[:150])) < 0.1
    loop.to(
        "acm",
        "reference",
        RIG.operator_console.payload("reference", {"q_ib": asked}),
        150 * of.step_ns,
    )
    loop.run(100)
    assert away(loop.all("motion", "q_ib")[-1], course[249]) > 0.3


# ----------------------------------------------------------------------------------------- mode


def mode(loop: Loop, **values: int) -> None:
    for part in ("adm", "acm"):
        loop.to(
            part,
            "mode",
            RIG.operator_console.payload("mode", values),
            loop.step * loop.config.step_ns,
        )


def test_control_stands_by_while_the_determination_goes_on(of):
    loop, plain = Loop(of).run(50), Loop(of).run(150)
    mode(loop, mode=1)
    loop.run(30)
    mode(loop, mode=2)  # as it is
    loop.run(20)
    mode(loop, mode=0)
    loop.run(50)
    torque = loop.all("command", "wheel_torque")
    np.testing.assert_array_equal(torque[:50], plain.all("command", "wheel_torque")[:50])
    assert np.all(torque[50:100] == 0.0)
    assert np.all(loop.all("command", "dipole_b")[50:100] == 0.0)
    assert np.all(np.any(torque[100:] != 0.0, axis=1))
    assert not np.any(loop.flags() & SAFE)
    used = loop.flags() & USED == USED
    np.testing.assert_array_equal(used, of.due[:150])


def test_a_reset_filter_begins_anew_with_the_next_star_frame(of):
    loop, plain = Loop(of).run(101), Loop(of).run(160)
    mode(loop, mode=0, reset=1)
    loop.run(59)
    again = int(np.flatnonzero(of.due[101:])[0]) + 101
    safe = np.flatnonzero(loop.flags() & SAFE)
    assert list(safe) == list(range(101, again))
    # the bias is that of the start, the attitude that of the frame, to the last bit
    first = np.asarray(of.form.bias(of.belief.mean))
    np.testing.assert_array_equal(loop.all("estimate", "gyro_bias")[again], first)
    frame = loop.heard["star"][int(np.sum(of.due[:again]))]["q_ib"]
    assert away(loop.all("estimate", "q_ib")[again], frame) < 1e-6
    sigma = loop.all("estimate", "sigma")
    before, plainly = (
        loop.all("estimate", "gyro_bias")[100],
        plain.all("estimate", "gyro_bias")[100],
    )
    np.testing.assert_array_equal(before, plainly)
    assert np.all(sigma[again, :3] > 1.5 * sigma[100, :3])  # it knows as much as at the start
    np.testing.assert_allclose(sigma[again, 3:], sigma[0, 3:], rtol=0.2)
    assert inside(of, said=[OperatorEvent(101, "mode", {"mode": 0, "reset": 1})]) is None


# ----------------------------------------------------------------------------- scripts and pages


def test_what_is_pressed_and_what_a_script_says(of, asked, monkeypatch):
    on_threads(monkeypatch)
    flight = changed(read("satellite/s1", LOOP), {"seconds": 30.0})

    def twice(session):
        session.say("reference", q_ib=[1.0, 0.0, 0.0, 0.0])
        session.say("reference", q_ib=asked)

    given = {
        0: {"do": "say", "label": "hold this attitude"},
        20: {"do": "say", "label": "slew 10 deg about y"},
        150: {"do": "say", "label": "back to the course"},
    }
    labels = [f"say {one['label']}" for one in given.values()]
    watch = Watch({99: twice}, given)
    result = Session(flight, None, watch, config=of).run()
    assert result.failure == ""
    assert [one.step for one in result.operator_events] == [1, 20, 100, 100, 150]
    commands = [text for kind, text in watch.events if kind == "command"]
    assert commands == labels
    assert not [text for kind, text in watch.events if kind == "said"]  # it was shown as pressed
    assert len([one for one in result.events if one.kind == "said"]) == 5  # and is in the record
    first, second = (
        result.operator_events[0].values["q_ib"],
        result.operator_events[1].values["q_ib"],
    )
    np.testing.assert_allclose(away(first, of.rows.course.ref_q_ib[0]), 0.0, atol=1e-5)
    by = (rotation(target_after(of, result.series, 19).q_ib).inv() * rotation(second)).as_rotvec()
    np.testing.assert_allclose(np.degrees(by), [0.0, 10.0, 0.0], atol=0.01)
    # of two in one step the later one stands, in the loop and in what it is judged by
    assert difference(result.series, inside(of, said=result.operator_events)) == 0.0
    assert (
        difference(
            result.series,
            inside(of, said=[*result.operator_events[:2], *result.operator_events[3:]]),
        )
        == 0.0
    )
    assert (
        difference(
            result.series,
            inside(of, said=[*result.operator_events[:3], *result.operator_events[4:]]),
        )
        > 0.0
    )


def test_all_that_the_page_offers_can_be_said(of):
    series = Telemetry(RIG, 4, of.step_ns).series
    for label, says in SAYS.items():
        message, values = says(series, of, 2)
        said = WIRE.decode(message, RIG.operator_console.payload(message, values))
        if message == "mode":
            continue
        assert np.isnan(said["q_ib"][0]) == (label == "back to the course")
