"""Topics for viewers and ROS 2, from the satellite's messages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robins.bench.recording.topics import JSON, Topic, as_json, imu
from robins.bench.rigs.satellite.kit import Kit

_IMU = "sensor_msgs/msg/Imu"


def topics(kit: Kit) -> Sequence[Topic]:
    """Rates, and attitudes with their covariance, along the body's own axes, from inertial ones."""
    step_s = kit.step_ns * 1e-9
    return (
        Topic("gyro", "/gyro/imu", _IMU, lambda v: imu(v["theta_b"] / step_s), "body"),
        Topic("motion", "/plant/imu", _IMU, lambda v: imu(v["omega_b"], q_nb=v["q_ib"]), "body"),
        Topic(
            "estimate",
            "/adm/imu",
            _IMU,
            lambda v: imu(q_nb=v["q_ib"], q_covariance=np.diag(v["sigma"][:3] ** 2)),
            "body",
        ),
        Topic("star", "/star/frame", JSON, as_json, "body"),
        Topic("wheels", "/actuators/wheels", JSON, as_json, "body"),
    )
