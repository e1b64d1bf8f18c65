"""Logs: read and write them, have them examined, make them safe.

- `open_log`, `load_dataset`, `load_pair`: any known format, recognised by content, into the tables
  of `robins.dataset`; `FORMATS` lists them. A file is read exactly or refused with a `LogError`.
- `Mounting`: how the IMU sits in the vehicle.
- `examine`: the doctor; findings in sentences about units, axes, time, sigmas.
- `clean`: refuses bad samples and counts them, so that a run never sees a NaN or a step back.
- `write_named`: what this room reads best; `write_kfgins_imu`, `write_pyins`, ...: for others.
"""

from robins.logs.broad import read_broad
from robins.logs.clean import clean
from robins.logs.doctor import examine
from robins.logs.euroc import read_euroc_imu, read_euroc_truth, write_euroc_imu
from robins.logs.findings import Finding, LogError, LogWarning
from robins.logs.gnss_imu import read_gnss_imu
from robins.logs.kfgins import (
    read_kfgins_gnss,
    read_kfgins_imu,
    read_kfgins_nav,
    write_kfgins_gnss,
    write_kfgins_imu,
    write_kfgins_nav,
)
from robins.logs.loading import load_dataset, load_pair
from robins.logs.local import Origin
from robins.logs.mounting import Mounting
from robins.logs.named_csv import read_named_imu, read_named_path, write_named
from robins.logs.phone import read_phone
from robins.logs.pyins_csv import read_pyins, write_pyins
from robins.logs.registry import FORMATS, Format, open_log
from robins.logs.rtklib import read_rtklib
from robins.logs.tum import write_tum
from robins.logs.ulog import read_ulog
from robins.logs.xio import read_xio

__all__ = [
    "FORMATS",
    "Finding",
    "Format",
    "LogError",
    "LogWarning",
    "Mounting",
    "Origin",
    "clean",
    "examine",
    "load_dataset",
    "load_pair",
    "open_log",
    "read_broad",
    "read_euroc_imu",
    "read_euroc_truth",
    "read_gnss_imu",
    "read_kfgins_gnss",
    "read_kfgins_imu",
    "read_kfgins_nav",
    "read_named_imu",
    "read_named_path",
    "read_phone",
    "read_pyins",
    "read_rtklib",
    "read_ulog",
    "read_xio",
    "write_euroc_imu",
    "write_kfgins_gnss",
    "write_kfgins_imu",
    "write_kfgins_nav",
    "write_named",
    "write_pyins",
    "write_tum",
]
