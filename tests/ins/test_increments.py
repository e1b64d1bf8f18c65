"""Increments against closed forms, against integration of the body's motion, and their order."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from composed import composed
from numpy.polynomial.legendre import leggauss
from scipy.spatial.transform import Rotation

from robins.dataset import ImuTable
from robins.ins.frames import to_enu_rfu
from robins.ins.increments import Increments, displacement, from_imu

rng = np.random.default_rng(3)
NODES, WEIGHTS = leggauss(8)


class Coning:
    """A body axis that runs around a cone while a force changes: attitude in closed form."""

    def __init__(self, half_angle, rate):
        self.a, self.w = half_angle, rate

    def attitude(self, t):
        phase = self.w * t
        axis = np.stack([np.cos(phase), np.sin(phase), 0.0 * phase], -1)
        return Rotation.from_rotvec(self.a * axis)

    def rate(self, t):
        phase, s, c = self.w * t, np.sin(self.a), np.cos(self.a)
        return self.w * np.stack(
            [-s * np.sin(phase), s * np.cos(phase), (c - 1.0) * np.ones_like(phase)], -1
        )

    def force(self, t):
        return np.stack([np.sin(3.0 * t), np.cos(2.0 * t), np.sin(t) - 9.8], -1)

    def imu(self, t, kind):
        time_ns = np.round(t * 1e9).astype(np.int64)
        if kind == "rate":
            return ImuTable(time_ns, self.rate(t), self.force(t), "rate")
        dt = np.append(np.diff(t)[:1], np.diff(t))
        at = (t - 0.5 * dt)[:, None] + 0.5 * dt[:, None] * NODES
        means = (0.5 * np.einsum("nkj,k->nj", f(at), WEIGHTS) for f in (self.rate, self.force))
        return ImuTable(time_ns, *(dt[:, None] * mean for mean in means), "increment")

    def motion(self, t0, t1):
        """Rotation, velocity and displacement from t0 to t1 in the axes at t0, by quadrature."""
        edges = np.linspace(t0, t1, 4001)
        half = 0.5 * (edges[1] - edges[0])
        at = (edges[:-1] + half)[:, None] + half * NODES
        start = self.attitude(np.array(t0)).inv()
        force = (start * self.attitude(at.ravel())).apply(self.force(at.ravel()))
        weights = half * np.tile(WEIGHTS, len(at))
        turned = (start * self.attitude(np.array(t1))).as_rotvec()
        return turned, weights @ force, (weights * (t1 - at.ravel())) @ force


def joined_error(body, t, kind):
    """Errors in attitude, velocity and displacement of all increments, joined."""
    imu = body.imu(t, kind)
    total = composed(from_imu(imu)[0])
    theta, dv, dr = body.motion(t[0], t[-1])
    miss = Rotation.from_rotvec(theta).inv() * Rotation.from_rotvec(total.theta)
    return np.array(
        [miss.magnitude(), np.linalg.norm(total.dv - dv), np.linalg.norm(total.dr - dr)]
    )


@pytest.mark.parametrize(("kind", "order"), [("increment", 3), ("rate", 4)])
def test_order_of_the_error_of_a_path(kind, order):
    body = Coning(0.3, 2.0)
    errors = np.array([joined_error(body, np.arange(10 * n + 1) / n, kind) for n in (20, 40, 80)])
    observed = np.log2(errors[:-1] / errors[1:])
    assert (observed > order - 0.1).all(), observed


@pytest.mark.parametrize("kind", ["increment", "rate"])
def test_jitter_of_the_sampling_does_not_lower_the_accuracy(kind):
    body = Coning(0.3, 2.0)
    t = np.arange(401) / 40.0
    uneven = t + np.append(rng.uniform(-0.1, 0.1, 400) / 40.0, 0.0)
    # true time stamps: the error grows by no more than the longest interval (1.2) to the order
    assert (joined_error(body, uneven, kind) < 1.2**4 * joined_error(body, t, kind)).all()


def test_constant_rate_and_force_in_closed_form():
    """Rodrigues' integrals: what a uniformly turning body with a constant force moves by."""
    omega, f, h = np.array([0.3, -0.5, 0.8]), np.array([1.0, 2.0, -9.8]), 0.02
    n = 12
    time_ns = np.arange(n, dtype=np.int64) * 20_000_000
    w = np.linalg.norm(omega)
    K = np.cross(np.eye(3), omega) / w  # cross product with the axis
    x = w * h
    dv = h * (np.eye(3) + (1 - np.cos(x)) / x * K + (1 - np.sin(x) / x) * K @ K) @ f
    once, twice = (x - np.sin(x)) / x**2, 0.5 - (1 - np.cos(x)) / x**2
    dr = h**2 * (0.5 * np.eye(3) + once * K + twice * K @ K) @ f
    for imu in (
        ImuTable(time_ns, np.tile(omega, (n, 1)), np.tile(f, (n, 1)), "rate"),
        ImuTable(time_ns, np.tile(omega * h, (n, 1)), np.tile(f * h, (n, 1)), "increment"),
    ):
        inc, end_ns = from_imu(imu)
        np.testing.assert_array_equal(end_ns, time_ns[1:])
        np.testing.assert_allclose(inc.theta, np.tile(omega * h, (n - 1, 1)), atol=1e-17)
        # the two-point Gauss rule leaves x^4 / 4320 of the force
        np.testing.assert_allclose(inc.dv, np.tile(dv, (n - 1, 1)), atol=h * 10 * x**4 / 4320)
        np.testing.assert_allclose(inc.dr, np.tile(dr, (n - 1, 1)), atol=h**2 * x**3)
        without = Increments(inc.dt, inc.theta, inc.dv)
        np.testing.assert_allclose(displacement(without), inc.dr, atol=h**2 * 10 * x**2 / 24)


def test_two_sample_coning_and_sculling_are_those_of_pyins():
    from pyins import strapdown  # with Numba

    n = 400
    g, a = rng.normal(0, 0.01, (n, 3)), rng.normal(0, 0.1, (n, 3))
    time_ns = np.arange(n, dtype=np.int64) * 10_000_000
    columns = ["gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"]
    theirs = strapdown.compute_increments_from_imu(
        pd.DataFrame(np.hstack([g, a]), index=time_ns * 1e-9, columns=columns), "increment"
    )
    ours, _ = from_imu(ImuTable(time_ns, g, a, "increment"))
    np.testing.assert_allclose(ours.dt, theirs["dt"], rtol=0, atol=1e-15)
    np.testing.assert_allclose(ours.theta, theirs[["theta_x", "theta_y", "theta_z"]], atol=1e-16)
    # pyins stops at the first power of the rotation within an interval; the next is theta^2 / 6
    second = np.max(np.linalg.norm(g, axis=1)) ** 2 / 6.0 * np.max(np.linalg.norm(a, axis=1))
    difference = np.abs(ours.dv - theirs[["dv_x", "dv_y", "dv_z"]].to_numpy()).max()
    assert 0.05 * second < difference < 2.0 * second


def coning_drift(half_angle_rad: float, rate_rad_s: float, dt_s: float) -> float:
    """Drift [rad/s] left by the two-sample rule about the axis of a coning motion.

    The body axis runs around a cone of small half angle a at rate W, sampled every T. Truth and
    rule differ by ``a^2 |(x - sin x)/2 - sin^2(x/2) sin(x)/3| / T`` with x = W T, which is
    a^2 x^5 / (60 T) for small x (as Ignagni 1996, without the small-x limit). Terms in a^4 are left
    out.
    """
    x = rate_rad_s * dt_s
    left = 0.5 * (x - np.sin(x)) - np.sin(0.5 * x) ** 2 * np.sin(x) / 3.0
    return float(half_angle_rad**2 * abs(left) / dt_s)


@pytest.mark.parametrize("hz", [10.0, 50.0])
@pytest.mark.parametrize("samples", [200.0, 1000.0])
def test_coning_drift_stays_at_its_bound(hz, samples):
    half_angle, rate = np.deg2rad(1.0), 2.0 * np.pi * hz
    body = Coning(half_angle, rate)
    seconds = 4.0
    t = np.arange(int(seconds * samples) + 1) / samples
    total = composed(
        from_imu(body.imu(t, "increment"))[0]
    )  # whole turns of the cone, so all of it is drift
    drift = abs(total.theta[2]) / seconds
    bound = coning_drift(half_angle, rate, 1.0 / samples)
    # terms in the fourth power of the half angle, and rounding of 4e3 joins
    assert drift == pytest.approx(bound, rel=2.0 * half_angle**2, abs=1e-13)
    if rate / samples < 1.0:
        leading = half_angle**2 * (rate / samples) ** 5 / 60.0 * samples
        assert bound == pytest.approx(leading, rel=(rate / samples) ** 2 / 5.0)


def test_a_gap_in_rates_is_bridged_by_a_straight_line():
    t = np.concatenate([np.arange(10), np.arange(300, 310)]) * 0.01
    gyro, accel = np.sin(50 * t)[:, None] * [1, 0, 0], np.tile([0, 0, 1.0], (20, 1))
    imu = ImuTable((t * 1e9).astype(np.int64), gyro, accel, "rate")
    inc, _ = from_imu(imu)
    mean = 0.5 * (imu.gyro[9] + imu.gyro[10])
    np.testing.assert_allclose(inc.theta[9], mean * (t[10] - t[9]), atol=1e-12)


def test_rfu_tables_give_the_same_increments():
    imu = Coning(0.1, 3.0).imu(np.arange(50) / 50.0, "increment")
    for ours, theirs in zip(from_imu(imu)[0], from_imu(to_enu_rfu(imu))[0], strict=True):
        np.testing.assert_array_equal(ours, theirs)


def at_row(k, value):
    return lambda a: np.where(np.arange(len(a))[:, None] == k, value, a)


NAMES = ("time_ns", "gyro", "accel")
BAD = {
    "time stands still or runs backwards at line 13": {"time_ns": lambda t: t - 50 * (t > 2)},
    "gyro in line 14 is .*nan": {"gyro": at_row(4, np.nan)},
    "accel in line 11 is .*inf": {"accel": at_row(1, np.inf)},
    r"1 sample\(s\); an interval needs two": dict.fromkeys(NAMES, lambda a: a[:1]),
    r"gyro has shape \(5, 3\), not \(6, 3\)": {"gyro": lambda g: g[:5]},
}


@pytest.mark.parametrize("message", BAD)
def test_bad_tables_are_refused_by_name_and_line(message):
    imu = ImuTable(
        np.arange(6, dtype=np.int64), np.ones((6, 3)), np.ones((6, 3)), "rate",
        source="walk.csv", rows=np.arange(10, 16),
    )  # fmt: skip
    bad = replace(imu, **{name: spoil(getattr(imu, name)) for name, spoil in BAD[message].items()})
    with pytest.raises(ValueError, match=f"walk.csv: {message}"):
        from_imu(bad)


def without(imu, lost):
    keep = ~np.isin(np.arange(len(imu)), lost)
    return replace(imu, **{name: getattr(imu, name)[keep] for name in NAMES})


@pytest.mark.parametrize(
    "lost", [[1], [100, 103], [200, 201, 202], np.arange(100, 110), np.arange(20, 400, 6)]
)
def test_lost_increments_are_bridged_by_a_straight_line(lost):
    """The error of the path is that of one line over each gap, times what the turn makes of it."""
    body, t = Coning(0.3, 2.0), np.arange(401) / 40.0
    total = composed(from_imu(without(body.imu(t, "increment"), lost))[0])
    theta, dv, _ = body.motion(t[0], t[-1])
    kept = np.delete(t, lost)
    gaps = np.diff(kept)[np.diff(kept) > 0.03]
    # |w''| = 0.3 x 2^3 rad/s^3, |f''| < 9.5 m/s^4; a line between means overshoots it by h/40
    off = (gaps**3 / 12.0 + gaps**2 / 40.0 / 6.0).sum()
    turned = (Rotation.from_rotvec(theta).inv() * Rotation.from_rotvec(total.theta)).magnitude()
    assert turned < 2.4 * off
    assert np.linalg.norm(total.dv - dv) < (9.5 + 9.8 * 2.4 * 10.0) * off


def burst(t):
    """Three of four stamps as late as the fourth, but for 0.1 ms each."""
    k = np.arange(len(t))
    return t[np.minimum(k | 3, len(t) - 1)] - 1e-4 * (3 - (k & 3))


UNEVEN = {
    "a rate that halves": lambda t: np.delete(t, np.arange(101, 200, 2)),
    "a sum over every gap": lambda t: np.delete(t, [50, 51, 90, 140]),
    "a late stamp": lambda t: t + 0.008 * np.isin(np.arange(len(t)), [50, 90]),
    "bursts": burst,
}


@pytest.mark.parametrize("stamps", UNEVEN)
def test_nothing_is_added_where_nothing_is_missing(stamps):
    """Sums and stamps that are not even have long intervals too, but no motion is lost in them."""
    t = np.arange(201) / 100.0
    made = UNEVEN[stamps](t)
    n = len(made)
    true = made if n < len(t) else t
    lasted = np.append(0.01, np.diff(true))[:, None]
    rate, force = np.array([0.0, 0.0, 0.2]), np.array([0.0, 0.0, -9.8])
    noise = 0.05 * rng.standard_normal((2, n, 3))
    gyro, accel = lasted * (rate + 0.1 * noise[0]), lasted * (force + noise[1])
    inc, _ = from_imu(ImuTable(np.round(made * 1e9).astype(np.int64), gyro, accel, "increment"))
    # coning and sculling of the noise is all that may come on top
    np.testing.assert_allclose(inc.theta.sum(0), gyro[1:].sum(0), atol=2e-4)
    np.testing.assert_allclose(inc.dv.sum(0)[2], accel[1:].sum(0)[2], atol=2e-4)


@pytest.mark.parametrize("kind", ["rate", "increment"])
def test_rows_integrated_in_parts_give_the_bits_of_all_together(monkeypatch, kind):
    imu = Coning(0.3, 2.0).imu(np.delete(np.arange(300) / 100.0, [50, 51, 130]), kind)
    together, _ = from_imu(imu)
    monkeypatch.setattr("robins.ins.increments._ROWS", 32)
    for part, whole in zip(from_imu(imu)[0], together, strict=True):
        np.testing.assert_array_equal(part, whole)
