"""Quaternions as a file holds them: made of unit length, missing whole, or not believed."""

from __future__ import annotations

import numpy as np

from robins.logs.findings import Finding, refused, report, told

TOLERANCE = 1e-3  # how far from one a length may be by its decimals


def unit_quaternions(
    file: str, name: str, q: np.ndarray, rows: np.ndarray | None, findings: list[Finding] | None
) -> np.ndarray:
    """Unit quaternions; a row that is not one is taken as missing, whole, and reported.

    Args:
        file: for messages.
        name: of the columns, for messages.
        q: (n, 4) as recorded; a row with a NaN is missing.
        rows: (n,) line numbers, or None where there are no lines.
        findings: receives what is not believed; without it that is issued as `LogWarning`.

    Raises:
        LogError: more than half of the rows are not of unit length.
    """
    length = np.linalg.norm(q, axis=-1)
    known = ~np.isnan(length)
    wrong = known & ~(np.abs(length - 1.0) < TOLERANCE)
    out = np.where(
        (known & ~wrong)[:, None], q / np.where(wrong | ~known, 1.0, length)[:, None], np.nan
    )
    if not wrong.any():
        return out
    k = int(np.argmax(wrong))
    where = f"row {k + 1}" if rows is None else f"line {rows[k]}"
    count = f"{wrong.sum()} of {known.sum()} rows"
    if 2 * wrong.sum() > known.sum():
        raise refused(file, where, f"length of {name}", float(length[k]))(
            f"is not of unit length, as in {count}", "are the columns scalar first: w, x, y, z?"
        )
    report(
        findings,
        told("warning", "quaternion_length", file, where, float(length[k]))(
            f"the quaternion {name} has length {length[k]:g}, not 1 ({count}). Such attitudes are "
            "taken as missing."
        ),
    )
    return out
