"""Building and calling: what is kept, what is refused, what is said when there is no compiler."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from machines import QUICK, quickly

from robins.program import BuildError, ProgramError, build, native
from robins.program.native import FASTER_IN_GCC


@pytest.fixture
def kept(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "robins" / "native"


def test_what_was_built_once_is_not_built_again(kept, monkeypatch):
    text = "int one(void) { return 1; }\n"
    library = build(text, QUICK)
    assert library.parent == kept
    made = library.stat().st_mtime_ns
    assert build(text, QUICK) == library
    assert library.stat().st_mtime_ns == made
    assert build(text + "\n", QUICK) != library
    assert build(text, (*QUICK, "-g")) != library
    assert [p.suffix for p in kept.iterdir()] == [".so"] * 3


def test_a_compiler_that_is_not_there_is_named_with_what_to_do(kept, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler -O9")
    with pytest.raises(BuildError, match=r"CC: there is no program 'no-such-compiler'; install"):
        build("int one;\n")


@pytest.mark.parametrize(
    ("says", "own"),
    [
        ("cc (Debian 12.2.0-14) 12.2.0 Copyright (C) 2022 Free Software Foundation, Inc.", True),
        ("clang version 17.0.1 Target: x86_64-unknown-linux-gnu", False),
    ],
)
def test_flags_of_gcc_are_given_to_gcc_only(kept, tmp_path, monkeypatch, says, own):
    cc, told = tmp_path / "cc", tmp_path / "told"
    cc.write_text(f"""#!/bin/sh
case "$1" in --version) printf '%s' "{says}"; exit;; esac
echo "$@" >> {told}
while [ "$1" != -o ]; do shift; done
: > "$2"
""")
    cc.chmod(0o755)
    monkeypatch.setenv("CC", str(cc))
    build("int one;\n", QUICK)
    build("int one;\n", ("-O2",))
    compiled = [set(FASTER_IN_GCC) <= set(line.split()) for line in told.read_text().splitlines()]
    assert compiled == [own, False]


def test_without_any_compiler_it_says_how_to_get_one(kept, monkeypatch):
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(kept))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(BuildError, match=r"no C compiler .*robins\[compiler\]"):
        build("int one;\n")


def test_what_the_compiler_says_is_passed_on(kept):
    with pytest.raises(BuildError, match=r"does not accept a program: .*error"):
        build("int one = ;\n")
    assert list(kept.iterdir()) == []


def test_trees_types_and_shapes_come_back_as_they_were_traced():
    def f(state, y):
        new = {"x": state["x"] + y[None], "count": state["count"] + 1, "ok": ~state["ok"]}
        return new, (jnp.zeros((0, 2)), y.astype(jnp.int32), None)

    state = {"x": np.ones((2, 3)), "count": np.int64(4), "ok": np.array([True, False])}
    one = native(f, state, np.full(3, 2.5), engine=quickly)
    got, want = one(state, np.full(3, 2.5)), jax.jit(f)(state, np.full(3, 2.5))
    assert jax.tree.structure(got) == jax.tree.structure(want)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        np.testing.assert_array_equal(a, b)
    again = one(got[0], np.full(3, 2.5))[0]
    assert again["count"] == 6
    assert got[0]["count"] == 5  # not memory that the next call writes to


def test_arguments_of_another_form_are_refused():
    one = native(lambda a, b: a["x"] + b, {"x": np.ones(3)}, np.ones(3), engine=quickly)
    with pytest.raises(ProgramError, match=r"arguments\[1\]: \(2,\) was given where \(3,\)"):
        one({"x": np.ones(3)}, np.ones(2))
    with pytest.raises(ProgramError, match="another structure"):
        one({"y": np.ones(3)}, np.ones(3))
