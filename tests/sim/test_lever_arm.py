"""Another point of the body: rigid-body kinematics against the path of the point."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation as SciRotation

from robins.earth import OMEGA_E, Geodetic, dcm_en, ecef_from_geodetic
from robins.sim.manoeuvres import BankedTurn, fly
from robins.sim.trajectory import at_lever_arm

LEVER = np.array([-1.5, 4.0, 0.6])


@pytest.fixture(scope="module")
def motion():
    start = Geodetic(np.deg2rad(50.0), np.deg2rad(179.999), 2000.0)  # flies over 180 deg
    return fly(
        start,
        [BankedTurn(0.6, 20.0), BankedTurn(-0.4, 10.0)],
        90.0,
        heading_rad=1.5,
        pitch_rad=0.05,
    )


@pytest.fixture(scope="module")
def point(motion):
    return at_lever_arm(motion, LEVER)


def axes(k):
    C_en = SciRotation.from_matrix(np.asarray(dcm_en(k.lat, k.lon)))
    return C_en, C_en * SciRotation.from_quat(k.q_nb, scalar_first=True)


def test_the_point_is_carried_along(motion, point):
    t = np.linspace(0.05, 29.9, 500)
    k, p = motion.at(t), point.at(t)
    C_en, C_eb = axes(k)
    D_en, D_eb = axes(p)
    np.testing.assert_allclose((C_eb.inv() * D_eb).as_rotvec(), 0.0, rtol=0, atol=1e-9)
    r, s = (np.asarray(ecef_from_geodetic(x.lat, x.lon, x.alt)) for x in (k, p))
    np.testing.assert_allclose(C_eb.inv().apply(s - r), np.tile(LEVER, (500, 1)), atol=1e-7)

    # v_e = v_e + omega_eb x r, with the rate relative to the Earth
    omega_ib, f_b = k.rates()
    omega_eb = omega_ib - C_eb.inv().apply(np.tile([0.0, 0.0, OMEGA_E], (500, 1)))
    carried = C_en.apply(k.v_n) + C_eb.apply(np.cross(omega_eb, LEVER))
    np.testing.assert_allclose(D_en.apply(p.v_n), carried, rtol=0, atol=2e-6)

    # f at the point: Euler and centripetal acceleration on top, gravity changes by 2e-6 in 0.6 m
    h = 1e-4
    alpha = (motion.at(t + h).rates()[0] - motion.at(t - h).rates()[0]) / (2.0 * h)
    expected = f_b + np.cross(alpha, LEVER) + np.cross(omega_ib, np.cross(omega_ib, LEVER))
    omega_s, f_s = p.rates()
    np.testing.assert_allclose(omega_s, omega_ib, rtol=0, atol=1e-7)
    steady = (np.abs(t - 1.0) > 1.1) & (np.abs(t - 21.0) > 1.1)
    np.testing.assert_allclose(f_s[steady], expected[steady], rtol=0, atol=2e-4)


def test_no_lever_arm_is_the_same_motion_and_nonsense_is_refused(motion):
    assert at_lever_arm(motion, np.zeros(3)) is motion
    for bad in ([1.0, 2.0], [1.0, np.nan, 0.0]):
        with pytest.raises(ValueError, match="lever_b_m must be three finite numbers"):
            at_lever_arm(motion, bad)
