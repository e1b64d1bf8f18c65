"""The multirotor on the bench: its physics, our autopilot, and stand-ins for PX4 and ArduPilot."""

import contextlib
import json
import math
import socket
import threading
import time

import numpy as np
import pytest
from flights import ran_of, series
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from stations import on_threads

from robins.bench.bridges import BridgeClosed, BridgeTimeout
from robins.bench.parts import node
from robins.bench.parts.config_files import put
from robins.bench.rigs import rig_of
from robins.bench.rigs.multirotor import MOTORS, autopilots
from robins.bench.rigs.multirotor.craft import at_rest, moved
from robins.bench.run.setup import changed, read
from robins.earth import dcm_en, ecef_from_geodetic
from robins.earth.atmosphere import pressure_altitude_m
from robins.earth.magnetic import elements
from robins.scenario import ScenarioError
from robins.workbench import InputError, bench_replay, bench_up

RIG = rig_of("multirotor")
G, MASS, DRAG, MOST = 9.80665, 1.5, 0.2, 8.0  # of the model, as its documents say
INERTIA, ARM, REACTION, DAMPING, LAG = np.array([0.02, 0.02, 0.04]), 0.18, 0.05, 2e-3, 0.02
# x forward and y right of each motor; how its propeller turns, seen from above
LAYOUT = {
    "front right": (1, 1, "left"),
    "rear left": (-1, -1, "left"),
    "front left": (1, -1, "right"),
    "rear right": (-1, 1, "right"),
}
WIND = np.array([4.0, -3.0, 0.0])
STEPS, HOVERS = 2000, 1250  # 8 s, 5 s
SHORT = ("duration=8 s", "counted_from=5 s", "height=2 m", 'wind=["4 m/s", "-3 m/s", "0 m/s"]')
CALM = ("duration=4 s", "counted_from=3 s", "height=1 m", 'wind=["1 m/s", "0 m/s", "0 m/s"]')


def kit_of(*settings, **options):
    flight = changed(read("windy-hover"), {"seed": 5, **options})
    given = read("multirotor", settings).given if settings else flight.given
    return flight._replace(given=given), RIG.prepare(flight.setup, given)


def judged(flight, of):
    return RIG.judge(flight, ran_of(of))


@pytest.fixture(scope="module")
def run():
    flight, config = kit_of(*SHORT)
    return flight, config, series(RIG, config, STEPS)[0]


@pytest.fixture(scope="module")
def hovering(run):
    """States after 5 s, when it counts."""
    return series(RIG, run[1], HOVERS)[1]


# ------------------------------------------------------------------------------------ physics


def after(s, control, seconds, dt=1e-3, wind=(0.0, 0.0, 0.0)):
    control, wind = np.asarray(control, float), np.asarray(wind, float)
    for _ in range(round(seconds / dt)):
        s = moved(s, control, wind, dt)
    return type(s)(*map(np.asarray, s))


def in_the_air(**more):
    return at_rest()._replace(p_n=np.array([0.0, 0.0, -50.0]), **more)


@pytest.mark.parametrize("share", [0.0, 0.4])
def test_on_the_ground_the_specific_force_is_against_gravity_and_nothing_moves(share):
    s = after(at_rest(), [share] * 4, 0.5, wind=WIND)
    np.testing.assert_array_equal(s.f_b, [0.0, 0.0, -G])
    for still in (s.p_n, s.v_n, s.omega_b):
        np.testing.assert_array_equal(still, np.zeros(3))


def test_it_hovers_at_a_quarter_of_its_weight_by_each_motor():
    thrust = MASS * G / 4.0
    s = after(in_the_air(thrust=np.full(4, thrust)), [thrust / MOST] * 4, 1.0)
    np.testing.assert_allclose(s.v_n, 0.0, atol=1e-12)
    np.testing.assert_allclose(s.f_b, [0.0, 0.0, -G], atol=1e-12)
    off = after(at_rest(), [1.02 * thrust / MOST] * 4, 1.0)
    assert off.p_n[2] < -0.05  # a little more lifts it off


def test_it_falls_as_the_drag_of_the_air_lets_it():
    terminal, tau = MASS * G / DRAG, MASS / DRAG
    wanted = terminal * (1.0 - math.exp(-2.0 / tau))
    errors = [after(in_the_air(), [0.0] * 4, 2.0, dt).v_n[2] - wanted for dt in (4e-3, 2e-3)]
    assert abs(errors[0]) < 0.02
    assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.1)
    np.testing.assert_allclose(after(in_the_air(), [0.0] * 4, 1e-3).f_b, 0.0, atol=2e-3)


@pytest.mark.parametrize("name", LAYOUT)
def test_a_motor_turns_the_craft_as_it_stands_and_turns(name):
    x, y, turns = LAYOUT[name]
    control = np.zeros(4)
    control[MOTORS.index(name)] = 0.5
    roll, pitch, yaw = after(in_the_air(), control, 0.05).omega_b
    assert roll * -y > 0.1  # one on the right lifts the right side
    assert pitch * x > 0.1  # one in front lifts the nose
    assert yaw * (1 if turns == "left" else -1) > 0.01  # the reaction


def test_its_motion_is_that_of_its_differential_equation():
    """SciPy integrates the equations as they stand, with the attitude as a matrix."""
    control, wind = np.array([0.5, 0.45, 0.52, 0.47]), np.array([3.0, -2.0, 1.0])
    start = in_the_air(
        q_nb=Rotation.from_rotvec([0.3, -0.2, 0.5]).as_quat(scalar_first=True),
        omega_b=np.array([1.0, -2.0, 0.5]),
        v_n=np.array([1.0, 2.0, -1.0]),
    )
    places = np.array([[x * ARM, y * ARM, 0.0] for x, y, _ in LAYOUT.values()])
    signs = np.array([1.0 if turns == "left" else -1.0 for *_, turns in LAYOUT.values()])

    def slope(_, z):
        C, omega, _, v, thrust = np.split(z, [9, 12, 15, 18])
        C = C.reshape(3, 3)
        torque = sum(np.cross(r, [0.0, 0.0, -t]) for r, t in zip(places, thrust, strict=True))
        torque = torque + REACTION * (signs @ thrust) * np.eye(3)[2] - DAMPING * omega
        spin = np.array(
            [[0, -omega[2], omega[1]], [omega[2], 0, -omega[0]], [-omega[1], omega[0], 0]]
        )
        force = C @ [0.0, 0.0, -thrust.sum()] - DRAG * (v - wind) + [0.0, 0.0, MASS * G]
        turning = (torque - np.cross(omega, INERTIA * omega)) / INERTIA
        lag = (MOST * control - thrust) / LAG
        return np.concatenate([(C @ spin).ravel(), turning, v, force / MASS, lag])

    C = Rotation.from_quat(start.q_nb, scalar_first=True).as_matrix()
    z = np.concatenate([C.ravel(), start.omega_b, start.p_n, start.v_n, start.thrust])
    end = solve_ivp(slope, (0.0, 0.5), z, rtol=1e-10, atol=1e-12).y[:, -1]
    errors = []
    for dt in (1e-3, 5e-4):
        s = after(start, control, 0.5, dt, wind)
        C = Rotation.from_quat(s.q_nb, scalar_first=True).as_matrix()
        ours = np.concatenate([C.ravel(), s.omega_b, s.p_n, s.v_n, s.thrust])
        errors.append(np.abs(ours - end))
    assert errors[1].max() < 5e-3
    moving = errors[1] > 1e-4
    np.testing.assert_allclose(errors[0][moving] / errors[1][moving], 2.0, rtol=0.1)


# -------------------------------------------------------------------------------- instruments


def test_instruments_measure_what_is_true(run):
    _, config, of = run
    given = config.given
    fixes = np.isfinite(of["fix.lat"])
    assert np.sum(fixes) == STEPS // 50
    origin = np.asarray(ecef_from_geodetic(given.lat, given.lon, given.alt))
    place = (of[f"fix.{name}"][fixes] for name in ("lat", "lon", "alt"))
    p_n = (np.asarray(ecef_from_geodetic(*place)) - origin) @ np.asarray(
        dcm_en(given.lat, given.lon)
    )
    off = p_n - of["motion.p_n"][fixes]
    assert np.std(off) == pytest.approx(0.5, rel=0.2)
    assert abs(np.mean(off)) < 0.1
    assert np.std((of["fix.v_n"] - of["motion.v_n"])[fixes]) == pytest.approx(0.1, rel=0.2)
    gyro = np.degrees(of["sample.omega_b"] - of["motion.omega_b"])
    assert np.std(gyro) == pytest.approx(0.1, rel=0.05)
    assert np.std(of["sample.f_b"] - of["motion.f_b"]) == pytest.approx(0.05, rel=0.05)
    slow = np.isfinite(of["sample.pressure"])
    np.testing.assert_array_equal(np.flatnonzero(slow), np.arange(0, STEPS, 5))
    heights = [pressure_altitude_m(p) for p in of["sample.pressure"][slow]]
    heights_off = np.array(heights) - given.alt + of["motion.p_n"][slow, 2]
    assert np.std(heights_off) == pytest.approx(3.0 / (1.16 * G), rel=0.1)  # by its density
    # the compass in the axes of the Earth, by another rotation
    field = Rotation.from_quat(of["motion.q_nb"][slow], scalar_first=True).apply(
        of["sample.field_b"][slow]
    )
    angles = elements(field.mean(axis=0))
    # of Zurich, as maps of the field have it
    assert np.degrees(float(angles.declination_rad)) == pytest.approx(3.5, abs=1.0)
    assert np.degrees(float(angles.inclination_rad)) == pytest.approx(63.5, abs=1.0)
    assert float(angles.total_t) == pytest.approx(48.5e-6, abs=1e-6)


def test_noise_is_that_of_the_seed_and_the_step(run):
    _, config, of = run
    part = RIG.part("imu", config)
    motion = {name: of[f"motion.{name}"][40] for name in ("q_nb", "omega_b", "p_n", "v_n", "f_b")}
    _, [(_, said)] = part.act(None, 40, {"motion": motion})
    np.testing.assert_array_equal(said["omega_b"], of["sample.omega_b"][40])
    _, [(_, other)] = RIG.part("imu", config._replace(seed=6)).act(None, 40, {"motion": motion})
    assert np.all(other["omega_b"] != said["omega_b"])
    assert part.act(None, 40, {"motion": None}) == (None, [])


# -------------------------------------------------------------------------------- our autopilot


def test_it_hovers_in_wind(run):
    flight, _, of = run
    said = judged(flight, of)
    assert said.metrics["position_rms_m"] < 0.4
    assert said.metrics["position_max_m"] < 0.8
    assert said.metrics["heading_rms_deg"] < 1.0
    assert said.counts["steps_without_control"] == 250  # the first second
    assert not said.warnings
    off_n = said.arrays["error_position"].values[0]
    np.testing.assert_allclose(off_n[-1], of["motion.p_n"][-1] + [0.0, 0.0, 2.0])
    # it leans into the wind as far as drag and weight say, and carries both
    last = slice(-500, None)
    turned = Rotation.from_quat(of["motion.q_nb"][last], scalar_first=True)
    up_n = -turned.apply([0.0, 0.0, 1.0]).mean(axis=0)
    np.testing.assert_allclose(up_n[:2], -DRAG * WIND[:2] / (MASS * G), atol=0.01)
    carried = np.hypot(MASS * G, DRAG * 5.0) / (4 * MOST)
    assert of["motors.control"][last].mean() == pytest.approx(carried, rel=0.01)


def test_a_sample_that_does_not_come_is_the_one_before(run, hovering):
    flight, config, whole = run
    again = series(RIG, config, HOVERS + 60, begin=HOVERS, states=hovering)[0]
    np.testing.assert_array_equal(again["motion.p_n"][HOVERS:], whole["motion.p_n"][HOVERS:][:60])

    def lost(name, k):
        return name == "sample" and k % 50 == 7

    of = series(RIG, config, STEPS, lost, HOVERS, hovering)[0]
    assert judged(flight, of).metrics["position_rms_m"] < 0.5


def disturbed(config, hovering, kind, **more):
    """A flight with a fault of a sensor or a motor from 5 s on."""
    one, of = RIG.fault(kind=kind, begin=0.0, **more), RIG.device_faults()[0][kind]

    def wrong(name, k, said):
        return of.act(said, one, 0) if name == of.message else said

    return series(RIG, config, STEPS, begin=HOVERS, states=hovering, wrong=wrong)[0]


def test_faults_of_its_sensors_and_motors(run, hovering):
    flight, config, whole = run
    weak = judged(flight, disturbed(config, hovering, "motor", motor=0, left=0.8)).metrics
    assert weak["position_rms_m"] < 0.6
    dead = disturbed(config, hovering, "motor", motor=2)
    assert judged(flight, dead).metrics["tilt_max_deg"] > 45.0
    assert dead["motion.p_n"][-1, 2] > -0.1  # it has come down
    np.testing.assert_array_equal(dead["motion.v_n"][-1], np.zeros(3))
    blind = disturbed(config, hovering, "blind")
    assert judged(flight, blind).metrics["position_max_m"] < 2.0  # its accelerometers carry it on
    assert np.any(blind["motion.p_n"][1300] != whole["motion.p_n"][1300])
    magnet = judged(flight, disturbed(config, hovering, "magnet", field=20e-6)).metrics
    assert magnet["heading_rms_deg"] > 15.0
    assert magnet["position_rms_m"] < 1.0
    with pytest.raises(ValueError, match="needs it"):
        RIG.fault(kind="motor", begin=0.0)


# ------------------------------------------------------------------------------- over the wire


def scenario(tmp_path, settings=CALM, **more):
    told = {"bench": "multirotor", "seed": 5, "set": list(settings), **more}
    path = tmp_path / "flight.toml"
    path.write_text("\n".join(f"{key} = {json.dumps(value)}" for key, value in told.items()))
    return path


def free(kind):
    with socket.socket(socket.AF_INET, kind) as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def px4(port, config, until=None):
    """A stand-in for PX4: our autopilot, which hears what MAVLink carries."""
    from px4_peer import Peer, controls_frame

    part, fix = autopilots.own_autopilot(config), None
    part.rare()
    state = part.begin()
    for _ in range(1200):
        with contextlib.suppress(ConnectionRefusedError):  # the bench starts
            peer = Peer(port)
            break
        time.sleep(0.05)
    with peer:
        peer.socket.settimeout(60.0)
        for one in peer.every():
            if one.get_type() == "HIL_GPS":
                place = np.radians([one.lat * 1e-7, one.lon * 1e-7])
                v_n = np.array([one.vn, one.ve, one.vd]) / 100.0
                fix = {"lat": place[0], "lon": place[1], "alt": one.alt / 1000.0, "v_n": v_n}
            if one.get_type() != "HIL_SENSOR":
                continue
            field_T = np.array([one.xmag, one.ymag, one.zmag]) * 1e-4
            sample = {
                "omega_b": np.array([one.xgyro, one.ygyro, one.zgyro]),
                "f_b": np.array([one.xacc, one.yacc, one.zacc]),
                "field_b": field_T if one.fields_updated & 0x1C0 else np.full(3, np.nan),
                "pressure": one.abs_pressure * 100.0,
            }
            k = one.time_usec * 1000 // config.step_ns - 1
            if until is not None and k >= until:
                return
            state, [(_, asked)] = part.act(state, k, {"sample": sample, "fix": fix})
            fix = None
            peer.put(controls_frame(one.time_usec, asked["control"]))


def beside(target, *given):
    one = threading.Thread(target=target, args=given, daemon=True)
    one.start()
    return one


def test_px4_flies_it_over_tcp(tmp_path):
    pytest.importorskip("pymavlink", reason="needs pymavlink, of the extra 'autopilot'")
    port, (_, config) = free(socket.SOCK_STREAM), kit_of(*CALM)
    other = beside(px4, port, config)
    path = scenario(tmp_path, autopilot="px4", port=port)
    outcome = bench_up(str(path), record=tmp_path / "record.mcap")
    other.join(10.0)
    assert not other.is_alive()
    assert outcome.failure == ""
    assert outcome.metrics["multirotor"]["position_rms_m"] < 0.5
    # but for rounding in MAVLink, 1 cm and 1 cm/s of a fix, it is the flight with ours
    p_n = outcome.solution["value_motion_p_n"].values[0]
    off = np.abs(p_n - series(RIG, config, 1000)[0]["motion.p_n"])
    assert 0.0 < off.max() < 0.05
    for part in ("craft", "gnss"):
        assert bench_replay(tmp_path / "record.mcap", node=part).same
    with pytest.raises(InputError, match="is px4, a program whose state no record holds; compare"):
        bench_replay(tmp_path / "record.mcap", node="autopilot")


def pulses(told, height):
    """A pilot who is told the truth, by cosines and hands: whole microseconds of four motors."""
    imu = told["imu"]
    turned = Rotation.from_quat(told["quaternion"], scalar_first=True)
    off = np.array([0.0, 0.0, -height]) - told["position"]
    a = 2.5 * (np.clip(off, -1.5, 1.5) - told["velocity"])
    f = a - [0.0, 0.0, G]
    turn = np.cross([0.0, 0.0, 1.0], turned.inv().apply(-f / np.linalg.norm(f)))
    turn[2] = -turned.as_euler("ZYX")[0]
    roll, pitch, yaw = INERTIA * (120.0 * turn - 20.0 * np.array(imu["gyro"]))
    each, roll, pitch, yaw = (
        MASS * np.linalg.norm(f) / 4.0, roll / (4 * ARM), pitch / (4 * ARM), yaw / (4 * REACTION),
    )  # fmt: skip
    thrusts = [
        each - roll + pitch + yaw,
        each + roll - pitch + yaw,
        each + roll + pitch - yaw,
        each - roll - pitch - yaw,
    ]
    return [round(1000.0 + 1000.0 * min(max(t / MOST, 0.0), 1.0)) for t in thrusts]


def ardupilot(port, height, over):
    """A stand-in for ArduPilot."""
    from ardupilot_peer import Peer, packet

    with Peer(port) as peer:
        frame, pwm = 0, [1000] * 4
        while not over.is_set():
            peer.put(packet(frame, pwm))  # again, if there was no answer
            if (line := peer.line(timeout=1.0)) is not None:
                told, frame = json.loads(line), frame + 1
                pwm = pulses(told, height) if told["timestamp"] > 0.5 else [1000] * 4


def test_ardupilot_flies_it_over_udp(tmp_path, monkeypatch):
    on_threads(monkeypatch, processes=("autopilot",))
    port, over = free(socket.SOCK_DGRAM), threading.Event()
    other = beside(ardupilot, port, 1.0, over)
    path = scenario(tmp_path, autopilot="ardupilot", port=port)
    outcome = bench_up(str(path))
    over.set()
    other.join(10.0)
    assert outcome.failure == ""
    metrics = outcome.metrics["multirotor"]
    assert metrics["position_rms_m"] < 0.2
    assert metrics["heading_rms_deg"] < 1.0
    motors = outcome.solution["value_motors_control"].values[0]
    np.testing.assert_allclose(motors * 1000.0, np.round(motors * 1000.0), atol=1e-9)  # of PWM


# ------------------------------------------------------------------------------------ trouble


def test_nobody_at_the_other_end_is_told(monkeypatch):
    monkeypatch.setattr(autopilots, "CONNECT_S", 0.05)
    for name, kind, program in (
        ("px4", socket.SOCK_STREAM, "PX4"), ("ardupilot", socket.SOCK_DGRAM, "ArduPilot"),
    ):  # fmt: skip
        port = free(kind)
        if name == "px4":
            pytest.importorskip("pymavlink")
        _, config = kit_of(autopilot=name, port=port)
        part = RIG.part("autopilot", config)
        with pytest.raises(
            BridgeTimeout, match=rf"{program} at port {port}: .*; start {program}'s SITL"
        ):
            part.rare()


def test_an_ardupilot_that_is_started_anew_is_told():
    from ardupilot_peer import Peer, packet

    port = free(socket.SOCK_DGRAM)
    part = RIG.part("autopilot", kit_of(autopilot="ardupilot", port=port)[1])
    motion = {name: getattr(at_rest(), name) for name in ("q_nb", "omega_b", "p_n", "v_n", "f_b")}
    with Peer(port) as peer:
        other = beside(lambda: [peer.put(packet(n)) or time.sleep(0.05) for n in (7, 7, 7, 7)])
        part.rare()
        other.join()
        peer.put(packet(0))
        with pytest.raises(BridgeClosed, match="started anew in the middle of the run; begin the"):
            part.act(part.begin(), 0, {"motion": motion})
    before = {"control": np.full(4, 0.5), "answered": 1}
    assert part.act(before, 1, {"motion": None}) == (before, [("motors", before)])


def test_an_autopilot_that_goes_fails_the_run_and_says_what_to_do(tmp_path, monkeypatch):
    on_threads(monkeypatch, processes=("autopilot",))
    pytest.importorskip("pymavlink", reason="needs pymavlink, of the extra 'autopilot'")
    port, (_, config) = free(socket.SOCK_STREAM), kit_of(*CALM)
    other = beside(px4, port, config, 100)
    outcome = bench_up(str(scenario(tmp_path, autopilot="px4", port=port)))
    other.join(10.0)
    assert f"'autopilot' ended with status 2: PX4 at port {port}: PX4 has gone:" in outcome.failure
    assert "; begin the run anew, then start the autopilot's SITL again, at 0.4" in outcome.failure
    assert "on_death" not in outcome.failure


def test_a_port_that_is_taken_ends_the_part_and_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(node.signal, "signal", lambda *_: None)  # of this process
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        put(kit_of(autopilot="ardupilot", port=port)[1], tmp_path / "kit")
        assert node.main(["multirotor", "autopilot", "none", str(tmp_path / "kit")]) == 2
    assert capsys.readouterr().err.startswith(f"127.0.0.1:{port}: cannot listen: ")


def test_what_cannot_be_is_refused(tmp_path):
    with pytest.raises(ScenarioError, match="on_death: 'autopilot' is px4, a program whose state"):
        read(str(scenario(tmp_path, autopilot="px4", on_death="restart")))
    with pytest.raises(ScenarioError, match="autopilot"):
        read(str(scenario(tmp_path, autopilot="betaflight")))
    with pytest.raises(ScenarioError, match="port"):
        read(str(scenario(tmp_path, autopilot="px4", port=70000)))
