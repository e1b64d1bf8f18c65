"""robins: robust inertial navigation and simulation.

Conventions, everywhere unless a name says otherwise:

- SI units and radians inside; names at an interface carry their unit (``lat_rad``, ``alt_m``).
- ``q_nb``, ``C_nb`` map body coordinates to navigation coordinates. Quaternions are unit, scalar
  first, Hamilton. Heading is clockwise from north.
- Navigation frames: NED with body forward-right-down (FRD) for logs and INS/GNSS, ENU with body
  right-forward-up (RFU) inside the systems of the papers; ``robins.ins.frames`` converts between
  them without rounding.
- The estimation error is ``true = retract(estimate, error)``; for an attitude this is
  ``C_true = exp(phi x) C_estimate``, phi seen in the navigation frame.
- Time is integer nanoseconds in files and tables, seconds since the start inside a run.
- NaN in a measurement means missing, per component.
"""

import os
from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("robins")
except PackageNotFoundError:  # run from its source, never installed
    __version__ = "0+unknown"

# Two batched QR factorisations at once, each waiting for the others' threads to do its share, stop
# jaxlib 0.10 for ever; with one worker each does its own. Read when JAX makes its first array.
os.environ.setdefault("PJRT_NPROC", "1")
