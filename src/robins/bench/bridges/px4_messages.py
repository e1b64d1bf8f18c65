"""Messages between a simulator and PX4: four of MAVLink's common set.

    HIL_SENSOR (107), from us             `Sensors`: IMU, magnetic field, pressure
    HIL_GPS (113), from us                `GnssFix`: position and velocity of a receiver
    HIL_STATE_QUATERNION (115), from us   `Truth`, for PX4's log only
    HIL_ACTUATOR_CONTROLS (93), from PX4  `Actuators`

(MAVLink, common message set; PX4 guide, "Simulator MAVLink API".) Here everything is in SI, in NED
and FRD; conversion to the units of the messages is at the edge. HIL_SENSOR has 32-bit floats,
so a rate of 1 rad/s is rounded by up to 6e-8.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from robins.bench.bridges.errors import BridgeError, as_integer, finite, needed, vector
from robins.earth.atmosphere import pressure_altitude_m

Vector = Sequence[float] | np.ndarray

INT16, UINT16, INT32 = (-(2**15), 2**15 - 1), (0, 2**16 - 1), (-(2**31), 2**31 - 1)
UNKNOWN = 65535  # value of 16-bit fields
GRAVITY_M_S2 = 9.80665  # of a unit "G" of MAVLink
GAUSS_PER_T = 1e4


@dataclass(frozen=True, kw_only=True)
class Sensors:
    """A sample of the inertial sensors, and of others when they are due; None: not in this sample.

    Attributes:
        time_us: of the simulation. PX4 in lock-step has no other clock.
        f_b_m_s2: specific force, FRD: (0, 0, -9.8) at rest and level.
        omega_ib_b_rad_s: rate against inertial, FRD.
        field_b_T: magnetic flux density, FRD.
        pressure_Pa: static.
        differential_pressure_Pa: of the pitot tube.
        temperature_K: of the sensors; PX4 reads it together with a pressure.
    """

    time_us: int
    f_b_m_s2: Vector
    omega_ib_b_rad_s: Vector
    field_b_T: Vector | None = None
    pressure_Pa: float | None = None
    differential_pressure_Pa: float | None = None
    temperature_K: float = 288.15


@dataclass(frozen=True, kw_only=True)
class GnssFix:
    """A fix of a GNSS receiver.

    Attributes:
        time_us: of the simulation; PX4 uses it as UTC too.
        lat_rad, lon_rad: geodetic.
        alt_m: above mean sea level.
        v_n_m_s: north, east, down.
        horizontal_m, vertical_m: standard deviations. The field of MAVLink is a dilution of
            precision times 100; PX4 reads it as centimetres, and so it is sent.
        kind: 3: a 3D fix; 0 or 1: none.
        satellites: used.
    """

    time_us: int
    lat_rad: float
    lon_rad: float
    alt_m: float
    v_n_m_s: Vector
    horizontal_m: float = 1.0
    vertical_m: float = 1.5
    kind: int = 3
    satellites: int = 12


@dataclass(frozen=True, kw_only=True)
class Truth:
    """The true motion. PX4 logs it with its estimate and does not use it.

    Attributes:
        time_us: of the simulation.
        q_nb: FRD to NED, scalar first.
        omega_nb_b_rad_s: turn rate of the body with respect to local level, FRD.
        lat_rad, lon_rad: geodetic.
        alt_m: above mean sea level.
        v_n_m_s: north, east, down.
        airspeed_m_s: indicated and true.
        f_b_m_s2: specific force, FRD.
    """

    time_us: int
    q_nb: Vector
    omega_nb_b_rad_s: Vector
    lat_rad: float
    lon_rad: float
    alt_m: float
    v_n_m_s: Vector
    airspeed_m_s: float = 0.0
    f_b_m_s2: Vector = (0.0, 0.0, -GRAVITY_M_S2)


Px4Sample = Sensors | GnssFix | Truth


class Actuators(NamedTuple):
    """Commands of PX4 to motors and servos."""

    time_us: int  # in lock-step: that of the sample which it answers
    controls: tuple[float, ...]  # 16: motors in [0, 1], servos in [-1, 1]; 0 while disarmed
    mode: int  # MAV_MODE_FLAG
    flags: int  # HIL_ACTUATOR_CONTROLS_FLAGS

    @property
    def armed(self) -> bool:
        """True if the motors may turn (MAV_MODE_FLAG_SAFETY_ARMED)."""
        return bool(self.mode & 128)

    @property
    def lockstep(self) -> bool:
        """True if PX4 takes its clock from our samples."""
        return bool(self.flags & 1)


def dialect() -> ModuleType:
    """Import pymavlink's module of MAVLink's common set.

    Raises:
        MissingPackage: pymavlink is not installed.
    """
    return needed("pymavlink.dialects.v20.common", "autopilot")


def message(sample: Px4Sample) -> Any:
    """The message of a sample, to be packed by a `MAVLink` of pymavlink.

    Raises:
        BridgeError: a number that is not finite, or that its field cannot hold.
        MissingPackage: pymavlink is not installed.
    """
    if isinstance(sample, Sensors):
        return _hil_sensor(sample)
    return _hil_gps(sample) if isinstance(sample, GnssFix) else _hil_state(sample)


def _hil_sensor(s: Sensors) -> Any:
    mavlink, name = dialect(), "HIL_SENSOR"
    force = vector("f_b_m_s2", s.f_b_m_s2, name)
    rate = vector("omega_ib_b_rad_s", s.omega_ib_b_rad_s, name)
    updated = 0b111_111
    field, hectopascal, differential, altitude = [0.0] * 3, 0.0, 0.0, 0.0
    if s.field_b_T is not None:
        field = [GAUSS_PER_T * b for b in vector("field_b_T", s.field_b_T, name)]
        updated |= 0b111 << 6
    if s.pressure_Pa is not None:
        hectopascal = finite("pressure_Pa", s.pressure_Pa, name) / 100.0
        try:
            altitude = pressure_altitude_m(s.pressure_Pa)
        except ValueError as error:
            raise BridgeError(f"pressure_Pa has no height: {error}", name) from None
        # PX4 accepts a pressure only together with its height and temperature.
        updated |= (
            mavlink.HIL_SENSOR_UPDATED_ABS_PRESSURE
            | mavlink.HIL_SENSOR_UPDATED_PRESSURE_ALT
            | mavlink.HIL_SENSOR_UPDATED_TEMPERATURE
        )
    if s.differential_pressure_Pa is not None:
        differential = finite("differential_pressure_Pa", s.differential_pressure_Pa, name) / 100.0
        updated |= mavlink.HIL_SENSOR_UPDATED_DIFF_PRESSURE
    celsius = finite("temperature_K", s.temperature_K, name) - 273.15
    return mavlink.MAVLink_hil_sensor_message(
        _time(s, name),
        *force,
        *rate,
        *field,
        hectopascal,
        differential,
        altitude,
        celsius,
        updated,
    )


def _hil_gps(s: GnssFix) -> Any:
    name = "HIL_GPS"
    v_n = vector("v_n_m_s", s.v_n_m_s, name)
    speed = math.hypot(v_n[0], v_n[1])
    course_deg = math.degrees(math.atan2(v_n[1], v_n[0])) % 360.0  # clockwise from north
    course = round(100.0 * course_deg) % 36000 if speed > 0.0 else UNKNOWN
    return dialect().MAVLink_hil_gps_message(
        _time(s, name),
        as_integer("kind", s.kind, 0, 255, name),
        *_position(s, name),
        as_integer("horizontal_m [cm]", 100.0 * s.horizontal_m, 0, UNKNOWN - 1, name),
        as_integer("vertical_m [cm]", 100.0 * s.vertical_m, 0, UNKNOWN - 1, name),
        as_integer("ground speed [cm/s]", 100.0 * speed, 0, UNKNOWN - 1, name),
        *_velocity(v_n, name),
        course,
        as_integer("satellites", s.satellites, 0, 254, name),
    )


def _hil_state(s: Truth) -> Any:
    name = "HIL_STATE_QUATERNION"
    airspeed = as_integer("airspeed_m_s [cm/s]", 100.0 * s.airspeed_m_s, *UINT16, name)
    milli_g = [1e3 / GRAVITY_M_S2 * f for f in vector("f_b_m_s2", s.f_b_m_s2, name)]
    return dialect().MAVLink_hil_state_quaternion_message(
        _time(s, name),
        vector("q_nb", s.q_nb, name, 4),
        *vector("omega_nb_b_rad_s", s.omega_nb_b_rad_s, name),
        *_position(s, name),
        *_velocity(vector("v_n_m_s", s.v_n_m_s, name), name),
        airspeed,
        airspeed,
        *(as_integer("f_b_m_s2 [mG]", f, *INT16, name) for f in milli_g),
    )


def _time(s: Px4Sample, name: str) -> int:
    return as_integer("time_us", s.time_us, 0, 2**64 - 1, name)


def _position(s: GnssFix | Truth, name: str) -> tuple[int, int, int]:
    return (
        as_integer(
            "lat_rad [degE7]", 1e7 * math.degrees(s.lat_rad), -900_000_000, 900_000_000, name
        ),
        as_integer(
            "lon_rad [degE7]", 1e7 * math.degrees(s.lon_rad), -1_800_000_000, 1_800_000_000, name
        ),
        as_integer("alt_m [mm]", 1e3 * s.alt_m, *INT32, name),
    )


def _velocity(v_n: list[float], name: str) -> list[int]:
    return [as_integer("v_n_m_s [cm/s]", 100.0 * v, *INT16, name) for v in v_n]
