"""An earlier result survives every failure, and nothing of the user is ever deleted."""

import errno
import os
import shutil
import subprocess
import sys
import textwrap
import threading
from pathlib import Path

import pytest
from example_folder import a_solution, a_summary, names, write

from robins import results
from robins.results import ResultError, ResultWriter, folder, read

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
    for path, what in ((".", "is"), (earlier, "is"), ("..", "holds"), ("/", "holds")):
        with pytest.raises(ResultError, match=f"{what} the folder you are in; choose"):
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


def failing(code):
    """A call of the system that fails with this error."""

    def fail(*_args, **_kwargs):
        raise OSError(code, os.strerror(code))

    return fail


@pytest.mark.parametrize("what", ["solution", "figure", "summary.json", "manifest.json", "sync"])
def test_a_full_disk_leaves_the_earlier_result(earlier, monkeypatch, what):
    real, full_disk = Path.write_bytes, failing(errno.ENOSPC)
    named = {"solution": "solution.nc", "figure": "x.png"}.get(what, what)
    monkeypatch.setattr(
        Path, "write_bytes", lambda p, b: full_disk() if p.name == named else real(p, b)
    )
    if what == "sync":
        monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(ResultError, match="No space left on device; free some space"):
        write(earlier, a_summary(seed=2), a_solution(), files={"figures/x.png": b"png"})
    monkeypatch.undo()
    still_there(earlier)


@pytest.mark.parametrize("code", [errno.EACCES, errno.EROFS, errno.EPERM, errno.EDQUOT])
def test_a_folder_without_permission_is_refused_before_the_work(earlier, monkeypatch, code):
    # Tests may run as root, whom no permission stops, so the refusal is played.
    monkeypatch.setattr(os, "mkdir", failing(code))
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


@pytest.mark.parametrize("every", [1, 5])
def test_an_interrupt_at_any_line_leaves_a_whole_result(earlier, every):
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
        lines += every
        sys.settrace(Countdown(lines))
        try:
            write(earlier, a_summary(seed=2))
        except KeyboardInterrupt:
            seeds.append(read(earlier).summary["seed"])
            hidden = [name for name in names(earlier.parent) if name != "out"]
            assert all(name.startswith(".robins-") for name in hidden), f"line {lines}"
            for name in hidden:  # this process lives, so no later writer may sweep them
                left = earlier.parent / name
                shutil.rmtree(left) if left.is_dir() else left.unlink()
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
    from example_folder import a_solution, a_summary, names, write
    from robins.results import ResultError, ResultWriter, read
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


def test_the_second_writer_of_a_folder_is_refused_at_once(earlier):
    """The second writer, by path or link, is refused before it has computed anything."""
    link = earlier.parent / "latest"
    link.symlink_to(earlier)
    first = ResultWriter(earlier)
    first.save_summary(a_summary(seed=2))
    record = earlier.with_name("out.record")
    record.write_text("what the first has so far")
    first.save_file("record", record)
    for path in (earlier, link):
        with pytest.raises(ResultError, match="is being written by process") as refused:
            ResultWriter(path)
        assert f"process {os.getpid()} on " in str(refused.value)
        assert "wait for it to end, or choose another folder (--out)" in str(refused.value)
    write(earlier.with_name("other"), a_summary())
    assert record.exists()
    first.commit()
    assert read(earlier).summary["seed"] == 2
    assert (earlier / "record").read_text() == "what the first has so far"
    write(earlier, a_summary(seed=3))
    assert read(earlier).summary["seed"] == 3
    assert names(earlier.parent) == ["latest", "other", "out"]


def test_a_writer_with_patience_waits_for_the_other(earlier):
    first = ResultWriter(earlier)
    first.save_summary(a_summary(seed=2))
    with pytest.raises(ResultError, match="is being written by process"):
        ResultWriter(earlier, timeout_s=0.3)
    other = threading.Timer(0.5, first.commit)
    other.start()
    with ResultWriter(earlier, timeout_s=60.0) as second:
        assert read(earlier).summary["seed"] == 2
        second.save_summary(a_summary(seed=3))
    other.join()
    assert read(earlier).summary["seed"] == 3


def test_another_process_holds_a_folder_until_it_is_killed(earlier):
    in_a_process(
        """
        import signal, subprocess
        code = "import sys; from robins.results import ResultWriter; "
        code += "ResultWriter(sys.argv[1]); print(flush=True); input()"
        other = subprocess.Popen(
            [sys.executable, "-c", code, out], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        other.stdout.readline()
        try:
            ResultWriter(out)
        except ResultError as error:
            assert f"is being written by process {other.pid} on " in str(error), error
        else:
            raise SystemExit("two writers")
        assert names(out.parent) != ["out"]
        other.kill()
        other.communicate()
        write(out, a_summary(seed=2))
        assert read(out).summary["seed"] == 2
        assert names(out.parent) == ["out"], names(out.parent)
        """,
        earlier,
    )


def unlocked(monkeypatch):
    """A file system that knows no locks."""
    monkeypatch.setattr(folder.fcntl, "flock", failing(errno.ENOLCK))


def test_without_locks_the_last_of_two_writers_stands(earlier, monkeypatch):
    unlocked(monkeypatch)
    unknown = folder._hidden_name(earlier, "new")
    unknown.mkdir()
    first = ResultWriter(earlier)
    first.save_summary(a_summary(seed=2))
    write(earlier, a_summary(seed=3))  # must not take the first for dead, nor the unknown
    assert read(earlier).summary["seed"] == 3
    first.commit()
    assert read(earlier).summary["seed"] == 2
    assert names(earlier.parent) == sorted([unknown.name, "out"])


def test_a_writer_that_is_overtaken_in_the_exchange_tries_again(earlier, monkeypatch):
    unlocked(monkeypatch)
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
    aside = folder._hidden_name(earlier, "old")
    earlier.rename(aside)
    assert read(earlier).summary["seed"] == 1
    assert read(earlier).path == aside
    assert names(earlier.parent) == [aside.name]  # reading changes nothing
    with pytest.raises(RuntimeError), ResultWriter(earlier):
        raise RuntimeError
    still_there(earlier)


def test_hidden_folders_of_others_are_not_touched(earlier):
    other = folder._hidden_name(earlier.with_name("other"), "new")
    looks_alike = earlier.parent / f"{folder._hidden_name(earlier, 'new').name}.backup"
    other.mkdir()
    looks_alike.mkdir()
    write(earlier, a_summary())
    assert names(earlier.parent) == sorted([other.name, looks_alike.name, "out"])


# -------------------------------------------------------------------------------------- extension
