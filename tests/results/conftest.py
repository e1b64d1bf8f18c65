"""Results to damage and to replace."""

import pytest
from example_folder import a_solution, a_summary, write


@pytest.fixture
def earlier(tmp_path):
    """A folder with one result, written with seed 1."""
    write(tmp_path / "out", a_summary(seed=1), a_solution())
    return tmp_path / "out"
