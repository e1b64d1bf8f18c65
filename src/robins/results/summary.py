"""Summary of a result for scripts: `summary.json`, checked and in strict JSON."""

from __future__ import annotations

import json
import math
import numbers
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from robins.results.probability import Probability

Json = Any  # a value of JSON, or one that `plain` makes into one
VERDICTS = ("reproduced", "partly", "not", "undecided")

_GIVEN = {
    "scenario": str,
    "seed": int,
    "runs": int,
    "filters": Mapping,
    "claims": Sequence,
    "counts": Mapping,
    "seconds": numbers.Real,
}
_CLAIM = ("id", "text", "verdict", "value", "band")
_MORE = ("interval", "more_runs")  # of a claim, where runs were simulated
_OPTIONAL = ("machine", "verdict")  # of a campaign, and of a replay
_ORDER = (
    *("scenario", "seed", "runs", "machine", "verdict", "filters", "claims", "counts", "warnings"),
    *("files", "seconds"),
)


def plain(value: Json, where: str = "value") -> Json:
    """Convert a value to types of JSON: NaN and infinities become null, arrays become lists.

    Raises:
        TypeError: a part of it has no form in JSON; the message locates it from `where`.
    """
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, str):
        # File names need not be UTF-8; Python carries their odd bytes as lone surrogates.
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, numbers.Integral):
        return int(value)
    if isinstance(value, numbers.Real):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, os.PathLike):
        return plain(os.fsdecode(value), where)
    if isinstance(value, Probability):
        value = value._asdict()
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise TypeError(f"{where}: the key {key!r} is not text")
        return {key: plain(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item, f"{where}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, np.ndarray | np.generic) or hasattr(value, "__array__"):
        array = np.asarray(value)
        if array.dtype.kind in "biufUS":
            return plain(array.tolist(), where)
    raise TypeError(f"{where}: {type(value).__name__} has no form in JSON")


def checked(summary: Mapping[str, Json]) -> dict[str, Json]:
    """Check a summary; return it in plain types and documented order, `files` left to the writer.

    Raises:
        TypeError, ValueError: a key is missing, unknown or of the wrong kind; the message names it.
    """
    if unknown := sorted(set(summary) - set(_ORDER)):
        raise ValueError(f"summary: unknown key {unknown[0]!r}; the keys are {', '.join(_ORDER)}")
    for key, kind in _GIVEN.items():
        if key not in summary:
            raise ValueError(f"summary: {key!r} is missing")
        value = summary[key]
        if not isinstance(value, kind) or isinstance(value, bool):
            raise TypeError(f"summary.{key}: {value!r} is not {_name(kind)}")
    for name, metrics in summary["filters"].items():
        if not isinstance(metrics, Mapping):
            raise TypeError(f"summary.filters.{name}: {metrics!r} does not map metrics to values")
    for i, claim in enumerate(summary["claims"]):
        if not isinstance(claim, Mapping) or set(claim) - set(_MORE) != set(_CLAIM):
            raise ValueError(f"summary.claims[{i}]: needs exactly the keys {', '.join(_CLAIM)}")
        if claim["verdict"] not in VERDICTS:
            raise ValueError(
                f"summary.claims[{i}].verdict: {claim['verdict']!r} is none of {VERDICTS}"
            )
    flat = plain(summary, "summary")
    for reason, count in flat["counts"].items():
        if not isinstance(count, int) or isinstance(count, bool):
            raise TypeError(f"summary.counts.{reason}: {count!r} is not a whole number")
    for i, sentence in enumerate(flat.setdefault("warnings", [])):
        if not isinstance(sentence, str):
            raise TypeError(f"summary.warnings[{i}]: {sentence!r} is not a sentence")
    for key in _OPTIONAL:
        if not isinstance(flat.get(key, ""), str):
            raise TypeError(f"summary.{key}: {flat[key]!r} is not text")
    # the writer fills in `files`
    return {key: flat.get(key, {}) for key in _ORDER if key in flat or key not in _OPTIONAL}


def _name(kind: type) -> str:
    named = {str: "text", int: "a whole number", Mapping: "a mapping", Sequence: "a list"}
    return named.get(kind, "a number")


def dumps(value: Json) -> str:
    """Strict JSON text, indented, ending with a line break."""
    return json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def loads(text: str | bytes) -> Json:
    """Parse strict JSON.

    Raises:
        ValueError: the text is not JSON, or holds NaN or Infinity, which JSON does not have.
    """

    def refuse(constant: str) -> Json:
        raise ValueError(f"{constant} is not JSON")

    return json.loads(text, parse_constant=refuse)
