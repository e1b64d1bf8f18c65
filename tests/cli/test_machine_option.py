"""The option `--machine` of `robins run`."""

import json
import shutil

import numpy as np
import pytest

from robins.program import CPP


def test_a_machine_that_is_not_there_is_refused(robins):
    answer = robins("run", "transfer-alignment/s1", "--machine", "cuda")
    assert answer.status == 2
    assert "'cuda' is not one of 'vm', 'c', 'jax'" in answer.err


@pytest.mark.skipif(not any(map(shutil.which, CPP.names)), reason="lanes need a C++ compiler")
def test_the_command_says_which_machine(robins):
    options = ("--runs", 3, "--filters", "kf", "--json")
    found = {}
    for name in ("c", "jax"):
        answer = robins("run", "transfer-alignment/s1", "--machine", name, "--out", name, *options)
        assert answer.status == 0, answer.err
        found[name] = json.loads(answer.out)
        assert found[name]["machine"] == name
    for key, value in found["jax"]["filters"]["kf"].items():
        other = found["c"]["filters"]["kf"][key]
        if isinstance(value, dict):  # a probability, of counts
            assert other == value
        else:
            np.testing.assert_allclose(other, value, rtol=1e-9)
