"""Results computed by the tests of a system, kept for its file alone."""

import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent


@pytest.fixture(scope="module", autouse=True)
def forgotten():
    """Runs that functions of this folder keep, a gigabyte in all, go with the file they are of."""
    yield
    for module in list(sys.modules.values()):
        if Path(getattr(module, "__file__", None) or "/").parent == HERE:
            for one in vars(module).values():
                if hasattr(one, "cache_clear") and one.__module__ == module.__name__:
                    one.cache_clear()
