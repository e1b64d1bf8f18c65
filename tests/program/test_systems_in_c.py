"""Filters of real systems in C against JAX.

Some are cheap enough to wait for; `make certify` walks all filters of all studies, those of the
airship, which take as long as all others together, in a file of their own.
"""

import pytest
from systems_in_c import AIRSHIP, STUDIES, check, walk

from robins.systems import SYSTEMS
from robins.systems.catalogue import SUMMARIES
from robins.workbench.scenarios import read_scenario


@pytest.mark.parametrize(
    ("name", "filter_"),
    [("transfer-alignment/s0", "kf"), ("gnss/city", "ls"), ("rocket/a1", "gyro")],
)
def test_a_filter_of_a_system(name, filter_):
    check(name, filter_)


@pytest.mark.parametrize("name", [name for name in STUDIES if name != AIRSHIP])
def test_every_filter_of_a_study(name):
    assert not walk(name)


def test_no_study_is_left_out():
    walked = [read_scenario(name, ()).study for name in STUDIES]
    for system in SUMMARIES:
        for study in SYSTEMS[system].studies.values():
            assert any(study is one for one in walked), system
