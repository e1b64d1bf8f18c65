"""Messages of ROS 2: bytes by hand and by another encoder, axes by matrices, what is not known."""

import math
import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robins import ros
from robins.ros.messages import DIAGONAL_KNOWN, FIX, KNOWN, NO_FIX, UNKNOWN

NS = 10**9
RNG = np.random.default_rng(5)


def numbers(count: int) -> list[float]:
    return RNG.normal(size=count).tolist()


def any_message(name: str) -> ros.Message:
    match name:
        case "sensor_msgs/msg/Imu":
            return ros.Imu(*map(numbers, (4, 9, 3, 9, 3, 9)))
        case "sensor_msgs/msg/MagneticField":
            return ros.MagneticField([math.nan, *numbers(2)], numbers(9))
        case "sensor_msgs/msg/NavSatFix":
            return ros.NavSatFix(-1, 513, *numbers(2), math.nan, numbers(9), 2)
        case _:
            return ros.Odometry("base", *map(numbers, (3, 4, 36, 3, 3, 36)))


# ------------------------------------------------------------------------------------- bytes


def test_a_fix_by_hand():
    """Each byte as CDR places it: padding before what must begin at a multiple of its size."""
    place, spread = (48.25, 11.5, -3.0), [float(k) for k in range(9)]
    made = ros.encode(ros.NavSatFix(-1, 258, *place, spread, 3), 5 * NS + 7, "gps")
    by_hand = (
        bytes.fromhex("00010000")  # little endian
        + bytes.fromhex("05000000 07000000")  # seconds, nanoseconds
        + bytes.fromhex("04000000 67707300")  # four bytes, "gps", zero
        + bytes.fromhex("ff 00 0201")  # status -1, one byte to an even place, service 258
        + bytes.fromhex("00000000")  # to the next multiple of eight, 24
        + b"".join(struct.pack("<d", x) for x in (*place, *spread))
        + b"\x03"
    )
    assert made == by_hand


@pytest.mark.parametrize(("frame_id", "first"), [("", 16), ("abc", 16), ("abcd", 24), ("é", 16)])
def test_numbers_begin_at_multiples_of_eight(frame_id, first):
    made = ros.encode(ros.MagneticField([1.0, 2.0, 3.0], [0.0] * 9), 0, frame_id)
    assert len(made) == 4 + first + 12 * 8
    assert struct.unpack_from("<3d", made, 4 + first) == (1.0, 2.0, 3.0)


@pytest.mark.parametrize("time_ns", [0, 1, 1_756_402_237_123_456_789, -1, -NS, 2**31 * NS - 1])
def test_times_are_seconds_and_nanoseconds(time_ns):
    made = ros.encode(ros.MagneticField([0.0] * 3, [0.0] * 9), time_ns)
    sec, nanosec = struct.unpack_from("<iI", made, 4)
    assert sec * NS + nanosec == time_ns
    assert nanosec < NS


@pytest.mark.parametrize("name", ros.TYPES)
@pytest.mark.parametrize("order", "<>")
def test_another_encoder_is_understood(name, order):
    """rosbags writes in both orders; NaN is compared as NaN."""
    typesys = pytest.importorskip("rosbags.typesys", reason="the cross-check needs rosbags")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    made = any_message(name)
    theirs = store.deserialize_cdr(ros.encode(made, 3 * NS + 4, "frame"), name)
    back = ros.decode(
        ros.TYPES[name], bytes(store.serialize_cdr(theirs, name, little_endian=order == "<"))
    )
    assert (back.time_ns, back.frame_id) == (3 * NS + 4, "frame")
    assert type(back.message) is type(made)
    for one, other in zip(back.message, made, strict=True):
        np.testing.assert_array_equal(one, other)


def test_bytes_that_are_no_message():
    made = ros.encode(ros.MagneticField([1.0, 2.0, 3.0], [0.0] * 9), 5, "frame")
    assert ros.decode(ros.MagneticField, made + b"\0\0\0").message.magnetic_field == (1, 2, 3)
    for cut in range(2, len(made)):
        with pytest.raises(ros.RosError, match=r"MagneticField of .* bytes cannot be decoded"):
            ros.decode(ros.MagneticField, made[:cut])
    with pytest.raises(ros.RosError, match=r"encoded in another way .00070000"):
        ros.decode(ros.MagneticField, b"\0\7" + made[2:])
    huge = made[:12] + b"\xff\xff\xff\x7f" + made[16:]
    with pytest.raises(ros.RosError, match="cannot be decoded"):
        ros.decode(ros.MagneticField, huge)


def test_what_cannot_be_encoded():
    field = ros.MagneticField([0.0] * 3, [0.0] * 9)
    with pytest.raises(ros.RosError, match="MagneticField at 2147483648000000000 ns cannot"):
        ros.encode(field, 2**31 * NS)
    with pytest.raises(ros.RosError, match="give each field the numbers that its class names"):
        ros.encode(field._replace(magnetic_field=[0.0] * 4), 0)


@pytest.mark.parametrize("name", ros.TYPES)
@pytest.mark.parametrize("frame_id", ["", "a", "imu_link", "twelve_bytes"])
def test_another_encoder_makes_the_same_bytes(name, frame_id):
    """rosbags builds the message of its own definitions and encodes it."""
    typesys = pytest.importorskip("rosbags.typesys", reason="the cross-check needs rosbags")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    made, kinds = any_message(name), store.types

    def built(kind: str, *values):
        return kinds[kind](*values)

    def vector(v):
        return built("geometry_msgs/msg/Vector3", *v)

    def quaternion(q):
        return built("geometry_msgs/msg/Quaternion", *q)

    header = built("std_msgs/msg/Header", built("builtin_interfaces/msg/Time", 3, 4), frame_id)
    match made:
        case ros.Imu():
            q, q_p, w, w_p, f, f_p = made
            fields = quaternion(q), np.array(q_p), vector(w), np.array(w_p), vector(f)
            fields = *fields, np.array(f_p)
        case ros.MagneticField():
            fields = vector(made.magnetic_field), np.array(made.magnetic_field_covariance)
        case ros.NavSatFix():
            status = built("sensor_msgs/msg/NavSatStatus", made.status, made.service)
            fields = status, *made[2:5], np.array(made.position_covariance), made[6]
        case _:
            child, r, q, pose_p, v, w, twist_p = made
            point = built("geometry_msgs/msg/Point", *r)
            pose = built("geometry_msgs/msg/Pose", point, quaternion(q))
            twist = built("geometry_msgs/msg/Twist", vector(v), vector(w))
            fields = (
                child,
                built("geometry_msgs/msg/PoseWithCovariance", pose, np.array(pose_p)),
                built("geometry_msgs/msg/TwistWithCovariance", twist, np.array(twist_p)),
            )
    theirs = store.serialize_cdr(built(name, header, *fields), name)
    assert ros.encode(made, 3 * NS + 4, frame_id) == bytes(theirs)


@pytest.mark.parametrize("name", ros.TYPES)
def test_definitions_are_those_of_ros(name):
    """Parsed by rosbags, each type in them has the fields that ROS 2 Humble has."""
    typesys = pytest.importorskip("rosbags.typesys", reason="the cross-check needs rosbags")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    parsed = typesys.get_types_from_msg(ros.definition(ros.TYPES[name]), name)
    assert len(parsed) >= 4
    for one, (constants, fields) in parsed.items():
        assert (one, fields) == (one, store.fielddefs[one][1])
        assert sorted(constants) == sorted(store.fielddefs[one][0])


# -------------------------------------------------------------------------------------- axes

# columns: the axes of ROS, seen in the frame of robins
BODY = {None: np.eye(3), "FRD": np.diag([1.0, -1.0, -1.0])}
BODY["RFU"] = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
NAV = {None: np.eye(3), "ENU": np.eye(3)}
NAV["NED"] = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def positive(size: int) -> np.ndarray:
    a = RNG.normal(size=(size, size))
    return a @ a.T


def turned(matrix: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Covariance along other axes, for each vector in it."""
    whole = np.kron(np.eye(len(matrix) // 3), axes.T)
    return whole @ matrix @ whole.T


@pytest.mark.parametrize("body", BODY)
@pytest.mark.parametrize("nav", NAV)
def test_axes_are_turned_as_by_matrices(body, nav):
    b, n = BODY[body], NAV[nav]
    attitude, (w, f, r, v) = Rotation.random(rng=RNG), RNG.normal(size=(4, 3))
    q = np.roll(attitude.as_quat(), 1)
    spread, six, other = positive(3), positive(6), positive(6)
    there = n.T @ attitude.as_matrix() @ b  # from the axes of ROS to those of ROS

    made = ros.imu(
        w,
        f,
        q,
        omega_covariance=spread,
        f_covariance=2.0 * spread,
        q_covariance=3.0 * spread,
        body=body,
        nav=nav,
    )
    np.testing.assert_array_equal(made.angular_velocity, b.T @ w)
    np.testing.assert_array_equal(made.linear_acceleration, b.T @ f)
    for scale, one in ((1, made[3]), (2, made[5]), (3, made[1])):
        np.testing.assert_array_equal(np.reshape(one, (3, 3)), scale * turned(spread, b))
    np.testing.assert_allclose(Rotation.from_quat(made.orientation).as_matrix(), there, atol=1e-15)

    place = ros.odometry(
        r_n_m=r,
        q_nb=q,
        v_b_mps=v,
        omega_b=w,
        pose_covariance=six,
        twist_covariance=other,
        body=body,
        nav=nav,
    )
    np.testing.assert_array_equal(place.position, n.T @ r)
    np.testing.assert_array_equal(place.linear, b.T @ v)
    np.testing.assert_array_equal(place.angular, b.T @ w)
    np.testing.assert_array_equal(np.reshape(place.pose_covariance, (6, 6)), turned(six, n))
    np.testing.assert_array_equal(np.reshape(place.twist_covariance, (6, 6)), turned(other, b))
    np.testing.assert_allclose(Rotation.from_quat(place.orientation).as_matrix(), there, atol=1e-15)
    assert place.child_frame_id == "base_link"

    field = ros.magnetic_field(w, covariance=spread, body=body)
    np.testing.assert_array_equal(field.magnetic_field, b.T @ w)
    np.testing.assert_array_equal(field.magnetic_field_covariance, np.ravel(turned(spread, b)))


@pytest.mark.parametrize(
    ("body", "nav", "q_nb", "f_b"),
    [
        ("FRD", "NED", [math.sqrt(0.5), 0, 0, math.sqrt(0.5)], [0, 0, -9.8]),
        ("RFU", "ENU", [math.sqrt(0.5), 0, 0, -math.sqrt(0.5)], [0, 0, 9.8]),
    ],
)
def test_a_level_body_that_heads_east(body, nav, q_nb, f_b):
    """East is the x axis of ROS: no turn at all; and at rest it feels +9.8 upwards."""
    made = ros.imu(None, f_b, q_nb, body=body, nav=nav)
    np.testing.assert_allclose(np.abs(made.orientation), [0, 0, 0, 1], atol=1e-15)
    assert tuple(made.linear_acceleration) == (0.0, 0.0, 9.8)


def test_a_fix_is_in_degrees_along_east_north_up():
    made = ros.nav_sat_fix(math.radians(48.0), math.radians(-11.0), 500.0, service=1)
    assert (made.status, made.service, made.altitude) == (FIX, 1, 500.0)
    np.testing.assert_allclose([made.latitude, made.longitude], [48.0, -11.0], rtol=1e-15)
    assert tuple(made.position_covariance) == (0.0,) * 9
    assert made.position_covariance_type == UNKNOWN
    north_east_down = np.diag([1.0, 4.0, 9.0])
    made = ros.nav_sat_fix(0.1, 0.2, 3.0, covariance=north_east_down)
    assert tuple(made.position_covariance) == (4, 0, 0, 0, 1, 0, 0, 0, 9)
    assert made.position_covariance_type == DIAGONAL_KNOWN
    north_east_down[0, 2] = north_east_down[2, 0] = 0.5
    made = ros.nav_sat_fix(0.1, 0.2, 3.0, covariance=north_east_down)
    assert tuple(made.position_covariance) == (4, 0, 0, 0, 1, -0.5, 0, -0.5, 9)
    assert made.position_covariance_type == KNOWN
    made = ros.nav_sat_fix(0.1, 0.2, 3.0, covariance=north_east_down, nav="ENU")
    np.testing.assert_array_equal(made.position_covariance, north_east_down.ravel())


# ------------------------------------------------------------------------------ what is not known


def test_what_is_missing_is_said():
    nothing = ros.imu()
    assert [nothing[k][0] for k in (1, 3, 5)] == [-1.0, -1.0, -1.0]
    assert tuple(nothing.orientation) == (0.0, 0.0, 0.0, 1.0)
    some = ros.imu(omega_b=[1.0, math.nan, 3.0], body="FRD")
    assert some.angular_velocity_covariance[0] == 0.0  # measured, how well is not known
    np.testing.assert_array_equal(some.angular_velocity, [1.0, math.nan, -3.0])
    still = ros.odometry()
    assert np.isnan([*still.position, *still.orientation, *still.linear, *still.angular]).all()
    assert not np.any([*still.pose_covariance, *still.twist_covariance])
    np.testing.assert_array_equal(
        ros.magnetic_field([1.0, math.nan, 2.0], body="RFU").magnetic_field, [math.nan, -1.0, 2.0]
    )


def test_a_fix_that_is_none():
    lost = ros.nav_sat_fix(math.nan, math.nan, math.nan, covariance=np.diag([1.0, 1.0, math.nan]))
    assert (lost.status, lost.position_covariance_type) == (NO_FIX, UNKNOWN)
    assert np.isnan([lost.latitude, lost.longitude, lost.altitude]).all()
    flat = ros.nav_sat_fix(0.1, 0.2, math.nan, status=2)
    assert (flat.status, math.isnan(flat.altitude)) == (2, True)
