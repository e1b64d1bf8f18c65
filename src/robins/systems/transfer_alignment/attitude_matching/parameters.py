"""Parameters of attitude matching: manoeuvre, errors, flexure, assumptions of filters."""

from __future__ import annotations

from typing import Annotated, Literal

import pydantic

from robins.scenario import Parameters, Positive, Quantity, default
from robins.systems import quantities as q
from robins.systems.parts import Runs, refuse_too_long, refuse_unsettled
from robins.systems.study import Scenario


class BankTurn(Parameters):
    """A level bank turn: roll in from the start, turn, roll out, fly on; speed and height stay."""

    speed: q.Speed
    # horizontal, in the turn, to the right; negative: a left turn
    acceleration: Annotated[float, Quantity("acceleration", least="-100 g", most="100 g")]
    roll_time: q.Duration  # of each roll, at a constant rate
    turn_time: q.Time  # between the rolls
    duration: q.Duration  # of the run
    latitude: Annotated[float, Quantity("angle", least="-85 deg", most="85 deg")]
    heading: q.Angle = default("0 deg")  # at the start, clockwise from north


class MatchingMaster(Parameters):
    """The attitude that the master reports, with white noise at each update."""

    attitude_noise: q.Spread
    # begin and end of a time without attitudes, as in an outage of the link
    outage: Annotated[tuple[float, float], Quantity("time", least="0 s")] | None = None


class MatchingSlave(Parameters):
    """True errors of the slave: constant drift, noise, and initial attitude error."""

    gyro_bias: Annotated[q.Three, Quantity("angle rate")]
    gyro_noise: q.AngleWalkSize
    attitude_error: Annotated[q.Three, Quantity("angle", least="-30 deg", most="30 deg")]  # E, N, U


class MatchingMounting(Parameters):
    """Mounting of the slave on the master: nominal, and the true error (slave axes)."""

    nominal: q.Angles = default("0 deg")  # rotation vector
    error: Annotated[q.Three, Quantity("angle", least="-30 deg", most="30 deg")]


class FlexureParameters(Parameters):
    """Motion of the structure between the two, in axes right, forward, up of the master."""

    sigma: q.AngleSizes
    time: q.Durations = default("1 s")
    damping: Positive = 1.0
    bending: q.Angles = default("0 rad")  # per g of load above one
    flutter: q.AngleSize  # white at each update


class BelievedSpread(Parameters):
    """Initial standard deviations assumed by filters, and factors on those of the true flexure."""

    attitude: q.Spread
    gyro_bias: q.AngleRate
    mounting: q.Spread
    flexure_sigma_factor: Positive = 1.0
    flexure_time_factor: Positive = 1.0  # of the correlation time


class HInfinityRequirements(Parameters):
    """Requirements of the H-infinity filters."""

    gamma: Positive = 50.0  # of those with R = 1 unit^2, in their unit
    weighted_over_least: Positive = 1.05  # of the weighted one: gamma over its least


class AttitudeMatching(Scenario):
    """Attitude matching in a bank turn; axes of the paper, ENU and RFU."""

    system: str = "transfer-alignment"
    study: str = "attitude-matching"
    title: str = "Attitude matching in a bank turn"
    runs: Runs = 200
    claims: tuple[str, ...] | None = ()
    step: q.Duration = default("10 ms")  # of the truth
    period: q.Duration = default("50 ms")  # of the filters
    settle: q.Time = default("15 s")  # metrics are pooled from here on
    # initial errors as given, or with a sign drawn for each axis and run
    signs: Literal["fixed", "random"] = "fixed"
    manoeuvre: BankTurn
    master: MatchingMaster
    slave: MatchingSlave
    mounting: MatchingMounting
    flexure: FlexureParameters
    believed: BelievedSpread
    h_infinity: HInfinityRequirements = pydantic.Field(default_factory=HInfinityRequirements)

    @pydantic.model_validator(mode="after")
    def _check_consistency(self) -> AttitudeMatching:
        lasts = self.manoeuvre.duration
        refuse_too_long("step", lasts, 1.0 / self.step)
        refuse_unsettled("settle", self.settle, lasts)
        return self
