"""A result is whole and true, or it is refused; what was there before survives every failure."""

import errno
import json
import math
import os
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

import robins
from robins import results
from robins.results import ResultError, ResultWriter, folder, read, variable, write


def a_summary(**changes):
    return {
        "scenario": "walk/street",
        "seed": 7,
        "runs": 1,
        "filters": {"kalman": {"horizontal_rms_m": 0.03}},
        "claims": [],
        "counts": {"nan": 2},
        "seconds": 1.5,
    } | changes


def a_solution(scale=1.0):
    rng = np.random.default_rng(0)
    error = scale * rng.normal(size=(2, 50, 3))
    error[0, 3, 1] = np.nan
    axes = ["roll", "pitch", "heading"]
    return xr.Dataset(
        {
            "error_attitude": variable(
                ("filter", "time", "axis_attitude"),
                error,
                "rad",
                "attitude error",
                frame="NED",
                display_unit="deg",
            ),
            "outage": variable("time", np.arange(50) > 40, "1", "aids withheld"),
            "count": variable((), np.int64(2**40 + 1), "1", "number of samples"),
        },
        coords={
            "filter": ["kalman", "robust – ü"],
            "axis_attitude": axes,
            "time": variable("time", np.linspace(0.1, 5.0, 50), "s", "time"),
        },
    )


def a_figure():
    figure = Figure()
    figure.subplots().plot([1, 2, 3])
    return figure


def names(path):
    """Everything a writer could leave behind, hidden folders included."""
    return sorted(p.name for p in path.iterdir())


@pytest.fixture
def earlier(tmp_path):
    """A folder with one result, written with seed 1."""
    write(tmp_path / "out", a_summary(seed=1), a_solution())
    return tmp_path / "out"


# ------------------------------------------------------------------------------- there and back


def test_everything_comes_back(tmp_path):
    path = tmp_path / "out"
    text = 'name = "walk"  # Ångström\n'
    with ResultWriter(path, scenario_text=text, device="gpu:0", command="robins run x") as writer:
        writer.save_solution(a_solution())
        writer.save_summary(a_summary(filters={"a": {"x_m": np.float64(2.5), "y": np.arange(2)}}))
        writer.figure("track", a_figure())
        writer.save_report("<p>ü</p>")
        writer.save_file("other/path.csv", b"1,2\n")
    back = read(path)
    assert back.path == path
    assert back.solution.identical(a_solution())
    assert back.solution["error_attitude"].values.tobytes() == (
        a_solution()["error_attitude"].values.tobytes()
    )
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
        *("scenario", "seed", "runs", "filters", "claims", "counts", "files", "seconds")
    ]
    assert back.figures["track"].read_bytes().startswith(b"\x89PNG")
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
    dims = ("filter", "update_time", "axis_gnss")
    empty = xr.Dataset(
        {"innovation_gnss": variable(dims, np.zeros((1, 0, 3)), "m", "innovation", "NED")},
        coords={"update_time": variable("update_time", np.zeros(0), "s", "time"), "filter": ["a"]},
    )
    write(tmp_path / "out", a_summary(), empty)
    back = read(tmp_path / "out").solution
    assert back.identical(empty)
    write(tmp_path / "again", a_summary(), back)  # what was read can be written
    assert read(tmp_path / "again").solution.identical(empty)


def test_the_checksums_are_those_of_a_common_tool(earlier):
    for name, entry in read(earlier).manifest["files"].items():
        printed = subprocess.run(
            ["sha256sum", earlier / name], capture_output=True, text=True, check=True
        ).stdout
        assert printed.split()[0] == entry["sha256"]


def test_a_result_without_time_series(tmp_path):
    write(tmp_path / "out", a_summary())
    back = read(tmp_path / "out")
    assert back.solution is None
    assert back.report is None
    assert back.figures == {}


def test_same_figure_same_bytes(tmp_path):
    for name in "ab":
        write(tmp_path / name, a_summary(), figures={"x": a_figure()})
    a, b = (read(tmp_path / name).figures["x"].read_bytes() for name in "ab")
    assert a == b


def test_seconds_are_measured_if_not_given(tmp_path):
    summary = a_summary()
    del summary["seconds"]
    write(tmp_path / "out", summary)
    assert 0.0 <= read(tmp_path / "out").summary["seconds"] < 60.0


# ------------------------------------------------------------------------------ what is accepted


def test_what_is_not_a_number_becomes_null(tmp_path):
    metrics = {"a_m": math.nan, "b_m": [1.0, -math.inf], "c_m": np.array([np.nan, 2.0])}
    write(tmp_path / "out", a_summary(filters={"k": metrics}))
    text = (tmp_path / "out" / "summary.json").read_text("utf-8")

    def refuse(constant):
        raise AssertionError(constant)

    strict = json.loads(text, parse_constant=refuse)
    assert strict["filters"]["k"] == {"a_m": None, "b_m": [1.0, None], "c_m": [None, 2.0]}


A_CLAIM = {"id": "c", "text": "t", "verdict": "not", "value": 1.0, "band": [0, 1]}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 1.5}, "summary.seed: 1.5 is not a whole number"),
        ({"runs": True}, "summary.runs: True is not a whole number"),
        ({"scenario": None}, "summary.scenario: None is not text"),
        ({"extra": 1}, "unknown key 'extra'"),
        ({"filters": {"k": 3.0}}, "summary.filters.k: 3.0 does not map"),
        ({"filters": {"k": {"x": 1j}}}, "summary.filters.k.x: complex has no form"),
        ({"filters": {"k": {"x": [{1}]}}}, r"summary.filters.k.x\[0\]: set has no form"),
        ({"filters": {"k": {1: 1.0}}}, "summary.filters.k: the key 1 is not text"),
        ({"claims": [A_CLAIM | {"verdict": "yes"}]}, r"claims\[0\].verdict: 'yes' is none of"),
        ({"claims": [{"id": "c"}]}, r"claims\[0\]: needs exactly the keys id, text"),
        ({"counts": {"nan": 1.5}}, "summary.counts.nan: 1.5 is not a whole number"),
    ],
)
def test_a_wrong_summary_is_refused_by_name(tmp_path, changes, message):
    with pytest.raises((TypeError, ValueError), match=message):
        write(tmp_path / "out", a_summary(**changes))
    assert names(tmp_path) == []


def test_a_missing_key_is_refused(tmp_path):
    summary = a_summary()
    del summary["counts"]
    with pytest.raises(ValueError, match="'counts' is missing"):
        write(tmp_path / "out", summary)


def without(attr):
    solution = a_solution()
    del solution["error_attitude"].attrs[attr]
    return solution


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
        assert caught.value.mend in str(caught.value)


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
    with open(earlier / "solution.nc", "ab") as file:
        file.write(b"\0")
    with pytest.raises(ResultError, match=r"solution\.nc is damaged: it has"):
        read(earlier)


def test_notes_of_the_user_do_not_disturb_reading(earlier):
    (earlier / "notes.txt").write_text("seen")
    assert read(earlier).summary["seed"] == 1


# ------------------------------------------------------------------- nothing of the user is lost


def test_a_folder_of_the_user_is_not_replaced(tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("years of work")
    with pytest.raises(ResultError, match="not a result of robins; choose a new folder"):
        ResultWriter(tmp_path / "thesis")
    assert (tmp_path / "thesis" / "chapter.tex").read_text() == "years of work"
    assert names(tmp_path) == ["thesis"]


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"schema": "1"}', '{"schema": 1, "files": 3}'])
def test_a_folder_with_a_manifest_of_something_else_is_not_replaced(tmp_path, text):
    (tmp_path / "app").mkdir()
    (tmp_path / "app" / "manifest.json").write_text(text)
    with pytest.raises(ResultError, match="choose a new folder"):
        ResultWriter(tmp_path / "app")
    assert names(tmp_path / "app") == ["manifest.json"]


def test_a_result_with_notes_of_the_user_is_not_replaced(earlier):
    (earlier / "notes.txt").write_text("seen")
    with pytest.raises(ResultError, match=r"holds 'notes\.txt', which robins did not write"):
        write(earlier, a_summary())
    (earlier / "notes.txt").rename(earlier / ".DS_Store")
    write(earlier, a_summary(seed=2))
    assert read(earlier).summary["seed"] == 2


def test_notes_added_while_the_run_goes_on_are_kept(earlier):
    writer = ResultWriter(earlier)
    writer.save_summary(a_summary())
    (earlier / "notes.txt").write_text("seen")
    with pytest.raises(ResultError, match=r"holds 'notes\.txt'"), writer:
        pass
    assert (earlier / "notes.txt").read_text() == "seen"
    assert names(earlier.parent) == ["out"]


def test_the_folder_one_stands_in_is_not_replaced(earlier, monkeypatch):
    monkeypatch.chdir(earlier)
    for path in (".", "..", earlier):
        with pytest.raises(ResultError, match="is the folder you are in"):
            ResultWriter(path)
    write("inner", a_summary())
    assert read(earlier / "inner").summary["seed"] == 7


def test_a_mount_point_is_refused_before_the_work(tmp_path, monkeypatch):
    (tmp_path / "mnt").mkdir()
    monkeypatch.setattr(os.path, "ismount", lambda path: Path(path) == tmp_path / "mnt")
    with pytest.raises(ResultError, match="is a mount point; choose a folder inside it"):
        ResultWriter(tmp_path / "mnt")


def test_an_empty_folder_is_used(tmp_path):
    (tmp_path / "out").mkdir()
    write(tmp_path / "out", a_summary())
    assert read(tmp_path / "out").summary["seed"] == 7
    assert names(tmp_path) == ["out"]


def test_a_linked_folder_is_replaced_where_it_lies(earlier):
    link = earlier.parent / "latest"
    link.symlink_to(earlier)
    write(link, a_summary(seed=2))
    assert link.is_symlink()
    assert read(earlier).summary["seed"] == 2


@pytest.mark.parametrize("name", ["x" * 255, "ä" * 127, "with space", "ﷺ 航法", "-n", "a'b\"c"])
def test_odd_names_work(tmp_path, name):
    for seed in (1, 2):
        write(tmp_path / name, a_summary(seed=seed), a_solution())
    assert read(tmp_path / name).summary["seed"] == 2
    assert names(tmp_path) == [name]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("x" * 256, "name too long; choose a shorter name"),
        ("file", "is a file, not a folder"),
        ("file/out", "choose a path whose parents are folders"),
        ("/dev/full", "is a file, not a folder"),
        ("/dev/full/out", "choose a path whose parents are folders"),
    ],
)
def test_impossible_paths_are_refused_before_the_work(tmp_path, name, message):
    (tmp_path / "file").write_text("x")
    with pytest.raises(ResultError, match=rf"(?i){message}"):
        ResultWriter(tmp_path / name)
    assert names(tmp_path) == ["file"]


# ------------------------------------------------------------------ failures leave what was there


def still_there(earlier):
    assert read(earlier).summary["seed"] == 1
    assert names(earlier.parent) == ["out"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit, MemoryError])
def test_a_failure_in_between_leaves_the_earlier_result(earlier, error):
    def run():
        with ResultWriter(earlier) as writer:
            writer.save_solution(a_solution(2.0))
            writer.save_summary(a_summary())
            raise error

    with pytest.raises(error):
        run()
    still_there(earlier)


def test_parents_made_for_a_failed_result_go_with_it(tmp_path):
    writer = ResultWriter(tmp_path / "a" / "b" / "out")
    assert names(tmp_path) == ["a"]
    writer.discard()
    assert names(tmp_path) == []


def full_disk(*_args, **_kwargs):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("what", ["solution", "figure", "summary.json", "manifest.json", "sync"])
def test_a_full_disk_leaves_the_earlier_result(earlier, monkeypatch, what):
    real = Path.write_bytes
    named = {"solution": "solution.nc", "figure": "x.png"}.get(what, what)
    monkeypatch.setattr(
        Path, "write_bytes", lambda p, b: full_disk() if p.name == named else real(p, b)
    )
    if what == "sync":
        monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(ResultError, match="No space left on device; free some space"):
        write(earlier, a_summary(seed=2), a_solution(), figures={"x": a_figure()})
    monkeypatch.undo()
    still_there(earlier)


@pytest.mark.parametrize("code", [errno.EACCES, errno.EROFS, errno.EPERM, errno.EDQUOT])
def test_a_folder_without_permission_is_refused_before_the_work(earlier, monkeypatch, code):
    # Tests may run as root, whom no permission stops, so the refusal is played.
    def refuse(*_args, **_kwargs):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "mkdir", refuse)
    with pytest.raises(ResultError, match=f"cannot make the result folder: {os.strerror(code)}"):
        ResultWriter(earlier)
    monkeypatch.undo()
    still_there(earlier)


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(errno.EACCES, "no")])
def test_a_failed_exchange_is_taken_back(earlier, monkeypatch, which, error):
    real, calls = os.rename, []

    def rename(a, b):
        calls.append(a)
        if len(calls) == which + 1:
            raise error
        real(a, b)

    monkeypatch.setattr(os, "rename", rename)
    with pytest.raises((ResultError, KeyboardInterrupt)):
        write(earlier, a_summary(seed=2))
    monkeypatch.undo()
    still_there(earlier)


def test_an_interrupt_at_any_line_leaves_a_whole_result(earlier):
    """Ctrl-C can fall between any two lines of the code that moves folders about."""
    modules = (folder.__file__, results.writer.__file__)

    class Countdown:
        def __init__(self, lines):
            self.left = lines

        def __call__(self, frame, event, _arg):
            if frame.f_code.co_filename not in modules:
                return None
            if event == "line":
                self.left -= 1
                if self.left == 0:
                    sys.settrace(None)
                    raise KeyboardInterrupt
            return self

    outer, seeds, lines = sys.gettrace(), [], 0
    while True:
        lines += 1
        sys.settrace(Countdown(lines))
        try:
            write(earlier, a_summary(seed=2))
        except KeyboardInterrupt:
            seeds.append(read(earlier).summary["seed"])
            hidden = [name for name in names(earlier.parent) if name != "out"]
            assert all(name.startswith(".robins-") for name in hidden), f"line {lines}"
            for name in hidden:  # this process lives, so no later writer may sweep them
                shutil.rmtree(earlier.parent / name)
        else:
            break
        finally:
            sys.settrace(outer)
    assert set(seeds) == {1, 2}  # 2 after an interrupt that fell behind the exchange
    assert seeds == sorted(seeds)
    write(earlier, a_summary(seed=1))
    still_there(earlier)


PROLOGUE = """
    import os, resource, sys
    from pathlib import Path
    sys.path[:0] = [{tests!r}]
    from test_results import a_solution, a_summary, names
    from robins.results import ResultError, ResultWriter, read, write
    out = Path({out!r})
"""


def in_a_process(script, out):
    code = textwrap.dedent(PROLOGUE.format(tests=str(Path(__file__).parent), out=str(out)))
    done = subprocess.run(
        [sys.executable, "-c", code + textwrap.dedent(script)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_kill_at_any_call_leaves_a_whole_result(earlier):
    """The process dies, without any clean-up, at the k-th call that changes the disk."""
    printed = in_a_process(
        """
        CALLS = ("mkdir", "rename", "fsync", "rmdir", "unlink", "open")
        def attempt(k):
            pid = os.fork()
            if pid == 0:
                for name in CALLS:
                    def dying(*args, real=getattr(os, name), **kwargs):
                        global k_left
                        k_left -= 1
                        if k_left < 0:
                            os._exit(9)
                        return real(*args, **kwargs)
                    setattr(os, name, dying)
                globals()["k_left"] = k
                write(out, a_summary(seed=2))
                os._exit(0)
            return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        k = 0
        while (code := attempt(k)) == 9:
            print(read(out).summary["seed"], names(out.parent) != ["out"])
            k += 1
        assert code == 0, code
        assert names(out.parent) == ["out"], names(out.parent)
        """,
        earlier,
    )
    lines = [line.split() for line in printed.splitlines()]
    assert {seed for seed, _ in lines} == {"1", "2"}
    assert any(left == "True" for _, left in lines)  # else the test did not kill at a bad moment


def test_a_file_size_limit_leaves_the_earlier_result(earlier):
    in_a_process(
        """
        for limit in (0, 10, 1000, 3000):
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
            try:
                write(out, a_summary(seed=2), a_solution())
            except ResultError as error:
                assert "raise the file size limit" in str(error), error
            else:
                raise SystemExit(f"written under a limit of {limit}")
            assert read(out).summary["seed"] == 1
            assert names(out.parent) == ["out"]
        """,
        earlier,
    )


# ------------------------------------------------------------------- other writers, left-overs


def test_two_writers_of_one_folder(earlier):
    first = ResultWriter(earlier)
    first.save_summary(a_summary(seed=2))
    write(earlier, a_summary(seed=3))  # must not take the first for dead
    assert read(earlier).summary["seed"] == 3
    first.commit()
    assert read(earlier).summary["seed"] == 2
    assert names(earlier.parent) == ["out"]


def test_a_writer_that_is_overtaken_in_the_exchange_tries_again(earlier, monkeypatch):
    real, done = os.rename, []

    def rename(a, b):
        real(a, b)
        if not done:  # the earlier result is aside: another writer now takes the place
            done.append(True)
            write(earlier, a_summary(seed=3))

    monkeypatch.setattr(os, "rename", rename)
    write(earlier, a_summary(seed=2))
    assert read(earlier).summary["seed"] == 2
    assert names(earlier.parent) == ["out"]


def test_what_a_dead_writer_set_aside_is_read_and_brought_back(earlier):
    aside = folder._hidden(earlier, "old")
    earlier.rename(aside)
    assert read(earlier).summary["seed"] == 1
    assert read(earlier).path == aside
    assert names(earlier.parent) == [aside.name]  # reading changes nothing
    with pytest.raises(RuntimeError), ResultWriter(earlier):
        raise RuntimeError
    still_there(earlier)


def test_hidden_folders_of_others_are_not_touched(earlier):
    other = folder._hidden(earlier.with_name("other"), "new")
    looks_alike = earlier.parent / f"{folder._hidden(earlier, 'new').name}.backup"
    for path in (other, looks_alike):
        path.mkdir()
    write(earlier, a_summary())
    assert names(earlier.parent) == sorted([other.name, looks_alike.name, "out"])


def test_without_locks_nothing_is_taken_for_dead(earlier, monkeypatch):
    def unsupported(*_args):
        raise OSError(errno.ENOLCK, "no locks")

    monkeypatch.setattr(folder.fcntl, "flock", unsupported)
    unknown = folder._hidden(earlier, "new")
    unknown.mkdir()
    write(earlier, a_summary(seed=2))
    assert read(earlier).summary["seed"] == 2
    assert names(earlier.parent) == sorted([unknown.name, "out"])


# -------------------------------------------------------------------------------------- extension


def test_a_result_is_extended(earlier):
    before = (earlier / "solution.nc").read_bytes()
    with results.extend(read(earlier)) as writer:
        writer.save_report("<p>")
    after = read(earlier)
    assert after.report.read_text() == "<p>"
    assert after.summary["files"]["report"] == "report.html"
    assert after.summary["seed"] == 1
    assert (earlier / "solution.nc").read_bytes() == before


def test_a_failed_extension_changes_nothing(earlier):
    writer = results.extend(read(earlier))
    writer.save_solution(a_solution(3.0))  # the file is a link into the earlier result
    writer.save_summary(a_summary(seed=5))
    writer.discard()
    still_there(earlier)


def test_an_extension_works_where_files_cannot_be_linked(earlier, monkeypatch):
    def unsupported(*_args):
        raise OSError(errno.EPERM, "no links")

    monkeypatch.setattr(os, "link", unsupported)
    with results.extend(read(earlier)) as writer:
        writer.save_report("<p>")
    assert read(earlier).solution.identical(a_solution())
