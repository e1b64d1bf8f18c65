"""Run every benchmark and print the figures; `make bench`.

Each compares robins with a peer timed in the same process or the same minute, so that the ratio
holds on any machine; absolute times are those of this one.
"""

import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
ORDER = [
    "strapdown.py",
    "filters.py",
    "rules.py",
    "ins_gnss.py",
    "long_replay.py",
    "transfer_alignment.py",
    "airship.py",
    "magnetic.py",
    "spacecraft.py",
    "satellite.py",
    "stars.py",
    "synthesis.py",
    "wire.py",
    "bench.py",
]


def main() -> int:
    failed = []
    for name in ORDER:
        print(f"== {name}", flush=True)
        if subprocess.run([sys.executable, str(HERE / name)], check=False).returncode != 0:
            failed.append(name)
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
