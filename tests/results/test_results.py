"""Results come back as they were written, or are refused."""

import json
import math
import re
import subprocess

import h5py
import numpy as np
import pytest
import xarray as xr
from example_folder import a_solution, a_summary, names, write

import robins
from robins import results
from robins.results import (
    ResultError,
    ResultWriter,
    array,
    manifest,
    read,
    solution,
    summary,
    variable,
)

# ------------------------------------------------------------------------------- there and back


def test_everything_comes_back(tmp_path):
    path = tmp_path / "out"
    text = 'name = "walk"  # Ångström\n'
    with ResultWriter(path, scenario_text=text, device="gpu:0", command="robins run x") as writer:
        writer.save_solution(a_solution())
        writer.save_summary(a_summary(filters={"a": {"x_m": np.float64(2.5), "y": np.arange(2)}}))
        writer.save_file("figures/track.png", b"png")
        writer.save_report("<p>ü</p>")
        writer.save_file("other/path.csv", b"1,2\n")
    back = read(path)
    assert back.path == path
    assert back.solution.identical(a_solution())
    error = a_solution()["error_attitude"].values
    assert back.solution["error_attitude"].values.tobytes() == error.tobytes()
    assert back.solution["count"].dtype == np.int64
    assert back.solution["outage"].dtype == bool
    assert back.summary["filters"] == {"a": {"x_m": 2.5, "y": [0, 1]}}
    assert back.summary["files"] == {
        "summary": "summary.json",
        "manifest": "manifest.json",
        "solution": "solution.nc",
        "report": "report.html",
        "figures": ["figures/track.png"],
        "other": ["other/path.csv"],
    }
    assert list(back.summary) == [
        *("scenario", "seed", "runs", "filters", "claims", "counts", "warnings", "files", "seconds")
    ]
    assert back.figures["track"].read_bytes() == b"png"
    assert back.report.read_text("utf-8") == "<p>ü</p>"
    made = back.manifest
    assert made["scenario"]["text"] == text
    assert made["seed"] == 7
    assert made["complete"] is True
    assert (made["device"], made["command"]) == ("gpu:0", "robins run x")
    assert made["versions"]["numpy"] == np.__version__
    assert made["versions"]["robins"] == robins.__version__
    assert made["files"]["other/path.csv"]["size"] == 4
    assert set(made["files"]) == {
        *("summary.json", "solution.nc", "report.html", "figures/track.png", "other/path.csv")
    }


def test_a_run_without_any_update_comes_back(tmp_path):
    empty = xr.Dataset(
        array("innovation", np.zeros((1, 0, 3)), "gnss", unit="m", frame="NED"),
        coords={"gnss_time": variable("gnss_time", np.zeros(0), "s", "time"), "filter": ["a"]},
    )
    write(tmp_path / "out", a_summary(), empty)
    back = read(tmp_path / "out").solution
    assert back.identical(empty)
    write(tmp_path / "again", a_summary(), back)  # what was read can be written
    assert read(tmp_path / "again").solution.identical(empty)


def test_the_checksums_are_those_of_a_common_tool(earlier):
    for name, entry in read(earlier).manifest["files"].items():
        printed = subprocess.check_output(["sha256sum", earlier / name], text=True)
        assert printed.split()[0] == entry["sha256"]


def test_a_result_without_time_series(tmp_path):
    write(tmp_path / "out", a_summary())
    back = read(tmp_path / "out")
    assert back.solution is None
    assert back.report is None
    assert back.figures == {}


def test_seconds_are_measured_if_not_given(tmp_path):
    summary = {key: value for key, value in a_summary().items() if key != "seconds"}
    write(tmp_path / "out", summary)
    assert 0.0 <= read(tmp_path / "out").summary["seconds"] < 60.0


# ------------------------------------------------------------------------------ what is accepted


def test_what_is_not_a_number_becomes_null(tmp_path):
    metrics = {"a_m": math.nan, "b_m": [1.0, -math.inf], "c_m": np.array([np.nan, 2.0])}
    write(tmp_path / "out", a_summary(filters={"k": metrics}))
    text = (tmp_path / "out" / "summary.json").read_text("utf-8")
    strict = json.loads(text, parse_constant=pytest.fail)
    assert strict["filters"]["k"] == {"a_m": None, "b_m": [1.0, None], "c_m": [None, 2.0]}


A_CLAIM = {"id": "c", "text": "t", "verdict": "not", "value": 1.0, "band": [0, 1]}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 1.5}, "summary.seed: 1.5 is not a whole number"),
        ({"runs": True}, "summary.runs: True is not a whole number"),
        ({"machine": 1}, "summary.machine: 1 is not text"),
        ({"scenario": None}, "summary.scenario: None is not text"),
        ({"extra": 1}, "unknown key 'extra'"),
        ({"filters": {"k": 3.0}}, "summary.filters.k: 3.0 does not map"),
        ({"filters": {"k": {"x": 1j}}}, "summary.filters.k.x: complex has no form"),
        ({"filters": {"k": {"x": [{1}]}}}, r"summary.filters.k.x\[0\]: set has no form"),
        ({"filters": {"k": {1: 1.0}}}, "summary.filters.k: the key 1 is not text"),
        ({"claims": [A_CLAIM | {"verdict": "yes"}]}, r"claims\[0\].verdict: 'yes' is none of"),
        ({"claims": [{"id": "c"}]}, r"claims\[0\]: needs exactly the keys id, text"),
        ({"warnings": [3]}, r"summary.warnings\[0\]: 3 is not a sentence"),
        ({"counts": {"nan": 1.5}}, "summary.counts.nan: 1.5 is not a whole number"),
    ],
)
def test_a_wrong_summary_is_refused_by_name(tmp_path, changes, message):
    with pytest.raises((TypeError, ValueError), match=message):
        write(tmp_path / "out", a_summary(**changes))
    assert names(tmp_path) == []


def test_a_missing_key_is_refused(tmp_path):
    summary = {key: value for key, value in a_summary().items() if key != "counts"}
    with pytest.raises(ValueError, match="'counts' is missing"):
        write(tmp_path / "out", summary)


def without(attr):
    solution = a_solution()
    del solution["error_attitude"].attrs[attr]
    return solution


def test_a_result_of_others_whose_checksums_fit(tmp_path):
    path = tmp_path / "out"
    write(path, a_summary())
    made = json.loads((path / "manifest.json").read_text())

    def sealed(**more):
        rest = {k: v for k, v in (made | more).items() if k != "sha256"}
        seal = manifest._seal(rest)
        (path / "manifest.json").write_text(summary.dumps(rest | {"sha256": seal}))

    for files in (None, {"summary.json": 3}, {"summary.json": {"size": 1}}):
        sealed(files=files)
        with pytest.raises(ResultError, match=r"manifest.json is damaged: it lists no files"):
            read(path)
    for content, why in (("[" * 5000, "RecursionError"), ("[]", "it lists no files")):
        (path / "summary.json").write_text(content)
        sealed(files={"summary.json": manifest.digest(path / "summary.json")})
        with pytest.raises(ResultError, match=f"summary.json is damaged.*{why}"):
            read(path)


@pytest.mark.parametrize(("rows", "chunk"), [(10**12, 1000), (10, 1 << 27)])
def test_sizes_that_a_solution_declares_are_not_believed(tmp_path, rows, chunk):
    path = tmp_path / "solution.nc"
    with h5py.File(path, "w") as file:
        file.create_dataset("x", (rows,), "<f8", chunks=(chunk,), maxshape=(None,))
    assert path.stat().st_size < 20_000
    with pytest.raises(ResultError, match=r"is damaged: it would take [0-9]{10,} bytes"):
        solution.read(path)
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    with pytest.raises(ResultError, match=r"solution.nc: is damaged: "):
        solution.read(path)


@pytest.mark.parametrize(
    ("solution", "message"),
    [
        (without("units"), "error_attitude: the attribute 'units' is missing"),
        (without("long_name"), "error_attitude: the attribute 'long_name' is missing"),
        (without("frame"), "error_attitude: has components along axes, but no attribute 'frame'"),
        (
            xr.Dataset({"x": variable((), 1.0, "rad", "x", display_unit="mg")}),
            "x: the attribute 'display_unit': mg is an acceleration; an angle",
        ),
        (xr.Dataset({"x": ("t", [1j])}), "x: arrays of complex128 are not stored"),
        (xr.Dataset({"x": ((), 1.0)}), "x: the attribute 'units'"),
        (xr.Dataset({"x": variable((), 1.0, "1", "x", a=None)}), "x: the attribute 'a'"),
        (xr.Dataset({"x": variable((), 1.0, "1", "x")}), "x: the attribute 'role' is missing"),
        (a_solution().rename(outage="lost"), "lost: by its role it is called outage"),
        (xr.Dataset(coords={"t": [1.0]}), "t: the attribute 'units' is missing"),
    ],
)
def test_an_array_that_could_be_misread_is_refused(tmp_path, solution, message):
    with pytest.raises(ValueError, match=message):
        write(tmp_path / "out", a_summary(), solution)
    assert names(tmp_path) == []


@pytest.mark.parametrize("name", ["../x", "/x", "", "a/../../x", "summary.json", "manifest.json"])
def test_a_file_that_is_not_ours_to_write_is_refused(tmp_path, name):
    with ResultWriter(tmp_path / "out") as writer:
        writer.save_summary(a_summary())
        with pytest.raises(ValueError, match=r"lie inside|written by robins"):
            writer.save_file(name, b"")


def test_a_result_needs_a_summary(tmp_path):
    with pytest.raises(ResultError, match="has no summary"), ResultWriter(tmp_path / "out"):
        pass
    assert names(tmp_path) == []


# -------------------------------------------------------------------------------- damage is found


def test_what_is_no_result_is_refused(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder").mkdir()
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "manifest.json").write_text('{"name": "an app"}')
    for name, reason in {
        "none": "does not exist",
        "file": "is not a folder",
        "folder": "it has no manifest.json",
        "foreign": "manifest.json is not one of robins",
    }.items():
        with pytest.raises(ResultError, match=reason) as caught:
            read(tmp_path / name)
        assert caught.value.path == tmp_path / name
        assert caught.value.fix in str(caught.value)


def rewrite_manifest(path, **changes):
    """Change the manifest as a writer would, its own checksum included."""
    file = path / "manifest.json"
    made = json.loads(file.read_text("utf-8")) | changes
    made["sha256"] = results.manifest._seal(made)
    file.write_text(results.summary.dumps(made), "utf-8")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schema": 2}, r"has schema version 2, this robins reads 1; read it with the version"),
        ({"schema": 0}, "has schema version 0"),
        ({"schema": "1"}, "is not one of robins"),
        ({"complete": False}, "is not complete"),
        ({"complete": None}, "is not complete"),
    ],
)
def test_another_version_or_an_incomplete_result_is_refused(earlier, changes, message):
    rewrite_manifest(earlier, **changes)
    with pytest.raises(ResultError, match=message):
        read(earlier)


def test_a_file_cut_anywhere_is_refused(earlier):
    for name in ("solution.nc", "summary.json", "manifest.json"):
        whole = (earlier / name).read_bytes()
        for size in {0, 1, len(whole) - 1, *np.linspace(0, len(whole) - 1, 60).astype(int)}:
            (earlier / name).write_bytes(whole[:size])
            with pytest.raises(ResultError, match=f"{name} is damaged"):
                read(earlier)
        (earlier / name).unlink()
        with pytest.raises(ResultError, match=r"is missing|has no manifest\.json"):
            read(earlier)
        (earlier / name).write_bytes(whole)
    read(earlier)


def test_a_flipped_bit_anywhere_is_refused(earlier):
    for name in ("solution.nc", "summary.json", "manifest.json"):
        whole = (earlier / name).read_bytes()
        for at in np.linspace(0, len(whole) - 1, 120).astype(int):
            flipped = bytearray(whole)
            flipped[at] ^= 1 << (at % 8)
            (earlier / name).write_bytes(flipped)
            with pytest.raises(ResultError, match=re.escape(name)):
                read(earlier)
        (earlier / name).write_bytes(whole)
    read(earlier)


def test_bytes_behind_the_end_are_refused(earlier):
    (earlier / "solution.nc").write_bytes((earlier / "solution.nc").read_bytes() + b"\0")
    with pytest.raises(ResultError, match=r"solution\.nc is damaged: it has"):
        read(earlier)


def test_notes_of_the_user_do_not_disturb_reading(earlier):
    (earlier / "notes.txt").write_text("seen")
    assert read(earlier).summary["seed"] == 1
