"""Claims about the rocket's filters: the paper's, and those of robins marked so."""

from __future__ import annotations

from robins.systems.judgement import Claim, Metrics, ratio

SEED, SCALAR, UKF = "federated-vector-stukf", "federated-scalar-ukf", "ukf"
RMS, QUIET, PEAK = "attitude_rms_deg", "quiet_rms_deg", "burst_peak_deg"
_AXES = ("roll_rms_deg", "pitch_rms_deg", "yaw_rms_deg")


def _worst_axis(metrics: Metrics) -> float:
    """Of the paper's filter, over the better of the two raw sensors."""
    return max(
        metrics[SEED][axis] / min(metrics[raw][axis] for raw in ("gyro", "magnetic-raw"))
        for axis in _AXES
    )


def _against_best(metrics: Metrics) -> float:
    return metrics["discriminator"][RMS] / min(metrics[n][RMS] for n in (UKF, SEED))


CLAIMS: dict[str, Claim] = {
    "better-than-sensors": Claim(
        "Fusion is better than either sensor about all three axes; value: the largest ratio of the "
        "RMS error of the vector-sharing STUKF to the better raw sensor, over roll, pitch, yaw",
        (SEED, "gyro", "magnetic-raw"),
        _worst_axis,
        (0.0, 0.98),
        (0.0, 1.0),
    ),
    "better-than-magnetometer": Claim(
        "Fusion is better than either sensor, each filtered with the same model (the fair reading; "
        "ours); value: RMS error of the vector-sharing STUKF over that of a UKF that has the "
        "magnetometer alone",
        (SEED, "magnetometer"),
        ratio(SEED, "magnetometer", RMS),
        (0.0, 0.98),
        (0.0, 1.0),
    ),
    "better-than-scalar": Claim(
        "Vector sharing with strong tracking is better than the federated UKF with scalar sharing; "
        "value: ratio of the RMS errors",
        (SEED, SCALAR),
        ratio(SEED, SCALAR, RMS),
        (0.0, 0.98),
        (0.0, 1.0),
    ),
    "better-than-scalar-quiet": Claim(
        "The same long after disturbances; value: ratio of the RMS errors",
        (SEED, SCALAR),
        ratio(SEED, SCALAR, QUIET),
        (0.0, 0.98),
        (0.0, 1.0),
    ),
    "resists-disturbance": Claim(
        "It is effective against abnormal disturbances of the magnetometer; value: its peak error "
        "in a disturbance over that of the plain UKF",
        (SEED, UKF),
        ratio(SEED, UKF, PEAK),
        (0.0, 0.9),
        (0.0, 1.0),
    ),
    "converges-faster": Claim(
        "It converges faster from a wrong start; value: ratio of the times until the RMS error is "
        "below 0.5 deg, to the UKF",
        (SEED, UKF),
        ratio(SEED, UKF, "settled_s"),
        (0.0, 0.8),  # a step of 0.1 s is a seventh of it
        (0.0, 0.95),
    ),
    "vector-shares-improve": Claim(
        "Shares by state improve the federated filter; value: RMS error with vector sharing as "
        "printed over scalar sharing, both without strong tracking",
        ("federated-vector-ukf", SCALAR),
        ratio("federated-vector-ukf", SCALAR, RMS),
        (0.0, 0.98),
        (0.0, 1.0),
    ),
    "discriminator-best": Claim(
        "Telling outliers from model errors by their length beats the UKF and strong tracking "
        "(ours); value: RMS error of the discriminator over the better of the two",
        ("discriminator", UKF, SEED),
        _against_best,
        (0.0, 0.98),
        (0.0, 1.0),
    ),
    "gate-consistent": Claim(
        "A gate keeps disturbances out of the direction that is not measured (ours); value: NEES "
        "of the attitude, gated over plain USQUE",
        ("gate", "usque"),
        ratio("gate", "usque", "nees_per_dim"),
        (0.0, 0.5),
        (0.0, 0.9),
    ),
    "fading-loses-attitude": Claim(
        "Strong tracking loses the direction that one vector does not show (ours); value: its RMS "
        "error about the field over that of dead reckoning",
        ("strong-tracking", "gyro"),
        ratio("strong-tracking", "gyro", "about_field_rms_deg"),
        (2.0, None),
        (1.0, None),
    ),
    "scale-factor-state": Claim(
        "With a scale factor on the spin, it must be a state (ours); value: total RMS error with "
        "the state over without, both gated",
        ("gate-scale-factor", "gate"),
        ratio("gate-scale-factor", "gate", "total_rms_deg"),
        (0.0, 0.5),
        (0.0, 0.9),
    ),
}
"""Every claim that a scenario may state."""
