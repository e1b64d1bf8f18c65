"""The parts of the satellite, joined by bytes: the bits of the loop in one program, and faults."""

import jax
import numpy as np
import pytest
import stations
from stations import Loop, config, one_program

from robins.bench.parts.station import Station
from robins.bench.rigs.satellite import RIG, RateTableParameters
from robins.bench.rigs.satellite.config import satellite_config
from robins.bench.rigs.satellite.judging import turn
from robins.bench.rigs.satellite.messages import FLAGS, WIRE
from robins.bench.run.setup import changed, read
from robins.bench.wire import Header, encode_frame
from robins.scenario import ScenarioError

ARCSEC = np.pi / 648000.0
SHORT = "duration=60 s", "counted_from=10 s"


@pytest.fixture
def of():
    """The numbers of a short run; its parts are programs that are interpreted."""
    return config("satellite/s1", "mekf", *SHORT)._replace(machine="vm")


def bit(flags, text):
    return flags >> FLAGS.index(text) & 1 == 1


def reference(name, steps):
    loop = one_program("satellite/s1", name, *SHORT)
    return {name: values[:steps] for name, values in loop.items()}


@pytest.mark.parametrize("name", ["mekf", "mekf-gate", "mixed-bias"])
def test_over_bytes_the_loop_has_the_bits_of_one_program(name):
    of = config("satellite/s1", name, *SHORT)
    loop = Loop(of).run(300)
    wanted = reference(name, 300)
    np.testing.assert_array_equal(loop.all("motion", "q_ib"), wanted["motion.q_ib"])
    np.testing.assert_array_equal(loop.all("estimate", "q_ib"), wanted["estimate.q_ib"])
    np.testing.assert_array_equal(loop.all("estimate", "gyro_bias"), wanted["estimate.gyro_bias"])
    np.testing.assert_array_equal(loop.all("wheels", "momentum"), wanted["wheels.momentum"])
    used = bit(loop.flags(), "star used")
    np.testing.assert_array_equal(used, of.due[:300])
    assert not np.any(loop.flags() & ~1)


def test_the_additive_filter_is_the_same_to_rounding():
    # XLA multiplies its matrices in another order where it is not in a scan.
    of = config("satellite/s1", "ekf-quaternion", *SHORT)
    loop, wanted = Loop(of).run(100), reference("ekf-quaternion", 100)
    np.testing.assert_allclose(loop.all("estimate", "q_ib"), wanted["estimate.q_ib"], atol=1e-13)
    np.testing.assert_allclose(
        loop.all("estimate", "gyro_bias"), wanted["estimate.gyro_bias"], atol=1e-15
    )


def test_a_camera_is_told_where_to_look():
    settings = "duration=30 s", "counted_from=10 s", "star.camera.magnitude=5.0"
    of = config("satellite/stars", "mekf", *settings)
    loop = Loop(of).run(100)
    inside = one_program("satellite/stars", "mekf", *settings)
    np.testing.assert_array_equal(loop.all("estimate", "q_ib"), inside["estimate.q_ib"][:100])
    factor, stars = loop.all("star", "factor"), loop.all("star", "stars")
    assert np.all(np.any(factor != 0.0, axis=1))
    # of twice as many stars the mean is better by the root of two
    spread = np.linalg.norm(factor.reshape(-1, 9), axis=1)
    assert np.min(stars) >= 2
    assert np.median(spread[stars > np.median(stars)]) < np.median(spread[stars < np.median(stars)])
    assert loop.stations["star"].part.takes == {"motion": 0, "gyro": 0, "estimate": 1}


def test_messages_are_of_the_schema_and_of_the_end_of_their_step(of):
    loop = Loop(of).run(20)
    for part, frame in loop.said:
        name = WIRE.message(frame.header.type).name
        WIRE.decode(name, frame.payload)
        assert frame.header.time_ns % of.step_ns == 0
        assert name in ("done", *RIG.sends[part])


def test_what_parts_take_is_what_the_links_carry(of):
    for name in RIG.parts:
        assert set(RIG.part(name, of).takes) <= set(RIG.takes[name])


# ------------------------------------------------------------------------------- what goes wrong


def without(name, takers, steps):
    def meddle(step, message, to, payload):
        gone = message == name and to in takers.split() and step in steps
        return [] if gone else [((step + 1) * 100_000_000, payload)]

    return meddle


def test_without_star_frames_the_gyro_carries_on(of):
    loop = Loop(of, without("star", "adm", range(100, 400))).run(300)
    error = np.linalg.norm(turn(loop.all("estimate", "q_ib"), loop.all("motion", "q_ib")), axis=1)
    assert np.all(bit(loop.flags()[125:], "star silent"))
    assert not np.any(bit(loop.flags()[:119], "star silent"))
    sigma = np.linalg.norm(loop.all("estimate", "sigma")[:, :3], axis=1)
    assert sigma[-1] > 1.5 * sigma[99]  # it knows that it knows less
    assert error[-1] < 5.0 * sigma[-1]


def test_a_gyro_sample_that_is_missing_is_held_for_one_step(of):
    loop = Loop(of, without("gyro", "adm", {50})).run(100)
    flags = loop.flags()
    assert list(np.flatnonzero(bit(flags, "gyro held"))) == [50]
    assert not np.any(bit(flags, FLAGS[3]))
    torque = loop.all("command", "wheel_torque")
    assert np.all(np.any(torque[1:] != 0.0, axis=1))


def test_a_gyro_that_stays_away_leads_to_safe_mode_and_back(of):
    loop = Loop(of, without("gyro", "adm acm", range(50, 60))).run(200)
    flags, torque = loop.flags(), loop.all("command", "wheel_torque")
    safe = np.flatnonzero(bit(flags, FLAGS[3]))
    again = int(np.flatnonzero(of.due[60:])[0]) + 60  # the first star frame with a gyro
    assert list(safe) == list(range(51, again))
    assert np.all(np.isnan(loop.all("estimate", "sigma")[safe]))
    # control hears of it in the next step, and rests
    assert np.all(torque[52 : again + 1] == 0.0)
    assert np.any(torque[again + 1] != 0.0)
    off = np.linalg.norm(turn(loop.all("estimate", "q_ib"), loop.all("motion", "q_ib")), axis=1)
    assert off[-1] < 60.0 * ARCSEC


def test_a_bank_begins_anew_with_all_its_modes():
    """A mode that kept its attitude of the start would pull the mixture back to it."""
    of = config("satellite/s1", "adaptive", *SHORT)._replace(machine="vm")
    loop = Loop(of, without("gyro", "adm acm", range(50, 60))).run(120)
    safe = np.flatnonzero(bit(loop.flags(), FLAGS[3]))
    again = int(safe[-1]) + 1
    found, true = loop.all("estimate", "q_ib"), loop.all("motion", "q_ib")
    moved = turn(true[again:], np.broadcast_to(true[0], true[again:].shape))
    assert np.min(np.linalg.norm(moved, axis=1)) > 600.0 * ARCSEC  # away from where it began
    off = np.linalg.norm(turn(found[again:], true[again:]), axis=1)
    sigma = np.linalg.norm(loop.all("estimate", "sigma")[again:, :3], axis=1)
    assert np.all(off < 5.0 * sigma)
    assert np.all(off < 120.0 * ARCSEC)


@pytest.mark.parametrize("name", ["mekf-gate", "mixed-bias"])
def test_by_c_the_loop_is_the_same_to_rounding_and_comes_back_from_safe_mode(name):
    of = config("satellite/s1", name, *SHORT)
    lost = without("gyro", "adm acm", range(50, 60))
    by_jax, by_c = (Loop(of._replace(machine=m), lost).run(120) for m in ("jax", "c"))
    np.testing.assert_array_equal(by_c.flags(), by_jax.flags())
    assert np.any(bit(by_c.flags(), FLAGS[3]))
    for what in (
        ("motion", "q_ib"),
        ("estimate", "q_ib"),
        ("estimate", "sigma"),
        ("gyro", "theta_b"),
    ):
        np.testing.assert_allclose(by_c.all(*what), by_jax.all(*what), rtol=1e-9, atol=1e-13)
    wanted = reference(name, 50)["estimate.q_ib"]
    np.testing.assert_allclose(by_c.all("estimate", "q_ib")[:50], wanted, atol=1e-13)


def test_a_camera_is_played_by_jax_when_the_rest_is_interpreted():
    settings = "duration=30 s", "counted_from=10 s", "star.camera.magnitude=5.0"
    of = config("satellite/stars", "mekf", *settings)._replace(machine="vm")
    inside = one_program("satellite/stars", "mekf", *settings)
    found = Loop(of).run(40).all("estimate", "q_ib")
    np.testing.assert_allclose(found, inside["estimate.q_ib"][:40], atol=1e-12)


def test_whatever_is_lost_nothing_is_compiled_while_it_runs():
    # In real time a step that waits for the compiler misses its deadline, and some after it.
    of = config("satellite/s1", "mekf-gate", *SHORT)
    carried = [name for part in RIG.parts for name in RIG.part(part, of).takes]
    lost_at = {name: range(10 * k, 10 * k + 6) for k, name in enumerate(dict.fromkeys(carried), 2)}

    def meddle(step, message, to, payload):
        return [] if step in lost_at[message] else [((step + 1) * of.step_ns, payload)]

    compiled = []

    def hear(event, seconds, **told):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(told["fun_name"])

    jax.clear_caches()
    stations._READY.clear()
    loop = Loop(of, meddle)
    jax.monitoring.register_event_duration_secs_listener(hear)
    try:
        loop.run(10 * (len(lost_at) + 4))
        assert compiled == []
        jax.jit(lambda x: x + 1)(1.0)
        assert len(compiled) == 1  # it would have been heard
    finally:
        jax.monitoring.unregister_event_duration_listener(hear)
    assert np.any(bit(loop.flags(), FLAGS[3]))


def test_no_sample_of_an_axis_is_no_sample(of):
    def meddle(step, message, to, payload):
        if message == "gyro" and to == "adm" and step == 40:
            payload = WIRE.encode("gyro", {"theta_b": [0.0, np.nan, 0.0]})
        return [((step + 1) * of.step_ns, payload)]

    loop = Loop(of, meddle).run(60)
    assert list(np.flatnonzero(bit(loop.flags(), "gyro held"))) == [40]
    assert np.all(np.isfinite(loop.all("estimate", "q_ib")))


@pytest.mark.parametrize(
    ("change", "text"),
    [(lambda q: 0.99 * q, FLAGS[5]), (lambda q: np.full(4, np.nan), None), (lambda q: -q, "same")],
)
def test_quaternions_that_are_none_are_refused_and_either_sign_is_the_same(of, change, text):
    def meddle(step, message, to, payload):
        if message == "star" and step >= 50:
            said = WIRE.decode("star", payload)
            payload = WIRE.encode("star", {**said, "q_ib": change(said["q_ib"])})
        return [((step + 1) * of.step_ns, payload)]

    plain, loop = Loop(of).run(80), Loop(of, meddle).run(80)
    due = np.flatnonzero(of.due[50:80]) + 50
    if text == "same":
        np.testing.assert_allclose(
            loop.all("estimate", "q_ib"), plain.all("estimate", "q_ib"), rtol=0.0, atol=1e-14
        )
        return
    assert not np.any(bit(loop.flags()[due], "star used"))
    assert np.all(bit(loop.flags()[due], FLAGS[5]) == (text is not None))


def test_late_frames_are_not_fused_at_the_wrong_time(of):
    def late(step, message, to, payload):
        behind = of.step_ns * (3 if message == "star" else 0)
        return [((step + 1) * of.step_ns - behind, payload)]

    loop = Loop(of, late).run(60)
    assert not np.any(bit(loop.flags(), "star used"))
    assert loop.stations["adm"].counts["late"] == int(np.sum(of.due[:60]))


def test_a_lost_command_stands_for_a_step_then_wheels_rest(of):
    loop = Loop(of, without("command", "actuators", {30, 31, 32})).run(40)
    given, asked = loop.all("actuation", "wheel_torque"), loop.all("command", "wheel_torque")
    np.testing.assert_array_equal(given[30], given[29])
    assert np.all(given[31:33] == 0.0)
    np.testing.assert_array_equal(given[33], asked[33])


def test_a_gyro_reports_what_it_missed_with_its_next_sample(of):
    plain = Loop(of).run(40)
    loop = Loop(of, without("mounted", "gyro", {20})).run(40)
    assert len(loop.heard["gyro"]) == 39
    whole, missed = plain.all("gyro", "theta_b"), loop.all("gyro", "theta_b")
    np.testing.assert_array_equal(missed[:20], whole[:20])
    # the turn of two steps, to the noise of a sample and what control made of it
    np.testing.assert_allclose(missed[20], whole[20] + whole[21], atol=20.0 * ARCSEC)


def test_a_table_that_lags_is_where_the_craft_was():
    flight = read("satellite/s2", ("duration=200 s", "counted_from=10 s"))
    of = satellite_config(flight.given, "mekf", 0, table=RateTableParameters(lag=0.02).table())
    loop = Loop(of).run(300)
    behind = turn(loop.all("mounted", "q_ib"), loop.all("motion", "q_ib"))
    change = np.linalg.norm(np.diff(loop.all("motion", "omega_b"), axis=0), axis=1)
    size = np.linalg.norm(behind, axis=1)
    # asked in each step for the way to where the craft is, it lags by tau times the change of rate
    assert np.all(size[20:] < 3.0 * 0.02 * np.max(change))
    assert np.max(size) > 0.2 * 0.02 * np.max(change)


def test_more_wheels_than_the_wire_has_are_refused():
    flight = read("satellite/s1", ("wheels.axes=[[1,0,0],[0,1,0],[0,0,1],[1,1,1],[1,1,0]]",))
    with pytest.raises(ValueError, match=r"the wire carries 4 wheels, this craft has 5"):
        satellite_config(flight.given, "mekf", 0)


def test_a_part_of_another_run_hears_nothing(of):
    station = Station(RIG.part("adm", of), WIRE)
    begin = WIRE.encode("begin", {"step": of.step_ns})
    station.feed(encode_frame(Header(WIRE.message("begin").number, 5, 0, 0), begin))
    tick = encode_frame(
        Header(WIRE.message("tick").number, 4, 1, of.step_ns), WIRE.encode("tick", {"step": 0})
    )
    assert station.feed(tick) == b""


def test_a_filter_that_solves_a_problem_at_every_frame_is_no_program_in_c():
    flight = changed(read("satellite/s1"), {"machine": "c", "filter": "mixed-lmi-step"})
    with pytest.raises(
        ScenarioError, match="machine: filter 'mixed-lmi-step' cannot be a program: it"
    ):
        RIG.prepare(flight.setup, flight.given)
