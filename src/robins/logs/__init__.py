"""Logs: read and write them, examine them, clean them.

- `open_log`, `load_dataset`, `load_pair`: any known format, recognised by content, into the tables
  of `robins.dataset`; `FORMATS` lists them. A file is read exactly or refused with a `LogError`.
- `load_ranges`: pseudoranges and odometry of a car, in the text format of libRSF, as a `RangeLog`.
- `write_log`: text, by default with units in its header, or a recording of ROS 2.
- `TextFormat` and `Column`: a format of your own; `columns_from` reads it from TOML.
- `Mounting`: orientation of the IMU in the vehicle, and lever arm of the antenna.
- `examine`: the doctor; findings in sentences about units, axes, time, sigmas.
- `clean`: refuses bad samples and counts them, so that a run never sees a NaN or a step back.
"""

from robins.logs.clean import clean
from robins.logs.declared import columns_from, formats_of
from robins.logs.doctor import examine
from robins.logs.findings import Finding, LogError, LogWarning
from robins.logs.librsf import load_ranges
from robins.logs.loading import load_dataset, load_pair
from robins.logs.mounting import Mounting, Origin
from robins.logs.registry import FORMATS, Format, open_log, write_log
from robins.logs.text_format import Column, TextFormat

__all__ = [
    "FORMATS",
    "Column",
    "Finding",
    "Format",
    "LogError",
    "LogWarning",
    "Mounting",
    "Origin",
    "TextFormat",
    "clean",
    "columns_from",
    "examine",
    "formats_of",
    "load_dataset",
    "load_pair",
    "load_ranges",
    "open_log",
    "write_log",
]
