"""Every filter of the airship in C against JAX: half of the walk of `test_systems_in_c`."""

import pytest
from systems_in_c import AIRSHIP, walk


@pytest.mark.filterwarnings("ignore:feedback='full' gives every local filter")  # one is such
def test_every_filter_of_the_airship():
    assert not walk(AIRSHIP)
