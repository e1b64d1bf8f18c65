"""Programs of the live filters for a wheel, so that they start at once where it is installed.

python .github/tapes.py src/robins/program/tapes
"""

import os
import shutil
import sys
import tempfile
from pathlib import Path

RATES_HZ = (50.0, 100.0, 200.0, 400.0)  # of an IMU


def make() -> None:
    """Make the live filters at usual rates, which writes their programs into the user's cache."""
    from robins.systems.ins_gnss import LiveInsGnss
    from robins.systems.ins_gnss import Replay as Navigated
    from robins.systems.marg import LiveMarg, Replay

    for rate_hz in RATES_HZ:
        LiveMarg(Replay(), rate_hz)
        for name in ("ekf", "robust"):
            LiveInsGnss(Navigated(), rate_hz, filter=name)


if __name__ == "__main__":
    into = Path(sys.argv[1])
    into.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as cache:
        os.environ["XDG_CACHE_HOME"] = cache
        make()
        for tape in sorted(Path(cache).rglob("*.npz")):
            name = f"{tape.name.partition('.')[0]}.npz"  # for all versions of packages
            shutil.copy(tape, into / name)
            print(f"{name}: {tape.stat().st_size / 1e3:.0f} kB")
