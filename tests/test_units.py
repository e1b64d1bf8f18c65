"""Units: values against first principles, and every wrong unit refused with a way out."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robins import units
from robins.units import KINDS, UNITS, UnitError, convert, from_si, parse, show, to_si

DEG = math.pi / 180


@pytest.mark.parametrize(
    ("text", "kind", "si"),
    [
        ("180 deg", "angle", math.pi),
        ("60 arcmin", "angle", DEG),
        ("3600 arcsec", "angle", DEG),
        ("15 deg/h", "angle rate", 15 * DEG / 3600),
        ("1 rpm", "angle rate", 2 * math.pi / 60),
        ("60 deg/sqrt(h)", "angle random walk", DEG),  # sqrt(1 h) = 60 sqrt(s)
        ("1 deg/s/sqrt(Hz)", "angle random walk", DEG),  # a density is a walk in sqrt(s)
        ("3600 deg/h/sqrt(Hz)", "angle random walk", DEG),
        ("216000 deg/h/sqrt(h)", "rate random walk", DEG),
        ("1 rad/s^2/sqrt(Hz)", "rate random walk", 1.0),
        ("1 g", "specific force", 9.80665),
        ("1 g", "acceleration", 9.80665),
        ("1000 mGal", "acceleration", 0.01),
        ("1 ug", "acceleration", 9.80665e-6),
        ("60 m/s/sqrt(h)", "velocity random walk", 1.0),
        ("1e6 ug/sqrt(Hz)", "velocity random walk", 9.80665),
        ("60 m/s^2/sqrt(h)", "acceleration random walk", 1.0),
        ("9.80665 deg/s/g", "g-sensitivity", DEG),
        ("1 NM", "length", 1852.0),
        ("1000 ft", "length", 304.8),
        ("3600 kn", "speed", 1852.0),
        ("36 km/h", "speed", 10.0),
        ("5 us", "time", 5e-6),
        ("2 h", "time", 7200.0),
        ("2 kHz", "frequency", 2000.0),
        ("300 ppm", "scale factor", 3e-4),
        ("5 %", "ratio", 0.05),
        ("0.25", "ratio", 0.25),
        ("1 G", "magnetic field", 1e-4),
        ("50000 nT", "magnetic field", 5e-5),
        ("5 mN m", "torque", 5e-3),
        ("1013.25 hPa", "pressure", 101325.0),
        ("20 degC", "temperature", 293.15),
        # ways to type the same
        ("0.5deg", "angle", DEG / 2),
        ("  -1.5e1   deg ", "angle", -15 * DEG),
        ("1 °/√h", "angle random walk", DEG / 60),
        ("1 µg/√(Hz)", "velocity random walk", 9.80665e-6),
        ("2 N·m", "torque", 2.0),
        ("2 m/s²", "acceleration", 2.0),
        ("2 deg / h", "angle rate", 2 * DEG / 3600),
    ],
)
def test_values_in_si(text, kind, si):
    assert parse(text, kind) == pytest.approx(si, rel=4e-16)


def dimension(symbol):
    """Scale and powers of (rad, m, s) of a unit, from its spelling alone."""
    prefixes = {"": 1.0, "n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3, "c": 1e-2, "M": 1e6}
    bases = {
        "rad": (1.0, (1, 0, 0)),
        "deg": (DEG, (1, 0, 0)),
        "arcmin": (DEG / 60, (1, 0, 0)),
        "arcsec": (DEG / 3600, (1, 0, 0)),
        "m": (1.0, (0, 1, 0)),
        "ft": (0.3048, (0, 1, 0)),
        "g": (9.80665, (0, 1, -2)),
        "Gal": (0.01, (0, 1, -2)),
        "s": (1.0, (0, 0, 1)),
        "min": (60.0, (0, 0, 1)),
        "h": (3600.0, (0, 0, 1)),
        "Hz": (1.0, (0, 0, -1)),
        "1": (1.0, (0, 0, 0)),
    }
    scale, powers = 1.0, np.zeros(3)
    for i, part in enumerate(symbol.replace("(m/s^2)", "m*s^-2").split("/")):
        for factor in part.split("*"):
            root = factor.startswith("sqrt(")
            name, _, power = factor.removeprefix("sqrt(").removesuffix(")").partition("^")
            exponent = (-1) ** (i > 0) * (0.5 if root else float(power or 1))
            prefix = next(p for p in prefixes if name.startswith(p) and name[len(p) :] in bases)
            if name in bases:
                prefix = ""
            base, dims = bases[name[len(prefix) :]]
            scale *= (prefixes[prefix] * base) ** exponent
            powers = powers + exponent * np.array(dims)
    return scale, tuple(powers)


MECHANICAL = [
    "angle",
    "angle rate",
    "angular acceleration",
    "angle random walk",
    "rate random walk",
    "acceleration",
    "velocity random walk",
    "acceleration random walk",
    "length",
    "position random walk",
]


@pytest.mark.parametrize("kind", MECHANICAL)
def test_scales_and_dimensions_follow_from_the_spelling(kind):
    # A second reading of the symbols: it would catch a slip in the table.
    symbols = [s for s in KINDS[kind] if s not in ("rpm", "NM")]
    assert len(symbols) >= 3
    _, expected = dimension(KINDS[kind][0])
    for symbol in symbols:
        scale, powers = dimension(symbol)
        assert scale == pytest.approx(UNITS[symbol].scale, rel=1e-15), symbol
        assert powers == expected, symbol


def test_first_unit_of_every_kind_is_that_of_the_si():
    for kind, symbols in KINDS.items():
        assert UNITS[symbols[0]].scale == 1.0, kind
        assert UNITS[symbols[0]].offset == 0.0, kind
        assert all(kind in UNITS[s].kinds for s in symbols)


@given(st.sampled_from(sorted(UNITS)), st.floats(1e-290, 1e9) | st.floats(-1e9, -1e-290))
def test_there_and_back(symbol, value):
    again = from_si(to_si(value, symbol), symbol)
    assert again == pytest.approx(value, rel=1e-15, abs=1e-9 if symbol == "degC" else 0)


@given(st.sampled_from([(k, s) for k, symbols in KINDS.items() for s in symbols]), st.floats(-9, 9))
def test_what_is_shown_can_be_read(kind_and_symbol, exponent):
    kind, symbol = kind_and_symbol
    value = to_si(10.0**exponent, symbol)
    text = show(value, symbol, digits=17)
    if symbol != "1" or kind == "ratio":
        assert parse(text, kind) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "kind", "words"),
    [
        ("5 deg/h", "frequency", "deg/h is an angle rate; a frequency in Hz is wanted here"),
        ("5 Hz", "angle rate", "Hz is a frequency; an angle rate in rad/s is wanted here"),
        ("5 deg/h", "angle random walk", "an angle random walk in deg/sqrt(h) is wanted"),
        ("5 deg/sqrt(h)", "angle rate", "an angle rate in deg/h is wanted"),
        ("5 ug", "velocity random walk", "a velocity random walk in ug/sqrt(Hz) is wanted"),
        ("5 mg/sqrt(Hz)", "acceleration", "an acceleration in mg is wanted"),
        ("5 deg", "angle rate", "in deg/s is wanted"),
        ("5 kg", "length", "kg is a mass; a length in m is wanted here (allowed: m, um, mm,"),
    ],
)
def test_a_unit_of_another_kind_is_refused_with_the_likely_one(text, kind, words):
    with pytest.raises(UnitError) as caught:
        parse(text, kind)
    assert words in str(caught.value)


def test_no_unit_passes_as_a_kind_that_does_not_list_it():
    for kind, symbols in KINDS.items():
        for symbol in UNITS:
            if symbol in symbols:
                parse(f"1 {symbol}", kind)
            else:
                with pytest.raises(UnitError, match="is wanted here"):
                    parse(f"1 {symbol}", kind)


@pytest.mark.parametrize(
    ("text", "kind", "meant"),
    [
        ("5 deg/hr", "angle rate", "deg/h"),
        ("5 hz", "frequency", "Hz"),
        ("5 KHz", "frequency", "kHz"),
        ("5 deg/rt(h)", "angle random walk", "deg/sqrt(h)"),
        ("5 ug/rt-Hz", "velocity random walk", "ug/sqrt(Hz)"),
        ("5 Nm", "torque", "N m"),
        ("5 m/s2", "acceleration", "m/s^2"),
        ("5 arcsecs", "angle", "arcsec"),
        ("5 nm", "length", "NM"),
    ],
)
def test_an_unknown_unit_gets_a_suggestion(text, kind, meant):
    with pytest.raises(UnitError, match="unknown unit") as caught:
        parse(text, kind)
    assert f"did you mean {meant}?" in str(caught.value)


def test_an_unknown_unit_like_no_other_gets_the_list():
    with pytest.raises(UnitError) as caught:
        parse("5 furlong", "speed")
    assert "did you mean" not in str(caught.value)
    assert "(for a speed: m/s, " in str(caught.value)


@pytest.mark.parametrize("value", ["5", 5, 5.0, "5 ", np.float64(5)])
@pytest.mark.parametrize("kind", sorted(set(KINDS) - {"ratio"}))
def test_a_number_without_unit_is_refused(value, kind):
    with pytest.raises(UnitError, match="has no unit"):
        parse(value, kind)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (True, "truth value"),
        (False, "truth value"),
        (math.nan, "not a finite number"),
        (-math.inf, "not a finite number"),
        (10**400, "not a finite number"),
        (None, "not a number"),
        (b"5", "not a number"),
        (1j, "not a number"),
        ([1.0], "not a number"),
        ("nan", "finite number, as in '0.5'"),
        ("inf", "finite number"),
        ("", "finite number"),
        ("five", "finite number"),
        ("1e999", "beyond the range"),
        ("1,5", "decimal sign is a point"),
        ("٥", "finite number"),  # digits, but not ours
    ],
)
def test_what_is_no_finite_number_is_refused(value, words):
    with pytest.raises(UnitError, match=words):
        parse(value, "ratio")


def test_a_number_that_leaves_the_range_on_the_way_to_si_is_refused():
    with pytest.raises(UnitError, match="beyond the range"):
        parse("1e308 km", "length")


def test_plain_numbers_are_ratios():
    assert parse(0.5, "ratio") == 0.5
    assert parse(2, "ratio") == 2.0
    assert parse("0.5", "ratio") == 0.5


def test_an_unknown_kind_is_a_fault_of_the_program():
    with pytest.raises(KeyError):
        parse("5 m", "lenght")


def test_conversion_needs_one_kind():
    assert convert(90.0, "deg/h", "deg/s") == pytest.approx(0.025, rel=1e-15)
    np.testing.assert_allclose(convert(np.array([0.0, 20.0]), "degC", "K"), [273.15, 293.15])
    assert convert(300.0, "ppm", "%") == pytest.approx(0.03, rel=1e-15)
    with pytest.raises(UnitError, match="Hz is a frequency; an angle rate in"):
        convert(1.0, "deg/h", "Hz")
    with pytest.raises(UnitError, match="did you mean deg/h"):
        convert(1.0, "deg/hr", "deg/s")


def test_show():
    assert show(parse("0.1 deg/h", "angle rate"), "deg/h") == "0.1 deg/h"
    assert show(math.pi, "deg") == "180 deg"
    assert show(1 / 3, "1", digits=3) == "0.333"
    assert show(math.nan, "m") == "nan m"


def test_noise_of_data_sheets_is_that_of_calibration_tools():
    arw = parse("0.66 deg/sqrt(h)", "angle random walk")
    assert arw == pytest.approx(parse("0.011 deg/s/sqrt(Hz)", "angle random walk"), rel=1e-15)
    assert units.show(arw, "rad/s/sqrt(Hz)", 4) == "0.000192 rad/s/sqrt(Hz)"
    vrw = parse("0.1 m/s/sqrt(h)", "velocity random walk")
    assert units.show(vrw, "ug/sqrt(Hz)", 4) == "170 ug/sqrt(Hz)"
    assert units.show(vrw, "m/s^2/sqrt(Hz)", 4) == "0.001667 m/s^2/sqrt(Hz)"
