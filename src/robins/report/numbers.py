"""Names and numbers as people read them: ``horizontal_rms_m`` is "Horizontal RMS" in "m"."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from robins.results import Probability
from robins.results.summary import Json

# Parts of the unit at the end of a metric's name, and their printed form.
_PARTS = {
    **{u: u for u in ("deg", "arcmin", "arcsec", "rad", "mrad", "m", "km", "cm", "mm", "s", "ms")},
    **{u: u for u in ("h", "mg")},
    **{"ug": "µg", "ut": "µT", "us": "µs", "s2": "s²", "hz": "Hz", "percent": "%"},
    **{"per_s": "1/s", "mps": "m/s", "m_s": "m/s", "deg_s": "deg/s", "arcsec_s": "arcsec/s"},
    **{"sqrt_h": "√h", "sqrt_s": "√s", "sqrt_hz": "√Hz"},
}
_PART = "|".join(sorted(_PARTS, key=len, reverse=True))
_UNIT = re.compile(rf"_((?:{_PART})(?:_per_(?:{_PART}))*)$")
_FEW = 4  # longest list whose numbers are all shown
_CAPITALS = {
    *("rms", "rmse", "nis", "nees", "anees", "gnss", "imu", "rts", "ins", "cep"),
    *("kf", "ekf", "mekf", "ukf", "sar", "rtk", "2d", "3d", "nhc", "zupt", "lmi"),
}

Values = Mapping[str, Json]  # metrics of a filter
Claim = Mapping[str, Json]  # with its verdict
Summary = Mapping[str, Json]  # contents of `summary.json`
MARK = " !"  # behind a number outside its own band
_LABELS = {  # where the words of the name would mislead
    "aided_horizontal_rms_m": "Distance to the fixes used, horizontal RMS",
    "aided_vertical_rms_m": "Distance to the fixes used, vertical RMS",
    "error_over_sigma_bounds": "Interval of error over sigma",
}
_STATES = {"Consistent": "reproduced", "With care": "partly", "Do not trust": "not"}
_WORDS = {"euler": "Euler angles", "accel": "accelerometer"}


class Label(NamedTuple):
    """A metric's name in words, and its unit ("" for a pure number)."""

    text: str
    unit: str

    def __str__(self) -> str:
        return f"{self.text} [{self.unit}]" if self.unit else self.text


def label(metric: str) -> Label:
    """Words and unit of a metric's name; for a share, the unit at its end is that of its limit."""
    unit = None if "share" in metric.split("_") else _UNIT.search(metric)
    text = _LABELS.get(metric) or words(metric[: unit.start()] if unit else metric) or metric
    texts = "/".join(_PARTS[part] for part in unit[1].split("_per_")) if unit else ""
    return Label(text[:1].upper() + text[1:], texts)


def words(name: str) -> str:
    """An identifier as words: ``gnss_position`` is "GNSS position"."""
    split = (word for word in name.split("_") if word)
    return " ".join(_WORDS.get(w, w.upper() if w in _CAPITALS else w) for w in split)


def show(value: Json) -> str:
    """A number to four significant digits; lists are joined; None is an en dash."""
    if value is None:
        return "–"
    if (probability := Probability.read(value)) is not None:
        return _probability(probability)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}".replace(",", "\u2009") if abs(value) >= 10_000 else str(value)
    if isinstance(value, float):
        return _float(value)
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {show(item)}" for key, item in value.items())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return _many(value)
    return str(value)


def _many(values: Sequence[Json]) -> str:
    """A list; of a long one, or one of lists, only its range and length."""
    nested = any(isinstance(item, Sequence) and not isinstance(item, str) for item in values)
    if len(values) <= _FEW and not nested:
        return ", ".join(show(item) for item in values)
    flat = [item for part in values for item in (part if nested else [part])]
    known = [item for item in flat if isinstance(item, int | float) and math.isfinite(item)]
    if not known:
        return f"{len(values)} values"
    return f"{show(min(known))} to {show(max(known))} ({len(values)} values)"


def _probability(found: Probability) -> str:
    """A share with its interval, to as many digits as that justifies."""
    digits = max(2, 1 - math.floor(math.log10(found.high - found.low)))
    texts = (f"{x:.{digits}f}".rstrip("0").rstrip(".") for x in found[:3])
    return "{} ({} to {})".format(*texts)


def _float(value: float) -> str:
    if not math.isfinite(value):
        return "–"
    if value == 0.0:
        return "0"
    if 1e-3 <= abs(value) < 1e5:
        digits = max(0, 3 - math.floor(math.log10(abs(value))))
        text = f"{value:.{min(digits, 6)}f}"
        return text.rstrip("0").rstrip(".") if "." in text else text
    mantissa, exponent = f"{value:.3e}".split("e")
    return f"{mantissa.rstrip('0').rstrip('.')}e{int(exponent)}"


def band(value: Json) -> str:
    """The band of a claim: two numbers as a range, with an open end where one is missing."""
    if isinstance(value, Sequence) and not isinstance(value, str) and len(value) == 2:
        low, high = value
        if low is None and high is None:
            return "–"
        if low is None:
            return f"at most {show(high)}"
        if high is None:
            return f"at least {show(low)}"
        return f"{show(low)} to {show(high)}"
    return show(value)


def outside(values: Values, metric: str) -> bool:
    """True if a metric lies outside its own band, the metric of the same name plus `_band`."""
    value, limits = values.get(metric), values.get(f"{metric}_band")
    if not isinstance(value, int | float) or not isinstance(limits, Sequence) or len(limits) != 2:
        return False
    low, high = (math.nan if x is None else x for x in limits)
    return value < low or value > high


def marked(values: Values, metric: str) -> str:
    """Metric formatted by `show`, followed by `MARK` if it lies outside its band."""
    return show(values.get(metric)) + (MARK if outside(values, metric) else "")


def verdict_class(verdict: str) -> str:
    """Claim verdict that sets the colour of the sentence on a replay; "" for none."""
    return next((state for begin, state in _STATES.items() if verdict.startswith(begin)), "")


def claim_value(
    value: float | int | str | Sequence[float] | None, interval: Sequence[float] | None = None
) -> str:
    """The value of a claim, with its 95 % interval where there is one."""
    return show(value) + (f" ({band(interval)})" if interval else "")


def verdict(claims: Sequence[Claim]) -> str:
    """One sentence on the claims."""
    if not claims:
        return "No claims are attached to this scenario."
    texts = [claim["verdict"] for claim in claims]
    held = texts.count("reproduced")
    rest = [f"{n} {v}" for v in ("partly", "not", "undecided") if (n := texts.count(v))]
    noun = "claim" if len(claims) == 1 else "claims"
    return f"{held} of {len(claims)} {noun} reproduced" + "".join(f", {r}" for r in rest) + "."


def csv_of(rows: Sequence[Sequence[str | int | float]]) -> bytes:
    """A table as the bytes of a CSV file; the first row names the columns."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()
