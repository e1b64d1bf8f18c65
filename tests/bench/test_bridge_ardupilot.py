"""ArduPilot's JSON interface, against its description and a stand-in made with `struct`."""

import json
import math
import re
import threading
import time

import numpy as np
import pytest
from ardupilot_peer import Peer, packet
from rotorcraft import STEP_US, Craft, Pilot, angle_deg, fly

from robins.bench.bridges import BridgeClosed, BridgeError
from robins.bench.bridges import ardupilot as bridge
from robins.bench.bridges.ardupilot import ArduPilotPhysics, BodyState, Servos, decode, encode


@pytest.fixture
def physics():
    with ArduPilotPhysics(port=0) as physics:
        yield physics


@pytest.fixture
def peer(physics):
    with Peer(physics.port) as peer:
        yield peer


def state(**more):
    given = {
        "time_s": 0.25,
        "f_b_m_s2": (0.5, 0.0, -9.75),
        "omega_ib_b_rad_s": (0.125, -0.5, 2.0),
        "position_n_m": (1.0, 2.0, -3.0),
        "v_n_m_s": (4.0, 5.0, -6.0),
        "q_nb": (1.0, 0.0, 0.0, 0.0),
    }
    return BodyState(**{**given, **more})


# ------------------------------------------------------------------------------------- bytes


def test_a_packet_byte_for_byte():
    data = bytes.fromhex("1a48" + "9001" + "04030201" + "e803" + "dc05" + "d007" + 13 * "0000")
    assert decode(data) == Servos(0x01020304, 400, (1000, 1500, 2000, *[0] * 13))
    wide = decode(bytes.fromhex("8173" + "3200" + "07000000" + 32 * "dc05"))
    assert wide == Servos(7, 50, (1500,) * 32)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x1a",
        packet(0)[:-1],
        packet(0) + b"\0",
        b"\x1b" + packet(0)[1:],
        packet(0, magic=29569)[:40],  # 32 channels, cut to the length of 16
    ],
)
def test_what_is_no_packet_is_refused(data):
    with pytest.raises(BridgeError, match="is none of ArduPilot's servo outputs"):
        decode(data)


def test_a_state_byte_for_byte():
    assert encode(state()) == (
        b'\n{"timestamp":0.25,"imu":{"gyro":[0.125,-0.5,2.0],"accel_body":[0.5,0.0,-9.75]},'
        b'"position":[1.0,2.0,-3.0],"quaternion":[1.0,0.0,0.0,0.0],"velocity":[4.0,5.0,-6.0]}\n'
    )


def scanned(text, section, key):
    """A number as ArduPilot finds it: the key as text after its section's, then what follows."""
    text = text[text.index(section) + len(section) :]
    text = text[text.index(key) + len(key) + 2 :]  # a quotation mark and a colon
    found = re.match(r"[-\d.]+|\[([-\d.,]+)\]", text)
    return [float(n) for n in (found[1] or found[0]).split(",")]


def test_fields_are_found_as_text():
    text = encode(
        state(
            airspeed_m_s=12.5,
            wind_n_m_s=(-1.0, 2.0, 0.5),
            apparent_wind=(0.75, 13.0),
            rangefinders_m=(1.5, 2.5),
            battery=(12.6, 3.25),
        )
    ).decode()
    told = json.loads(text)
    assert told["windvane"] == {"direction": 0.75, "speed": 13.0}
    assert told["battery"] == {"voltage": 12.6, "current": 3.25}
    assert (told["airspeed"], told["rng_1"], told["rng_2"]) == (12.5, 1.5, 2.5)
    assert " " not in text
    assert scanned(text, "", "timestamp") == [0.25]
    assert scanned(text, "imu", "gyro") == [0.125, -0.5, 2.0]
    assert scanned(text, "imu", "accel_body") == [0.5, 0.0, -9.75]
    assert scanned(text, "", "position") == [1.0, 2.0, -3.0]
    assert scanned(text, "", "velocity") == [4.0, 5.0, -6.0]
    assert scanned(text, "", "velocity_wind") == [-1.0, 2.0, 0.5]


@pytest.mark.parametrize(
    ("more", "what"),
    [
        ({"time_s": math.inf}, "time_s is inf"),
        ({"v_n_m_s": (0.0, math.nan, 0.0)}, "v_n_m_s is nan"),
        ({"q_nb": (1.0, 0.0, 0.0)}, "q_nb has 4 components, got 3"),
        ({"rangefinders_m": (1.0,) * 7}, "rangefinders_m has 6 at most"),
        ({"airspeed_m_s": math.nan}, "airspeed_m_s is nan"),
    ],
)
def test_what_json_cannot_carry_is_refused(more, what):
    with pytest.raises(BridgeError, match=what):
        encode(state(**more))


# ---------------------------------------------------------------------------------- the loop


def pulses(controls):
    """Controls in [-1, 1] as whole microseconds."""
    return [round(1500.0 + 500.0 * c) for c in controls]


def controls(pulses_us):
    return (np.array(pulses_us[:3], float) - 1500.0) / 500.0


def fly_by_wire(port, frames, first=0):
    """A stand-in: a packet, an answer, and so on."""
    pilot, told = Pilot(), {"imu": {"gyro": Craft().omega}}
    with Peer(port) as peer:
        for k in range(frames):
            peer.put(packet(first + k, pulses(pilot.controls(told["imu"]["gyro"]))))
            told = json.loads(peer.line())


def series(physics, frames):
    """The physics: a craft that begins anew when ArduPilot does."""
    craft, time_us, attitudes = Craft(), 0, []
    for _ in range(frames):
        servos = physics.receive(10.0)
        if servos.restarted:
            craft, time_us, attitudes = Craft(), 0, []
        craft.step(controls(servos.pwm_us))
        time_us += STEP_US
        physics.reply(
            state(
                time_s=time_us * 1e-6,
                f_b_m_s2=craft.force(),
                omega_ib_b_rad_s=craft.omega,
                q_nb=craft.q_nb,
            )
        )
        attitudes.append(craft.q_nb)
    return np.array(attitudes)


def test_the_loop_over_the_line_is_that_inside_one_program(physics):
    one = threading.Thread(target=fly_by_wire, args=(physics.port, 300), daemon=True)
    one.start()
    attitudes = series(physics, 300)
    one.join(10.0)
    inside = fly(300, lambda gyro: gyro, lambda c: controls(pulses(c)))
    np.testing.assert_array_equal(attitudes, inside)
    assert angle_deg(attitudes[0]) > 40.0
    assert angle_deg(attitudes[-1]) < 1.0
    assert physics.counts.packets == 300
    assert (physics.counts.lost, physics.counts.repeated, physics.counts.restarts) == (0, 0, 0)


def test_ardupilot_goes_and_comes_back_and_the_physics_begin_anew(physics, monkeypatch):
    monkeypatch.setattr(bridge, "SILENT_S", 0.0)
    for flight in range(2):
        one = threading.Thread(target=fly_by_wire, args=(physics.port, 20), daemon=True)
        one.start()
        attitudes = series(physics, 20)
        one.join(10.0)
        np.testing.assert_array_equal(
            attitudes, fly(20, lambda gyro: gyro, lambda c: controls(pulses(c)))
        )
        assert physics.counts.restarts == flight
        assert physics.receive(0.01) is None


# ---------------------------------------------------------------------------------- trouble


def test_packets_that_jump_are_lost(physics, peer):
    peer.put(packet(5), packet(6), packet(9))
    assert [physics.receive(5.0).frame for _ in range(3)] == [5, 6, 9]
    assert physics.counts.lost == 2


def test_a_packet_that_comes_again_gets_the_same_answer(physics, peer):
    peer.put(packet(0))
    physics.receive(5.0)
    physics.reply(state(time_s=1.0))
    first = peer.line()
    peer.put(packet(0))
    assert physics.receive(0.05) is None  # nothing to compute
    assert peer.line() == first
    assert (physics.counts.packets, physics.counts.repeated) == (2, 1)


def test_a_slow_physics_answers_once(physics, peer):
    peer.put(packet(0))
    assert physics.receive(5.0).frame == 0
    peer.put(packet(0), packet(0), packet(1))
    physics.reply(state(time_s=1.0))
    assert physics.receive(5.0).frame == 1
    physics.reply(state(time_s=2.0))
    assert [json.loads(peer.line())["timestamp"] for _ in range(2)] == [1.0, 2.0]
    assert peer.line(timeout=0.05) is None
    assert (physics.counts.packets, physics.counts.repeated, physics.counts.lost) == (4, 2, 0)


def test_a_packet_that_was_not_answered_is_handed_out_again(physics, peer):
    peer.put(packet(3, [1100]), packet(3, [1100]))
    assert physics.receive(5.0) == physics.receive(5.0)
    assert physics.counts.repeated == 1


@pytest.mark.parametrize(("before", "after"), [(1000, 0), (7, 7), (7, 9)])
def test_another_ardupilot_is_a_restart_whatever_it_counts(physics, before, after, monkeypatch):
    monkeypatch.setattr(bridge, "SILENT_S", 0.0)
    for count, restarted in ((before, False), (after, True)):
        with Peer(physics.port) as peer:
            peer.put(packet(count))
            servos = physics.receive(5.0)
            assert (servos.frame, servos.restarted) == (count, restarted)
            physics.reply(state(time_s=float(count)))
            assert json.loads(peer.line())["timestamp"] == count
    assert (physics.counts.restarts, physics.counts.lost) == (1, 0)


def test_other_datagrams_are_counted_and_nobody_is_answered(physics, peer):
    with Peer(physics.port) as stranger:
        stranger.put(b"hello", packet(0)[:-2], bytes(40))
        peer.put(packet(0, [1234]))
        assert physics.receive(5.0).pwm_us[0] == 1234
        physics.reply(state())
        assert stranger.line(timeout=0.05) is None
    assert peer.line() is not None
    assert (physics.counts.wrong, physics.counts.packets) == (3, 1)


def test_a_stranger_does_not_take_the_place_of_an_autopilot_that_flies(physics, peer):
    peer.put(packet(0))
    assert physics.receive(5.0).frame == 0
    with Peer(physics.port) as stranger:
        stranger.put(packet(0, [1900]), packet(7, [1900]))
        physics.reply(state(time_s=1.0))  # what came while the answer was computed
        stranger.put(packet(8, [1900]))
        assert physics.receive(0.05) is None
        peer.put(packet(1))
        servos = physics.receive(5.0)
        assert (servos.frame, servos.restarted) == (1, False)
        physics.reply(state(time_s=2.0))
        assert stranger.line(timeout=0.05) is None
    assert [json.loads(peer.line())["timestamp"] for _ in range(2)] == [1.0, 2.0]
    assert (physics.counts.strangers, physics.counts.restarts, physics.counts.packets) == (3, 0, 2)


HERE, THERE, ELSEWHERE = "127.0.0.1", "192.0.2.7", "192.0.2.8"


@pytest.mark.parametrize(
    ("declared", "bound", "sender", "silent_s", "admitted"),
    [
        ("", None, ELSEWHERE, 0.0, True),  # nobody is bound yet
        ("", HERE, HERE, 0.9, False),
        ("", HERE, HERE, 1.1, True),
        ("", HERE, THERE, 9e9, False),
        ("", THERE, THERE, 9e9, False),  # of another machine, which nobody declared
        (THERE, THERE, THERE, 0.9, False),
        (THERE, THERE, THERE, 1.1, True),
        (THERE, None, ELSEWHERE, 9e9, False),
        (THERE, None, THERE, 0.0, True),
    ],
)
def test_who_may_take_the_place_of_an_autopilot(declared, bound, sender, silent_s, admitted):
    with ArduPilotPhysics(port=0, peer=declared) as physics:
        physics._peer = None if bound is None else (bound, 1000)
        physics._active = time.monotonic() - silent_s
        assert physics.admits((sender, 2000)) == admitted
        assert bound is None or physics.admits((bound, 1000))


def test_errors_say_what_to_do(physics):
    with pytest.raises(BridgeClosed, match=r"no packet of ArduPilot came yet; call receive\(\)"):
        physics.reply(state())
    with pytest.raises(BridgeClosed, match=f"127.0.0.1:{physics.port}: cannot listen"):
        ArduPilotPhysics(port=physics.port)
    physics.close()
    with pytest.raises(BridgeClosed, match="cannot receive"):
        physics.receive(1.0)
