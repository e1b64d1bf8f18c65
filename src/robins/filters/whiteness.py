"""Tests of sequences of innovations and readings.

The innovations of a consistent filter are independent of earlier ones, of either sign equally
often, and as large at the end of a run as at its start; a working sensor does not repeat its
readings. Each test compares one of these properties with a quantile of a stated probability, and
with a least deviation worth reporting: in a long log any model error is significant.

Innovations are those before a robust rule raises the noise. The functions use NumPy on arrays that
a run has kept, with any leading axes of runs.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial

import numpy as np
from jax.tree_util import tree_leaves
from jaxtyping import ArrayLike
from scipy.special import bdtrik, ndtr, ndtri

from robins.filters.chi_square import chi_square
from robins.filters.consistency_limits import FEWEST
from robins.manifold import State

FALSE_ALARM = 1e-5  # probability of a finding on a consistent run, over all sensors and tests
BY_CHANCE = 1e-3  # probability that as many runs have a finding by chance
TESTS = 5  # per component: correlation, sign overall, sign late, NIS late, share beyond CLIPPED
BEFORE = 10  # preceding innovations whose sum each innovation is correlated with
CLIPPED = 3.0  # limit at which an innovation is clipped [sigma]
FOLLOWING = 0.2  # least correlation with preceding innovations that is reported
ONE_SIDE = 0.6  # least share of one sign that is reported: a bias of a quarter of a sigma
FAR_SHARE = 1.0 / 3.0  # least share of the last quarter beyond `CLIPPED` that is reported
LATE_NIS = 2.0  # least mean NIS per degree of freedom in the last quarter that is reported
REPEATS = 10  # equal readings in a row that mark a stuck sensor
COARSE = 0.1  # resolution over innovation sigma above which a sensor may repeat readings

# Columns of `innovation_sums`, which may be added over several pieces of one log (`joined`).
_COUNT, _PRODUCT, _SQUARE, _SEEN, _ABOVE, _LATE, _LATE_ABOVE, _FAR, _NIS, _DOF, _REPEATS = range(11)


def innovation_sums(
    innovation: ArrayLike, sigma: ArrayLike, nis: ArrayLike, dof: ArrayLike, readings: State = None
) -> np.ndarray:
    """Sums (..., m, 11) over the updates of a sensor in a run, for `suspicions`.

    Args:
        innovation: (..., T, m), NaN where missing.
        sigma: (..., T, m) standard deviations of the innovations, NaN where not used.
        nis: (..., T) normalised innovations squared.
        dof: (..., T) degrees of freedom of the NIS.
        readings: (..., T) pytree of measurements as a run takes it; None skips the test of
            repeated readings.
    """
    e, sigma = np.asarray(innovation, float), np.asarray(sigma, float)
    out = np.zeros((*e.shape[:-2], e.shape[-1], 11))
    there = np.any(np.isfinite(e), axis=(*range(e.ndim - 2), -1))
    e, sigma = e[..., there, :], sigma[..., there, :]
    nis, dof = (np.asarray(x, float)[..., there] for x in (nis, dof))
    if not e.shape[-2]:
        return out
    w = _standard(e, sigma)
    total = np.cumsum(w, axis=-2)
    before = total[..., :-1, :].copy()
    before[..., BEFORE:, :] -= total[..., : -BEFORE - 1, :]
    product = w[..., 1:, :] * before
    late = slice(3 * w.shape[-2] // 4, None)
    used = np.isfinite(nis) & (dof > 0)
    end = w[..., late, :]
    for column, terms in (
        (_COUNT, product != 0.0),
        (_PRODUCT, product),
        (_SQUARE, product**2),
        (_SEEN, w != 0.0),
        (_ABOVE, w > 0.0),
        (_LATE, end != 0.0),
        (_LATE_ABOVE, end > 0.0),
        (_FAR, np.abs(end) >= CLIPPED),
    ):
        out[..., column] = np.sum(terms, axis=-2)
    for column, terms in ((_NIS, nis), (_DOF, dof)):
        out[..., column] = np.sum(np.where(used, terms, 0.0)[..., late], axis=-1)[..., None]
    if readings is not None:
        out[..., _REPEATS] = _repeats(readings, there, e, sigma)
    return out


def _standard(e: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Innovations in units of their sigmas, clipped; zero where missing.

    A refused innovation has no sigma; the mean sigma of the run is used.
    """
    blank = np.isnan(sigma)
    if np.any(blank):
        known = np.where(blank, 0.0, sigma)
        mean = np.sum(known, axis=-2, keepdims=True) / np.maximum(
            np.sum(~blank, axis=-2, keepdims=True), 1
        )
        sigma = np.where(blank, np.where(mean > 0.0, mean, 1.0), sigma)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.clip(np.nan_to_num(e / sigma, nan=0.0), -CLIPPED, CLIPPED)


def _repeats(readings: State, there: np.ndarray, e: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Longest run of equal readings of each component; zero where repetition is legitimate.

    Legitimate are a reading that is constant throughout (a pseudo-measurement such as zero
    velocity) and a sensor whose resolution exceeds a tenth of the innovation's sigma.
    """
    lead, m = e.shape[:-2], e.shape[-1]
    flat = [np.asarray(leaf, float) for leaf in tree_leaves(readings)]
    y = np.concatenate([a.reshape(*a.shape[: len(lead) + 1], -1) for a in flat], axis=-1)
    if y.shape[-1] != m:  # an element of a manifold has more numbers than components
        return np.zeros((*lead, m))
    y = np.where(np.isfinite(e), y[..., there, :], np.nan)
    with np.errstate(invalid="ignore"):
        scale = np.sqrt(np.nanmean(np.where(np.isfinite(sigma), sigma, 0.0) ** 2, axis=-2))
    columns = np.moveaxis(y, -1, -2).reshape(-1, y.shape[-2])
    most = [_longest(row, s) for row, s in zip(columns, scale.reshape(-1), strict=True)]
    return np.reshape(most, (*lead, m))


def _longest(y: np.ndarray, sigma: float) -> int:
    y = y[np.isfinite(y)]
    same = np.diff(y) == 0.0
    if len(y) < REPEATS or np.all(same):
        return 0
    ends = np.flatnonzero(np.concatenate([[True], ~same, [True]]))
    most = int(np.max(np.diff(ends)))
    if most < REPEATS:
        return 0
    steps = np.diff(np.unique(y))
    steps = steps[steps > 1e-12 * np.max(np.abs(y))]  # smaller steps are rounding
    return most if len(steps) and np.min(steps) <= COARSE * sigma else 0


def joined(looks: Sequence[np.ndarray]) -> np.ndarray:
    """Sums over all pieces of one log; the greatest count of repeated readings."""
    table = np.sum(looks, axis=0)
    table[..., _REPEATS] = np.max([look[..., _REPEATS] for look in looks], axis=0)
    return table


def suspicions(looks: Mapping[str, ArrayLike], assumed: Collection[str] = ()) -> list[str]:
    """Sentences on sequences of innovations that a consistent filter would not produce.

    Args:
        looks: sums of `innovation_sums` by sensor; with leading axes each run is tested separately,
            and a sentence states the number of runs for which it holds.
        assumed: sensors whose innovations are correlated by design, so that only their size and
            repeated readings are tested: the noise is a cautious guess, or the gain is constant or
            omits states (`constant_gain`, `consider`).
    """
    tables = {name: np.asarray(table, float) for name, table in looks.items()}
    components = sum(table.shape[-2] for table in tables.values())
    level = FALSE_ALARM / max(TESTS * components, 1)
    found = []
    for sensor, table in tables.items():
        lasting = sensor in assumed
        tests = [_repeating, partial(_late, lasting=lasting)]
        if not lasting:
            tests += [_far, _following, _one_sided]
        for test in tests:
            found += _sentence(sensor, table.reshape(-1, *table.shape[-2:]), test, level)
    return found


Findings = Iterator[tuple[float, str]]  # strength, and the words after the sensor's name
Test = Callable[[np.ndarray, float], Findings]


def _sentence(sensor: str, rows: np.ndarray, test: Test, level: float) -> list[str]:
    """Sentence of one test of one sensor, on its strongest component and run."""
    found = []
    for table in rows:
        judged = ((i, one) for i, row in enumerate(table) for one in test(row, level))
        by_component = [(strength, index, words) for index, (strength, words) in judged]
        if by_component:
            found.append(max(by_component))
    # a few of very many runs fail by chance
    if len(found) <= _binomial(len(rows), BY_CHANCE, FALSE_ALARM):
        return []
    _, index, words = max(found)
    where = f" (component {index + 1})" if rows.shape[1] > 1 else ""
    among = f"in {len(found)} of {len(rows)} runs " if len(rows) > 1 else ""
    return [f"{among}'{sensor}'{where} {words}"]


def _binomial(count: float | int, level: float, share: float = 0.5) -> float:
    """Upper quantile of the number of hits in ``count`` draws of probability ``share``."""
    return max(float(np.ceil(bdtrik(1.0 - level, count, share))), 0.0)


def _following(row: np.ndarray, level: float) -> Findings:
    count, z = row[_COUNT], row[_PRODUCT] / np.sqrt(max(row[_SQUARE], 1e-300))
    if count >= FEWEST and not z < max(-ndtri(level), FOLLOWING * np.sqrt(count)):
        yield (
            z,
            f"has innovations that follow the {BEFORE} before them, by {z:.1f} sigma more than "
            "chance: the filter may trust its motion too much, or the errors of the sensor may "
            "last; compare a run with more process noise, or estimate that error",
        )


def _one_sided(row: np.ndarray, level: float) -> Findings:
    for count, above, when in (
        (row[_SEEN], row[_ABOVE], ""),
        (row[_LATE], row[_LATE_ABOVE], "in the last quarter "),
    ):
        most = max(above, count - above)
        if count >= FEWEST and most > max(_binomial(count, level / 2.0), ONE_SIDE * count):
            z = (2.0 * most - count) / np.sqrt(count)
            yield (
                z,
                f"has {when}{most:.0f} of {count:.0f} innovations on one side, by {z:.1f} "
                "sigma more than chance: the sensor or the motion may have an error that the "
                "model leaves out; look at its bias, its units and its axes",
            )


def _late(row: np.ndarray, level: float, lasting: bool) -> Findings:
    nis, dof = row[_NIS], row[_DOF]
    if dof < FEWEST:
        return
    # with lasting errors all innovations of a run are large or small together: they count as one
    free = 1.0 if lasting else dof
    if not nis < dof * max(LATE_NIS, float(chi_square(1.0 - level, free)) / free):
        z = (nis - dof) / np.sqrt(2.0 * dof)
        yield (
            z,
            f"has innovations in the last quarter of mean NIS per degree of freedom "
            f"{nis / dof:.3g}, {z:.1f} sigma above one: the filter may have lost its way, or its "
            "standard deviations are too small; look at the time when the NIS begins to rise",
        )


def _far(row: np.ndarray, level: float) -> Findings:
    count, far = row[_LATE], row[_FAR]
    chance = _binomial(count, level, 2.0 * float(ndtr(-CLIPPED)))
    if count < FEWEST or far <= max(FAR_SHARE * count, chance):
        return
    yield (
        far / count,
        f"has {far:.0f} of the last {count:.0f} innovations beyond {CLIPPED:.0f} sigma, before "
        "a rule gives them a weight: the filter may have lost its way, or the sensor may be "
        "wrong; look at the time when that begins",
    )


def _repeating(row: np.ndarray, level: float) -> Findings:
    if (most := row[_REPEATS]) >= REPEATS:
        yield (
            most,
            f"gave the same reading {most:.0f} times in a row, though its resolution is finer than "
            "its noise: it may be stuck, or its last reading may be repeated by what records it; "
            "look at its readings there, and use each once",
        )
