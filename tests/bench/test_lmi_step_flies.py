"""The filter that solves an LMI at every star frame, as a part of the bench."""

import numpy as np
import pytest
from stations import Loop, config

from robins.bench.rigs.satellite.judging import Alarms, inside
from robins.bench.rigs.satellite.messages import FLAGS
from robins.filters import StepWarning
from robins.filters.synthesis import EveryStep, NotCertified

SHORT = "duration=12 s", "counted_from=5 s"
STEPS = 60
ONE = ("satellite/s2", "mixed-lmi-step", *SHORT)
KEPT = FLAGS.index("last gain kept: no new one passed")


def same(loop, wanted):
    for name, values in wanted.items():
        np.testing.assert_array_equal(loop.all(*name.split(".")), values[:STEPS])


def test_over_bytes_it_has_the_bits_of_one_program(monkeypatch):
    """Also where designs do not pass, which the estimate says."""
    real = EveryStep.__call__

    def call(self, plant):  # by the plant alone, so alike in both runs
        if round(1e9 * float(plant.A[0, 1])) % 3 == 0:
            raise NotCertified("not this one")
        return real(self, plant)

    monkeypatch.setattr(EveryStep, "__call__", call)
    of = config(*ONE)
    loop = Loop(of).run(STEPS)
    with pytest.warns(StepWarning, match="did not pass the test"):
        wanted = inside(of, STEPS)
    same(loop, wanted)
    told = loop.flags() >> KEPT & 1
    assert 0 < np.sum(told) < np.sum(of.due[:STEPS])
    # all frames are used, and no step says anything else
    np.testing.assert_array_equal(loop.flags() & ~(1 << KEPT), of.due[:STEPS])
    assert not np.any(told & ~of.due[:STEPS])
    alarms = Alarms()
    said = [one for flags in loop.flags() for one in alarms.alerts_of(int(flags))]
    assert [one.level for one in said if one.text == FLAGS[KEPT]]
