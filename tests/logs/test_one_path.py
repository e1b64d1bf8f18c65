"""One path in the place of several, as a newcomer types it."""

import pytest

from robins.logs import LogError, load_dataset


@pytest.mark.parametrize("kind", [str, lambda path: path])
def test_one_path_is_a_path(tmp_path, kind):
    log = tmp_path / "imu.csv"
    log.write_text("")
    with pytest.raises(LogError, match=r"imu\.csv: is empty"):
        load_dataset(kind(log))
