"""The command as a process: signals, streams that are full, closed or short of characters."""

import io
import json
import os
import select
import shlex
import signal
import subprocess
import sys
import textwrap
import threading
from pathlib import Path

import pytest

from robins import results
from robins.cli import ExitStatus, interrupts


def start(code, *arguments, **settings):
    """Start a process that runs `main` after some code of the test's; its output is piped."""
    prologue = "import sys\nfrom robins.cli import main\n"
    script = f"{prologue}{textwrap.dedent(code)}\nsys.exit(main(sys.argv[1:]))"
    settings = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True} | settings
    return subprocess.Popen([sys.executable, "-c", script, *arguments], **settings)


@pytest.mark.parametrize("argument", ["--help", "list", "nonsense"])
def test_what_computes_nothing_is_there_in_a_blink(argument):
    code = """
    import atexit, resource
    def told():
        heavy = {"jax", "numpy", "matplotlib", "xarray", "scipy", "pydantic", "rich"}
        used = resource.getrusage(resource.RUSAGE_SELF)
        print(used.ru_utime + used.ru_stime, sorted(heavy & set(sys.modules)), file=sys.stderr)
    atexit.register(told)
    """
    process = start(code, argument)
    _, err = process.communicate(timeout=60)
    assert process.returncode == (
        ExitStatus.BAD_INPUT if argument == "nonsense" else ExitStatus.DONE
    )
    seconds, loaded = err.splitlines()[-1].split(maxsplit=1)
    assert float(seconds) < 0.5  # of processor time, which other work on the machine does not touch
    assert loaded.strip() == "[]"


def test_questions_about_a_log_import_nothing_heavy(tmp_path):
    """Writing, reading, turning and cleaning it, the doctor, and the guess of its columns."""
    code = """
    import atexit
    import numpy as np
    from robins import dataset, logs
    t = np.arange(3001) / 50.0  # a circle of 25 m, at a rate that changes
    a, w, o, k = 0.2 * t + np.cos(0.3 * t), 0.2 - 0.3 * np.sin(0.3 * t), 0.0 * t, slice(0, None, 10)
    ns = np.round(t * 1e9).astype(np.int64)
    noise = 0.01 * np.random.default_rng(1).normal(size=(6, t.size))
    force = -2.25 * np.cos(0.3 * t), 25.0 * w**2, o - 9.81
    gyro, accel = np.stack([o, o, w] + noise[:3], -1), np.stack(force + noise[3:], -1)
    place = 0.8 + 25.0 * np.sin(a) / 6.37e6, 0.1 - 25.0 * np.cos(a) / 4.45e6, o + 430.0
    v_n = 25.0 * np.stack([w * np.cos(a), w * np.sin(a), o], -1)
    q_nb = np.stack([np.cos(a / 2), o, o, np.sin(a / 2)], -1)
    path = dataset.Trajectory(ns, *place, v_n, q_nb)
    fixes = dataset.GnssTable(ns[k], *(p[k] for p in place), 0.1 + 0.0 * v_n[k], v_n[k])
    logs.write_log("imu.csv", dataset.ImuTable(ns, gyro, accel, "rate", "FRD"))
    logs.write_log("gnss.csv", fixes, "kfgins-gnss")
    logs.write_log("path.txt", path, "tum")
    turned = logs.load_dataset(["imu.csv", "gnss.csv"], mounting=logs.Mounting(0.0, 5.0, 90.0))
    logs.clean(turned)
    told = lambda: print(sorted({"jax", "scipy", "xarray", "matplotlib"} & set(sys.modules)))
    atexit.register(told)
    main(["guess", "imu.csv"])
    """
    process = start(code, "doctor", "imu.csv", "gnss.csv", "path.txt", "--json", cwd=tmp_path)
    out, err = process.communicate(timeout=60)
    assert process.returncode == ExitStatus.DONE, out + err
    assert out.splitlines()[-1] == "[]"


# What is printed under a progress bar goes to the bar's terminal, so it is written below Python.
SLOW = """
import os
import time
from robins import workbench
def run(name, **asked):
    os.write(1, b"computing\\n")
    time.sleep(60)
workbench.run = run
"""
RUN = ("run", "car/town", "--out", "out")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_the_earlier_result_and_status_3(tmp_path, robins, workbench, number):
    robins(*RUN, "--seed", 1)
    process = start(SLOW, *RUN, cwd=tmp_path)
    assert process.stdout.readline() == "computing\n"
    assert len(list(tmp_path.iterdir())) == 3  # the result, the next one, and its lock
    process.send_signal(number)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 3
    assert "Traceback" not in err
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert results.read("out").summary["seed"] == 1


def test_a_terminal_that_is_closed_is_an_interrupt(tmp_path):
    """Writes to a closed terminal fail, also those of click before it passes Ctrl-C on."""
    screen, keyboard = os.openpty()
    process = start(SLOW, *RUN, cwd=tmp_path, stderr=keyboard)
    os.close(keyboard)
    # A screen that nobody reads is full after some refreshes, and who writes to it waits.
    while process.stdout not in select.select([process.stdout, screen], [], [], 60)[0]:
        os.read(screen, 4096)
    assert process.stdout.readline() == "computing\n"
    # To close it may wait for who writes to it: some kernels then wait for ever.
    closing = threading.Thread(target=os.close, args=(screen,), daemon=True)
    closing.start()
    closing.join(timeout=5)
    process.send_signal(signal.SIGHUP)
    process.communicate(timeout=30)
    assert process.returncode == 3
    assert list(tmp_path.iterdir()) == []


def test_nohup_is_respected():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interrupts.interruptible():
            signal.raise_signal(signal.SIGHUP)
            interrupts.raise_if_interrupted()
    finally:
        signal.signal(signal.SIGHUP, before)


DEAF = """
import gc, os, signal, time
from robins import workbench
def run(name, *, progress, **asked):
    def _xla_gc_callback(phase, info):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)
    gc.callbacks.append(_xla_gc_callback)
    gc.collect()
    gc.callbacks.clear()
    time.sleep(30)
workbench.run = run
"""

SWALLOWED = """
import os, signal, time
from robins import workbench
def run(name, *, progress, **asked):
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1)
    except BaseException:
        pass
    progress(0.5, "on and on")
    time.sleep(30)
workbench.run = run
"""


@pytest.mark.parametrize("code", [DEAF, SWALLOWED], ids=["in a callback", "swallowed"])
def test_an_interrupt_is_not_lost(tmp_path, code):
    process = start(code, "run", "car/town", cwd=tmp_path)
    _, err = process.communicate(timeout=15)
    assert process.returncode == 3
    assert err.strip().startswith("robins: interrupted.")


def test_an_interrupted_process_ends_with_its_status_whatever_its_threads_do(tmp_path):
    """Compilers leave threads that crash when the interpreter is taken away beneath them."""
    code = f"""{SLOW}
import atexit, os
atexit.register(os.abort)
main_of_the_process = main
main = lambda arguments: main_of_the_process()
"""
    process = start(code, *RUN, cwd=tmp_path)
    assert process.stdout.readline() == "computing\n"
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 3
    assert err.strip().startswith("robins: interrupted.")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", [("list",), ("bench", "status", "--json"), ("--help",)])
def test_a_full_standard_output_is_a_failure(command):
    with open("/dev/full", "w") as full:
        process = start("", *command, stdout=full)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 1
    assert err == "robins: cannot write to standard output: No space left on device\n"


def test_a_reader_that_goes_away_is_no_reason_to_complain():
    process = start("", "list")
    process.stdout.close()
    process.wait(timeout=60)
    assert process.stderr.read() == ""
    process.stderr.close()
    assert process.returncode == 1


def test_a_closed_standard_output_is_told():
    code = "from robins.cli import main; raise SystemExit(main())"
    shell = f"{shlex.join([sys.executable, '-c', code])} --help >&-"
    closed = subprocess.run(shell, shell=True, stderr=subprocess.PIPE, text=True, timeout=30)
    assert closed.returncode == 1
    assert closed.stderr == "robins: cannot write to standard output: it is closed\n"


def test_a_closed_standard_error_is_no_fault(robins, workbench, monkeypatch):
    monkeypatch.setattr(sys, "stderr", None)
    assert robins("run", "car/town", "--json").status == 0
    workbench.error = RuntimeError()
    answer = robins("run", "car/town", "--debug")
    assert (answer.status, answer.out) == (1, "noise of some library on standard output\n")


@pytest.mark.parametrize("encoding", ["latin-1", "ascii"])
@pytest.mark.parametrize("as_json", [True, False])
def test_a_terminal_that_lacks_characters_gets_the_others(
    robins, workbench, monkeypatch, encoding, as_json
):
    workbench.warnings = ["100 \N{MICRO SIGN}s \N{EN DASH} late \N{ROCKET}"]
    with io.TextIOWrapper(io.BytesIO(), encoding) as screen:
        monkeypatch.setattr(sys, "stdout", screen)
        status = robins("run", "car/town", *(["--json"] if as_json else [])).status
        screen.flush()
        shown = screen.buffer.getvalue()
    assert status == 0
    if as_json:  # click writes UTF-8 where it is told of a mere ASCII
        text = shown.decode("utf-8" if encoding == "ascii" else encoding)
        assert json.loads(text)["warnings"] == workbench.warnings
    elif encoding == "latin-1":
        assert b"Warning: 100 \xb5s ? late ?\n" in shown


def test_a_command_in_any_bytes_can_be_kept(robins, workbench):
    folder = os.fsdecode(b"caf\xe9")
    assert robins("run", "car/town", "--out", folder).status == 0
    assert results.read(folder).manifest["command"] == r"robins run car/town --out 'caf\xe9'"


def test_the_entry_point_is_installed():
    installed = Path(sys.executable).with_name("robins")
    told = subprocess.check_output([installed, "--version"], text=True)
    assert told.startswith("robins, version ")
