"""The command `design`: a problem read, its filters designed, the curve written and drawn."""

import contextlib
import csv
import io
import json
import sys

import numpy as np
import pytest

from robins import report, results
from robins.cli import main
from robins.filters.synthesis import certify, riccati
from robins.workbench.design import as_text
from robins.workbench.design_problem import read_problem
from robins.workbench.list import designs

METHODS = ("riccati", "lmi-common", "retuned-slack")
TWO_STATES = """
title = "Two states"
form = "prediction"
A = [[0.9, 0.2], [-0.1, 0.8]]
Bw = [[0.3, 0, 0], [0, 0.3, 0]]
Bn = [[0], [0.4]]
C = [[1, 0]]
Dw = [[0, 0, 0.5]]
gamma = [1, 0.7]
units = { z = "m", n = "m/s" }
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Output of the command, and its result."""
    folder, said = tmp_path_factory.mktemp("design"), io.StringIO()
    (folder / "two.toml").write_text(TWO_STATES)
    with (
        contextlib.chdir(folder),
        contextlib.redirect_stdout(said),
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setenv("COLUMNS", "200")
        assert main(["design", "two.toml", "--methods", ",".join(METHODS)]) == 0
    return said.getvalue(), results.read(folder / "results" / "design-two")


def test_the_table_says_what_each_method_reaches(made):
    out, result = made
    columns = result.summary["filters"]
    assert list(columns) == ["kalman", "riccati", "lmi-common", "retuned-slack"]
    assert columns["kalman"] == pytest.approx({"h2": 0.6571125579, "hinf": 1.70093599}, rel=1e-8)
    assert columns["riccati"]["h2_at_gamma_1"] == pytest.approx(0.9420, abs=5e-5)
    assert columns["riccati"]["hinf_at_gamma_1"] == pytest.approx(1.0, rel=1e-8)
    assert columns["riccati"]["h2_at_gamma_0.7"] == "cannot, least 0.7244"
    assert columns["riccati"]["hinf_at_gamma_0.7"] is None
    assert columns["lmi-common"]["h2_at_gamma_0.7"] == pytest.approx(2.5916, rel=1e-3)
    assert columns["retuned-slack"]["h2_at_gamma_0.7"] == pytest.approx(2.4225, rel=1e-3)
    for text in (
        "Two states",
        "cannot, least 0.7244",
        "The Kalman filter has H2 0.6571 m and Hinf 1.701 m/(m/s); the least Hinf of any gain is "
        "0.5945 m/(m/s) (the Riccati recursion of the game proves it at step 3).",
        "gamma 1: least H2 0.9066 m by retuned-slack, +38.0% of the Kalman filter's.",
        "Gains:  results/design-two/gains.json",
        "Next:   kalman(taylor(), [channel_inflation(16.4595, Bn)])",
    ):
        assert text in out


def test_the_gains_have_every_digit_and_are_what_is_said(made):
    _, result = made
    told = json.loads((result.path / "gains.json").read_text())
    p = read_problem(str(result.path.parents[1] / "two.toml")).plant
    assert told["least_gamma"] == pytest.approx(0.594542, abs=1e-6)
    assert len(told["designs"]) == 1 + 3 + 2
    for design in told["designs"]:
        again = certify(p, design["K"], method=design["method"])
        assert (again.h2, again.hinf) == pytest.approx((design["h2"], design["hinf"]), rel=1e-12)
    (one,) = [d for d in told["designs"] if d["method"] == "riccati"]
    assert np.array_equal(one["K"], riccati(p, 1.0).gain)
    assert one["lambda"] == riccati(p, 1.0).lambda_
    (refused,) = told["not_reached"]
    assert (refused["method"], refused["gamma"]) == ("riccati", 0.7)
    assert refused["least"] == pytest.approx(0.724431, abs=1e-6)
    assert told["blocks"]["Dw"] == [[0, 0, 0.5]]


def test_the_curve_is_a_table_and_arrays(made):
    _, result = made
    with (result.path / "trade_off.csv").open() as file:
        rows = list(csv.DictReader(file))
    points = [(name, gamma) for gamma in (1, 0.7) for name in METHODS]
    assert [(r["method"], float(r["gamma"])) for r in rows] == [("kalman", np.inf), *points]
    assert rows[4]["h2"] == ""
    assert "cannot reach gamma 0.7" in rows[4]["not_reached"]
    solution = result.solution
    h2 = solution["trade_off_h2"].sel(design="lmi-common").values
    assert h2.tolist() == [float(rows[2]["h2"]), float(rows[5]["h2"])]
    assert solution["trade_off_h2"].attrs["units"] == "m"
    assert np.isnan(solution["trade_off_h2"].sel(design="riccati").values).tolist() == [False, True]


def test_the_figure_shows_every_design(made):
    _, result = made
    assert (result.path / "figures" / "trade_off.png").stat().st_size > 10_000
    (picture,) = report.pictures(result.solution, result.summary)
    above, below = picture.figure.axes
    legend = {text.get_text() for text in picture.figure.legends[0].texts}
    assert legend == {*METHODS, "Kalman filter", "least of any gain"}
    hinf, h2 = above.lines[1].get_data()
    wanted = result.solution.sel(design="lmi-common").sortby("trade_off_hinf")
    np.testing.assert_array_equal(hinf, wanted["trade_off_hinf"])
    np.testing.assert_array_equal(h2, wanted["trade_off_h2"])
    kalman = above.lines[3].get_data()
    assert np.ravel(kalman) == pytest.approx([1.70093599, 0.6571125579])
    assert above.lines[4].get_xdata()[0] == pytest.approx(0.594542, abs=1e-6)
    gamma, lost = below.lines[1].get_data()
    assert gamma.tolist() == [1.0, 0.7]
    least = [100 * (0.98375 / 0.90657 - 1), 100 * (2.5916 / 2.4225 - 1)]
    assert lost == pytest.approx(least, rel=0.02)
    assert above.get_ylabel() == "H2 norm [m]"
    assert below.get_xlabel().endswith("[m/(m/s)]")
    page = (result.path / "report.html").read_text()
    assert "What a bound on the worst case costs" in page
    assert "cannot, least 0.7244" in page
    assert "Two states" in page  # the problem as it was given


def test_json_is_the_summary_and_nothing_else(robins):
    answer = robins("design", "baro-height", "--gamma", "10,5", "--methods", "riccati", "--json")
    assert answer.status == 0
    told = json.loads(answer.out)
    assert told["scenario"] == "design/baro-height"
    assert list(told["filters"]["riccati"]) == [
        "h2_at_gamma_10", "hinf_at_gamma_10", "h2_at_gamma_5", "hinf_at_gamma_5",
    ]  # fmt: skip
    assert set(told["files"]["other"]) >= {"gains.json", "trade_off.csv"}


@pytest.mark.parametrize("name", designs())
def test_every_example_is_designed(robins, name):
    answer = robins("design", name, "--methods", "riccati")
    assert answer.status == 0, answer.err
    assert "least H2" in answer.out
    assert f"results/design-{name}" in answer.out


def test_the_attitude_axis_is_that_of_the_specification(robins, tmp_path):
    answer = robins("design", "attitude-axis", "--gamma", "2.7542", "--methods", "riccati")
    assert answer.status == 0
    columns = results.read(tmp_path / "results" / "design-attitude-axis").summary["filters"]
    assert columns["kalman"] == pytest.approx({"h2": 2.884756, "hinf": 5.508426}, abs=5e-7)
    assert columns["riccati"]["h2_at_gamma_2.754"] == pytest.approx(3.1983, abs=5e-5)


def test_without_the_extra_it_says_what_is_missing(robins, monkeypatch):
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    answer = robins("design", "two-states", "--gamma", "1,0.7")
    assert answer.status == 0, answer.err
    needing = "lmi-common, lmi-slack, retuned-common, retuned-slack, full-order"
    assert f"Left out: {needing}; they need" in answer.out
    assert "pip install 'robins[design]'" in answer.out
    assert "the least Hinf of any gain is 0.5945 (" in answer.out
    assert "gamma 0.7: no method of these reaches it." in answer.out


def test_gammas_are_written_as_short_as_tells_them_apart():
    assert as_text([1.0, 0.5, 0.123456]) == ["1", "0.5", "0.1235"]
    assert as_text([1.00001, 1.00002]) == ["1.00001", "1.00002"]
    assert as_text([]) == []


def changed(old, new):
    assert old in TWO_STATES
    return TWO_STATES.replace(old, new)


EYE = np.eye(4).tolist()
OF_THE_DOCUMENT = f"""
form = "prediction"
A = {EYE}
Bw = {EYE}
C = {EYE}
Dn = {EYE}
Bn = {np.eye(4)[:, 1:].tolist()}
"""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("A = [", "two.toml: is not TOML"),
        (changed('"prediction"', '"predicton"'), "form must be"),
        (changed("C = [[1, 0]]", ""), "C is missing; form 'prediction' takes A, Bw, Bn, C, Dw"),
        (changed("Dw", "Dv"), "there is no 'Dv'; form 'prediction' takes the matrices A, Bw"),
        (changed('"prediction"', '"current"'), "Dv is missing; form 'current' takes A, Bw, Bn"),
        (changed("[[1, 0]]", "[[1, 0, 0]]"), "C is (1, 3), must be (1, 2): A says that x has 2"),
        (changed("[[0], [0.4]]", "[0, 0.4]"), "Bn has shape (2,), a matrix (rows of numbers)"),
        (changed("[[0, 0, 0.5]]", "[[0.5]]"), "Dw is (1, 1), must be (1, 3)"),
        (changed("[0, 0.3, 0]]", "[0, 0.3]]"), "Bw is no matrix: its rows differ in length"),
        (changed("0.5", '"5 m"'), "Dw holds <U"),
        (changed("0.9, 0.2", "nan, 0.2"), "A[0, 0] is nan, not a finite number"),
        (changed("[[0.9, 0.2], [-0.1, 0.8]]", "[[0.9, 0], [0, 1.2]]"), "mode of A at 1.2 does not"),
        (changed("[1, 0.7]", "[]"), "gamma must be a number or a list of numbers"),
        (changed("[1, 0.7]", '"1"'), "gamma must be a number or a list of numbers, got '1'"),
        (changed("[1, 0.7]", "-1"), "gamma must be positive"),
        (
            changed("[1, 0.7]", "[0.5]"),
            "gamma 0.5 is below the least that any gain can have, 0.594542",
        ),
        (changed('{ z = "m", n = "m/s" }', '{ y = "m" }'), "units must be a table with z and n"),
        (changed('z = "m"', "z = 1"), "units must be text"),
        (changed("[[0, 0, 0.5]]", "[[0, 0, 0]]") + "L = [[1]]", "L is (1, 1), must have one row"),
        (
            OF_THE_DOCUMENT,
            "Dn is (4, 4), must be (4, 3): C says that y has 4 components and Bn that n has 3",
        ),
    ],
)
def test_a_problem_that_does_not_fit_is_refused_in_a_line(robins, tmp_path, text, message):
    (tmp_path / "two.toml").write_text(text)
    answer = robins("design", "two.toml")
    assert answer.status == 2
    assert message in answer.err
    assert len(answer.err.splitlines()) == 1
    assert not (tmp_path / "results" / "design-two").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nothing.toml"], "nothing.toml: no such file, and no example of that name; there are"),
        (["two-states", "--gamma", "one"], "--gamma 'one': give numbers"),
        (["two-states", "--gamma", "0.5"], "below the least that any gain can have, 0.594542"),
        (["two-states", "--methods", "ricatti"], "no method 'ricatti'; there are riccati,"),
    ],
)
def test_bad_usage(robins, arguments, message):
    answer = robins("design", *arguments)
    assert answer.status == 2
    assert message in answer.err
    assert answer.out == ""
