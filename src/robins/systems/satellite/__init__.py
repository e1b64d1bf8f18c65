"""A small satellite controlled by its estimate: star sensor, gyro of multi-source noise, wheels.

After the patent of a mixed H2/H-infinity filter and its test platform: that filter in the
interpretations that can work, the filters that it is compared with, and the recommended one.

`SYSTEM` is made when it is used: the processes of the test bench need the model alone, and
start much sooner without the campaign's packages.
"""

from typing import TYPE_CHECKING

from robins.errors import lazy

if TYPE_CHECKING:
    from robins.systems.satellite.study import SYSTEM

__all__ = ["SYSTEM"]


__getattr__ = lazy(__name__, {"SYSTEM": f"{__name__}.study"})
