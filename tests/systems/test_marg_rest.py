"""Rest of a nine-axis unit by spread and constancy, and the bias that it shows."""

from types import SimpleNamespace

import numpy as np
import pytest

from robins.systems.marg.parameters import Rest
from robins.systems.marg.rest import RestDetector

BLOCK_S, GRAVITY = 0.1, 9.81
NO_FIELD = np.full((200, 3), np.nan)


def told(rate, field=NO_FIELD, noise=0.0, seed=0):
    """Rest in 20 s of blocks, with gravity in one place; the rate (200, 3) or (3,) in deg/s."""
    rng = np.random.default_rng(seed)
    rate = np.broadcast_to(np.radians(rate), (200, 3)) + noise * rng.standard_normal((200, 3))
    return at_rest(BLOCK_S, rate, field)


def at_rest(block_s, rate, field):
    """(K,) bool, whether each block is at rest; and what the first rest shows."""
    watch, force = RestDetector(block_s, Rest()), np.array([0.0, 0.0, -GRAVITY])
    rows = zip(rate, field, strict=True)
    still = [watch.process_block(block_s, one, force, field_b)[0] for one, field_b in rows]
    return SimpleNamespace(still=np.array(still), first=watch.first, first_sigma=watch.first_sigma)


@pytest.mark.parametrize("bias", [0.0, 4.4, -9.5])
def test_a_log_that_begins_at_rest_shows_its_bias(bias):
    found = told([0.3, -0.2, bias], noise=np.radians(0.05))
    assert not found.still[:14].any()
    assert found.still[15:].all()
    np.testing.assert_allclose(np.degrees(found.first), [0.3, -0.2, bias], atol=0.05)
    assert np.degrees(found.first_sigma) == pytest.approx(0.05, rel=0.5)


def test_a_turn_is_no_rest():
    assert not told([0.0, 0.0, 12.0]).still.any()
    # a swing has the mean rate of rest, not its spread
    swing = np.zeros((200, 3))
    swing[:, 1] = 5.0 * np.sin(np.arange(200) * 0.6)
    assert not told(swing).still.any()


def test_rest_is_told_after_a_while_and_ends_at_once():
    rate = np.zeros((200, 3))
    rate[100:104, 0] = 20.0
    still = told(rate).still
    assert still[14:100].all()
    assert not still[100:118].any()
    assert still[-1]


def test_a_new_bias_is_believed_where_it_lasts():
    """Turning at 6 deg/s after rest is a turn for 5 s; a rest that begins with it has no other."""
    rate = np.zeros((200, 3))
    rate[80:, 2] = 6.0
    still = told(rate).still
    assert still[14:80].all()
    assert not still[80:125].any()
    assert still[-1]
    slow = np.zeros((200, 3))
    slow[80:, 2] = 2.0
    assert told(slow).still[-60:].all()


def test_a_field_that_turns_is_a_unit_that_turns():
    """5 deg/s about the vertical, which gravity does not show, from the first sample on."""
    angle = np.radians(5.0) * BLOCK_S * np.arange(200)
    field = 2e-5 * np.stack([np.cos(angle), -np.sin(angle), np.ones(200)], axis=1)
    assert told([0.0, 0.0, 5.0]).still[20:].all()
    assert not told([0.0, 0.0, 5.0], field).still.any()


def test_samples_that_are_too_rare_tell_nothing():
    found = at_rest(1.0, np.zeros((30, 3)), NO_FIELD[:30])
    assert not found.still.any()
    assert found.first is None
