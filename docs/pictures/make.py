"""Make the pictures of the documents anew: `python docs/pictures/make.py`."""

import shutil
import tempfile
from pathlib import Path

from robins.workbench import publish, run

HERE = Path(__file__).parent
DRIVE = {"drive_position.png": "error_position.png", "drive_track.png": "track.png"}
AIRSHIP = {"airship_position.png": "error_position.png", "airship_velocity.png": "rms_velocity.png"}
SHOWN = ("ukf", "raukf", "cukf-wind-states", "product")


def main():
    with tempfile.TemporaryDirectory() as name:
        drive = publish(run("ins-gnss/drive"), Path(name) / "drive")
        airship = publish(run("airship/s1", filters=SHOWN), Path(name) / "airship")
        for done, pictures in ((drive, DRIVE), (airship, AIRSHIP)):
            for picture, figure in pictures.items():
                shutil.copyfile(done.path / "figures" / figure, HERE / picture)


if __name__ == "__main__":
    main()
