"""Command lines and settings that are wrong, or look right: what robins answers.

    python tests/hostile.py lines 2000 --seed 43
    python tests/hostile.py settings 1000 --seed 43

Each is carried out in this process up to where a simulation, a process or the compilation of more
than one operation would begin. Prints what ended otherwise than docs/contract.md says: with an
exception, as a fault of robins, or with an unknown status; exits 1 if there is any.
"""

import argparse
import contextlib
import io
import json
import os
import random
import resource
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import click
import counting
import pydantic

LEAST_BYTES = 12 << 30  # of address space, so that a giant array is refused and not begun
SLOW_S = 60
WORDS = (
    *("", " ", "-", "--", "x", "0", "-1", "1e400", "nan", "inf", "1,,2", "a=b", "=", "a=", "a,b"),
    *("../..", "/", "/dev/null", "/nonexistent/x", "é☃", "\udcff", "x" * 300, "a\nb", "%s", "{x}"),
    *("ins-gnss", "ins-gnss/drive", "ins-gnss/drvie", "satellite/s1", "marg/replay", "airship/s1"),
    *("empty.toml", "text.toml", "binary.csv", "empty.csv", "folder", "folder.toml", "no.py:study"),
    *("text.py:study", "imu.gyro_bias=5 deg/h", "imu.gyro_bias=5 m", "runs=0", "seed=1", "ekf"),
)

# tracebacks are asked for; the process ends with its standard input
_LEFT_OUT = ("debug", "held")


class Begins(BaseException):
    """Computing would begin: the line was accepted."""


class Slow(BaseException):
    """A line took longer than it may."""


class Answer(NamedTuple):
    """Outcome of a command line."""

    words: list[str]
    status: int | None  # None: it was accepted
    said: str
    fault: str


def _stop(event: str, _given: tuple) -> None:
    if _watching and event in ("robins.simulate", "subprocess.Popen"):
        raise Begins


def _compile(event: str, _duration: float, **about: object) -> None:
    name = str(about.get("fun_name")).removeprefix("jit(").rstrip(")").strip("_")
    if _watching and event.endswith("jaxpr_trace_duration") and name not in counting.operations():
        raise Begins


def _alarm(*_: object) -> None:
    raise Slow


_watching: list[bool] = []


@cache
def watch() -> None:
    """Have this process stop where computing would begin, while `answered` is at work."""
    import jax.monitoring

    sys.addaudithook(_stop)
    jax.monitoring.register_event_duration_secs_listener(_compile)
    signal.signal(signal.SIGALRM, _alarm)


def answered(words: list[str]) -> Answer:
    """Carry out a command line in the present folder."""
    from robins.cli import main

    watch()
    out, err = io.StringIO(), io.StringIO()
    status, fault = None, ""
    signal.setitimer(signal.ITIMER_REAL, SLOW_S)
    _watching.append(True)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = int(main(words))
    except Begins:
        pass
    except Slow:
        fault = f"took more than {SLOW_S} s"
    except BaseException as error:
        fault = f"raised {error!r}"
    finally:
        _watching.clear()
        signal.setitimer(signal.ITIMER_REAL, 0)
    said = err.getvalue()
    if status is not None and status not in (0, 1, 2, 3):
        fault = f"ended with {status}"
    if "fault of robins" in said or "Traceback" in said:
        fault = said.strip()
    if status == 0 and "--json" in words and not fault:
        try:
            json.loads(out.getvalue())
        except ValueError as error:
            fault = f"printed no JSON: {error}"
    return Answer(words, status, said, fault)


def commands() -> list[tuple[list[str], click.Command]]:
    """Every command with its words."""
    from robins.cli import app

    def inside(group: click.Group, before: list[str]) -> Iterator[tuple[list[str], click.Command]]:
        for name, one in group.commands.items():
            if isinstance(one, click.Group):
                yield from inside(one, [*before, name])
            else:
                yield [*before, name], one

    return [one for one in inside(app, []) if one[0] != ["bench", "node"]]


def lines(seed: int, count: int) -> Iterator[list[str]]:
    """Command lines of known commands and options with words drawn by chance."""
    draw = random.Random(seed)
    known = commands()
    for _ in range(count):
        name, command = draw.choice(known)
        words = list(name)
        for given in command.params:
            if isinstance(given, click.Argument):
                count = draw.choice([0, 1, 1, 1, 2])
                words += [draw.choice(WORDS) for _ in range(count)]
            elif given.name not in _LEFT_OUT and draw.random() < 0.25:
                words.append(given.opts[0])
                if not given.is_flag:
                    words.append(draw.choice(WORDS))
        if draw.random() < 0.05:
            words.insert(draw.randrange(len(words) + 1), draw.choice(WORDS))
        yield words


def _leaves(model: type[pydantic.BaseModel], before: str = "") -> Iterator[tuple[str, Any]]:
    """Paths of the parameters of a model with their defaults."""
    for name, about in model.model_fields.items():
        kind, default = about.annotation, about.get_default(call_default_factory=True)
        if isinstance(kind, type) and issubclass(kind, pydantic.BaseModel):
            yield from _leaves(kind, f"{before}{name}.")
        else:
            yield before + name, default


def settings(seed: int, count: int) -> Iterator[list[str]]:
    """Runs of packaged scenarios with one or two parameters that look right."""
    from robins import scenario, systems
    from robins.systems.catalogue import listed
    from robins.workbench.scenarios import study_of

    draw = random.Random(seed)
    known = []
    for system in systems.SYSTEMS:
        for name, one in listed(system).items():
            text = one.path.read_text("utf-8")
            study = study_of(systems.SYSTEMS[system], text, name)
            stated = scenario.mapping_of(text)
            for path, default in _leaves(study.parameters):
                value: Any = stated
                for key in path.split("."):
                    value = value.get(key) if isinstance(value, dict) else None
                known.append((f"{system}/{name}", path, default if value is None else value))
    for _ in range(count):
        name, *_ = first = draw.choice(known)
        others = [one for one in known if one[0] == name]
        some = [first] if draw.random() < 0.7 else [first, draw.choice(others)]
        changed = [f"{path}={_like(draw, value)}" for _, path, value in some]
        yield ["run", name, "--runs", "1", *(f"--set={one}" for one in changed)]


def _like(draw: random.Random, value: Any) -> str:
    """A value that looks like another, larger, smaller, negative or none."""
    if isinstance(value, bool):
        return draw.choice(["true", "false", "1"])
    if isinstance(value, int | float):
        return repr(draw.choice([0, 1, -1, 2, 0.5, 1e-9, 1e9, 1e18, 1e300, 5e-324, value * 10]))
    if isinstance(value, str):
        number, _, unit = value.partition(" ")
        with contextlib.suppress(ValueError):
            factor = draw.choice([0.0, -1.0, 1e-12, 1e-3, 0.1, 10.0, 1e3, 1e6, 1e12, 1e290])
            return f"{float(number) * factor!r} {unit}".strip()
        return draw.choice(["", "x", value, value + value])
    if isinstance(value, list | tuple):
        like = ((_like(draw, one), isinstance(one, str)) for one in value)
        quoted = [json.dumps(text) if was_text else text for text, was_text in like]
        return f"[{', '.join(draw.choice([quoted, quoted[:1], quoted * 2, []]))}]"
    return draw.choice(["0", "1", "x", "[]", '"1 s"', "{}"])


def furnish(folder: Path) -> None:
    """Files that the words name."""
    (folder / "folder").mkdir()
    (folder / "folder.toml").mkdir()
    for name in ("empty.toml", "empty.csv"):
        (folder / name).write_bytes(b"")
    (folder / "text.toml").write_text("a = [1, 2\n")
    (folder / "text.py").write_text("study = 1\n")
    (folder / "binary.csv").write_bytes(bytes(range(256)) * 40)


def main() -> int:
    """Try many, and print those whose end is a finding."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["lines", "settings"])
    parser.add_argument("count", type=int)
    parser.add_argument("--seed", type=int, default=43)
    parser.add_argument("--show", action="store_true", help="print every answer")
    asked = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (LEAST_BYTES, LEAST_BYTES))
    found: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as name:
        os.chdir(name)
        furnish(Path(name))
        every = {"lines": lines, "settings": settings}[asked.what](asked.seed, asked.count)
        for words in every:
            one = answered(words)
            found["accepted" if one.status is None else f"status {one.status}"] += 1
            if one.fault or asked.show:
                found["findings"] += bool(one.fault)
                print(f"{one.words}\n    {one.fault or one.said}", flush=True)
        os.chdir("/")
    print(", ".join(f"{n} {what}" for what, n in sorted(found.items())))
    return int(found["findings"] > 0)


if __name__ == "__main__":
    sys.exit(main())
