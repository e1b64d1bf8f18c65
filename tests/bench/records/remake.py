"""Write adm.mcap anew: `python tests/bench/records/remake.py`, from the root of the repository.

To be done when the wire or the filter is meant to have changed, and never to make a test pass.
"""

import tempfile
from pathlib import Path

from robins.bench.recording import Recorder, read_record
from robins.bench.rigs.satellite.messages import WIRE
from robins.bench.run.session import Session
from robins.bench.run.setup import read

SCENARIO = """
bench = "satellite"
title = "Eight seconds in which much happens to the attitude determination"
flies = "satellite/s1"
filter = "mekf-gate"
seconds = "8 s"
seed = 8

[[faults]]  # a frame that the gate refuses
kind = "turned"
begin = "3 s"
end = "3.4 s"

[[faults]]  # the last sample is held, then the estimate says that it is not to be steered by
kind = "silent"
link = "gyro"
begin = "4.6 s"
end = "5 s"

[[faults]]  # wrong bytes
kind = "bit errors"
link = "adm"
direction = "to"
share = "30 %"
begin = "6 s"
end = "7 s"
"""
HERE = Path(__file__).parent


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        scenario, whole = Path(folder) / "eventful.toml", Path(folder) / "whole.mcap"
        scenario.write_text(SCENARIO)
        result = Session(read(str(scenario)), whole).run()
        assert not result.failure, result.failure
        record = read_record(whole)
    # how the faults were made is no matter of who hears what came of them
    header = {k: v for k, v in record.header.items() if k != "run"}
    header["setup"] = {k: v for k, v in header["setup"].items() if k != "faults"}
    with Recorder(HERE / "adm.mcap", WIRE, header, overwrite=True) as out:
        for number, entry in enumerate(e for e in record.entries if e.link == "adm"):
            out.write(entry._replace(received_ns=number * 1_000_000))


if __name__ == "__main__":
    main()
