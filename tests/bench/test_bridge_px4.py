"""PX4's simulator protocol, against MAVLink's definition and a stand-in with pymavlink's parser."""

import math
import socket
import struct
import time

import numpy as np
import pytest
from px4_peer import CONTROLS, SENSOR, Peer, controls_frame, frame, mavlink, thread, x25
from rotorcraft import STEP_US, Craft, Pilot, angle_deg, fly

from robins.bench.bridges import BridgeClosed, BridgeError, BridgeTimeout, MissingPackage
from robins.bench.bridges import errors as bridge_errors
from robins.bench.bridges.px4 import Px4Simulator
from robins.bench.bridges.px4_messages import Actuators, GnssFix, Sensors, Truth, message

# --------------------------------------------------------------------------- stand-in for PX4


def serve(port, start_us=0):
    """Answer samples from `start_us` on until the line ends; PX4 is deaf while it starts."""
    pilot = Pilot()
    with Peer(port) as peer:
        peer.put(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3).pack(peer.mav))
        request = mavlink.MAVLink_command_long_message(0, 0, 511, 0, 115, 5e3, 0, 0, 0, 0, 0)
        peer.put(request.pack(peer.mav))
        while sensor := peer.next("HIL_SENSOR"):
            if sensor.time_usec < start_us:
                continue
            values = pilot.controls([sensor.xgyro, sensor.ygyro, sensor.zgyro])
            peer.put(controls_frame(sensor.time_usec, values))


@pytest.fixture
def simulator():
    with Px4Simulator(port=0) as simulator:
        yield simulator


@pytest.fixture
def connected(simulator):
    with Peer(simulator.port) as peer:
        simulator.accept(5.0)
        yield simulator, peer


def sensors(time_us=0, **more):
    given = {"f_b_m_s2": (0.0, 0.0, -9.75), "omega_ib_b_rad_s": (0.5, -0.25, 1.0)}
    return Sensors(time_us=time_us, **{**given, **more})


# ------------------------------------------------------------------------------------- bytes


def test_the_check_is_that_of_its_definition():
    assert x25(b"123456789") == 0x6F91  # of the catalogue of CRCs, CRC-16/MCRF4XX
    assert (SENSOR, CONTROLS) == (108, 47)  # as published with the messages


def test_a_greeting_and_a_sample_byte_for_byte(simulator):
    with socket.create_connection(("127.0.0.1", simulator.port), timeout=5.0) as line:
        simulator.accept(5.0)
        simulator.send(sensors(1_000_000))
        got = bytearray()
        while len(got) < 21 + 73:  # four zeros at the end of 65 bytes are not sent
            got += line.recv(4096)
    # HEARTBEAT: custom_mode u32, generic, no autopilot (8), no mode, active (4), version 3.
    assert bytes(got[:21]) == frame(0, bytes.fromhex("000000000008000403"), 50, 0)
    assert bytes(got[:19]) == bytes.fromhex("fd090000000" + "1c8000000" + "000000000008000403")
    payload = (
        bytes.fromhex("40420f0000000000")  # 1 000 000 us
        + bytes.fromhex("0000000000000000" + "00001cc1")  # 0, 0, -9.75 m/s^2
        + bytes.fromhex("0000003f" + "000080be" + "0000803f")  # 0.5, -0.25, 1 rad/s
        + bytes(12)  # no magnetic field
        + bytes(12)  # no pressures, no height
        + struct.pack("<f", 15.0)  # 288.15 K
        + bytes.fromhex("3f000000")  # accelerometers and gyros
        + bytes(1)
    )
    assert bytes(got[21:]) == frame(107, payload, SENSOR, 1)


def test_the_fields_that_are_told():
    mav = mavlink.MAVLink(None)
    full = sensors(
        field_b_T=(21e-6, -2e-6, 43e-6), pressure_Pa=90_000.0, differential_pressure_Pa=250.0
    )
    payload = bytes(message(full).pack(mav))[10:-2].ljust(65, b"\0")
    values = struct.unpack("<Q13fIB", payload)
    np.testing.assert_allclose(values[7:10], [0.21, -0.02, 0.43], rtol=1e-6)  # gauss
    np.testing.assert_allclose(values[10:12], [900.0, 2.5], rtol=1e-6)  # hPa
    assert values[12] == pytest.approx(988.5, abs=0.5)  # m at 900 hPa, standard tables
    assert values[14:] == (0x1FFF, 0)
    assert message(sensors(pressure_Pa=9e4)).fields_updated == 0b1_1010_0011_1111


def test_a_fix_and_the_truth_in_the_units_of_mavlink():
    place = {"lat_rad": math.radians(-33.5), "lon_rad": math.radians(151.25), "alt_m": 58.125}
    motion = {"time_us": 12_345, "v_n_m_s": (-3.0, 4.0, -0.5)}
    fix = message(GnssFix(**place, **motion, horizontal_m=0.9, vertical_m=1.25))
    packed = bytes(fix.pack(mavlink.MAVLink(None)))[10:-2].ljust(39, b"\0")
    sent = struct.unpack("<QiiiHHHhhhHBBBH", packed)
    assert sent[:6] == (12_345, -335_000_000, 1_512_500_000, 58_125, 90, 125)
    # 5 m/s towards 90 + 36.87 deg
    assert sent[6:] == (500, -300, 400, -50, 12687, 3, 12, 0, 0)
    truth = Truth(
        **place, **motion, q_nb=(0.5, -0.5, 0.5, 0.5), omega_nb_b_rad_s=(1.0, 2.0, -4.0),
        airspeed_m_s=5.5, f_b_m_s2=(0.980665, 0.0, -9.80665),
    )  # fmt: skip
    packed = bytes(message(truth).pack(mavlink.MAVLink(None)))[10:-2].ljust(64, b"\0")
    assert struct.unpack("<Q4f3f3i3hHH3h", packed) == (
        12_345, 0.5, -0.5, 0.5, 0.5, 1.0, 2.0, -4.0, -335_000_000, 1_512_500_000, 58_125,
        -300, 400, -50, 550, 550, 100, 0, -1000,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("sample", "what"),
    [
        (sensors(f_b_m_s2=(0.0, math.nan, 0.0)), "f_b_m_s2 is nan"),
        (sensors(omega_ib_b_rad_s=(0.0, 0.0)), "has 3 components, got 2"),
        (sensors(time_us=-1), "time_us = -1 does not fit"),
        (sensors(pressure_Pa=0.0), "pressure_Pa has no height"),
        (
            GnssFix(time_us=0, lat_rad=0.0, lon_rad=0.0, alt_m=0.0, v_n_m_s=(0.0, 0.0, 400.0)),
            r"v_n_m_s \[cm/s\] = 40000 does not fit",
        ),
        (
            GnssFix(time_us=0, lat_rad=1.6, lon_rad=0.0, alt_m=0.0, v_n_m_s=(0.0, 0.0, 0.0)),
            r"lat_rad \[degE7\]",
        ),
    ],
)
def test_what_a_message_cannot_carry_is_refused(sample, what):
    with pytest.raises(BridgeError, match=what):
        message(sample)


# ---------------------------------------------------------------------------------- the loop


def test_the_loop_over_the_line_is_that_inside_one_program(simulator):
    steps, craft, attitudes = 300, Craft(), []
    with thread(serve, simulator.port):
        simulator.accept(5.0)
        for k in range(steps):
            answer = None
            while answer is None:  # PX4 starts
                sample = Sensors(
                    time_us=STEP_US * (k + 1), f_b_m_s2=craft.force(), omega_ib_b_rad_s=craft.omega
                )
                answer = simulator.step(sample)
            assert (answer.time_us, answer.armed, answer.lockstep) == (sample.time_us, True, True)
            craft.step(answer.controls[:3])
            attitudes.append(craft.q_nb)
        simulator.close()

    def single(values):
        return np.asarray(values, np.float32)

    np.testing.assert_array_equal(attitudes, fly(steps, single, single))
    assert angle_deg(Craft().q_nb) > 40.0
    assert angle_deg(attitudes[-1]) < 1.0
    counts = simulator.counts
    assert (counts.heartbeats, counts.others, counts.bad) == (1, 1, 0)


def test_the_simulation_runs_on_while_px4_starts(simulator):
    with thread(serve, simulator.port, 10 * STEP_US):
        simulator.accept(5.0)
        answers = []
        for k in range(30):
            answers.append(simulator.step(sensors(STEP_US * k)))
            if k == 9:
                assert answers == [None] * 10
                assert simulator.freewheeling
                time.sleep(0.05)
        simulator.close()
    assert answers[-1].time_us == STEP_US * 29
    assert not simulator.freewheeling


def test_an_answer_to_another_sample_is_none(connected):
    simulator, peer = connected
    peer.put(controls_frame(100, [0.5]) + controls_frame(200, [0.25]))
    answer = simulator.step(sensors(200))
    assert answer == Actuators(200, (0.25, *[0.0] * 15), 129, 1)
    assert simulator.counts.late == 1
    with pytest.raises(BridgeTimeout, match=r"no answer to the sample of 300 us within 0\.05 s"):
        simulator.step(sensors(300), timeout_s=0.05)
    peer.put(controls_frame(12, [0.5]))  # its clock is another
    with pytest.raises(BridgeTimeout, match=r"within 0\.05 s, but one to 12 us; look whether"):
        simulator.step(sensors(400), timeout_s=0.05)


def test_without_lockstep_the_newest_answer_counts(connected):
    simulator, peer = connected
    peer.put(b"".join(controls_frame(987_654_321 + k, [k / 4], mode=1, flags=0) for k in range(5)))
    answer = simulator.step(sensors(4000))
    assert (answer.time_us, answer.armed, answer.lockstep) == (987_654_325, False, False)
    assert answer.controls[0] == 1.0
    assert simulator.actuators(0.0) is None


# ---------------------------------------------------------------------------------- trouble


@pytest.mark.parametrize(
    "damage",
    [
        lambda f: f[:20] + bytes([f[20] ^ 4]) + f[21:],
        lambda f: f[:-1] + bytes([f[-1] ^ 0x80]),
        lambda f: b"noise",
    ],
    ids=["payload", "check", "noise"],
)
def test_damaged_bytes_are_counted_and_the_next_frame_is_heard(connected, damage):
    simulator, peer = connected
    peer.put(damage(controls_frame(1, [0.5])) + controls_frame(2, [0.75], sequence=1))
    answer = simulator.actuators(5.0)
    assert (answer.time_us, answer.controls[0]) == (2, 0.75)
    assert simulator.counts.bad == 1


def test_a_frame_in_single_bytes(connected):
    simulator, peer = connected
    for byte in controls_frame(7, [0.5]):
        peer.put(bytes([byte]))
    assert simulator.actuators(5.0).time_us == 7
    assert simulator.actuators(0.0) is None
    assert simulator.counts.bad == 0


def test_px4_goes_and_comes_back(simulator):
    with pytest.raises(BridgeTimeout, match=f"PX4 at port {simulator.port}: PX4 did not connect"):
        simulator.accept(0.05)
    with pytest.raises(BridgeClosed, match="PX4 is not connected; call accept"):
        simulator.send(sensors())
    for flight in range(2):
        with thread(serve, simulator.port):
            simulator.accept(5.0)
            assert simulator.freewheeling
            for k in range(1, 4):
                while simulator.step(sensors(STEP_US * k)) is None:
                    pass
            simulator.hang_up()
        assert simulator.counts.heartbeats == flight + 1


def test_a_line_that_ends_is_told(connected):
    simulator, peer = connected
    peer.socket.close()
    # The first bytes after the end are taken by the system.
    with pytest.raises(BridgeClosed, match="PX4 has gone"):  # noqa: PT012
        for k in range(100):
            simulator.step(sensors(k))
    assert not simulator.connected
    with Peer(simulator.port) as again:
        simulator.accept(5.0)
        again.put(controls_frame(5, [0.5]))
        assert simulator.actuators(5.0).time_us == 5


def test_a_connection_of_another_machine_is_closed_and_counted():
    with Px4Simulator(port=0, peer="192.0.2.7") as simulator:
        with Peer(simulator.port) as stranger:
            with pytest.raises(BridgeTimeout, match="PX4 did not connect"):
                simulator.accept(0.2)
            assert stranger.socket.recv(1) == b""
        assert (simulator.counts.strangers, simulator.connected) == (1, False)
        simulator._peer = "127.0.0.1"
        with Peer(simulator.port):
            simulator.accept(5.0)
        assert simulator.connected


def test_a_port_that_is_taken_is_told(simulator):
    with pytest.raises(BridgeClosed, match=f"127.0.0.1:{simulator.port}: cannot listen"):
        Px4Simulator(port=simulator.port)
    simulator.close()
    with pytest.raises(BridgeClosed, match="cannot wait for PX4"):
        simulator.accept(0.05)


def test_a_missing_package_names_its_extra():
    with pytest.raises(MissingPackage, match=r"pip install 'robins\[autopilot\]'"):
        bridge_errors.needed("pymavlink_that_is_not_there", "autopilot")
