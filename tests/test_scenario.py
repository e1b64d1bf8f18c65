"""Scenarios: right ones read to the letter, wrong ones refused with one line a fault (F30)."""

import datetime
import math
import os
import tomllib
from typing import Annotated, Literal

import pydantic
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robins import scenario
from robins.scenario import Parameters, Quantity, ScenarioError, default, override, text_of

DEG_H = math.pi / 180 / 3600
Axes = tuple[float, float, float]


class Imu(Parameters):
    rate: Annotated[float, Quantity("frequency", above="0 Hz", most="1 kHz")]
    gyro_bias: Annotated[Axes, Quantity("angle rate")] = default("0 deg/h")
    scale: Annotated[float, Quantity("scale factor")] = default("0 ppm")
    markov: Annotated[float, Quantity("time", above="0 s")] | None = None


class Ekf(Parameters):
    kind: Literal["ekf"]
    iterations: int = 1


class Ukf(Parameters):
    kind: Literal["ukf"]
    alpha: Annotated[float, Quantity("ratio", above="0")] = 1.0


class Drive(Parameters):
    imu: Imu
    runs: int = 1
    name: str = "drive"
    smooth: bool = False
    form: Literal["sqrt", "joseph"] = "sqrt"
    heights: Annotated[tuple[float, ...], Quantity("length", least="-500 m", below="500 km")] = ()
    filters: tuple[Annotated[Ekf | Ukf, pydantic.Field(discriminator="kind")], ...] = ()
    others: dict[str, Imu] = pydantic.Field(default_factory=dict)


GOOD = '[imu]\nrate = "100 Hz"\n'


def read(text="", *settings):
    return scenario.parse(Drive, text or GOOD, settings)


def refused(text, *settings):
    with pytest.raises(ScenarioError) as caught:
        read(text, *settings)
    faults = caught.value.faults
    assert str(caught.value).splitlines() == list(faults)  # one line a fault
    return list(faults)


# ------------------------------------------------------------------------------------- right ones


def test_quantities_arrive_in_si():
    drive = read("""
        runs = 3
        form = "joseph"
        heights = ["-0.1 km", "30 ft"]
        [imu]
        rate = "0.2 kHz"
        gyro_bias = ["1 deg/h", "2 deg/h", "3 deg/h"]
        scale = "300 ppm"
        [[filters]]
        kind = "ukf"
        alpha = 0.5
        [[filters]]
        kind = "ekf"
        [others.spare]
        rate = "1 Hz"
        markov = "1 h"
    """)
    assert drive.imu.rate == 200.0
    assert drive.imu.gyro_bias == pytest.approx((DEG_H, 2 * DEG_H, 3 * DEG_H), rel=1e-15)
    assert drive.imu.scale == pytest.approx(3e-4, rel=1e-15)
    assert drive.imu.markov is None
    assert drive.heights == pytest.approx((-100.0, 9.144), rel=1e-15)
    assert drive.filters == (Ukf(kind="ukf", alpha=0.5), Ekf(kind="ekf"))
    assert drive.others["spare"].markov == 3600.0
    assert (drive.runs, drive.form, drive.smooth) == (3, "joseph", False)


def test_one_text_serves_all_axes_and_defaults_have_units():
    assert read().imu.gyro_bias == (0.0, 0.0, 0.0)
    drive = read(GOOD + 'gyro_bias = "2 deg/h"')
    assert drive.imu.gyro_bias == pytest.approx((2 * DEG_H,) * 3, rel=1e-15)


def test_parameters_cannot_be_changed():
    with pytest.raises(pydantic.ValidationError, match="frozen"):
        read().runs = 2


def test_python_numbers_are_si_and_dumps_can_be_read_again():
    imu = Imu(rate=50.0, gyro_bias=(1e-5, 2e-5, 3e-5), markov=10)
    assert (imu.rate, imu.markov) == (50.0, 10.0)
    drive = Drive(imu=imu, heights=(1.0, 2.0))
    assert Drive.model_validate(drive.model_dump()) == drive
    with pytest.raises(pydantic.ValidationError, match="must be above 0 Hz"):
        Imu(rate=-50.0)


def test_a_default_that_would_stay_text_is_a_fault_of_the_program():
    with pytest.raises(TypeError, match=r"Bad.rate: write default\('1 Hz'\)"):

        class Bad(Parameters):
            rate: Annotated[float, Quantity("frequency")] = "1 Hz"  # type: ignore[assignment]


@pytest.mark.parametrize("bound", ["5 s", "5", "5 hz"])
def test_a_bound_of_another_kind_is_a_fault_of_the_program(bound):
    with pytest.raises(ValueError, match="frequency"):
        Quantity("frequency", above=bound)
    with pytest.raises(KeyError):
        Quantity("frequenzy")


# -------------------------------------------------------------------------- F30: wrong ones, each


@pytest.mark.parametrize(
    ("text", "line"),
    [
        # unknown and misspelt keys
        (
            GOOD + 'gyro_bais = "1 deg/h"',
            "imu.gyro_bais: unknown key; did you mean gyro_bias? "
            "(allowed: rate, gyro_bias, scale, markov)",
        ),
        (
            "wind = 3\n" + GOOD,
            "wind: unknown key (allowed: imu, runs, name, smooth, form, heights, filters, others)",
        ),
        (  # a key in the wrong table
            'gyro_bias = "1 deg/h"\n' + GOOD,
            "gyro_bias: unknown key; did you mean imu.gyro_bias? "
            "(allowed: imu, runs, name, smooth, form, heights, filters, others)",
        ),
        (  # the missing key is not told a second time
            '[imu]\nrat = "100 Hz"',
            "imu.rat: unknown key; did you mean rate? (allowed: rate, gyro_bias, scale, markov)",
        ),
        (
            GOOD + '[others.a]\nrate = "1 Hz"\nmarkow = "1 s"',
            "others.a.markow: unknown key; did you mean markov? "
            "(allowed: rate, gyro_bias, scale, markov)",
        ),
        (  # of the filter that was chosen, not of the other
            'filters = [{kind = "ukf", alhpa = 1}]\n' + GOOD,
            "filters.0.alhpa: unknown key; did you mean alpha? (allowed: kind, alpha)",
        ),
        (
            'filters = [{kind = "ekf", alpha = 1}]\n' + GOOD,
            "filters.0.alpha: unknown key (allowed: kind, iterations)",
        ),
        ("[imu]", "imu.rate: required, but not given"),
        (GOOD + 'gyro_bias = ["1 deg/h", "1 deg/h"]', "imu.gyro_bias.2: required, but not given"),
        # missing unit, wrong dimension
        (
            "[imu]\nrate = 100",
            "imu.rate = 100: 100 has no unit; a frequency is wanted here "
            "(allowed: Hz, mHz, kHz, MHz)",
        ),
        (
            '[imu]\nrate = "100"',
            "imu.rate = \"100\": '100' has no unit; a frequency is wanted here "
            "(allowed: Hz, mHz, kHz, MHz)",
        ),
        (
            '[imu]\nrate = "1 deg/h"',
            'imu.rate = "1 deg/h": deg/h is an angle rate; a frequency in Hz is wanted here '
            "(allowed: Hz, mHz, kHz, MHz)",
        ),
        (
            '[imu]\nrate = "1 hz"',
            "imu.rate = \"1 hz\": unknown unit 'hz'; did you mean Hz? "
            "(for a frequency: Hz, mHz, kHz, MHz)",
        ),
        (
            'heights = ["1 m", "2 kg"]\n' + GOOD,
            'heights.1 = "2 kg": kg is a mass; a length in m is wanted here '
            "(allowed: m, um, mm, cm, km, ft, NM)",
        ),
        # NaN and infinity, where a quantity, a number, a whole number is wanted
        ("[imu]\nrate = nan", "imu.rate = nan: nan is not a finite number"),
        (
            '[imu]\nrate = "nan Hz"',
            "imu.rate = \"nan Hz\": 'nan Hz' does not begin with a finite number, as in '1.5 Hz'",
        ),
        ("runs = nan\n" + GOOD, "runs = nan: should be a valid integer"),
        (
            'filters = [{kind = "ukf", alpha = inf}]\n' + GOOD,
            "filters.0.alpha = inf: inf is not a finite number",
        ),
        # a truth value for a number, a number for a truth value, text for either
        ("runs = true\n" + GOOD, "runs = true: should be a valid integer"),
        ("[imu]\nrate = true", "imu.rate = true: True is a truth value; a number is wanted here"),
        ("smooth = 1\n" + GOOD, "smooth = 1: should be a valid boolean"),
        ('runs = "3"\n' + GOOD, 'runs = "3": should be a valid integer'),
        ("runs = 3.0\n" + GOOD, "runs = 3.0: should be a valid integer"),
        ("name = 3\n" + GOOD, "name = 3: should be a valid string"),
        # negative and otherwise out of bounds
        ('[imu]\nrate = "-100 Hz"', 'imu.rate = "-100 Hz": must be above 0 Hz and at most 1 kHz'),
        ('[imu]\nrate = "0 Hz"', 'imu.rate = "0 Hz": must be above 0 Hz and at most 1 kHz'),
        ('[imu]\nrate = "1001 Hz"', 'imu.rate = "1001 Hz": must be at most 1 kHz and above 0 Hz'),
        (
            'heights = ["-501 m"]\n' + GOOD,
            'heights.0 = "-501 m": must be at least -500 m and below 500 km',
        ),
        (
            'heights = ["500 km"]\n' + GOOD,
            'heights.0 = "500 km": must be below 500 km and at least -500 m',
        ),
        # beyond the range of the kind, where a side has no bound of its own
        (GOOD + 'markov = "1e6 d"', 'imu.markov = "1e6 d": must be at most 3650 d and above 0 s'),
        (
            GOOD + 'gyro_bias = "-1e9 deg/h"',
            'imu.gyro_bias = "-1e9 deg/h": must be at least -100000 deg/s and at most 100000 deg/s',
        ),
        # no such choice, no table, no list
        (
            'form = "josef"\n' + GOOD,
            "form = \"josef\": should be 'sqrt' or 'joseph'; did you mean 'joseph'?",
        ),
        (
            'filters = [{kind = "ukff"}]\n' + GOOD,
            "filters.0 = {kind = \"ukff\"}: 'kind' should be one of 'ekf', 'ukf'; "
            "did you mean 'ukf'?",
        ),
        ("filters = [{}]\n" + GOOD, "filters.0 = {}: 'kind' is required, but not given"),
        ("imu = 3", "imu = 3: should be a table"),
        ("filters = 3\n" + GOOD, "filters = 3: should be a list"),
        ("others = 3\n" + GOOD, "others = 3: should be a table"),
    ],
)
def test_a_fault_is_one_line_with_path_value_and_mend(text, line):
    assert refused(text) == [line]


def test_a_bound_itself_is_let_in_where_it_is_included():
    drive = read('heights = ["-500 m"]\n[imu]\nrate = "1 kHz"')
    assert (drive.heights, drive.imu.rate) == ((-500.0,), 1000.0)


def test_one_wrong_text_for_all_axes_is_one_fault():
    (line,) = refused(GOOD + 'gyro_bias = "2 Hz"')
    assert line.startswith('imu.gyro_bias = "2 Hz": Hz is a frequency; an angle rate')
    (line,) = refused(GOOD + "gyro_bias = 2")
    assert line.startswith("imu.gyro_bias = 2: 2 has no unit")


def test_all_faults_are_told_at_once():
    faults = refused('runs = true\n[imu]\nrate = "-1 Hz"\nscal = "1 ppm"\nmarkov = 5')
    assert [fault.split(":")[0].split(" =")[0] for fault in faults] == [
        "imu.scal",
        "imu.rate",
        "imu.markov",
        "runs",
    ]


def test_long_values_and_odd_keys_stay_on_one_line():
    (line,) = refused(f'runs = "{"x" * 500}"\n' + GOOD)
    assert len(line) < 120
    (line,) = refused('"a\\nb" = 1\n' + GOOD)
    assert line.startswith('"a\\nb": unknown key')


# -------------------------------------------------------------------------------------------- text


@pytest.mark.parametrize(
    "text", ["x =", "[imu", 'a = "', "\0", "a = 1\na = 2", "a = " + "[" * 9999]
)
def test_text_that_is_not_toml_is_refused_with_its_place(text):
    (line,) = refused(text)
    assert line.startswith("not TOML: ")
    (line,) = refused("runs = 1\nform = sqrt\n")
    assert "line 2" in line


def test_files_are_read_with_their_name_in_messages(tmp_path):
    path = tmp_path / "straße 1.toml"
    path.write_text('\ufeff[imu]\r\nrate = "100 Hz"\r\n', encoding="utf-8")  # as Windows writes it
    assert scenario.load(Drive, path).imu.rate == 100.0
    assert scenario.load(Drive, str(path), ["runs=4"]).runs == 4
    path.write_text("[imu]\nrate = 3\n")
    with pytest.raises(ScenarioError, match=r"^.*straße 1\.toml: imu\.rate = 3: 3 has no unit"):
        scenario.load(Drive, path)
    path.write_text("[imu\n")
    with pytest.raises(ScenarioError, match=r"straße 1\.toml: not TOML: .*line 1"):
        scenario.load(Drive, path)


def test_files_that_cannot_be_read_are_refused(tmp_path):
    def message(path):
        with pytest.raises(ScenarioError) as caught:
            scenario.load(Drive, path)
        assert len(caught.value.faults) == 1
        return str(caught.value).removeprefix(f"{path}: ")

    assert message(tmp_path / "none.toml") == "No such file or directory"
    assert message(tmp_path) == "Is a directory"
    (tmp_path / "binary").write_bytes(b"a = 1\n\xff\xfe")
    assert message(tmp_path / "binary") == "byte 6 is not UTF-8 text"
    (tmp_path / "table.toml").write_text("a = 1\n[imu\n")
    with pytest.raises(ScenarioError, match=r"table\.toml: not TOML: .*line 2"):
        scenario.read_text(tmp_path / "table.toml")  # what comes later knows no file
    with open(tmp_path / "sparse", "wb") as file:
        os.truncate(file.fileno(), 10_000_000_000)  # 10 GB that are not there
    assert "hardly a scenario" in message(tmp_path / "sparse")


# ---------------------------------------------------------------------------------------- settings


def test_settings_change_the_scenario():
    drive = read(
        GOOD + "[[filters]]\nkind = 'ekf'\n",
        "imu.gyro_bias=2 deg/h",
        "imu.rate = 50 Hz",
        "runs=7",
        "smooth=true",
        "form=joseph",
        'name="a = b"',
        'heights=["1 m", "2 m"]',
        "filters.0.iterations=3",
        "others.spare.rate=1 Hz",
        "runs=8",
    )
    assert drive.imu.gyro_bias == pytest.approx((2 * DEG_H,) * 3, rel=1e-15)
    assert drive.imu.rate == 50.0
    assert (drive.runs, drive.smooth, drive.form, drive.name) == (8, True, "joseph", "a = b")
    assert drive.heights == (1.0, 2.0)
    assert drive.filters == (Ekf(kind="ekf", iterations=3),)
    assert drive.others["spare"].rate == 1.0


def test_settings_leave_the_mapping_they_are_given():
    mapping = tomllib.loads(GOOD + "[[filters]]\nkind = 'ekf'\n")
    before = tomllib.loads(text_of(mapping))
    changed = override(mapping, ["imu.rate=1 Hz", "filters.0.kind=ukf", "new.key=1"])
    assert mapping == before
    assert changed == {"imu": {"rate": "1 Hz"}, "filters": [{"kind": "ukf"}], "new": {"key": 1}}


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("imu.gyro_bais=2 deg/h", "imu.gyro_bais: unknown key; did you mean gyro_bias?"),
        ("ium.rate=2 Hz", "ium: unknown key; did you mean imu?"),
        ("imu.rate=fast", "imu.rate = \"fast\": 'fast' does not begin with a finite number"),
        ("imu.rate=", "imu.rate = \"\": '' does not begin with a finite number"),
        ("runs=1\nsmooth=true", 'runs = "1\\nsmooth=true": should be a valid integer'),
        ("runs=" + "9" * 5000, "should be a valid integer"),
        ("imu.rate", "'imu.rate': a setting is written path.to.key=value"),
        ("=3", "'=3': a setting is written path.to.key=value"),
        ("imu..rate=3", "a setting is written path.to.key=value"),
        ("imu.rate.x=3", "imu.rate.x: imu.rate holds no 'x' to set"),
        ("imu.rate.x.y=3", "imu.rate.x.y: imu.rate holds no 'x' to set"),
        ("filters.0.kind=ekf", "should be a list"),
    ],
)
def test_wrong_settings_are_refused(setting, words):
    (line,) = refused(GOOD, setting)
    assert words in line


def test_a_setting_beyond_the_end_of_a_list_is_refused():
    (line,) = refused(GOOD + "[[filters]]\nkind = 'ekf'\n", "filters.1.kind=ekf")
    assert line == "filters.1.kind: filters holds no '1' to set"


# ---------------------------------------------------------------------------------- text out again

texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
scalars = (
    st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False)
    | texts
    | st.dates()
    | st.times()
    | st.datetimes(timezones=st.sampled_from([None, datetime.UTC]))
)
tables = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=8,
)


@given(st.dictionaries(texts, tables, max_size=4))
def test_text_written_is_read_back_the_same(mapping):
    text = text_of(mapping)
    back = tomllib.loads(text)
    assert back == mapping
    assert text_of(back) == text


def test_a_changed_scenario_can_be_kept_and_run_again():
    changed = override(tomllib.loads(GOOD), ["imu.gyro_bias=2 deg/h", "runs=7"])
    assert read(text_of(changed)) == read(GOOD, "imu.gyro_bias=2 deg/h", "runs=7")
