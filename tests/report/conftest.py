"""Results to draw."""

import pytest
from example_results import a_drive, a_summary


@pytest.fixture(scope="session")
def drive():
    return a_drive()


@pytest.fixture(scope="session")
def town():
    return a_summary()
