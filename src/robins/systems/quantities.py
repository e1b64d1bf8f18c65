"""Physical quantities shared by the parameters of several systems, as types of fields.

A plural has three axes. A `Size` or `Time` may be zero, not negative; all others are positive,
except `Angle`, `Angles` and `Arm`, which may have either sign. A `Walk` is the density of the white
noise whose integral is that quantity.
"""

from typing import Annotated

from robins.scenario import Quantity

Three = tuple[float, float, float]

AccelRateWalkSizes = Annotated[Three, Quantity("acceleration random walk", least="0 mg/sqrt(h)")]
AccelSizes = Annotated[Three, Quantity("acceleration", least="0 mg")]
AccelWalk = Annotated[float, Quantity("velocity random walk", above="0 m/s/sqrt(h)")]
AccelWalks = Annotated[Three, Quantity("velocity random walk", above="0 m/s/sqrt(h)")]
AccelWalkSizes = Annotated[Three, Quantity("velocity random walk", least="0 m/s/sqrt(h)")]
Acceleration = Annotated[float, Quantity("acceleration", above="0 m/s^2")]
Angle = Annotated[float, Quantity("angle")]
AngleRate = Annotated[float, Quantity("angle rate", above="0 deg/s")]
AngleSize = Annotated[float, Quantity("angle", least="0 deg", most="180 deg")]
AngleSizes = Annotated[Three, Quantity("angle", least="0 deg", most="180 deg")]
AngleWalk = Annotated[float, Quantity("angle random walk", above="0 deg/sqrt(h)")]
AngleWalks = Annotated[Three, Quantity("angle random walk", above="0 deg/sqrt(h)")]
AngleWalkSize = Annotated[float, Quantity("angle random walk", least="0 deg/sqrt(h)")]
Angles = Annotated[Three, Quantity("angle")]
Arm = Annotated[Three, Quantity("length", least="-1 km", most="1 km")]
Duration = Annotated[float, Quantity("time", above="0 s")]
Durations = Annotated[Three, Quantity("time", above="0 s")]
FieldStrength = Annotated[float, Quantity("magnetic field", above="0 uT")]
Frequency = Annotated[float, Quantity("frequency", above="0 Hz", most="100 kHz")]
AngleWalkSizes = Annotated[Three, Quantity("angle random walk", least="0 deg/sqrt(h)")]
Length = Annotated[float, Quantity("length", above="0 m")]
LengthSizes = Annotated[Three, Quantity("length", least="0 m")]
RateSize = Annotated[float, Quantity("angle rate", least="0 deg/s")]
RateSizes = Annotated[Three, Quantity("angle rate", least="0 deg/h")]
RateWalkSize = Annotated[float, Quantity("rate random walk", least="0 deg/s/sqrt(s)")]
RateWalkSizes = Annotated[Three, Quantity("rate random walk", least="0 deg/h/sqrt(h)")]
Speed = Annotated[float, Quantity("speed", above="0 m/s")]
SpeedSize = Annotated[float, Quantity("speed", least="0 m/s")]
SpeedSizes = Annotated[Three, Quantity("speed", least="0 m/s")]
Spread = Annotated[float, Quantity("angle", above="0 deg", most="180 deg")]
Time = Annotated[float, Quantity("time", least="0 s")]
