"""Sobol indices: against closed forms, and a point of a batch against a run of the scenario."""

import csv
import io
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from robins import results
from robins.campaign import sensitivity as sobol
from robins.errors import RobinsError
from robins.filters import Belief
from robins.report.sensitivity import budget, scatter, table
from robins.systems import Case
from robins.systems.ins_gnss.model import POSITION, Fix
from robins.systems.ins_gnss.world import as_believed
from robins.workbench import publish, run
from robins.workbench.scenarios import read_scenario
from robins.workbench.sensitivity import UncertainParameter, sensitivity, uncertain

HERE = Path(__file__).parent
PAIR = f"{HERE / 'budget_world.py'}:study"
BALLOON = f"{HERE.parents[1] / 'docs' / 'examples' / 'balloon.py'}:study"
LEFT, RIGHT = "noise.left=0.5 m to 2 m", "noise.right=0.1 m to 3 m"


def budget_of(name, filter_, vary, settings=(), seed=0):
    """Budget that the command makes of these words."""
    read = read_scenario(name, settings)
    study, given = read.study, read.parameters
    course = study.lay_out(given)
    ranges = []
    for one in map(uncertain, vary):
        ends = (read.parsed((*settings, end)) for end in one.ends)
        ranges.append(sobol.between(*ends))
    parts = study.view(given, course), study.contender(given, course, filter_)
    return sobol.SensitivityRuns(study, given, course, *parts, seed, tuple(ranges))


# ------------------------------------------------------------------------- what is asked


def test_a_range_has_two_ends_in_one_unit():
    assert uncertain("a.b = 1 m to 2.5 m") == UncertainParameter("a.b", 1.0, 2.5, "m")
    assert uncertain("a=1 to 10 deg/h") == UncertainParameter("a", 1.0, 10.0, "deg/h")
    assert uncertain("a=-1e-3 to 0.2").ends == ("a=-0.001", "a=0.2")
    assert uncertain("a=1 m to 2 m").ends == ("a=1 m", "a=2 m")


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        (["a"], "is not key=low to high"),
        (["=1 to 2"], "is not key=low to high"),
        (["a=1,2"], "is not key=low to high"),
        (["a=one to two"], "is not key=low to high"),
        (["a=1 m to 1 km"], "has two units"),
        ([LEFT, LEFT], "each once"),
        (["noise.both=1 m to 2 m", "noise.both.0=1 m to 2 m"], "noise.both.0: is part of another"),
        (["nothing=1 to 2"], "nothing: unknown key"),
        (["noise.left=1 s to 2 s"], "noise.left"),
        (["noise.left=1 m to 1 m"], "noise.left: its two ends are the same"),
        (["runs=1 to 20"], "runs: is no quantity"),
        (["step=1 s to 2 s"], "step: decides the motion"),
        ([LEFT, "shape=1 m to 9 m"], "^--vary shape: decides a shape"),
    ],
)
def test_what_cannot_vary_is_refused_by_name(vary, message):
    with pytest.raises(RobinsError, match=message):
        sensitivity(PAIR, vary=vary, runs=1, samples=2)


@pytest.mark.parametrize(
    ("samples", "fix"), [(100, "64 or 128"), (1, "2 or 4"), (1 << 20, "16384")]
)
def test_samples_are_a_power_of_two(samples, fix):
    with pytest.raises(RobinsError, match=f"power of two.*take .*{fix}"):
        sensitivity(PAIR, vary=[LEFT], samples=samples)


def test_ends_far_apart_are_drawn_by_their_logarithm():
    def law(low, high):
        return sobol.ParameterRange((("a",),), (low,), (high,))

    assert [law(1.0, x).by_logarithm for x in (10.0, 10.1, -100.0)] == [False, True, False]
    assert not law(0.0, 5.0).by_logarithm
    assert law(100.0, 1.0).by_logarithm
    assert law(1.0, 4.0).at(0.5)[("a",)] == 2.5
    assert law(-1.0, -100.0).at(0.5)[("a",)] == pytest.approx(-10.0, rel=1e-15)


def test_numbers_are_placed_where_the_key_points():
    whole = budget_of(PAIR, "kf", ["noise.both=1 m to 3 m", LEFT])
    axes, left = whole.ranges
    assert axes.paths == (("noise", "both", 0), ("noise", "both", 1))
    placed = sobol.with_numbers(whole.given, axes.at(0.5) | left.at(0.0))
    assert placed.noise.both == (2.0, 2.0)
    assert (placed.noise.left, placed.noise.right) == (0.5, 1.0)
    assert whole.given.noise.both == (1.0, 1.0)


def test_a_course_that_differs_is_seen_and_what_never_compares_is_not():
    course = {"at": np.array([1.0, np.nan]), "count": 3}
    assert not sobol.courses_differ(course, course, {"at": np.array([1.0, np.nan]), "count": 3})
    assert sobol.courses_differ(course, course, course | {"count": 4})
    assert sobol.courses_differ(course, course, {"at": np.array([1.0, 2.0]), "count": 3})
    assert sobol.courses_differ(course, course, course | {"more": 1.0})
    first, again, other = ([lambda: None, 1.0] for _ in range(3))
    assert not sobol.courses_differ(first, again, other)


# ----------------------------------------------------------------- points against runs


def test_a_point_is_the_scenario_run_with_its_values():
    """The filter of the balloon is not told of outliers, so a run with `--set` is the same."""
    vary = ["outlier_share=0 to 0.2", "outlier_factor=2 to 50"]
    short = ("duration=20 s",)
    shares = np.array([[0.25, 0.5], [1.0, 0.0], [0.0, 0.7]])
    squares, *_ = sobol.simulate_points(budget_of(BALLOON, "gated", vary, short, 3), shares, 5)
    assert squares.shape == (3, 5, 2)
    settings = (*short, "outlier_share=0.05", "outlier_factor=10")
    alone = run(BALLOON, runs=5, seed=3, filters=("gated",), settings=settings).metrics["gated"]
    rms = np.ravel([alone["height_rms_m"], alone["climb_rms_m_per_s"]])
    np.testing.assert_allclose(np.sqrt(np.mean(squares[0], axis=0)), rms, rtol=1e-9)
    assert not np.allclose(squares[0], squares[1])


# World and key: a number of one structure of each system goes through its simulation untouched.
TRACED = {
    "transfer-alignment/aircraft": ("flexure.sigma", "start.attitude", "slave.gyro_slow"),
    "airship/s1": ("imu.gyro_noise", "start.position"),
    "ins-gnss/drive": ("gnss.lever_arm", "imu.gyro_bias", "start.tilt"),
}


@pytest.mark.parametrize("name", TRACED)
def test_worlds_take_numbers_that_are_traced(name):
    read = read_scenario(name, ())
    study, given = read.study, read.parameters
    course = study.lay_out(given)

    def simulated(numbers):
        placed = {}
        for key, number in zip(TRACED[name], numbers, strict=True):
            path = tuple(key.split("."))
            value = getattr(getattr(given, path[0]), path[1])
            axes = [(*path, k) for k in range(len(value))] if isinstance(value, tuple) else [path]
            placed |= dict.fromkeys(axes, number)
        study.simulate(sobol.with_numbers(given, placed), course, 0, jnp.asarray(0))
        return jnp.zeros(())

    jax.eval_shape(simulated, [jax.ShapeDtypeStruct((), float)] * len(TRACED[name]))


def test_a_filter_of_a_drive_is_told_what_the_scenario_says():
    told = jnp.eye(2), {POSITION: jnp.array([1.0, 1.0, 2.0])}
    drawn = Fix(jnp.full((4, 3), 9.0), jnp.ones((4, 3)))
    start = Belief(jnp.arange(2.0), 7.0 * jnp.eye(2))
    case = as_believed(told, Case(start, None, {}, {POSITION: drawn}, None))
    np.testing.assert_array_equal(case.start.factor, np.eye(2))
    np.testing.assert_array_equal(case.start.mean, start.mean)
    np.testing.assert_array_equal(case.aux[POSITION].sigma, np.tile([1.0, 1.0, 2.0], (4, 1)))
    np.testing.assert_array_equal(case.aux[POSITION].omega_b, drawn.omega_b)


# ------------------------------------------------------------------------ the closed form


def scalar_mean_squares(runs, seed):
    """(2,) of each instrument, noise of 1 m: a scalar Kalman filter of a constant, P = 4, R = 1."""
    whole = budget_of(PAIR, "kf", [LEFT])
    noise = np.stack(
        [whole.study.simulate(whole.given, whole.course, seed, k).y["pair"] for k in range(runs)]
    )
    steps = np.arange(1, noise.shape[1] + 1)
    error = np.cumsum(noise, axis=1) / (steps + 1.0 / 4.0)[None, :, None]
    return np.mean(error[:, 3:] ** 2, axis=(0, 1))


def quadrature(f, ends):
    """First-order and total indices of f(a, b) by Gauss and Legendre; the second by logarithm."""
    x, w = np.polynomial.legendre.leggauss(40)
    x, w = 0.5 * (x + 1.0), 0.5 * w
    (a0, a1), (b0, b1) = ends
    y = f((a0 + (a1 - a0) * x)[:, None], (b0 * (b1 / b0) ** x)[None])
    mean = w @ y @ w
    variance = w @ (y - mean) ** 2 @ w
    first = np.array([w @ (y @ w - mean) ** 2, w @ (w @ y - mean) ** 2]) / variance
    return mean, variance, first, 1.0 - first[::-1]


@pytest.fixture(scope="module")
def found():
    return sensitivity(PAIR, vary=[LEFT, RIGHT, "unused=1 m to 2 m"], runs=6, samples=1024, seed=2)


def index(found, order, block):
    return np.asarray(results.find(found.solution, f"sobol_{order}")[block])


def test_squares_of_independent_errors_add(found):
    """sqrt(a^2 A + b^2 B) of the noise a and b; A and B by the scalar filter."""
    A, B = scalar_mean_squares(6, 2)
    ends = (0.5, 2.0), (0.1, 3.0)
    mean, variance, first, total = quadrature(lambda a, b: np.sqrt(a**2 * A + b**2 * B), ends)
    assert total[0] - first[0] > 0.01  # they act together
    np.testing.assert_allclose(index(found, "first", "both")[:2], first, atol=0.02)
    np.testing.assert_allclose(index(found, "total", "both")[:2], total, atol=0.02)
    rms = np.asarray(results.find(found.solution, "sobol_rms")["both"])[: 2 * 1024]
    assert np.mean(rms) == pytest.approx(mean, rel=2e-3)
    assert np.var(rms) == pytest.approx(variance, rel=2e-2)


def test_each_block_has_the_index_of_its_own_instrument(found):
    for order in ("first", "total"):
        np.testing.assert_allclose(index(found, order, "left"), [1.0, 0.0, 0.0], atol=0.01)
        np.testing.assert_allclose(index(found, order, "right"), [0.0, 1.0, 0.0], atol=0.01)
    for order in ("first", "total"):
        low, value, high = (index(found, f"{order}{end}", "both") for end in ("_low", "", "_high"))
        assert np.all((low <= value) & (value <= high))


@pytest.mark.usefixtures("sketched")
def test_what_is_told_of_it(found, tmp_path):
    assert any("unused: changes no error" in one for one in found.warnings)
    assert not any("noise" in one and "changes no" in one for one in found.warnings)
    assert "noise.left uniform from 0.5 m to 2 m" in found.notes[1]
    assert "noise.right log-uniform from 0.1 m to 3 m" in found.notes[1]
    metrics = found.metrics["noise.right"]
    assert metrics["both_first_order"] == float(index(found, "first", "both")[1])
    assert metrics["both_total_order_bounds"][1] == float(index(found, "total_high", "both")[1])
    rows = list(csv.DictReader(io.StringIO(found.files["sensitivity.csv"].decode())))
    assert len(rows) == 9
    assert (rows[1]["parameter"], rows[1]["distribution"]) == ("noise.right", "log-uniform")
    assert float(rows[7]["total"]) == metrics["both_total_order"]
    points = list(csv.reader(io.StringIO(found.files["points.csv"].decode())))
    assert points[0][::3] == ["noise.left [m]", "left RMS [cm]"]
    drawn = np.array(points[1:], float)
    assert drawn.shape == (2048, 6)
    A, B = scalar_mean_squares(6, 2)
    both = 100.0 * np.sqrt(A * drawn[:, 0] ** 2 + B * drawn[:, 1] ** 2)
    np.testing.assert_allclose(drawn[:, 5], both, rtol=1e-9)
    result = publish(found, tmp_path / "r")
    blocks = ("left", "right", "both")
    assert set(result.figures) == {"sensitivity", *(f"sensitivity_{b}" for b in blocks)}


def test_bars_are_the_indices(found):
    picture = budget(found.solution)
    axes = next(a for a in picture.figure.axes if a.get_title("left") == "both")
    widths = [bar.get_width() for bar in axes.patches]
    want = [*index(found, "first", "both"), *index(found, "total", "both")]
    np.testing.assert_allclose(widths, want)
    ends = [[x for x, _ in line] for one in axes.collections for line in one.get_segments()]
    low, high = (index(found, f"first_{end}", "both") for end in ("low", "high"))
    np.testing.assert_allclose(ends[:3], np.stack([low, high], 1))


def test_points_are_drawn_over_their_parameter(found):
    left, right, _ = scatter(found.solution, "both").figure.axes
    points, mean = right.lines
    drawn = np.loadtxt(io.BytesIO(found.files["points.csv"]), delimiter=",", skiprows=1)
    np.testing.assert_allclose(0.1 * 30.0 ** points.get_xdata(), drawn[:, 1], rtol=1e-12)
    np.testing.assert_allclose(points.get_ydata(), drawn[:, 5], rtol=1e-12)
    first = points.get_xdata() < 0.1
    assert mean.get_xdata()[0] == pytest.approx(0.05)
    assert mean.get_ydata()[0] == pytest.approx(np.mean(drawn[first, 5]), rel=1e-12)
    assert [label.get_text() for label in right.get_xticklabels()] == ["0.1 m", "3 m"]
    assert left.get_ylabel() == "both RMS [cm]"


def test_the_greatest_share_stands_first(found):
    block, name, first, _, total, bounds = (list(c.cells) for c in table(found.solution).columns)
    assert [str(x) for x in block] == ["left", "", "", "right", "", "", "both", "", ""]
    assert [str(x) for x in name[6:8]] == ["noise.right", "noise.left"]
    assert str(first[6]) == f"{index(found, 'first', 'both')[1]:.2f}"
    assert str(total[7]) == f"{index(found, 'total', 'both')[0]:.2f}"
    low, high = (index(found, f"total_{end}", "both")[0] for end in ("low", "high"))
    assert str(bounds[7]) == f"{low:.2f} to {high:.2f}"


# ------------------------------------------------------------------------------- warnings


@pytest.mark.usefixtures("sketched")
def test_beliefs_that_follow_the_world_and_runs_that_diverge_are_told(tmp_path):
    vary, told = [LEFT, "begin=1 m to 3 m", "explode=0 m to 1 m"], []
    found = sensitivity(
        PAIR, vary=vary, runs=16, samples=4, progress=lambda share, what: told.append((share, what))
    )
    lost, begin = found.warnings
    assert "of 20 points 'kf' diverged" in lost
    assert begin.startswith("begin: what 'kf' believes at the start follows it")
    assert np.all(np.isnan(index(found, "total", "both")))
    assert len(found.last_lines) == 1
    assert publish(found, tmp_path / "r").summary["filters"]["explode"]["both_total_order"] is None
    shares = [share for share, _ in told]
    assert shares == sorted(shares)
    assert told[-1] == (1.0, "20 of 20 points")
    assert len(told) > 5


def test_errors_that_do_not_vary_and_wide_bounds_are_told(monkeypatch):
    def simulated(budget, shares, runs, progress):
        """RMS left: both parameters alike; right: a constant; both: the first alone."""
        first = shares[:, 0]
        rms = np.stack([1.0 + first + shares[:, 1], np.ones(len(shares)), 1.0 + first], axis=1)
        return np.repeat(rms[:, None] ** 2, runs, axis=1), np.zeros((len(shares), runs)), []

    monkeypatch.setattr(sys.modules[sensitivity.__module__], "simulate_points", simulated)
    found = sensitivity(PAIR, vary=[LEFT, RIGHT], runs=2, samples=64)
    still, wide = found.warnings
    assert "RMS error of right does not vary" in still
    assert np.all(np.isnan(index(found, "first", "right")))
    assert wide.startswith("left: the bounds of noise.")


def test_bounds_are_those_of_chance_in_points_and_in_runs():
    """Bounds are of the points where all runs are alike; more points bring them together."""
    shares = sobol.sobol_points(2, 256, 0)
    output = (shares[..., 0] + 0.5 * shares[..., 1] + 1.0)[..., None, None]
    alike = sobol.indices(np.repeat(output, 3, axis=2) ** 2, 1, 199)
    np.testing.assert_allclose(alike.first[0], [0.8, 0.2], atol=0.02)
    again = sobol.indices(np.repeat(output, 3, axis=2) ** 2, 1, 199)
    np.testing.assert_array_equal(alike, again)
    few = sobol.indices(np.repeat(output, 3, axis=2)[:, :16] ** 2, 1, 199)
    width = [x.total_high[0] - x.total_low[0] for x in (alike, few)]
    assert np.all(2.0 * width[0] < width[1])
    # runs of which each depends on another parameter: which of them were drawn decides
    apart = np.stack([shares[..., 0], shares[..., 1]], axis=2)[..., None]
    torn = sobol.indices((1.0 + apart) ** 2, 1, 199)
    assert np.all(torn.total_high[0] - torn.total_low[0] > 0.8)
    np.testing.assert_allclose(torn.first[0], [0.5, 0.5], atol=0.05)


def test_an_output_that_is_lost_leaves_the_others():
    shares = sobol.sobol_points(1, 8, 0)
    output = np.repeat(1.0 + shares[..., None], 2, axis=-1)
    output[0, 3, 0, 1] = np.inf
    found = sobol.indices(output, 0, 9)
    assert np.isfinite(found.total[0]).all()
    assert np.isnan(found.total[1]).all()


def test_points_are_saltellis():
    A, B, *mixed = sobol.sobol_points(3, 8, 5)
    assert not np.any(A == B)
    for i, one in enumerate(mixed):
        changed = np.arange(3) == i
        np.testing.assert_array_equal(one[:, changed], B[:, changed])
        np.testing.assert_array_equal(one[:, ~changed], A[:, ~changed])
    np.testing.assert_array_equal(sobol.sobol_points(3, 8, 5)[0], A)
