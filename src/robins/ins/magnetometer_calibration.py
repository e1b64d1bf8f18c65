"""Hard and soft iron of a magnetometer from samples taken during rotations.

In any orientation the Earth's field has the same magnitude F, so the true field b lies on a sphere
and the reading, ``z = A b + h + noise``, on an ellipsoid. `calibrate` finds

    b = W (z - h),   W symmetric, |b| = F

The magnitude does not show a rotation of the sensor's axes, so that in A remains: W is the
symmetric root ``(A A')^(-1/2)`` (Renaudin, Afzal & Lachapelle 2010, "Complete triaxis magnetometer
calibration in the magnetic domain"). Unless F is given, W has determinant one and F is estimated.

The fit starts from the least-squares ellipsoid in its coefficients, which cannot become another
quadric (Li & Griffiths 2004, "Least squares ellipsoid specific fitting"), and then minimises
Huber's loss of the distance of each sample to the ellipsoid, to first order
``(|W (z - h)| - F) / |W u|`` with u the direction of b, less the bias of noise by curvature: with
normal noise, equal on the three axes, that is maximum likelihood, and single disturbed samples have
little weight. Lasting disturbances do have weight: turn the sensor well away from iron.

If the directions do not determine an ellipsoid, a sphere is fitted, for hard iron only, which needs
fewer of them; a rotation about one axis determines neither and is refused.

A vehicle that cannot tilt turns about the vertical only. The same fit in the plane then calibrates
the two horizontal axes, by an ellipse of constant horizontal field; the vertical axis stays
uncalibrated, so hard iron along it causes errors as soon as the vehicle tilts.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from robins.errors import RobinsError

FEWEST = 50  # samples
MOST = 20_000  # samples used, evenly over the log; neighbours add hardly any information
_ENDS = (0.2, 99.8)  # percentiles that define the extent of the samples, against single spikes
_SIDE, _SHARE = 0.15, 20  # edge of a cube, in extents; most samples used of a cube
_HUBER = 1.345  # in sigmas of the noise; 95 % efficiency for normal noise
_VAGUE = 0.1  # of the field, one sigma; a less certain result is not determined
_STRETCHED = 2.0  # ratio of axes; a larger one must fit the samples well
_NEEDLE = 20.0  # ratio of axes; the fit does not converge beyond
_OFF = 0.1  # of the field, RMS distance; a surface further from the samples does not fit
_FLAT = 0.08  # ratio of the narrowest to the widest extent; less is a plane
_REACH = np.deg2rad(30.0)  # about a sample, for the share of directions covered
_PASSES, _SETTLED = 200, 1e-8  # iterations; step, in extents, far below the resolution of any log
_NO_ELLIPSOID = (
    "the samples lie on no ellipsoid: the field was not the same while the sensor was turned, or "
    "it was turned too little; turn it away from iron, so that each of its axes points up and down "
    "once"
)
_TILTED = 0.2  # scatter of the vertical field, in horizontal fields
# Elements of a symmetric matrix by its size, and indices of those of the horizontal one.
_PAIRS = {2: ((0, 0), (1, 1), (0, 1)), 3: ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))}
_HORIZONTAL = [0, 1, 3, 4, 8]  # of offset, then matrix


class CalibrationError(RobinsError, ValueError):
    """Samples that do not determine a calibration."""


class Calibration(NamedTuple):
    """Result of `calibrate`. Sigmas are due to noise, including its correlation in time.

    Fields that vary from place to place, as indoors, are not included: there two logs differ by
    more than the sigmas.
    """

    offset_t: np.ndarray  # (3,) h, hard iron
    matrix: np.ndarray  # (3, 3) W, symmetric
    soft_iron: bool  # W was fitted; else it is a multiple of the identity
    field_t: float  # F, magnitude of the field
    offset_sigma_t: np.ndarray  # (3,)
    matrix_sigma: np.ndarray  # (3, 3)
    covariance: np.ndarray  # (9, 9) of h [T], then W: 00, 11, 22, 12, 02, 01
    noise_t: float  # of a sample along one axis, one sigma, robust
    before_t: float  # RMS of the magnitude of samples about its mean, directions weighted equally
    after_t: float  # RMS of the magnitude of the calibrated samples about F
    outliers: float  # share of samples further than 5 sigma from the ellipsoid
    independent: float  # effective number of samples with independent noise
    covered: float  # share of all directions within 30 deg of one of a sample
    gap: np.ndarray  # (3,) direction in sensor axes furthest from any sample
    gap_rad: float  # its distance from the nearest sample
    level: bool = False  # horizontal axes only; before, after and gap refer to their plane


def calibrated(field_t: Any, offset_t: Any, matrix: Any) -> np.ndarray:
    """Field (..., 3) [T] corrected for hard and soft iron, ``W (z - h)``."""
    z, h, W = (np.asarray(v, float) for v in (field_t, offset_t, matrix))
    return (z - h) @ W.T


def calibrate(
    field_t: Any,
    strength_t: float | None = None,
    soft_iron: bool | None = None,
    level: bool = False,
) -> Calibration:
    """Hard and soft iron of a magnetometer that was turned about all its axes, or the vertical.

    Args:
        field_t: (N, 3) samples [T] in sensor axes, in order of time; rows with NaN are omitted.
        strength_t: magnitude of the field at the place [T], e.g. from `robins.earth.magnetic`; it
            sets the scale of the result. None: the scale is kept on average, ``det W = 1``.
        soft_iron: True to fit it; None: if the directions determine it.
        level: turned about its third axis only, which was vertical; the other two are calibrated.
            With a strength, their scale follows from it and the vertical reading.

    Raises:
        CalibrationError: too few samples; they lie in a plane or on too small a part of the
            ellipsoid; neither an ellipsoid nor, if soft iron is None, a sphere fits; a strength
            that is not positive.
    """
    z = np.asarray(field_t, float)
    if z.ndim != 2 or z.shape[1] != 3:
        raise CalibrationError(f"field_t must have shape (N, 3), got {z.shape}")
    if strength_t is not None and not (np.isfinite(strength_t) and strength_t > 0.0):
        raise CalibrationError(f"strength_t must be a positive field in tesla, got {strength_t}")
    z = z[np.all(np.isfinite(z), axis=1)]
    if len(z) < FEWEST:
        raise CalibrationError(
            f"there are {len(z)} samples of the field; a calibration needs at least {FEWEST}, "
            "taken while the sensor is turned about all its axes"
        )
    vertical = 0.0
    if level:
        vertical, z = _level(z)
        strength_t = None if strength_t is None else _horizontal(strength_t, vertical)
    low, high = np.percentile(z, _ENDS, axis=0)
    centre, size = (low + high) / 2.0, float((high - low).max()) / 2.0
    if not size > 0.0:
        raise CalibrationError("all samples of the field are equal: turn the sensor about")
    unit = _thinned_evenly(((z - centre) / size)[:: -(-len(z) // MOST)])
    _refuse_flat(unit)
    found = _best(unit, centre, size, strength_t, soft_iron)
    return _embed_in_three(found, vertical) if level else found


def _best(
    unit: np.ndarray,
    centre: np.ndarray,
    size: float,
    strength_t: float | None,
    soft_iron: bool | None,
) -> Calibration:
    """Calibration by an ellipsoid of samples of unit extent, or by a sphere if not determined."""
    why = CalibrationError(_NO_ELLIPSOID)
    d = unit.shape[1]
    if soft_iron is not False:
        try:
            free = np.eye(d + len(_PAIRS[d]))
            fitted = _refined(unit, *_direct_ellipsoid(unit), free=free)
            found = _calibration_in_tesla(unit, *fitted, free, centre, size, strength_t)
            _refuse_stretched(found)
            return found
        except CalibrationError as error:
            if soft_iron:
                raise
            why = error
    free = _of_sphere(d)
    fitted = _refined(unit, *_direct_sphere(unit), free=free)
    found = _calibration_in_tesla(unit, *fitted, free, centre, size, strength_t)
    if soft_iron is None and found.after_t > _OFF * found.field_t:
        share = found.after_t / found.field_t
        raise CalibrationError(
            f"a sphere, the hard iron alone, is {share:.0%} of the field off, and there is no "
            f"ellipsoid: {why.what}",
            fix=why.fix,
        )
    return found


def _level(z: np.ndarray) -> tuple[float, np.ndarray]:
    """Median vertical field, and the horizontal field (N, 2).

    Raises:
        CalibrationError: the vertical field varies, so the vehicle tilts.
    """
    across = z[:, :2] - np.mean(z[:, :2], axis=0)
    horizontal = float(np.sqrt(np.mean(np.sum(across**2, axis=1))))
    scatter = float(np.std(z[:, 2]))
    if scatter > _TILTED * horizontal:
        raise CalibrationError(
            f"the vertical field scatters by {scatter * 1e6:.3g} uT, the horizontal one by "
            f"{horizontal * 1e6:.3g} uT: the sensor was not turned about the vertical only",
            fix="calibrate all three axes, or give a mounting that makes its third axis vertical",
        )
    return float(np.median(z[:, 2])), z[:, :2]


def _horizontal(strength_t: float, vertical_t: float) -> float:
    if not strength_t > abs(vertical_t):
        raise CalibrationError(
            f"the vertical axis reads {vertical_t * 1e6:.4g} uT, more than the whole field of "
            f"{strength_t * 1e6:.4g} uT: it has a hard iron of its own",
            fix="leave the strength out",
        )
    return float(np.sqrt(strength_t**2 - vertical_t**2))


def _embed_in_three(found: Calibration, vertical_t: float) -> Calibration:
    """Embed a calibration of the horizontal axes in three, the vertical one unchanged."""
    offset, matrix, sigma = np.zeros(3), np.eye(3), np.zeros((3, 3))
    offset[:2], matrix[:2, :2], sigma[:2, :2] = found.offset_t, found.matrix, found.matrix_sigma
    covariance = np.zeros((9, 9))
    covariance[np.ix_(_HORIZONTAL, _HORIZONTAL)] = found.covariance
    return found._replace(
        offset_t=offset,
        matrix=matrix,
        matrix_sigma=sigma,
        offset_sigma_t=np.append(found.offset_sigma_t, 0.0),
        covariance=covariance,
        field_t=float(np.hypot(found.field_t, vertical_t)),
        gap=np.append(found.gap, 0.0),
        level=True,
    )


def _refuse_stretched(found: Calibration) -> None:
    """Refuse an elongated ellipsoid unless the samples lie on it."""
    axes = np.linalg.eigvalsh(found.matrix)
    share = found.after_t / found.field_t
    if axes[-1] > _STRETCHED * axes[0] and share > 0.5 * _OFF:
        raise CalibrationError(
            f"the axes of the ellipsoid differ by a factor of {axes[-1] / axes[0]:.2g}, and the "
            f"samples are {share:.0%} of the field off it",
            fix="if the field was not the same while the sensor was turned, turn it away from iron",
        )


def _thinned_evenly(z: np.ndarray) -> np.ndarray:
    """Samples in order of time, thinned evenly to at most `_SHARE` in each small cube.

    A sensor at rest, as before and after the rotations, would otherwise outweigh them by samples
    whose common error is not noise.
    """
    cube = np.unique(np.floor(z / _SIDE).astype(np.int64), axis=0, return_inverse=True)[1]
    order = np.argsort(cube.reshape(-1), kind="stable")
    counts = np.bincount(cube.reshape(-1))
    rank = np.arange(len(z)) - np.repeat(np.cumsum(counts) - counts, counts)
    every = np.repeat(-(-counts // _SHARE), counts)
    return z[np.sort(order[rank % every == 0])]


def _refuse_flat(z: np.ndarray) -> None:
    extent = np.linalg.svd(z - z.mean(axis=0), compute_uv=False)
    if extent[-1] < _FLAT * extent[0]:
        share = f"their extent across it is {extent[-1] / extent[0]:.2g} of that along it"
        if z.shape[1] == 2:
            raise CalibrationError(
                f"the samples lie on a line ({share}): the vehicle hardly turned",
                fix="turn it by a whole circle",
            )
        raise CalibrationError(
            f"the samples lie in a plane ({share}): the sensor was turned about one axis only",
            fix="turn it about two more, so that each of its axes points up and down once; of a "
            "vehicle that cannot tilt calibrate the horizontal axes alone (--horizontal)",
        )


def _direct_ellipsoid(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre and matrix W with ``|W (z - centre)| = 1`` after Li & Griffiths (2004), k = 4."""
    pairs = _PAIRS[z.shape[1]]
    d, m = z.shape[1], len(pairs)
    squares = np.stack([(1.0 + (i != j)) * z[:, i] * z[:, j] for i, j in pairs])
    D = np.concatenate([squares, 2.0 * z.T, np.ones((1, len(z)))])
    S = D @ D.T / len(z)
    C = np.zeros((m, m))  # inverse of the matrix of 4 J - I^2, which is positive for ellipsoids
    C[:d, :d] = 0.5 * (1.0 - np.eye(d))
    C[d:, d:] = -0.25 * np.eye(m - d)
    lower = np.linalg.solve(S[m:, m:], S[m:, :m])
    values, vectors = np.linalg.eig(C @ (S[:m, :m] - S[:m, m:] @ lower))
    v = np.real(vectors[:, np.argmax(np.real(values))])
    q = np.concatenate([v, -lower @ v])
    A = _unpacked(np.concatenate([np.zeros(d), v]))[1]
    centre = -np.linalg.solve(A, q[m:-1])
    level = centre @ A @ centre - q[-1]
    spread, axes = np.linalg.eigh(A / level)
    if not np.all(spread > 0.0):
        raise CalibrationError(_NO_ELLIPSOID)
    return centre, (axes * np.sqrt(spread)) @ axes.T


def _direct_sphere(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre and W = I / radius of the sphere of ``|z|^2 = 2 z . c + k``, least squares."""
    design = np.column_stack([2.0 * z, np.ones(len(z))])
    *c, k = np.linalg.lstsq(design, np.sum(z * z, axis=1), rcond=None)[0]
    centre = np.array(c)
    return centre, np.eye(len(c)) / np.sqrt(k + centre @ centre)


def _of_sphere(d: int) -> np.ndarray:
    """Free directions of a sphere: its centre, and a common diagonal of W."""
    free = np.eye(d + len(_PAIRS[d]), d + 1)
    free[d : 2 * d, d] = 1.0
    return free


def _refined(
    z: np.ndarray, offset: np.ndarray, W: np.ndarray, free: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Minimise the Huber loss of the distances by iteratively reweighted Gauss-Newton steps.

    Steps are combinations of the columns of ``free`` (9, K), in the plane (5, K).
    """
    noise = _robust_sigma(_distances(z, offset, W, 0.0))
    for _ in range(_PASSES):
        distance = _distances(z, offset, W, noise)
        noise = min(noise, _robust_sigma(distance))  # a growing scale would follow a worse fit
        clip = _HUBER * noise
        share = np.sqrt(clip / np.maximum(np.abs(distance), clip))
        J = (_jacobian(z, offset, W, distance) * share[:, None]) @ free
        step = -free @ np.linalg.lstsq(J.T @ J, J.T @ (distance * share), rcond=None)[0]
        offset, W = _unpacked(_packed(offset, W) + step)
        axes = np.linalg.eigvalsh(W)
        if not (np.all(np.isfinite(step)) and 0.0 < axes[-1] < _NEEDLE * axes[0]):
            raise CalibrationError(_NO_ELLIPSOID)
        if np.abs(step).max() < _SETTLED:
            return offset, W
    raise CalibrationError(_NO_ELLIPSOID)


def _distances(z: np.ndarray, offset: np.ndarray, W: np.ndarray, noise: float) -> np.ndarray:
    """Distance (N,) of each sample to the ellipsoid, to first order, positive outwards.

    Noise along a curved surface has a mean outward distance of half its variance times the sum of
    the curvatures; that is subtracted, as it would bias an ellipsoid sampled only in part.
    """
    b = (z - offset) @ W
    size = np.linalg.norm(b, axis=1)
    slope = np.linalg.norm(b @ W, axis=1) / size
    curvature = (np.sum(W * W) - slope**2) / (size * slope)
    return (size - 1.0) / slope - 0.5 * noise**2 * curvature


def _jacobian(z: np.ndarray, offset: np.ndarray, W: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Jacobian (N, 9) of the distances by offset and the six elements of W; in the plane (N, 5).

    Taken at the nearest points of the ellipsoid: at the samples its noise would correlate with that
    of the distances, and bias the fit.
    """
    y = z - offset
    normal = y @ W @ W
    y = y - distance[:, None] * normal / np.linalg.norm(normal, axis=1, keepdims=True)
    b = y @ W
    u = b / np.linalg.norm(b, axis=1, keepdims=True)
    by_offset = -u @ W
    by_matrix = [u[:, i] * y[:, j] + (i != j) * u[:, j] * y[:, i] for i, j in _PAIRS[len(offset)]]
    return np.column_stack([by_offset, *by_matrix]) / np.linalg.norm(by_offset, axis=1)[:, None]


def _packed(offset: np.ndarray, W: np.ndarray) -> np.ndarray:
    return np.concatenate([offset, [W[i, j] for i, j in _PAIRS[len(offset)]]])


def _unpacked(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    d = 2 if len(p) == 5 else 3
    W = np.empty((d, d))
    for (i, j), value in zip(_PAIRS[d], p[d:], strict=True):
        W[i, j] = W[j, i] = value
    return p[:d], W


def _robust_sigma(x: np.ndarray) -> float:
    return max(1.4826 * float(np.median(np.abs(x - np.median(x)))), 1e-12)


def _correlation(x: np.ndarray) -> float:
    """Samples per independent one: ``1 + 2 sum rho_k`` up to the first rho < 0."""
    x = x - x.mean()
    size = 1 << (2 * len(x) - 1).bit_length()
    rho = np.fft.irfft(np.abs(np.fft.rfft(x, size)) ** 2, size)[: len(x) // 4]
    if not rho[0] > 0.0:
        return 1.0
    negative = np.flatnonzero(rho < 0.0)
    last = negative[0] if negative.size else len(rho)
    return 1.0 + 2.0 * float(rho[1:last].sum() / rho[0])


def _calibration_in_tesla(unit, offset, W, free, centre, size, strength_t) -> Calibration:
    """Result in tesla, with its covariance and the coverage of directions."""
    noise = _robust_sigma(_distances(unit, offset, W, 0.0))
    distance = _distances(unit, offset, W, noise)
    clip = _HUBER * noise
    influence = np.clip(distance, -clip, clip)
    inside = np.mean(np.abs(distance) <= clip)
    correlated = _correlation(influence)
    J = _jacobian(unit, offset, W, distance) @ free
    # Variance of an M-estimate of influence psi: E psi^2 / (E psi')^2, times the correlation
    # (Huber 1981).
    spread = np.mean(influence**2) / inside**2 * correlated
    covariance = spread * free @ np.linalg.inv(J.T @ J) @ free.T

    d = len(offset)
    field = strength_t / size if strength_t else np.linalg.det(W) ** (-1.0 / d)
    # (h, W') -> (h, F W'): with F = det^(-1/d) its change is -F tr(W'^-1 dW') / d.
    scale = np.diag([1.0] * d + [field] * len(_PAIRS[d]))
    if strength_t is None:
        inverse = np.linalg.inv(W)
        by_entry = np.array([inverse[i, j] * (1.0 if i == j else 2.0) for i, j in _PAIRS[d]])
        scale[d:, d:] -= field / d * np.outer(_packed(offset, W)[d:], by_entry)
    scale[:d] *= size
    covariance = scale @ covariance @ scale.T
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    sigma[d:][sigma[d:] < 1e-12] = 0.0  # fixed, but for rounding
    offset_t, matrix, field_t = centre + size * offset, field * W, field * size
    _refuse_uncertain(sigma[:d], sigma[d:], field_t)
    z = centre + size * unit
    b = calibrated(z, offset_t, matrix)
    after = np.linalg.norm(b, axis=1)
    covered, gap, gap_rad = _coverage(b / after[:, None])
    return Calibration(
        offset_t=offset_t,
        matrix=matrix,
        soft_iron=len(free) == free.shape[1],
        field_t=field_t,
        offset_sigma_t=sigma[:d],
        matrix_sigma=_unpacked(sigma)[1],
        covariance=covariance,
        noise_t=noise * size,
        before_t=float(np.std(np.linalg.norm(z, axis=1))),
        after_t=float(np.sqrt(np.mean((after - field_t) ** 2))),
        outliers=float(np.mean(np.abs(distance) > 5.0 * noise)),
        independent=len(unit) / correlated,
        covered=covered,
        gap=gap,
        gap_rad=gap_rad,
    )


def _refuse_uncertain(offset: np.ndarray, matrix: np.ndarray, field_t: float) -> None:
    worst = max(offset.max() / field_t, matrix.max())
    if not worst < _VAGUE:
        raise CalibrationError(
            f"the samples do not tell the ellipsoid (one sigma is {worst:.0%} of the field): too "
            "few directions, or a field that changed meanwhile",
            fix="turn the sensor away from iron, so that each of its axes points up and down once",
        )


def _coverage(directions: np.ndarray) -> tuple[float, np.ndarray, float]:
    """Share of the sphere near a sample; the direction furthest from any; its distance [rad]."""
    tree = KDTree(directions)
    grid = _sphere(1000) if directions.shape[1] == 3 else _circle(1000)
    chord, _ = tree.query(grid)
    angle = 2.0 * np.arcsin(np.clip(chord / 2.0, 0.0, 1.0))
    furthest = int(np.argmax(angle))
    return float(np.mean(angle <= _REACH)), grid[furthest], float(angle[furthest])


def _circle(count: int) -> np.ndarray:
    """Directions (count, 2) spread evenly."""
    turn = 2.0 * np.pi * np.arange(count) / count
    return np.column_stack([np.cos(turn), np.sin(turn)])


def _sphere(count: int) -> np.ndarray:
    """Directions (count, 3) spread evenly, on a spiral of the golden angle."""
    k = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    across = np.sqrt(1.0 - z * z)
    return np.column_stack([across * np.cos(turn), across * np.sin(turn), z])
