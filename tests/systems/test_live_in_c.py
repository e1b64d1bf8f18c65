"""Live filters whose steps are compiled as C answer what they answer by JAX.

A step rounds in another order there. A sum of some hundred terms differs by 1e-14 of its size, and
a filter that forgets does not let that grow with its steps.
"""

import shutil
from importlib import import_module

import numpy as np
import pytest
from test_live_ins_gnss import DRIVE, FIX_HZ, as_rates, events, played, vector
from test_live_ins_gnss import RATE_HZ as IMU_HZ
from test_live_marg import PARAMETERS, RATE_HZ, columns, made_log
from test_live_marg import played as moved

from robins import scenario
from robins.program import FLAGS, build
from robins.systems.ins_gnss import Drive, InsGnssReplay, LiveInsGnss, drive_dataset
from robins.systems.marg import LiveMarg
from robins.systems.streaming import Flag

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler, cc")


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Compile without optimisation; the bits are the same."""
    flags = tuple("-O0" if flag == "-O2" else flag for flag in FLAGS)
    # the name of this module is also that of a function of the package
    module = import_module("robins.program.native")
    monkeypatch.setattr(module, "build", lambda text, _: build(text, flags))


def test_the_orientation_is_that_by_jax():
    log = made_log(18.0)
    (q, sigma, flags), (of, stated, told) = (
        columns(moved(LiveMarg(PARAMETERS, RATE_HZ, machine=machine), log))
        for machine in ("c", "jax")
    )
    np.testing.assert_array_equal(flags, told)
    assert np.mean((flags & Flag.STARTING) == 0) > 0.8
    assert np.any(flags & Flag.DISTURBED)
    assert not np.array_equal(q, of, equal_nan=True)  # they are two machines
    np.testing.assert_allclose(q, of, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(sigma, stated, rtol=1e-8)


def test_the_navigation_is_that_by_jax():
    log = as_rates(drive_dataset(scenario.parse(Drive, DRIVE), seed=4))
    late = events(log, np.full(len(log.gnss), 0.17))  # so that epochs are gone through again
    (c, at), (jax, of) = (
        played(LiveInsGnss(InsGnssReplay(), IMU_HZ, FIX_HZ, "ekf", machine=machine), log, late)
        for machine in ("c", "jax")
    )
    assert [a.flags for a in c] == [a.flags for a in jax]
    assert at.keys() == of.keys()
    assert len(at) > 20
    scale = np.concatenate([np.ones(7), [6.4e6, 6.4e6, 1.0], np.ones(9)])
    for found, wanted in (
        *((at[t], of[t]) for t in at),
        *((vector(a), vector(b)) for a, b in zip(c, jax, strict=True)),
    ):
        np.testing.assert_allclose(found * scale, wanted * scale, rtol=1e-9, atol=2e-9)
