"""Claims about the satellite's filters: the document's, and those of robins marked so."""

from __future__ import annotations

from robins.systems.judgement import Claim, ratio

RMS, POINTING, SPREAD = "attitude_rms_arcsec", "pointing_rms_arcsec", "attitude_rms_spread_arcsec"
BETTER, PARTLY = (0.0, 0.9), (0.0, 1.0)


def _against(other: str, words: str) -> Claim:
    return Claim(
        f"The mixed filter improves the precision of attitude determination; read against {words}, "
        f"value: RMS error of mixed-lmi over that of {other}",
        ("mixed-lmi", other),
        ratio("mixed-lmi", other, RMS),
        BETTER,
        PARTLY,
    )


CLAIMS: dict[str, Claim] = {
    "improves-on-star": _against("raw", "the star sensor alone"),
    "improves-on-mekf": _against("mekf", "a Kalman filter that believes the nominal noise"),
    "improves-on-tuned": _against("mekf-tuned", "a Kalman filter with more noise on the bias"),
    "improves-on-informed": _against("mekf-informed", "a Kalman filter told the true drift"),
    "steadier": Claim(
        "The mixed filter's error varies less from run to run (ours); value: the spread of its "
        "RMS error over that of the nominal MEKF",
        ("mixed-bias", "mekf"),
        ratio("mixed-bias", "mekf", SPREAD),
        (0.0, 0.5),
        PARTLY,
    ),
    "bias-better": Claim(
        "The modelling error belongs on the bias, not on the rate (ours); value: pointing error of "
        "mixed-bias over that of mixed-riccati-quarter, both a quarter of the Kalman filter's gain",
        ("mixed-bias", "mixed-riccati-quarter"),
        ratio("mixed-bias", "mixed-riccati-quarter", POINTING),
        BETTER,
        PARTLY,
    ),
}
"""Every claim that a scenario may state."""
