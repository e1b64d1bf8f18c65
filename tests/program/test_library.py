"""An exported library, compiled and run as its user does."""

import re
import shutil
import subprocess

import jax.numpy as jnp
import numpy as np
import pytest
from boat import STEPS, made, write_boat
from exported import found, spoil

from robins.export.library import Library, fields_of, identifier, number, symbol
from robins.filters import Code
from robins.program import DOUBLE, SINGLE, to_c, trace

PRECISIONS = {"double": DOUBLE, "float": SINGLE}
PRINTED = re.compile(r"[0-9a-f]+ [0-9.e+-]+")
ENTRIES = "init", "predict", "update_steering_compass", "reset"


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """The same library in each precision."""
    return {k: write_boat(tmp_path_factory.mktemp(k), one) for k, one in PRECISIONS.items()}


@pytest.fixture
def folder(folders):
    return folders["double"]


def check(folder, *settings):
    return subprocess.run(
        ["make", "-B", "-C", str(folder), "check", *settings], capture_output=True, text=True
    )


@pytest.mark.parametrize("kind", PRECISIONS)
def test_it_is_what_jax_computes_and_no_compiler_warns(folders, kind):
    folder = folders[kind]
    done = check(folder, "CC=cc -Werror")
    assert done.returncode == 0, done.stderr
    assert f"{STEPS} steps: 0 codes differ" in done.stdout
    assert "passed" in done.stdout
    codes = (folder / "recorded.h").read_text().split("compass_result_code[")[1]
    assert "{1}" in codes.split("}\n}")[0]  # the gap is in the record


@pytest.mark.parametrize("kind", PRECISIONS)
def test_its_test_sees_garbage_in_any_output(folders, tmp_path, kind):
    """A law over entry points and outputs: the start, and every field of state and result."""
    for one in folders[kind].iterdir():
        if one.suffix in (".c", ".h") or one.name == "Makefile":
            (tmp_path / one.name).write_text(one.read_text())
    outputs = spoil(tmp_path, "boat")
    assert {entry for entry, _ in outputs} == {f"boat_{name}" for name in ENTRIES}
    assert len(outputs) > 5 * len(ENTRIES)
    whole, *statuses = found(tmp_path, len(outputs))
    assert whole == 0
    missed = [one for one, status in zip(outputs, statuses, strict=True) if status == 0]
    assert not missed
    nth = outputs.index(("boat_predict", "state.mean_rate")) + 1
    assert "first in predict/state.mean_rate" in (tmp_path / f"said{nth}").read_text()


USERS = {
    "user.c": """#include <complex.h>
#include "boat.h"
#include "boat.h"
int user(void) { boat_predict_input u = {.I_ = 0.1, .new_ = 0.0}; return (int)u.new_; }
""",
    "main.cc": """#include "boat.h"
#include "boat.h"
int main()
{
    boat_state state;
    boat_predict_input u = {0.1, 0.0};
    boat_predict_result moved;
    boat_init(&state);
    return boat_predict(&state, &u, &moved);
}
""",
}


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler, g++")
def test_a_program_of_c_and_cplusplus_may_include_its_header(folder, tmp_path):
    """Twice, beside the macros of C, and linked with what a compiler of C made of the library."""
    for name, text in USERS.items():
        (tmp_path / name).write_text(text)
    line = ["gcc", "-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror", f"-I{folder}"]
    files = [*(tmp_path / name for name in USERS), folder / "boat.c"]
    line += [*map(str, files), "-lstdc++", "-lm", "-o", str(tmp_path / "program")]
    done = subprocess.run(line, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("flag", "name"),
    [("-ffast-math", "boat.c"), ("-ffinite-math-only", "boat.h"), ("-ffast-math", "alone.c")],
)
def test_a_compiler_that_takes_nan_for_impossible_is_refused(folder, flag, name):
    (folder / "alone.c").write_text(to_c(made()[0][0].program))
    line = ["cc", flag, "-fsyntax-only", name]
    done = subprocess.run(line, cwd=folder, capture_output=True, text=True)
    assert done.returncode != 0
    assert "NaN means missing here: compile without -ffast-math" in done.stderr


def test_names_that_a_header_cannot_use_end_with_an_underscore():
    assert [identifier(f".{name}") for name in ("I", "log", "rate_N", "new", "default", "x")] == [
        *("I_", "log", "rate_N", "new_", "default_", "x")
    ]
    assert symbol("update_steering compass") == "update_steering_compass"
    library = Library("boat", made()[0], made()[1], ("From a*/b.",))
    assert library.header().count("*/") == library.header().count("/*")


def test_a_note_on_a_field_that_is_not_there_is_refused():
    entries, start, _ = made()
    absent = Library("boat", entries, start, (), {("update_log_reading", "value"): "m/s"})
    assert absent.header() == Library("boat", entries, start).header()  # not every model has a log
    stale = absent._replace(notes={("state", "mean_rat"): "rad/s"})
    with pytest.raises(ValueError, match=r"'state' does not have: \['mean_rat'\]"):
        stale.header()


def test_the_codes_are_those_of_the_filters(folder):
    text = (folder / "boat.h").read_text()
    assert re.findall(r"BOAT_CODE_(\w+) = (\d+)", text) == [(c.name, str(int(c))) for c in Code]


def test_a_library_that_single_precision_ruins_fails(tmp_path):
    write_boat(tmp_path)
    record = tmp_path / "recorded.h"
    record.write_text(record.read_text().replace('RUINED ""', 'RUINED "It drifts."'))
    done = check(tmp_path)
    assert done.returncode != 0
    assert "FAILED: It drifts." in done.stdout
    assert "0 codes differ" in done.stdout


def test_fields_have_the_names_of_the_model(folder):
    text = (folder / "boat.h").read_text()
    assert "boat_real mean_heading_rad;" in text
    assert "boat_real mean_rate[1]; /* rad/s */" in text
    assert "boat_real factor[2][2];" in text
    assert "int boat_predict(boat_state *state, const boat_predict_input *input," in text
    assert "boat_update_steering_compass_about" not in text  # it takes nothing


def test_fields_lie_where_the_program_has_them():
    def function(state, row):
        return state, row

    row = {"a": jnp.zeros((2, 3)), "b": jnp.zeros((), dtype=bool), "none": jnp.zeros((0, 4))}
    program = trace(function, {"x": jnp.zeros(2), "n": jnp.zeros(3, dtype=int)}, row)
    assert [(f.name, f.at, f.size) for f in fields_of(program.inputs, 0)] == [
        ("n", 0, 3),
        ("x", 0, 2),
    ]
    assert [(f.name, f.at, f.is_real) for f in fields_of(program.inputs, 1)] == [
        ("a", 2, True),
        ("b", 3, False),
    ]


def test_the_header_is_one_for_its_precision_and_fits_a_page(folders):
    for kind, folder in folders.items():
        header, source = ((folder / f"boat.{end}").read_text() for end in "hc")
        assert f"typedef {kind} boat_real;" in header
        assert f"typedef {kind} real;" in source
        assert max(map(len, f"{header}{source}".split("\n"))) <= 100


def test_zeros_that_all_calls_keep_are_neither_read_nor_computed(folder):
    """The factor's upper triangle: x[0] is the heading, x[1] the rate, x[2:6] the factor."""
    source = (folder / "boat.c").read_text()
    assert "x[4]" in source
    assert "x[3]" not in source
    assert "static const real at_factor[4] = {" in source


def test_bits_are_those_of_the_states(folders, tmp_path):
    """The checksum is FNV-1a over the words that -DPRINT_BITS prints."""
    for kind, folder in folders.items():
        out = tmp_path / kind
        line = ["cc", "-DPRINT_BITS", "test.c", "boat.c", "-lm", "-o", str(out)]
        subprocess.run(line, cwd=folder, check=True)
        lines = subprocess.run([out], capture_output=True, text=True, check=True).stdout.split("\n")
        bits = 14695981039346656037
        words = [int(one.split()[0], 16) for one in lines if PRINTED.fullmatch(one)]
        for word in words:
            bits = (bits ^ word) * 1099511628211 % 2**64
        assert f"bits of all numbers: {bits:016x}" in lines
        dtype = np.float64 if kind == "double" else np.float32
        last = np.array(words[-1], np.uint64 if kind == "double" else np.uint32).view(dtype)
        assert np.isfinite(last)


def test_numbers_are_written_to_the_bit():
    assert float(number(0.1 + 0.2, True)) == 0.1 + 0.2
    assert [number(x, True) for x in (np.nan, np.inf, -np.inf)] == ["NAN", "INFINITY", "-INFINITY"]
    assert number(True, False) == "1"
