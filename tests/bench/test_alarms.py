"""Alerts on the flags of estimates: one when a thing begins, one when it ends, and no more."""

import pytest

from robins.bench.rigs.satellite.judging import Alarms
from robins.bench.rigs.satellite.messages import HELD, REFUSED, SAFE, SHORT, SILENT, USED

BETWEEN = [0] * 4  # estimates without a star frame


def heard(*flags: int) -> list[tuple[int, str, str]]:
    """Number of the estimate, level and text of all that is said."""
    alarms = Alarms()
    return [(k, *said) for k, one in enumerate(flags) for said in alarms.alerts_of(one)]


RUNS = {
    "nothing is said of a sound run": ([USED, *BETWEEN, USED, *BETWEEN, USED], []),
    "frames refused in a row are one alarm and are counted": (
        [USED, *BETWEEN, REFUSED, *BETWEEN, REFUSED, *BETWEEN, REFUSED, *BETWEEN, USED],
        [(5, "alarm", "star refused"), (20, "info", "star used again, 3 frames were refused")],
    ),
    "each row is counted from its beginning": (
        [REFUSED, 0, USED, 0, REFUSED, 0, USED],
        [
            (0, "alarm", "star refused"),
            (2, "info", "star used again, one frame was refused"),
            (4, "alarm", "star refused"),
            (6, "info", "star used again, one frame was refused"),
        ],
    ),
    "a frame that is no attitude is said until one is": (
        [SHORT, 0, SHORT, 0, USED, SHORT],
        [(k, "warning", "star of a length other than one") for k in (0, 5)],
    ),
    "a gyro that falls silent ends in safe and comes back": (
        [0, HELD, HELD | SAFE, HELD | SAFE, SAFE, USED],
        [
            (1, "warning", "gyro held"),
            (2, "alarm", "safe: do not steer by this"),
            (5, "info", "the estimate can be steered by again"),
        ],
    ),
    "a silence of the star sensor is said once": (
        [0, SILENT, SILENT, SILENT | HELD, USED, SILENT],
        [(1, "warning", "star silent"), (3, "warning", "gyro held"), (5, "warning", "star silent")],
    ),
}


@pytest.mark.parametrize(("flags", "said"), RUNS.values(), ids=RUNS)
def test_what_is_said(flags, said):
    assert heard(*flags) == said
