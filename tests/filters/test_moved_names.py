"""Public names that moved: found at their old place, with a warning that states the new one."""

import importlib

import pytest

from robins.errors import MOVED


@pytest.mark.parametrize("package", MOVED)
def test_public_names_that_moved_are_found_with_a_warning(package):
    here = importlib.import_module(package)
    assert not set(MOVED[package]) & set(getattr(here, "__all__", ())), package
    for name, (place, now) in MOVED[package].items():
        with pytest.warns(DeprecationWarning, match=f"{package}.{name} is now {place}.{now}"):
            got = getattr(here, name)
        assert got is getattr(importlib.import_module(place), now)
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = here.nothing
