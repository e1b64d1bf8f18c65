"""The doctor on GNSS fixes: each fault put into a healthy table is found, named and mended."""

import dataclasses

import numpy as np
import pytest
from made_logs import START_NS, found, the, velocity_ned

from robins.logs import examine


@pytest.fixture(scope="module")
def gnss(drive):
    return drive.gnss


def changed(gnss, **columns):
    return dataclasses.replace(gnss, **columns)


def test_a_healthy_table_is_silent(gnss):
    assert examine(gnss) == []
    assert examine(changed(gnss, v_n=None, sigma_v=None)) == []


@pytest.mark.parametrize("name", ["sigma_m", "sigma_v"])
def test_zero_and_negative_sigmas(gnss, name):
    sigma = getattr(gnss, name).copy()
    sigma[7, 1] = 0.0
    f = the(changed(gnss, **{name: sigma}), "sigma_not_positive")
    assert (f.severity, f.where, f.value) == ("error", "line 10", 1)
    f = the(changed(gnss, **{name: -sigma}), "sigma_not_positive")
    assert (f.where, f.value) == ("line 3", len(gnss))


@pytest.mark.parametrize("name", ["sigma_m", "sigma_v"])
def test_sigmas_that_were_never_written(gnss, name):
    spoilt = changed(gnss, **{name: getattr(gnss, name) * np.nan})
    assert the(spoilt, "sigma_missing").severity == "error"


@pytest.mark.parametrize("factor", [1e-3, 1e6])
def test_sigmas_of_another_unit(gnss, factor):
    f = the(changed(gnss, sigma_m=factor * gnss.sigma_m), "sigma_absurd")
    assert (f.severity, f.value) == ("warning", pytest.approx(0.02 * factor))


def test_float_fixes_as_sure_as_fixed_ones(gnss):
    quality = np.where(np.arange(len(gnss)) > 300, 2, 1)
    f = the(changed(gnss, quality=quality), "float_sigma")
    assert (f.severity, f.where) == ("warning", "line 304")
    honest = gnss.sigma_m * np.where(quality == 2, 5.0, 1.0)[:, None]
    assert examine(changed(gnss, quality=quality, sigma_m=honest)) == []


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda lat, lon: (np.rad2deg(lat), np.rad2deg(lon)), "degrees where radians are needed"),
        (lambda lat, lon: (lon - np.deg2rad(110.0), lat), "Latitude and longitude are exchanged"),
        (lambda lat, lon: (1e7 * lat, lon), "scaled (1e-7 deg?)"),
    ],
)
def test_places_that_are_none(gnss, change, cause):
    lat, lon = change(gnss.lat_rad, gnss.lon_rad)
    spoilt = changed(gnss, lat_rad=lat, lon_rad=lon)
    f = the(spoilt, "position_unit")
    assert (f.severity, f.where) == ("error", "line 3")
    assert cause in f.sentence
    assert found(spoilt) == ["position_unit"]


def test_no_fix_written_as_zero(gnss):
    lat, lon = gnss.lat_rad.copy(), gnss.lon_rad.copy()
    lat[5:8] = lon[5:8] = 0.0
    f = the(changed(gnss, lat_rad=lat, lon_rad=lon), "no_fix_as_zero")
    assert (f.severity, f.where, f.value) == ("error", "line 8", 3)


def test_radians_read_as_degrees(gnss):
    lat, lon = np.deg2rad(gnss.lat_rad), np.deg2rad(gnss.lon_rad)
    spoilt = changed(gnss, lat_rad=lat, lon_rad=lon)
    assert the(spoilt, "position_in_radians").severity == "warning"
    f = the(spoilt, "velocity_unit")
    assert f.severity == "error"
    assert "The positions are radians that were read as degrees" in f.sentence


@pytest.mark.parametrize(
    ("by_m", "severity"), [(430_000.0, "warning"), (-20_000.0, "error"), (-1000.0, "warning")]
)
def test_heights_nobody_has(gnss, by_m, severity):
    assert the(changed(gnss, alt_m=gnss.alt_m + by_m), "height").severity == severity


def test_velocities_east_north_up_taken_for_north_east_down(gnss):
    enu = gnss.v_n[:, [1, 0, 2]] * [1, 1, -1]
    spoilt = changed(gnss, v_n=enu)
    f = the(spoilt, "velocity_axes")
    assert f.severity == "error"
    assert "probably east, north, up, not north, east, down" in f.sentence
    assert found(spoilt) == ["velocity_axes"]
    assert examine(changed(gnss, v_n=enu, nav="ENU")) == []
    f = the(changed(gnss, nav="ENU"), "velocity_axes")
    assert "probably north, east, down, not east, north, up" in f.sentence


def test_latitude_and_longitude_exchanged_where_both_are_possible(gnss):
    f = the(changed(gnss, lat_rad=gnss.lon_rad, lon_rad=gnss.lat_rad), "velocity_axes")
    assert "Latitude and longitude are exchanged" in f.sentence


@pytest.mark.parametrize(
    ("signs", "words"), [([1, -1, 1], "reversed east"), ([-1, -1, 1], "reversed north and east")]
)
def test_horizontal_signs(gnss, signs, words):
    f = the(changed(gnss, v_n=gnss.v_n * signs), "velocity_axes")
    assert f"only with {words}. A sign convention differs" in f.sentence


def test_up_in_place_of_down(gnss):
    f = the(changed(gnss, v_n=gnss.v_n * [1, 1, -1]), "velocity_sign")
    assert f.severity == "error"
    assert "The third component is probably up, not down" in f.sentence


@pytest.mark.parametrize(
    ("factor", "unit"),
    [(3.6, "km/h"), (1 / 0.514444, "knots"), (1 / 0.3048, "ft/s"), (100, "cm/s"), (1e3, "mm/s")],
)
def test_velocities_in_another_unit(gnss, factor, unit):
    f = the(changed(gnss, v_n=factor * gnss.v_n), "velocity_unit")
    assert f.severity == "error"
    assert f.value == pytest.approx(factor, rel=0.01)
    assert f"probably in {unit}" in f.sentence


def test_velocities_that_lag_behind_by_half_an_epoch(gnss):
    t = (gnss.time_ns - START_NS) * 1e-9
    f = the(changed(gnss, v_n=velocity_ned(np.maximum(t - 0.1, 0.0))), "velocity_late")
    assert (f.severity, f.value) == ("warning", pytest.approx(0.1, abs=0.02))
    assert "half an epoch" in f.sentence


def test_velocities_of_another_journey(gnss):
    assert found(changed(gnss, v_n=np.roll(gnss.v_n, 130, axis=0))) == ["velocity_disagrees"]


def test_missing_components(gnss):
    alt = gnss.alt_m.copy()
    alt[3] = np.nan
    f = the(changed(gnss, alt_m=alt), "gnss_missing")
    assert (f.severity, f.where, f.value) == ("warning", "line 6", 1)
    f = the(changed(gnss, lat_rad=gnss.lat_rad * np.nan), "gnss_missing")
    assert f.severity == "error"
    f = the(changed(gnss, alt_m=np.full(len(gnss), 1e300)), "gnss_missing")
    assert "height is 1e+300 here, missing or impossible in" in f.sentence


def test_too_few_decimals(gnss):
    lat = np.deg2rad(np.round(np.rad2deg(gnss.lat_rad), 6))
    f = the(changed(gnss, lat_rad=lat), "position_resolution")
    assert (f.severity, f.value) == ("note", pytest.approx(0.111, rel=0.01))
