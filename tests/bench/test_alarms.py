"""What is said of the flags of estimates: when a thing begins and when it ends, and no more."""

from robins.bench.run.alarms import Alarms
from robins.bench.wire.schema import FLAGS

USED, REFUSED, HELD, SAFE, SILENT, SHORT = (1 << k for k in range(len(FLAGS)))
BETWEEN = [0] * 4  # estimates without a star frame


def heard(*flags: int) -> list[tuple[int, str, str]]:
    """Number of the estimate, level and text of all that is said."""
    alarms = Alarms()
    return [(k, *said) for k, one in enumerate(flags) for said in alarms.hear(one)]


def test_nothing_is_said_of_a_sound_run():
    assert heard(USED, *BETWEEN, USED, *BETWEEN, USED) == []


def test_frames_refused_in_a_row_are_one_alarm_and_are_counted():
    run = [USED, *BETWEEN, REFUSED, *BETWEEN, REFUSED, *BETWEEN, REFUSED, *BETWEEN, USED]
    assert heard(*run) == [
        (5, "alarm", "star refused"),
        (20, "info", "star used again, 3 frames were refused"),
    ]


def test_each_row_is_counted_from_its_beginning():
    assert heard(REFUSED, 0, USED, 0, REFUSED, 0, USED) == [
        (0, "alarm", "star refused"),
        (2, "info", "star used again, one frame was refused"),
        (4, "alarm", "star refused"),
        (6, "info", "star used again, one frame was refused"),
    ]


def test_a_frame_that_is_no_attitude_is_said_until_one_is():
    assert heard(SHORT, 0, SHORT, 0, USED, SHORT) == [
        (0, "warning", "star of a length other than one"),
        (5, "warning", "star of a length other than one"),
    ]


def test_a_gyro_that_falls_silent_ends_in_safe_and_comes_back():
    assert heard(0, HELD, HELD | SAFE, HELD | SAFE, SAFE, USED) == [
        (1, "warning", "gyro held"),
        (2, "alarm", "safe: do not steer by this"),
        (5, "info", "the estimate can be steered by again"),
    ]


def test_a_silence_of_the_star_sensor_is_said_once():
    assert heard(0, SILENT, SILENT, SILENT | HELD, USED, SILENT) == [
        (1, "warning", "star silent"),
        (3, "warning", "gyro held"),
        (5, "warning", "star silent"),
    ]
