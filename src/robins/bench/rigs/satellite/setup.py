"""Parameters of the rate table of a run on the bench."""

from __future__ import annotations

from typing import Annotated

from robins.scenario import Parameters, Quantity, default
from robins.sim.rate_table import RateTable, rate_table


class Carrier(Parameters):
    """A rate table that is a little late; without one the gyro turns with the craft exactly."""

    lag: Annotated[float, Quantity("time", above="0 s")] = default("20 ms")
    rate_limit: Annotated[float, Quantity("angle rate", above="0 deg/s")] = default("100 deg/s")
    acceleration_limit: Annotated[float, Quantity("angular acceleration", above="0 rad/s^2")] = (
        default("10 rad/s^2")
    )

    def table(self) -> RateTable:
        """Rate table of the simulation."""
        return rate_table(self.lag, self.rate_limit, self.acceleration_limit)
