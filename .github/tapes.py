"""Programs of the live filters for a wheel, so that they start at once where it is installed.

Make them: python .github/tapes.py src/robins/program/tapes
Check that an installed wheel has them: python .github/tapes.py
"""

import os
import shutil
import sys
import tempfile
from pathlib import Path

RATES_HZ = (50.0, 100.0, 200.0, 400.0)  # of an IMU


def make() -> None:
    """Make the live filters at usual rates, which writes their programs into the user's cache."""
    from robins.systems.ins_gnss import InsGnssReplay as Navigated
    from robins.systems.ins_gnss import LiveInsGnss
    from robins.systems.marg import LiveMarg, MargReplay

    for rate_hz in RATES_HZ:
        LiveMarg(MargReplay(), rate_hz)
        for name in ("ekf", "robust"):
            LiveInsGnss(Navigated(), rate_hz, filter=name)


def main() -> None:
    """Write the programs into the folder that is named, or check that none is made."""
    with tempfile.TemporaryDirectory() as cache:
        os.environ["XDG_CACHE_HOME"] = cache
        make()
        written = sorted(Path(cache).rglob("*.npz"))
        if not sys.argv[1:]:
            sys.exit(f"{len(written)} programs are not in the wheel" if written else 0)
        into = Path(sys.argv[1])
        into.mkdir(parents=True, exist_ok=True)
        for tape in written:
            name = f"{tape.name.partition('.')[0]}.npz"  # for all versions of packages
            shutil.copy(tape, into / name)
            print(f"{name}: {tape.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
