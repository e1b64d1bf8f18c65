"""Parameters of a replay of gyro, accelerometer and magnetometer, with units.

The defaults are those of a low-cost MEMS unit held in a hand or strapped to a limb or a small
machine. None is taken from a particular unit or log.
"""

from __future__ import annotations

from typing import Annotated, Literal

import pydantic

from robins.scenario import Entry, Parameters, Quantity, default
from robins.systems import quantities as q
from robins.systems.parts import Names

Row = tuple[Entry, Entry, Entry]
Matrix = tuple[Row, Row, Row]
Field = Annotated[q.Three, Quantity("magnetic field")]

IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class MargGyro(Parameters):
    """The gyros: true rate = (I + gain) (measured rate) - bias."""

    noise: q.AngleWalk = default("0.01 deg/s/sqrt(Hz)")
    bias: q.RateSize = default("3 deg/s")
    bias_walk: q.RateWalkSize = default("0.0006 deg/s/sqrt(s)")
    # vibration and the warmth of a hand make the bias drift faster than at rest
    bias_walk_moving: q.RateWalkSize = default("0.01 deg/s/sqrt(s)")
    # sigma of each of nine scale factors, misalignments and cross-couplings
    gain: Annotated[float, Quantity("scale factor", least="0 ppm")] = default("3000 ppm")
    # the same for an uncalibrated chip, used once it explains the motion better
    bare_gain: Annotated[float, Quantity("scale factor", least="0 ppm")] = default("3 %")
    # residual error not explained by the nine gains, as a share of the angle turned
    turn_error: Annotated[float, pydantic.Field(ge=0.0, le=1e6)] = 0.001
    range: q.AngleRate = default("2000 deg/s")


class Accelerometer(Parameters):
    """The accelerometers."""

    noise: q.AccelWalk = default("0.02 m/s/sqrt(s)")
    bias: Annotated[float, Quantity("acceleration", least="0 mg")] = default("0.05 m/s^2")
    bias_walk: Annotated[float, Quantity("acceleration random walk", least="0 mg/sqrt(s)")] = (
        default("0.0001 m/s^2/sqrt(s)")
    )
    range: q.Acceleration = default("157 m/s^2")
    gravity: Annotated[float, Quantity("acceleration", above="0 m/s^2", most="100 m/s^2")] = (
        default("9.81 m/s^2")
    )


class MargMagnetometer(Parameters):
    """The magnetometer and the ambient field.

    A reading is first calibrated: matrix (reading - offset). The field of a room varies from place
    to place; `noise` is the sigma of a reading about the field state of the filter, and
    `declination` that of the local azimuth of the field, averaged over places.
    """

    offset: Field = default("0 uT")
    matrix: Matrix = IDENTITY
    noise: q.FieldStrength = default("2.5 uT")
    declination: q.Spread = default("2.5 deg")
    declination_time: q.Duration = default("60 s")
    # sigma of the azimuth of the field at a revisited site, without the effect of tilt errors
    site: q.Spread = default("0.3 deg")
    # random walk of strength and dip of the undisturbed field: sigma after 1 s
    field_walk: Annotated[float, Quantity("magnetic field", least="0 uT")] = default("0.01 uT")
    # readings outside these magnitudes are counted and not used
    least: Annotated[float, Quantity("magnetic field", least="0 uT")] = default("8 uT")
    most: q.FieldStrength = default("200 uT")
    gate: Annotated[float, pydantic.Field(gt=0.0, lt=1.0)] = 0.95
    # time in motion within one other field after which that field becomes the reference
    patience: q.Duration = default("20 s")


class BoundedTravel(Parameters):
    """Bounds of the motion, as a pseudo-measurement.

    Once in `every` of motion, velocity and position are measured as zero with these sigmas. For a
    vehicle give its speed, and a large `place`.
    """

    velocity: q.Speed = default("1 m/s")
    place: q.Length = default("0.6 m")
    every: q.Duration = default("1 s")


class Rest(Parameters):
    """Detection of rest, and the sigmas of its measurements of rate and velocity."""

    detect: bool = True
    after: q.Duration = default("1.5 s")
    quiet_rate: q.AngleRate = default("2 deg/s")
    quiet_accel: q.Acceleration = default("0.5 m/s^2")
    # largest difference of the mean rate from the last bias found at rest; beyond, it is a turn,
    most_rate: q.AngleRate = default("4 deg/s")
    # or a new bias of up to `most_bias`, if it lasts this long or the log begins with it
    new_bias: q.Duration = default("5 s")
    most_bias: q.AngleRate = default("10 deg/s")
    # largest change of the field at rest, as a share of it; it changes when the unit turns
    quiet_field: Annotated[float, pydantic.Field(gt=0.0, le=1.0)] = 0.05
    rate: q.AngleRate = default("0.03 deg/s")
    velocity: q.Speed = default("0.01 m/s")


class MargStart(Parameters):
    """Uncertainty of the first attitude, found at rest and in motion."""

    still: q.Duration = default("0.5 s")
    moving: q.Duration = default("3 s")
    tilt: q.Spread = default("1 deg")
    heading: q.Spread = default("1 deg")
    tilt_moving: q.Spread = default("5 deg")
    heading_moving: q.Spread = default("30 deg")
    # definition of north: the field where the log begins, or its mean over all places of the log;
    # with the mean, the initial heading is no better than the declination there
    north: Literal["start", "mean"] = "start"


class StatedErrors(Parameters):
    """Errors without a state, which the stated standard deviations of attitude must include.

    Misalignment of the housing, delayed response of the gyros, and late stamps cannot be separated
    from attitude. They do not average out, so they are added to the stated sigma, not to a noise.
    """

    tilt: q.Spread = default("0.3 deg")
    heading: q.Spread = default("2 deg")
    delay: q.Time = default("0.002 s")


class MargUpdate(Parameters):
    """Steps of the filter."""

    # a sample is the mean over the interval that it ends, or the value at its instant
    samples: Literal["means", "instants"] = "means"
    block: q.Duration = default("0.1 s")
    # an interval longer than this many usual ones is a gap
    gap: Annotated[float, pydantic.Field(gt=1.0, le=1e6)] = 3.0
    gap_rate: q.AngleRate = default("60 deg/s")
    gap_accel: q.Acceleration = default("3 m/s^2")


class MargReplay(Parameters):
    """Parameters of a recorded nine-axis log that its files do not contain."""

    system: Literal["marg"] = "marg"
    title: str = "Orientation from gyro, accelerometer and magnetometer"
    use_magnetometer: Literal["always", "undisturbed", "never"] = "undisturbed"
    orientation: q.Angles = default("0 deg")  # roll, pitch, yaw of the mounting
    gyro: MargGyro = pydantic.Field(default_factory=MargGyro)
    accelerometer: Accelerometer = pydantic.Field(default_factory=Accelerometer)
    magnetometer: MargMagnetometer = pydantic.Field(default_factory=MargMagnetometer)
    travel: BoundedTravel = pydantic.Field(default_factory=BoundedTravel)
    rest: Rest = pydantic.Field(default_factory=Rest)
    start: MargStart = pydantic.Field(default_factory=MargStart)
    stated: StatedErrors = pydantic.Field(default_factory=StatedErrors)
    update: MargUpdate = pydantic.Field(default_factory=MargUpdate)
    filters: Names = ("marg", "marg-smoothed")
