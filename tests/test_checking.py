"""Annotations of what is defined again and again are checked like all others."""

import importlib

import checking
import pytest

TEXT = """
from __future__ import annotations

def made(held):
    def doubled(x: KIND, *, twice: bool = False) -> KIND:
        return held + x + (x if twice else type(x)())
    return doubled
"""


def test_functions_of_one_text_are_checked_each_with_what_it_holds(tmp_path, monkeypatch):
    """The modules have the same text but for the name of a type."""
    monkeypatch.setattr("jaxtyping.jaxtyped", checking.checked)
    monkeypatch.syspath_prepend(tmp_path)
    for kind in ("int", "str"):
        (tmp_path / f"of_{kind}.py").write_text(TEXT.replace("KIND", kind))
    with checking.install("of_int"), checking.install("of_str"):
        whole, words = (importlib.import_module(f"of_{kind}").made for kind in ("int", "str"))
    one, two, a, b = whole(1), whole(2), words("a"), words("b")
    assert (one(5), two(5, twice=True), a("c"), b("c", twice=True)) == (6, 12, "ac", "bcc")
    for function, wrong in ((one, "c"), (two, "c"), (a, 5), (b, 5)):
        with pytest.raises(Exception, match=r"parameter x=.* violates type hint"):
            function(wrong)
    with pytest.raises(Exception, match="parameter twice=3 violates"):
        b("c", twice=3)
    with pytest.raises(Exception, match=r"return 1\.5 violates"):
        whole(0.5)(1)
