"""The doctor on a master and its slave: no healthy pair is blamed, and a delay is measured."""

import pytest
from made_pair import make_pair
from made_spoilt import late

from robins.logs import examine


def errors(data):
    return [f for f in examine(data) if f.severity != "note"]


@pytest.mark.parametrize("kind", ["rate", "increment"])
def test_a_healthy_pair_is_silent(kind):
    for seed in range(3):
        pair = make_pair(seed, kind)
        assert errors(pair) == []
        assert errors(late(0.1, 0.1)(pair)) == []


@pytest.mark.parametrize("delay_s", [0.03, 0.08, 0.2, -0.05])
@pytest.mark.parametrize("stated_s", [0.0, 0.04])
def test_a_delay_is_measured_by_the_gyros(delay_s, stated_s):
    (told,) = errors(late(delay_s + stated_s, stated_s)())
    assert (told.severity, told.code, told.file) == ("error", "master_late", "master.csv")
    assert told.value == pytest.approx(delay_s, abs=0.004)
    total = told.value + stated_s
    mend = f'master.delay = "{total:.3f} s"' if total >= 0.0 else f"Add {-total:.3f} s to their"
    assert mend in told.sentence
