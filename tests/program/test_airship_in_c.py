"""Every filter of the airship in C against JAX: half of the walk of `test_systems_in_c`."""

from systems_in_c import AIRSHIP, walk


def test_every_filter_of_the_airship():
    assert not walk(AIRSHIP)
