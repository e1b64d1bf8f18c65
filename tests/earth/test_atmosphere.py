"""The standard atmosphere against the tables that were published with it."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from robins.earth import atmosphere

# U.S. Standard Atmosphere 1976, table I, by geometric height [m]: K, mbar.
PUBLISHED = [
    (-1000.0, 294.651, 1.1393e3),
    (0.0, 288.150, 1.01325e3),
    (1000.0, 281.651, 8.9876e2),
    (5000.0, 255.676, 5.4048e2),
    (10000.0, 223.252, 2.6499e2),
    (20000.0, 216.650, 5.5293e1),
    (30000.0, 226.509, 1.1970e1),
    (50000.0, 270.650, 7.9779e-1),
    (70000.0, 219.585, 5.2209e-2),
]


@pytest.mark.parametrize(("alt_m", "kelvin", "mbar"), PUBLISHED)
def test_the_published_table(alt_m, kelvin, mbar):
    assert atmosphere.temperature_K(alt_m) == pytest.approx(kelvin, abs=1e-3)
    assert atmosphere.pressure_Pa(alt_m) / 100.0 == pytest.approx(mbar, rel=1e-4)


def test_pressure_is_the_weight_of_the_air_above():
    """dP/dz = -rho g, integrated with the gravity that a geopotential metre implies."""
    radius, g0 = 6356766.0, 9.80665
    heights = np.array([3e3, 15e3, 25e3, 40e3, 60e3, 85e3])

    def fall(z, p):
        return -p / (287.0529 * atmosphere.temperature_K(z)) * g0 * (radius / (radius + z)) ** 2

    found = solve_ivp(fall, (0.0, 85e3), [101325.0], t_eval=heights, rtol=1e-9, max_step=250.0)
    ours = [atmosphere.pressure_Pa(z) for z in heights]
    np.testing.assert_allclose(ours, found.y[0], rtol=1e-5)


@pytest.mark.parametrize("alt_m", [-4999.0, -1.0, 0.0, 11019.0, 11020.0, 20063.0, 47e3, 85999.0])
def test_the_height_of_a_pressure_is_where_it_was(alt_m):
    found = atmosphere.pressure_altitude_m(atmosphere.pressure_Pa(alt_m))
    assert found == pytest.approx(alt_m, abs=1e-6)


def test_what_no_table_holds_is_refused():
    for alt_m in (-5001.0, 86001.0, math.nan):
        with pytest.raises(ValueError, match="a height lies in"):
            atmosphere.pressure_Pa(alt_m)
    for pressure in (0.0, 2e5, math.nan):
        with pytest.raises(ValueError, match="a pressure lies in"):
            atmosphere.pressure_altitude_m(pressure)
