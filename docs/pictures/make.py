"""Make the pictures of the documents anew: `python docs/pictures/make.py`."""

import shutil
import tempfile
from pathlib import Path

from robins.workbench import run_scenario

HERE = Path(__file__).parent
PICTURES = {"drive_position.png": "error_position.png", "drive_track.png": "track.png"}


def main():
    with tempfile.TemporaryDirectory() as name:
        done = run_scenario("ins-gnss/drive", out=Path(name) / "drive")
        for picture, figure in PICTURES.items():
            shutil.copyfile(done.path / "figures" / figure, HERE / picture)


if __name__ == "__main__":
    main()
