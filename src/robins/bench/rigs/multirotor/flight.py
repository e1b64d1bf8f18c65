"""Parameters of a flight, the numbers that its parts share, and its evaluation."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
import pydantic

from robins.bench.evaluation import RunFigures, RunResult, arrays_of, figures_of
from robins.bench.rig import LoadedRun
from robins.bench.run.setup import Setup, counted_from
from robins.earth import curvature_radii
from robins.earth.magnetic import field_n, wmm_for
from robins.results import array
from robins.rotation import to_dcm
from robins.scenario import Parameters, Quantity, default


class Multirotor(Parameters):
    """Hover point, wind, and noise of the instruments (standard deviations).

    It starts on the ground at ``lat``, ``lon``, ``alt`` (above mean sea level), level and heading
    north; ``wind`` is north, east, down. Errors are relative to the point ``height`` above its
    start, from ``counted_from`` on. ``year`` is that of the magnetic field.
    """

    duration: Annotated[float, Quantity("time", above="0 s", most="1 h")] = default("20 s")
    step: Annotated[float, Quantity("time", least="1 ms", most="10 ms")] = default("4 ms")
    counted_from: Annotated[float, Quantity("time", least="0 s")] = default("10 s")
    height: Annotated[float, Quantity("length", above="0 m", most="100 m")] = default("5 m")
    wind: Annotated[
        tuple[float, float, float], Quantity("speed", least="-50 m/s", most="50 m/s")
    ] = default("3 m/s", "-2 m/s", "0 m/s")
    lat: Annotated[float, Quantity("angle", least="-85 deg", most="85 deg")] = default("47.4 deg")
    lon: Annotated[float, Quantity("angle", least="-180 deg", most="180 deg")] = default("8.5 deg")
    alt: Annotated[float, Quantity("length", least="-400 m", most="5 km")] = default("490 m")
    year: Annotated[float, pydantic.Field(ge=2020.0, le=2030.0)] = 2026.0
    gyro: Annotated[float, Quantity("angle rate", least="0 deg/s")] = default("0.1 deg/s")
    accelerometer: Annotated[float, Quantity("acceleration", least="0 m/s^2")] = default(
        "0.05 m/s^2"
    )
    compass: Annotated[float, Quantity("magnetic field", least="0 T", most="1 mT")] = default(
        "0.2 uT"
    )
    barometer: Annotated[float, Quantity("pressure", least="0 Pa", most="1 kPa")] = default("3 Pa")
    receiver: Annotated[float, Quantity("length", least="0 m", most="1 km")] = default("0.5 m")
    receiver_velocity: Annotated[float, Quantity("speed", least="0 m/s", most="100 m/s")] = default(
        "0.1 m/s"
    )


class MultirotorConfig(NamedTuple):
    """Configuration of a run."""

    step_ns: int
    given: Multirotor
    seed: int
    autopilot: str
    address: str  # to which another program connects
    port: int
    field_n_T: np.ndarray  # (3,) of the Earth
    m_per_rad: np.ndarray  # (2,) of latitude and longitude
    frames: tuple[int, ...] = ()  # an autopilot is not called before the first step

    def place(self, p_n: np.ndarray) -> np.ndarray:
        """Latitude, longitude [rad] and height [m] of a point (3,) [m] NED of the start."""
        lat, lon = np.array([self.given.lat, self.given.lon]) + p_n[:2] / self.m_per_rad
        return np.array([lat, lon, self.given.alt - p_n[2]])

    def p_n(self, place: np.ndarray) -> np.ndarray:
        """The point (3,) [m] NED of the start, of latitude, longitude [rad] and height [m]."""
        start = np.array([self.given.lat, self.given.lon, self.given.alt])
        return (place - start) * np.array([*self.m_per_rad, -1.0])


def prepare(setup: Setup, given: Multirotor) -> MultirotorConfig:
    """The config of a run; the Earth is flat over the tens of metres of a flight."""
    field_T = np.asarray(field_n(wmm_for(given.year), given.lat, given.lon, given.alt, given.year))
    north_m, east_m = (float(x) + given.alt for x in curvature_radii(given.lat))
    m_per_rad = np.array([north_m, east_m * np.cos(given.lat)])
    ends = (setup.autopilot, setup.address, setup.port)
    return MultirotorConfig(round(1e9 * given.step), given, setup.seed, *ends, field_T, m_per_rad)


def judge(flight: LoadedRun, result: RunResult) -> RunFigures:
    """Figures of a run: distance from the hover point [m], tilt and heading [deg]."""
    series, height_m = result.series, flight.given.height
    off_n = series["motion.p_n"] + np.array([0.0, 0.0, height_m])
    known = np.all(np.isfinite(off_n), axis=1)
    known[: counted_from(flight, result.steps)] = False
    metrics: dict[str, float | None] = {}
    if known.any():
        off_m = np.linalg.norm(off_n[known], axis=1)
        C_nb = to_dcm(series["motion.q_nb"][known])
        tilt_rad = np.arccos(np.clip(C_nb[:, 2, 2], -1.0, 1.0))
        heading_rad = np.arctan2(C_nb[:, 1, 0], C_nb[:, 0, 0])
        metrics = {
            "position_rms_m": float(np.sqrt(np.mean(off_m**2))),
            "position_max_m": float(np.max(off_m)),
            "tilt_max_deg": float(np.degrees(np.max(tilt_rad))),
            "heading_rms_deg": float(np.degrees(np.sqrt(np.mean(heading_rad**2)))),
        }
    silent = int(np.sum(series["motors.answered"] == 0))
    never = ["the autopilot never controlled the motors"] * (silent == len(series.time_s))
    caption = "Where the craft is, less where it is to hover."
    about = {"unit": "m", "frame": "NED", "comment": caption}
    off = array("error", off_n[None], "position", axes=("north", "east", "down"), **about)
    return RunFigures(
        metrics,
        {"steps_without_control": silent},
        never,
        off | arrays_of(flight.rig.noted, series),
        figures_of(metrics),
    )
